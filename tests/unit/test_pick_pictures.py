"""Photos as the page shows them: upright, in tiles that fit each other, and the sharpest first."""

import cv2
import numpy as np
import pytest
from PIL import Image

from scenefuse.core.stage import StageError
from scenefuse.photos.photo_files import upright_size
from scenefuse.pick.photo_tiles import BACKGROUND, TILE_PX, Picture, Thumbnails, Tiles, read_upright

GREY = int(BACKGROUND[1:3], 16)


def stripes(width, height):
    """Smooth colours, so that JPEG changes them little."""
    x, y = np.meshgrid(np.linspace(0, 255, width), np.linspace(0, 255, height))
    return np.stack([x, y, 255 - x], axis=2).astype(np.uint8)


def saved(path, pixels, orientation=None):
    exif = Image.Exif()
    if orientation:
        exif[0x0112] = orientation
    Image.fromarray(pixels).save(path, exif=exif, quality=98)
    return Picture(path.name, path, *upright_size(path))


@pytest.mark.parametrize("size", [(700, 500), (200, 90), (256, 256), (300, 1025)])
def test_tiles_of_the_last_zoom_are_the_photo(tmp_path, size):
    picture = saved(tmp_path / "Füße 2.png", stripes(*size))
    tiles, full = Tiles(), np.asarray(Image.open(picture.path))
    columns, rows = (-(-side // TILE_PX) for side in size)
    laid = np.zeros((rows * TILE_PX, columns * TILE_PX, 3), dtype=np.uint8)
    for row in range(rows):
        for column in range(columns):
            data = np.frombuffer(tiles.tile(picture, picture.depth, column, row), dtype=np.uint8)
            place = np.s_[row * TILE_PX : (row + 1) * TILE_PX, column * TILE_PX : (column + 1) * TILE_PX]
            laid[place] = cv2.imdecode(data, cv2.IMREAD_COLOR)[..., ::-1]
    assert np.abs(laid[: size[1], : size[0]].astype(int) - full)[: size[1] - 9, : size[0] - 9].mean() < 2
    assert laid[size[1] + 9 :].size == 0 or abs(laid[size[1] + 9 :].mean() - GREY) < 2


@pytest.mark.parametrize("tile", [(99, 0, 0), (-1, 0, 0), (0, 1, 0), (0, 0, -1), (2, 3, 0)])
def test_a_tile_that_there_is_not_is_none(tmp_path, tile):
    with pytest.raises(IndexError):
        Tiles().tile(saved(tmp_path / "a.png", stripes(700, 500)), *tile)


def test_the_first_tile_holds_the_whole_photo(tmp_path):
    picture = saved(tmp_path / "a.png", stripes(1024, 512))
    tile = cv2.imdecode(np.frombuffer(Tiles().tile(picture, 0, 0, 0), dtype=np.uint8), cv2.IMREAD_COLOR)[..., ::-1]
    assert tile[64, 20, 0] < 30 and tile[64, 240, 0] > 225 and abs(tile[200].mean() - GREY) < 2


@pytest.mark.parametrize("scale", [1.0, 0.4])
def test_places_and_pixels_are_each_other_s_inverse_and_tiles_lie_where_they_belong(scale):
    picture = Picture("a", None, 8660, 5773, scale)
    for pixel in [(0, 0), (8660, 5773), (4321.5, 17.25)]:
        assert np.allclose(picture.pixel(*picture.place(*pixel)), pixel, atol=1e-5)
    assert np.allclose(picture.place(0, 0), (85.05112877980659, -180))
    world = TILE_PX * 2**picture.depth
    assert world >= 8660 * scale > world / 2
    assert np.allclose(picture.place(world / 2 / scale, world / 2 / scale), (0, 0))


@pytest.mark.parametrize("ending", ["jpg", "tif"])
@pytest.mark.parametrize(("orientation", "turned"), [(1, 0), (3, 2), (6, 3), (8, 1)])
def test_rotated_photos_stand_upright_and_sizes_are_as_people_see_them(tmp_path, orientation, turned, ending):
    pixels = stripes(90, 40)
    picture = saved(tmp_path / f"a.{ending}", pixels, orientation)
    upright = read_upright(picture.path, 2000)
    assert (picture.height, picture.width) == upright.shape[:2]
    assert np.abs(upright.astype(int) - np.rot90(pixels, turned)).mean() < 4


@pytest.mark.parametrize("channels", [1, 3])
@pytest.mark.parametrize(("bits", "kind"), [(16, np.uint16), (12, np.uint16), (8, np.uint8), (5, np.uint8)])
def test_grey_and_sixteen_bit_photos_are_shown_by_the_bits_that_they_use(tmp_path, bits, kind, channels):
    ramp = np.linspace(0, 2**bits - 1, 300).astype(kind)[None, :, None].repeat(200, 0).repeat(channels, 2)
    cv2.imwrite(str(tmp_path / "a.png"), ramp)
    assert abs(int(read_upright(tmp_path / "a.png", 2000)[100, 150, 1]) - 127) < 8


def test_a_broken_photo_is_named(tmp_path):
    (tmp_path / "broken.jpg").write_bytes(b"\xff\xd8 no photo")
    for reader in (upright_size, lambda path: read_upright(path, 2000)):
        with pytest.raises(StageError, match=r"broken\.jpg cannot be "):
            reader(tmp_path / "broken.jpg")


def test_the_sharpest_photo_comes_first_and_is_known_the_next_time(tmp_path):
    noise = np.random.default_rng(0).integers(0, 255, (300, 400, 3), dtype=np.uint8)
    pictures = [saved(tmp_path / f"{k}.png", cv2.GaussianBlur(noise, (0, 0), k)) for k in (5, 1, 3)]
    thumbnails = Thumbnails(tmp_path / "cache")
    assert [p.name for p in thumbnails.sharpest_first(pictures)] == ["1.png", "3.png", "5.png"]
    assert all(thumbnails.sharpness(p) is None for p in pictures)
    thumbnails.get(pictures[0])[0].unlink()  # they may be deleted
    first = {p.name: thumbnails.get(p) for p in pictures}
    again = Thumbnails(tmp_path / "cache")
    assert [p.name for p in again.sharpest_first(pictures)] == ["1.png", "3.png", "5.png"]
    assert {p.name: again.get(p) for p in pictures} == first
    assert all(max(Image.open(path).size) == 320 for path, _ in first.values())


def test_a_photo_that_was_replaced_gets_a_new_thumbnail(tmp_path):
    picture = saved(tmp_path / "a.png", stripes(400, 300))
    thumbnails = Thumbnails(tmp_path / "cache")
    before = thumbnails.get(picture)[0]
    saved(tmp_path / "a.png", stripes(400, 300)[::-1].copy()[:299])
    assert thumbnails.sharpness(picture) is None and thumbnails.get(picture)[0] != before

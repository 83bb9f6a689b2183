"""The room that results take on the disk."""

import os

import numpy as np
import pytest
from PIL import Image
from PIL.ExifTags import Base

from scenefuse.core.settings import read_settings
from scenefuse.photos.pictures import write_picture
from scenefuse.report.disk import disk_line, disk_table, forecast, forecast_note, parts_of


@pytest.fixture
def photos(tmp_path):
    folder = tmp_path / "photos"
    folder.mkdir()
    for name in "abc":
        write_picture(folder / f"{name}.png", np.zeros((300, 400, 3), dtype=np.uint8))
    return folder


def test_a_forecast_grows_with_photos_and_maps(photos):
    shipped = read_settings(None)
    row = {"photos": str(photos)}
    scene, thing = forecast("scene", row, shipped), forecast("object", row, shipped)
    # Photos are not enlarged: all maps have the photos' size.
    assert 3 * 400 * 300 * 15 < scene < thing < 3 * 400 * 300 * 150
    for kind, whole in (("scene", scene), ("object", thing)):  # a cloud beside photos saves the maps
        assert forecast(kind, row | {"cloud": "a.ply"}, shipped) < 0.7 * whole
    shipped["object"]["nerf"]["width_px"] = 200
    assert forecast("object", row, shipped) < thing
    (photos / "c.png").unlink()
    assert forecast("scene", row, shipped) == pytest.approx(2 / 3 * scene, abs=1)


def test_a_forecast_counts_the_frames_that_are_used_as_they_are_turned(photos):
    shipped, row = read_settings(None), {"photos": str(photos)}
    shipped["object"]["nerf"]["width_px"] = 200
    thing = forecast("object", row, shipped)
    shipped["object"]["frames"]["frame_step"] = 2
    assert forecast("object", row, shipped) == pytest.approx(2 / 3 * thing, abs=1)
    shipped["object"]["frames"]["max_frames"] = 1
    assert forecast("object", row, shipped) == pytest.approx(1 / 3 * thing, abs=1)
    exif = Image.Exif()
    exif[Base.Orientation] = 6
    Image.new("RGB", (400, 300)).save(photos / "a.jpg", exif=exif)
    (photos / "a.png").unlink()
    # 200 x 267 pixels of maps in the place of 200 x 150.
    assert forecast("object", row, shipped) > 1 / 3 * thing + 50 * 200 * 117


def test_what_cannot_be_told_is_left_to_the_stage_that_needs_it(photos, tmp_path):
    shipped = read_settings(None)
    (photos / "a.png").write_bytes(b"no picture")
    rows = [{"cloud": "x.laz"}, {"photos": str(tmp_path / "none")}, {"photos": str(photos)}, {"photos": "film.mp4"}]
    assert [forecast("object", row, shipped) for row in rows] == [None] * 4


def test_a_note_says_when_the_disk_is_too_small(tmp_path):
    house, dragon, film = (tmp_path / "results" / "objects" / name for name in ("house", "dragon", "film"))
    assert "too little" not in forecast_note({house: 10**6}) and "about 1 MB" in forecast_note({house: 10**6})
    assert "1e+06 TB (0 MB now)" in forecast_note({house: 10**18})
    assert forecast_note({house: 10**18}).endswith("; that is too little: free some space, or set `keep_maps: false`")
    passing = forecast_note({house: 10**18}, keep_maps=False)
    assert "take less than, as maps go (keep_maps: false), 1e+06 TB" in passing and "or set" not in passing
    # What one has too much is no room for the other.
    house.mkdir(parents=True)
    (house / "cloud.ply").write_bytes(bytes(5 * 10**6))
    note = forecast_note({house: 10**6, dragon: 10**18, film: None})
    assert "(5 MB now)" in note and "not counted: film" in note and "too little" in note
    assert forecast_note({film: None}) == ""


def test_parts_are_counted_once_and_links_are_not(tmp_path):
    house = tmp_path / "objects" / "house"
    (house / "stage2" / "maps").mkdir(parents=True)
    (house / "stage2" / "maps" / "a.bin").write_bytes(bytes(2 * 10**6))
    (house / "stage2" / "b.bin").write_bytes(bytes(10**6))
    (house / "fused.ply").write_bytes(bytes(10**6))
    os.symlink(house / "fused.ply", house / "link.ply")
    (house / ".figures.tmp-77").mkdir()
    (house / ".figures.tmp-77" / "a.png").write_bytes(bytes(10**6))
    assert parts_of(house) == {"fused.ply": 10**6, "stage2": 3 * 10**6}
    table = disk_table([house, tmp_path / "objects" / "none"])
    assert table.to_dict("list") == {
        "name": ["objects/house"] * 2,
        "part": ["stage2", "fused.ply"],
        "megabytes": [3.0, 1.0],
    }
    assert disk_line(table, "objects/house") == "4 MB: stage2 3 MB, fused.ply 1 MB"
    assert disk_line(table, "objects/none") == ""

import time
import unicodedata
from dataclasses import replace

import numpy as np
import pycolmap
import pytest
from PIL import Image

from scenefuse.core.stage import StageError
from scenefuse.marks.clicks import Click, Clicks, ScenePoints, check_marks, read_length_clicks, read_points
from scenefuse.marks.triangulation import triangulate, triangulate_consistent

LABELS = "label\tphoto\tx_px\ty_px\n"
POINTS = {"roof": [0.3, -0.2, 0.1], "door": [-0.4, 0.1, 0.3]}


@pytest.fixture(scope="module")
def model():
    """Three cameras with strong distortion, 5 units away, looking at the origin from 0, 30 and 60 degrees."""
    reconstruction = pycolmap.Reconstruction()
    camera = pycolmap.Camera.create_from_model_name(1, "SIMPLE_RADIAL", 500.0, 640, 480)
    camera.params = [500.0, 320.0, 240.0, 0.1]
    reconstruction.add_camera_with_trivial_rig(camera)
    for index, angle in enumerate(np.radians([0.0, 30.0, 60.0]), 1):
        rotation = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(rotation), np.array([0.0, 0.0, 5.0]))
        image = pycolmap.Image(name=f"{index}.jpg", camera_id=1, image_id=index)
        reconstruction.add_image_with_trivial_frame(image, pose)
    return reconstruction


def clicked(model, tmp_path, points=POINTS, photos=("1.jpg", "2.jpg", "3.jpg"), shift=(0.0, 0.0), scale=1.0):
    """Clicks where the model sees the points; `shift` moves the first click."""
    images = {image.name: image for image in model.images.values()}
    marks = [(name, photo, np.array(place)) for name, place in points.items() for photo in photos]
    rows = [Click(name, photo, *(images[photo].project_point(place) * scale)) for name, photo, place in marks]
    rows[0] = replace(rows[0], x_px=rows[0].x_px + shift[0], y_px=rows[0].y_px + shift[1])
    return Clicks(tmp_path / "fiducials.tsv", "points", tuple(rows))


def test_clicks_are_triangulated_through_the_distortion(model, tmp_path):
    names, positions, residuals = triangulate(clicked(model, tmp_path), model, 5.0)
    assert names == ["roof", "door"]
    np.testing.assert_allclose(positions, list(POINTS.values()), atol=1e-7)
    assert residuals.max() < 1e-5


def test_two_noisy_photos_give_a_small_residual(model, tmp_path):
    clicks = clicked(model, tmp_path, photos=("1.jpg", "3.jpg"), shift=(0.0, 2.0))
    _, positions, residuals = triangulate(clicks, model, 5.0)
    # A vertical error of 2 px between two level cameras is split into one pixel each.
    assert residuals[0] == pytest.approx(1.0, abs=0.1)
    assert np.linalg.norm(positions[0] - POINTS["roof"]) < 0.03


def test_a_pixel_of_a_long_lens_weighs_more_than_one_of_a_wide_lens(tmp_path):
    model, angles = pycolmap.Reconstruction(), np.radians([0.0, 90.0, 3.0, 93.0])
    for index, (focal, angle) in enumerate(zip((1500.0, 1500.0, 9000.0, 9000.0), angles), 1):
        camera = pycolmap.Camera.create_from_model_name(index, "SIMPLE_RADIAL", focal, 4000, 3000)
        model.add_camera_with_trivial_rig(camera)
        rotation = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(rotation), np.array([0.0, 0.0, 10.0]))
        image = pycolmap.Image(name=f"{index}.jpg", camera_id=index, image_id=index)
        model.add_image_with_trivial_frame(image, pose)
    clicks, rng = clicked(model, tmp_path, photos=[f"{index}.jpg" for index in range(1, 5)]), np.random.default_rng(0)
    off, missed = [], []
    for _ in range(40):
        noisy = [replace(c, x_px=c.x_px + rng.normal(), y_px=c.y_px + rng.normal()) for c in clicks.rows]
        _, positions, residuals = triangulate(replace(clicks, rows=tuple(noisy)), model, np.inf)
        off.append(positions - list(POINTS.values()))
        missed.append(residuals)
    # Of distances from the rays the least squares lie 0.0055 off, and miss the clicks by 2.7 px.
    assert np.sqrt((np.array(off) ** 2).sum(2).mean()) < 0.0025
    assert np.sqrt((np.array(missed) ** 2).mean()) < 1.3


def test_clicks_in_larger_originals_are_scaled(model, tmp_path):
    clicks = clicked(model, tmp_path, scale=2.0)
    sizes = {f"{i}.jpg": (1280, 960) for i in (1, 2, 3)}
    _, positions, _ = triangulate(clicks, model, 5.0, sizes)
    np.testing.assert_allclose(positions, list(POINTS.values()), atol=1e-7)


def with_click(clicks, index, photo=None, pixel=None):
    x_px, y_px = clicks.pixels[index] if pixel is None else pixel
    changed = replace(clicks.rows[index], photo=photo or clicks.photos[index], x_px=x_px, y_px=y_px)
    return replace(clicks, rows=(*clicks.rows[:index], changed, *clicks.rows[index + 1 :]))


def test_error_sentences_name_the_point(model, tmp_path):
    clicks = clicked(model, tmp_path)
    with pytest.raises(StageError, match=r"point door is clicked in 9\.jpg, which is not among the 3 registered"):
        triangulate(with_click(clicks, 3, photo="9.jpg"), model, 5.0, {f"{i}.jpg": (640, 480) for i in (1, 2, 3)})
    with pytest.raises(StageError, match=r"the click on roof at \(700, 10\) lies outside 2\.jpg, which has 640 x 480"):
        triangulate(with_click(clicks, 1, pixel=[700, 10]), model, 5.0)
    with pytest.raises(StageError, match=r"point door miss each other by .* px\): 1\.jpg .*, 2\.jpg .*, 3\.jpg"):
        triangulate(with_click(clicks, 3, pixel=clicks.pixels[3] + [0, 60]), model, 5.0)
    single = clicked(model, tmp_path, photos=("2.jpg",))
    with pytest.raises(StageError, match=r"roof is clicked in 2\.jpg only; click it in another one"):
        triangulate(single, model, 5.0)


def test_all_points_whose_clicks_miss_each_other_are_named_at_once_or_left_out(model, tmp_path):
    clicks = clicked(model, tmp_path, points=POINTS | {"step": [0.0, 0.3, 0.0]})
    clicks = with_click(with_click(clicks, 0, pixel=[300, 200]), 3, pixel=clicks.pixels[3] + [0, 60])
    with pytest.raises(StageError, match="point roof miss each other by .*; the clicks on point door .* 3.jpg .* px; "):
        triangulate(clicks, model, 5.0)
    names, positions, _, left_out = triangulate_consistent(clicks, model, 5.0)
    assert names == ["step"] and len(left_out) == 2 and "1.jpg 39.1 px" in left_out[1]
    np.testing.assert_allclose(positions, [[0.0, 0.3, 0.0]], atol=1e-7)


def test_a_click_in_a_photo_that_was_not_registered_is_left_out(model, tmp_path):
    sizes = {f"{i}.jpg": (640, 480) for i in range(1, 5)}
    clicks = with_click(clicked(model, tmp_path), 0, photo="4.jpg")
    _, positions, _ = triangulate(clicks, model, 5.0, sizes)
    np.testing.assert_allclose(positions[0], POINTS["roof"], atol=1e-7)
    left_out = triangulate_consistent(clicks, model, 5.0, sizes)[3]
    assert left_out == ["4.jpg could not be registered: its click on point roof"]
    # Of one photo only, the point is left out; the others remain.
    two = with_click(clicked(model, tmp_path, photos=("1.jpg", "2.jpg")), 0, photo="4.jpg")
    with pytest.raises(StageError, match=r"is 1 \(4\.jpg could not be registered\)"):
        triangulate(two, model, 5.0, sizes)
    assert triangulate_consistent(two, model, 5.0, sizes)[0] == ["door"]
    # Where the photos are not known, as in a scene, it may be a wrong name as well.
    left_out = triangulate_consistent(clicks, model, 5.0)[3]
    assert left_out == ["4.jpg could not be registered, or is none of the photos: its click on point roof"]


def test_parallel_rays(model, tmp_path):
    clicks = Clicks(tmp_path / "f.tsv", "points", (Click("p", "1.jpg", 300.0, 200.0),) * 2)
    with pytest.raises(StageError, match="the rays to point p .* are parallel"):
        triangulate(clicks, model, 5.0)


def test_both_kinds_of_file(tmp_path):
    path = tmp_path / "f.tsv"
    path.write_text("point\tphoto\tx_px\ty_px\nroof\ta.jpg\t10\t20.5\n\nroof\tb.jpg\t1\t2\n")
    clicks = read_points(path)
    assert clicks.kind == "points" and clicks.photos == ["a.jpg", "b.jpg"]
    np.testing.assert_array_equal(clicks.pixels, [[10, 20.5], [1, 2]])
    path.write_text("point\tx\ty\tz\na\t1\t2\t3\nb\t4\t5\t6e1\n")
    points = read_points(path)
    assert isinstance(points, ScenePoints) and points.points == ["a", "b"]
    np.testing.assert_array_equal(points.positions, [[1, 2, 3], [4, 5, 60]])


@pytest.mark.parametrize(
    "text, names",
    [
        ("1 2 3\n4 5 60\n", ["1", "2"]),
        ("# of the site\n1;2;3\n\n4; 5; 6e1\n", ["1", "2"]),
        ("1, 2, 3\n4, 5, 60\n", ["1", "2"]),
        ("1\t2\t3\n4\t5\t60\n", ["1", "2"]),
        ("x,y,z\n1,2,3\n4,5,60\n", ["1", "2"]),
        ("point x y z\na 1 2 3\nb  4 5 60\n", ["a", "b"]),
        ("a 1 2 3\nb 4 5 60\n", ["a", "b"]),
        ("Point #0,1,2,3\nPoint #1,4,5,60\n", ["Point #0", "Point #1"]),
        ("point,x,y,z\na,1,2,3\nb,4,5,60\n", ["a", "b"]),
    ],
)
def test_scene_points_as_other_programs_write_them(tmp_path, text, names):
    path = tmp_path / "f.txt"
    path.write_text(text)
    points = read_points(path)
    assert isinstance(points, ScenePoints) and points.points == names
    np.testing.assert_array_equal(points.positions, [[1, 2, 3], [4, 5, 60]])


@pytest.mark.parametrize(
    "text, sentence",
    [
        ("", "has to begin with the tab-separated header"),
        ("name x y z\na 1 2 3\n", "has to begin with the tab-separated header"),
        ("point photo x_px y_px\na 1.jpg 2 3\n", "separate its columns by tabs"),
        ("1 2 3\n4 5\n", "line 2: expected x y z, perhaps behind a name, got '4 5'"),
        ("1;2;3\n4,5;5;6\n", r"line 2: expected x y z.* 4,5 has a decimal comma, write 4\.5"),
        ("1,5;2;3\n", r"1,5 has a decimal comma, write 1\.5"),
        ("a 1 2 3\na 4 5 6\n", "a is given more than once"),
        ("1 2 3\n4 5 nan\n", "line 2: expected x y z"),
        ("1 2 3 4 5\n", "has to begin with"),
        ("x y z\n", "holds no points below its header"),
        ("point\tx\ty\tz\n", "holds no points below its header"),
        ("point\tx\ty\tz\na\t1\t2\n", "line 2: expected x y z, perhaps behind a name, got 'a 1 2'"),
        ("point\tx\ty\tz\na\t1\t2\tnan\n", "line 2"),
        ("point\tphoto\tx_px\ty_px\na\tp.jpg\t1\ttwo\n", "line 2"),
        ("point\tphoto\tx_px\ty_px\na\tp.jpg\t1\t2\na\tp.jpg\t3\t4\n", "a in p.jpg is given more than once"),
    ],
)
def test_bad_files(tmp_path, text, sentence):
    path = tmp_path / "f.tsv"
    path.write_text(text)
    with pytest.raises(StageError, match=sentence):
        read_points(path)


def test_any_cloud_marks_an_object_in_time_that_grows_with_its_points(tmp_path):
    rows = np.arange(120_000.0).reshape(-1, 3)
    np.savetxt(tmp_path / "marks.xyz", rows)
    start = time.process_time()
    assert np.array_equal(read_points(tmp_path / "marks.xyz").positions, rows)
    assert time.process_time() - start < 20


def test_a_file_from_a_spreadsheet_is_read_as_the_tables_are(tmp_path):
    path, lines = tmp_path / "f.tsv", LABELS + "inside\tIMG, 7.JPG\t690\t180\n"
    quoted = lines.replace("IMG, 7.JPG", '"IMG, 7.JPG"')
    for content in (
        lines.replace("\n", "\r\n").encode("utf-16"),
        lines.encode("utf-8-sig"),
        lines.replace("\n", "\t \t\n").encode(),
        (quoted + "\t\t\t\n").encode(),
    ):
        path.write_bytes(content)
        marked = read_points(path)
        assert (marked.photos, marked.pixels.tolist()) == (["IMG, 7.JPG"], [[690, 180]])
    path.write_bytes(lines.replace("IMG", "König").encode("cp1252"))
    with pytest.raises(StageError, match="line 2: not UTF-8 text; save it as UTF-8"):
        read_points(path)


def test_a_decimal_comma_is_named(tmp_path):
    path = tmp_path / "f.tsv"
    path.write_text(LABELS + "inside\tIMG_1,2.JPG\t10\t20\ninside\tIMG 7.JPG\t690,5\t180\n")
    with pytest.raises(StageError, match=r"line 3: expected .* got '.*'; 690,5 has a decimal comma, write 690\.5$"):
        read_points(path)
    path.write_text("length\tmetres\tend\tphoto\tx_px\ty_px\nbar\t1,5\ta\t1.jpg\t3\t4\n")
    with pytest.raises(StageError, match=r"line 2: .*; 1,5 has a decimal comma, write 1\.5$"):
        read_length_clicks(path)


def test_umlauts_in_two_spellings_are_one_photo(model, tmp_path):
    model = pycolmap.Reconstruction(model)
    for image in model.images.values():
        image.name = unicodedata.normalize("NFD", f"Gebäude {image.name}")
    sizes = {image.name: (640, 480) for image in model.images.values()}
    plain = clicked(model, tmp_path, photos=tuple(sizes))
    clicks = replace(plain, rows=tuple(replace(c, photo=unicodedata.normalize("NFC", c.photo)) for c in plain.rows))
    assert clicks.photos != plain.photos
    for known in (None, sizes):
        np.testing.assert_allclose(triangulate(clicks, model, 5.0, known)[1], list(POINTS.values()), atol=1e-7)


def test_clicks_in_photos_that_will_not_be_there_are_named_before_anything_runs(tmp_path):
    path, photos = tmp_path / "f.tsv", {f"{k}.jpg": tmp_path / f"{k}.jpg" for k in range(1, 6)}
    exif = Image.Exif()
    exif[0x0112] = 6
    for file in photos.values():
        Image.new("RGB", (40, 30)).save(file, exif=exif)  # stored on its side
    path.write_text(LABELS + "inside\t3.jpg\t1\t2\noutside\t4.jpg\t1\t2\n")
    check_marks(path, photos)
    check_marks(path)
    with pytest.raises(
        StageError,
        match=r"the click outside at \(1, 2\) is in 4\.jpg, which is none of the 3 photos \(1\.jpg, \.\.\.\)",
    ):
        check_marks(path, dict(list(photos.items())[:3]))
    with pytest.raises(
        StageError, match=r"in 4\.jpg, but only 3 of the 5 photos are used .* max_frames to 5 and frame_s"
    ):
        check_marks(path, photos, list(photos)[::2])
    path.write_text(LABELS + "inside\t3.jpg\t29\t39\nbox\t4.jpg\t1\t2\nbox\t4.jpg\t35\t12\n")
    with pytest.raises(
        StageError, match=r"box at \(35, 12\) lies outside 4\.jpg, which has 30 x 40 pixels; correct the click"
    ):
        check_marks(path, photos)
    photos["3.jpg"].write_bytes(b"cut")
    with pytest.raises(StageError, match=r"3\.jpg cannot be decoded"):
        check_marks(path, photos)
    path.write_text("point\tx\ty\tz\na\t1\t2\t3\n")
    check_marks(path, photos)
    path.write_text("point\tphoto\tx_px\ty_px\na\t1.jpg\t1\t2\na\t9.jpg\t1\t2\n")
    with pytest.raises(StageError, match=r"the click on a at \(1, 2\) is in 9\.jpg"):
        check_marks(path, photos)
    path.write_text("point\tphoto\tx_px\ty_px\nroof\t1.jpg\t1\t2\nrof\t2.jpg\t1\t2\n")
    with pytest.raises(StageError, match=r"roof is clicked in 1\.jpg only"):
        check_marks(path)


def test_a_click_in_a_smaller_copy_that_is_left_out_is_not_taken_for_one_in_its_original(tmp_path):
    for name, size in (("p/1.jpg", (40, 30)), ("p/web/1.jpg", (20, 15)), ("p/same/1.jpg", (40, 30))):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        Image.new("RGB", size).save(tmp_path / name)
    photos, path = {"1.jpg": tmp_path / "p/1.jpg"}, tmp_path / "clicks.tsv"
    for name in ("1.jpg", "p/1.jpg", "same/1.jpg"):
        path.write_text(f"{LABELS}inside\t{name}\t9\t9\n")
        check_marks(path, photos)
    path.write_text(f"{LABELS}inside\tweb/1.jpg\t9\t9\n")
    with pytest.raises(StageError, match=r"at \(9, 9\) is in web/1.jpg, a smaller copy of 1.jpg; click in that one"):
        check_marks(path, photos)


@pytest.mark.parametrize(
    ("rows", "sentence"),
    [
        ("outside\t3.jpg\t1\t2\n", "holds only clicks outside the object"),
        ("inside\t3.jpg\t1\t2\nbox\t3.jpg\t5\t6\n", r"a box needs two lines, .*; in 3\.jpg there are 1"),
    ],
)
def test_clicks_that_say_nothing_are_named_before_anything_runs(tmp_path, rows, sentence):
    (tmp_path / "f.tsv").write_text(LABELS + rows)
    with pytest.raises(StageError, match=sentence):
        check_marks(tmp_path / "f.tsv")


def test_missing_file(tmp_path):
    with pytest.raises(StageError, match=r"f\.tsv does not exist"):
        read_points(tmp_path / "f.tsv")

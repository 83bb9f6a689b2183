"""What a run will take, before it begins."""

import shutil

import numpy as np
import pytest
from PIL import Image
from PIL.ExifTags import GPS, IFD, Base
from support.user_project import film

from scenefuse.core.settings import read_settings
from scenefuse.core.stage import StageError
from scenefuse.photos.pictures import write_picture
from scenefuse.report.forecast import Photos, disk_bytes, forecast_lines, job_seconds, read_forecast, write_forecast

JOBS, MEMORY = {"map_scene_photos": 1800.0, "make_masks": 600.0}, {"map_scene_photos": 4000, "make_masks": 2000}


def lines(needed, keep_maps=True, memory=MEMORY):
    return forecast_lines(JOBS, 2, memory, 8000, needed, keep_maps)


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
    scene, thing = disk_bytes("scene", row, shipped), disk_bytes("object", row, shipped)
    # Photos are not enlarged: all maps have the photos' size.
    assert 3 * 400 * 300 * 15 < scene < thing < 3 * 400 * 300 * 150
    for kind, whole in (("scene", scene), ("object", thing)):  # a cloud beside photos saves the maps
        assert disk_bytes(kind, row | {"cloud": "a.ply"}, shipped) < 0.7 * whole
    shipped["object"]["nerf"]["width_px"] = 200
    assert disk_bytes("object", row, shipped) < thing
    (photos / "c.png").unlink()
    assert disk_bytes("scene", row, shipped) == pytest.approx(2 / 3 * scene, abs=1)


def test_a_forecast_counts_the_frames_that_are_used_as_they_are_turned(photos):
    shipped, row = read_settings(None), {"photos": str(photos)}
    shipped["object"]["nerf"]["width_px"] = 200
    thing = disk_bytes("object", row, shipped)
    shipped["object"]["frames"]["frame_step"] = 2
    assert disk_bytes("object", row, shipped) == pytest.approx(2 / 3 * thing, abs=1)
    shipped["object"]["frames"]["max_frames"] = 1
    assert disk_bytes("object", row, shipped) == pytest.approx(1 / 3 * thing, abs=1)
    exif = Image.Exif()
    exif[Base.Orientation] = 6
    Image.new("RGB", (400, 300)).save(photos / "a.jpg", exif=exif)
    (photos / "a.png").unlink()
    # 200 x 267 pixels of maps in the place of 200 x 150.
    assert disk_bytes("object", row, shipped) > 1 / 3 * thing + 50 * 200 * 117


def test_a_forecast_counts_the_frames_that_are_taken_of_a_video(tmp_path):
    shipped, row = read_settings(None), {"photos": str(film(tmp_path / "film.mp4", 12, (400, 300)))}
    assert Photos.of("scene", row, shipped) == Photos.of("object", row, shipped) == Photos(12, 400, 300, True)
    shipped["scene"]["frames"]["max_frames"] = 5
    assert Photos.of("scene", row, shipped) == Photos(5, 400, 300, True)
    (tmp_path / "film.mp4").write_bytes(b"no video")
    assert Photos.of("scene", row, shipped) is None


def test_what_cannot_be_told_is_left_to_the_stage_that_needs_it(photos, tmp_path):
    shipped = read_settings(None)
    (photos / "a.png").write_bytes(b"no picture")
    rows = [{"cloud": "x.laz"}, {"photos": str(tmp_path / "none")}, {"photos": str(photos)}, {"photos": "film.mp4"}]
    assert [disk_bytes("object", row, shipped) for row in rows] == [None] * 4


def test_a_line_says_when_the_disk_is_too_small_and_a_run_that_cannot_fit_is_refused(tmp_path):
    house, dragon, film = (tmp_path / "results" / "objects" / name for name in ("house", "dragon", "film"))
    free = shutil.disk_usage(tmp_path).free
    disk = lines({house: 10**6})[-1]
    assert "too little" not in disk and "about 1 MB (0 MB now)" in disk
    assert "about 554 MB (0 MB now)" in lines({house: 554 * 10**6})[-1]
    assert lines({house: int(1.2 * free)})[-1].endswith(
        "; that is too little: free some space, or set `keep_maps: false`"
    )
    with pytest.raises(StageError, match=r"1e\+06 TB.*that cannot do: free some space, or set `keep_maps: false`"):
        lines({house: 10**18})
    passing = lines({house: 10**18}, keep_maps=False)[-1]
    assert "take less than, as maps go (keep_maps: false), 1e+06 TB" in passing and "or set" not in passing
    # What one has too much is no room for the other.
    house.mkdir(parents=True)
    (house / "cloud.ply").write_bytes(bytes(5 * 10**6))
    note = lines({house: 10**6, dragon: int(1.2 * free), film: None})[-1]
    assert "(5 MB now)" in note and "too little" in note
    assert len(lines({film: None})) == 2 and "without those that have no photos: film" in lines({film: None})[0]


def test_time_and_memory_are_said_with_the_steps_that_take_most(tmp_path):
    time, memory = lines({})
    # 2400 s of one core on two, which wait for each other now and then.
    assert time.startswith("time: about 23 min on 2 cores") and "map_scene_photos, make_masks" in time
    assert memory == "memory: up to 4 GB in one job (map_scene_photos)"
    assert "this machine has 8 GB" in lines({}, memory=MEMORY | {"make_masks": 9000})[1]


def test_the_time_of_a_step_grows_with_what_it_works_on(photos, tmp_path):
    shipped, row = read_settings(None), {"photos": str(photos)}
    once = job_seconds("object", row, shipped)
    for name in "defghij":
        (photos / f"{name}.png").write_bytes((photos / "a.png").read_bytes())
    more = job_seconds("object", row, shipped)
    assert more["make_masks"] > 2 * once["make_masks"] and more["train_object_nerf"] == once["train_object_nerf"]
    assert more["match_object_features"] - 4 == pytest.approx(
        15 * (once["match_object_features"] - 4)
    )  # 45 pairs, not 3
    shipped["object"]["features"]["max_features"] *= 2
    twice = job_seconds("object", row, shipped)
    assert twice["match_object_features"] - 4 == pytest.approx(4 * (more["match_object_features"] - 4))
    assert job_seconds("object", {"cloud": "house.ply"}, shipped) == {}


def test_photos_with_gps_are_compared_with_their_neighbours_only(photos):
    shipped, row = read_settings(None), {"photos": str(photos)}
    for k in range(97):
        (photos / f"b{k}.png").write_bytes((photos / "a.png").read_bytes())
    every = job_seconds("scene", row, shipped)["match_scene_features"] - 4
    exif = Image.Exif()
    exif.get_ifd(IFD.GPSInfo)[GPS.GPSLatitude] = (48.0, 0.0, 0.0)
    Image.new("RGB", (400, 300)).save(photos / "a.jpg", exif=exif)
    (photos / "a.png").unlink()
    near = job_seconds("scene", row, shipped)["match_scene_features"] - 4
    assert near == pytest.approx(every * 1200 / 4950)


def test_a_forecast_is_that_of_the_last_run(tmp_path):
    path = tmp_path / "summary/forecast.tsv"
    path.parent.mkdir()
    assert read_forecast(path) == {}
    write_forecast(path, {"benchmarks/a/x.tsv": 10.0})
    write_forecast(path, {"benchmarks/b/x.tsv": 20.0})
    assert read_forecast(path) == {"benchmarks/b/x.tsv": 20.0}
    path.write_text("cut")
    assert read_forecast(path) == {}


@pytest.mark.parametrize(("kind", "name", "count"), [("scene", "scene", 60), ("object", "house", 40)])
def test_photos_that_the_demo_is_yet_to_render_are_counted(tmp_path, monkeypatch, kind, name, count):
    monkeypatch.chdir(tmp_path)
    row, shipped = {"photos": f"results/demo/demo/{name}/photos"}, read_settings(None)
    planned = Photos.of(kind, row, shipped)
    width = 800 if kind == "scene" else 640
    assert planned == Photos(count, width, 3 * width // 4, kind == "scene")
    assert job_seconds(kind, row, shipped) and disk_bytes(kind, row, shipped)
    assert Photos.of(kind, {"photos": "elsewhere"}, shipped) is None

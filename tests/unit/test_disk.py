"""The room that results take on the disk."""

import os

import numpy as np
import pytest

from scenefuse.io.pictures import write_picture
from scenefuse.io.settings import read_settings
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
    shipped["object"]["nerf"]["width_px"] = 200
    assert forecast("object", row, shipped) < thing
    (photos / "c.png").unlink()
    assert forecast("scene", row, shipped) == pytest.approx(2 / 3 * scene, abs=1)


def test_what_cannot_be_told_is_left_to_the_stage_that_needs_it(photos, tmp_path):
    shipped = read_settings(None)
    (photos / "a.png").write_bytes(b"no picture")
    rows = [{"cloud": "x.laz"}, {"photos": str(tmp_path / "none")}, {"photos": str(photos)}, {"photos": "film.mp4"}]
    assert [forecast("object", row, shipped) for row in rows] == [0, 0, 0, 0]


def test_a_note_says_when_the_disk_is_too_small(tmp_path):
    results = tmp_path / "results"
    assert "too little" not in forecast_note(10**6, results) and "1 MB" in forecast_note(10**6, results)
    assert "that is too little: free some space" in forecast_note(10**18, results)
    results.mkdir()
    (results / "cloud.ply").write_bytes(bytes(5 * 10**6))
    assert "(5 MB now)" in forecast_note(10**6, results)


def test_parts_are_counted_once_and_links_are_not(tmp_path):
    house = tmp_path / "objects" / "house"
    (house / "stage2" / "maps").mkdir(parents=True)
    (house / "stage2" / "maps" / "a.bin").write_bytes(bytes(2 * 10**6))
    (house / "stage2" / "b.bin").write_bytes(bytes(10**6))
    (house / "fused.ply").write_bytes(bytes(10**6))
    os.symlink(house / "fused.ply", house / "link.ply")
    assert parts_of(house) == {"fused.ply": 10**6, "stage2": 3 * 10**6}
    table = disk_table([house, tmp_path / "objects" / "none"])
    assert table.to_dict("list") == {
        "name": ["objects/house"] * 2,
        "part": ["stage2", "fused.ply"],
        "megabytes": [3.0, 1.0],
    }
    assert disk_line(table, "objects/house") == "4 MB: stage2 3 MB, fused.ply 1 MB"
    assert disk_line(table, "objects/none") == ""

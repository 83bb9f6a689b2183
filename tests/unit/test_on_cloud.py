"""Photos laid on a cloud in a CRS: GPS brings them near, the cloud's surface the rest of the way."""

from dataclasses import replace

import numpy as np
import pycolmap
import pyproj
import pytest
from support.surveyed import FRAME, fly, gcp_lines, write_inputs

from scenefuse.io.clouds import Cloud, read_cloud, write_cloud, write_laz
from scenefuse.sfm.geodesy import scene_frame
from scenefuse.sfm.georeference import camera_poses, georegister
from scenefuse.sfm.given.cloud import import_posed_cloud
from scenefuse.sfm.survey.placement import GeoreferenceSettings
from scenefuse.stage import StageError, read_json, value

FLIGHT = fly()
BESIDE = np.array([2.5, -1.5, 47.0])
"""How far the photos' GPS is off in east, north and height, which counts from the ellipsoid."""


def field(count=60000, upside_down=False):
    """The hilly field under the flight as a laser scanner has it: easting, northing and height in UTM."""
    x, y = np.random.default_rng(1).uniform([-50, -35], [50, 35], (count, 2)).T
    height = 3 * np.sin(x / 15) + 2 * np.cos(y / 11)
    latitude, longitude, height = FRAME.inverse(np.stack([x, y, -height if upside_down else height], axis=1)).T
    easting, northing = pyproj.Transformer.from_crs(4326, 32632, always_xy=True).transform(longitude, latitude)
    return np.stack([easting, northing, height], axis=1)


def flown(folder, noise_m=1.5, beside=BESIDE):
    """What georeferencing reads, with positions that are off by noise and all alike."""
    photos = FLIGHT.photos(noise_m=noise_m)
    there = FRAME.inverse(
        FRAME.apply(np.array([[p.latitude_deg, p.longitude_deg, p.altitude_m] for p in photos])) + beside
    )
    names = ("latitude_deg", "longitude_deg", "altitude_m")
    write_inputs(
        folder, FLIGHT.model(), [replace(p, **dict(zip(names, row))) for p, row in zip(photos, there.tolist())]
    )


def without_gps():
    return [replace(photo, latitude_deg=None, longitude_deg=None) for photo in FLIGHT.photos()]


def written(folder, points, crs="EPSG:32632"):
    write_laz(folder / "scan.laz", Cloud(points - points[0]), points[0], crs)
    return folder / "scan.laz"


def laid(folder, cloud, **more):
    """The content of georeference.json, and of the imported cloud its points and its report."""
    georegister(
        sparse=folder / "sparse",
        sparse_json=folder / "sparse.json",
        photos=folder / "photos.json",
        cloud=cloud,
        georeferenced=folder / "georeferenced",
        residuals=folder / "residuals.tsv",
        report=folder / "georeference.json",
        settings=GeoreferenceSettings(),
        seed=0,
        **more,
    )
    import_posed_cloud(
        source=cloud,
        sparse=folder / "georeferenced",
        georeference_json=folder / "georeference.json",
        crs=more.get("crs"),
        cloud=folder / "dense.ply",
        report=folder / "dense.json",
    )
    return read_json(folder / "georeference.json"), read_cloud(folder / "dense.ply"), read_json(folder / "dense.json")


def cameras_off(folder, content):
    """(N,) metres that the cameras are off the truth."""
    names, _, centres = camera_poses(pycolmap.Reconstruction(folder / "georeferenced"))
    truth = scene_frame(content).apply(FRAME.inverse(FLIGHT.centres))
    return np.linalg.norm(centres - truth[[FLIGHT.names.index(name) for name in names]], axis=1)


def test_photos_come_to_lie_on_a_scan_that_their_gps_is_metres_off(tmp_path):
    flown(tmp_path)
    points = field()
    content, dense, report = laid(tmp_path, written(tmp_path, points))
    assert np.median(cameras_off(tmp_path, content)) < 0.25  # of 47 m
    np.testing.assert_allclose(scene_frame(content).in_crs(dense.points), points, atol=1e-3)
    assert value(content, "crs") == value(report, "crs") == "EPSG:32632" and value(report, "met_share") > 0.35
    assert "by GPS; then laid on scan.laz" in value(content, "reason")
    moved = np.array(value(content, "laid_on_cloud_by"))
    assert abs(np.linalg.norm(moved[:2, 3]) - np.linalg.norm(BESIDE[:2])) < 1.5 and abs(moved[2, 3] + BESIDE[2]) < 2
    # The positions' common shift is no error of a position.
    assert value(content, "gps_residual_median_m") < 4


def test_a_cloud_that_names_no_crs_takes_the_table_s(tmp_path):
    flown(tmp_path)
    write_cloud(tmp_path / "scan.ply", Cloud(field()))
    with pytest.raises(StageError, match="scan.ply names no CRS, .*: fill the column crs, or give the cameras"):
        laid(tmp_path, tmp_path / "scan.ply")
    content, _, _ = laid(tmp_path, tmp_path / "scan.ply", crs="EPSG:32632")
    assert np.median(cameras_off(tmp_path, content)) < 0.25


def test_control_points_place_photos_without_gps_on_a_scan(tmp_path):
    write_inputs(tmp_path, FLIGHT.model(), without_gps())
    lines = gcp_lines(FLIGHT, FLIGHT.ground[:6], list("abcdef"))
    (tmp_path / "gcp_list.txt").write_text("\n".join(lines) + "\n")
    content, _, report = laid(tmp_path, written(tmp_path, field()), control=tmp_path / "gcp_list.txt")
    assert np.median(cameras_off(tmp_path, content)) < 0.15 and "so they fit scan.laz" in value(content, "reason")
    assert np.array_equal(value(content, "laid_on_cloud_by"), np.eye(4)) and value(report, "met_share") > 0.35


@pytest.mark.parametrize(
    "points, crs, sentence",
    [
        (field() + [30_000, 0, 0], "EPSG:32632", "scan.laz lies 30 km from where its photos were taken"),
        (field(upside_down=True), "EPSG:32632", "photos were laid on .*scan.laz, and do not fit it: only"),
        (field(), "EPSG:32618", "does not lie in WGS 84 / UTM zone 18N|km from where its photos were taken"),
    ],
    ids=["elsewhere", "another surface", "another zone"],
)
def test_a_cloud_of_another_scene_is_one_sentence(tmp_path, points, crs, sentence):
    flown(tmp_path)
    with pytest.raises(StageError, match=sentence):
        laid(tmp_path, written(tmp_path, points, crs))
    assert not (tmp_path / "dense.ply").exists()


def test_photos_that_nothing_places_are_one_sentence(tmp_path):
    write_inputs(tmp_path, FLIGHT.model(), without_gps())
    with pytest.raises(StageError, match="nothing says where the photos lie in .*scan.laz: 0 registered photos"):
        laid(tmp_path, written(tmp_path, field()))
    assert not (tmp_path / "georeferenced").exists()

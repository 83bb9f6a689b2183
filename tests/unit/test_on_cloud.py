"""Photos laid on a cloud in a CRS: GPS brings them near, the cloud's surface the rest of the way."""

from dataclasses import replace

import numpy as np
import pycolmap
import pyproj
import pytest
from support.surveyed import FRAME, fly, gcp_lines, write_inputs

from scenefuse.cloud.clouds import Cloud, read_cloud, write_cloud
from scenefuse.cloud.write_las import write_laz
from scenefuse.core.stage import StageError, read_json, value
from scenefuse.core.transforms import Sim3
from scenefuse.crop.crop_cloud import CropSettings
from scenefuse.crop.crop_scene import CropInputs, crop_scene
from scenefuse.geometry.icp import refine_on_cloud
from scenefuse.georef.georeference import camera_poses, georegister
from scenefuse.georef.given_cloud import import_posed_cloud
from scenefuse.georef.placement import GeoreferenceSettings
from scenefuse.photos.geodesy import scene_frame

FLIGHT = fly()
BESIDE = np.array([2.5, -1.5, 47.0])
"""How far the photos' GPS is off in east, north and height, which counts from the ellipsoid."""


def field(count=60000, upside_down=False, low=(-50, -35), high=(50, 35)):
    """The hilly field under the flight as a laser scanner has it: easting, northing and height in UTM."""
    x, y = np.random.default_rng(1).uniform(low, high, (count, 2)).T
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


@pytest.mark.slow
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
    # The positions' common shift is no error of a position, and known: photos to be taken are told in GPS heights.
    assert abs(value(content, "gps_shift")[2] - BESIDE[2]) < 1
    assert value(content, "gps_residual_median_m") < 4


@pytest.mark.slow
@pytest.mark.parametrize(
    ("extent", "most_m"),
    [
        ({"count": 400_000, "low": (-130, -100), "high": (130, 100)}, 0.25),
        ({"low": (0, -35)}, 0.6),
        ({"low": (-32, -22), "high": (32, 22)}, 0.6),
    ],
    ids=["a tile around the flight", "its eastern half", "40 % of it"],
)
def test_a_scan_may_be_larger_or_smaller_than_what_the_photos_show(tmp_path, extent, most_m):
    flown(tmp_path)
    content, dense, _ = laid(tmp_path, written(tmp_path, field(**extent)))
    assert np.median(cameras_off(tmp_path, content)) < most_m and value(content, "seen_share") > 0.5
    assert len(dense) == extent.get("count", 60000)


def test_a_scan_that_shows_next_to_nothing_of_the_scene_is_one_sentence(tmp_path):
    flown(tmp_path)
    with pytest.raises(StageError, match="of the .* points that the photos' matches give lie over .*, 50 are needed"):
        laid(tmp_path, written(tmp_path, field(low=(-8, -6), high=(8, 6))))


@pytest.mark.slow
def test_heights_keep_the_name_of_their_zero_and_a_table_that_contradicts_the_file_is_refused(tmp_path):
    flown(tmp_path)
    content, _, report = laid(tmp_path, written(tmp_path, field(), "EPSG:32632+5773"))
    assert "EGM96 height" in value(content, "crs") and "EGM96 height" in value(report, "crs")
    with pytest.raises(StageError, match="is in .*, but the column crs says WGS 84 / UTM zone 33N"):
        laid(tmp_path, tmp_path / "scan.laz", crs="EPSG:32633")


@pytest.mark.slow
def test_a_user_s_points_are_in_the_scan_s_coordinates(tmp_path):
    flown(tmp_path)
    _, dense, _ = laid(tmp_path, written(tmp_path, field()))
    corners = [[-5, -5], [5, -5], [-5, 5], [5, 5]]
    middle = field().mean(0)
    chosen = [int(np.linalg.norm(field()[:, :2] - middle[:2] - corner, axis=1).argmin()) for corner in corners]
    rows = [f"p{k}\t{x:.3f}\t{y:.3f}\t{z:.3f}\n" for k, (x, y, z) in enumerate(field()[chosen].tolist())]
    (tmp_path / "points.tsv").write_text("point\tx\ty\tz\n" + "".join(rows))
    inputs = CropInputs(
        scene=tmp_path / "dense.ply",
        sparse=tmp_path / "georeferenced",
        georeference_json=tmp_path / "georeference.json",
        fiducials=tmp_path / "points.tsv",
    )
    settings = CropSettings(remove_ground=False)
    crop_scene(inputs=inputs, crop=tmp_path / "crop.ply", report=tmp_path / "crop.json", settings=settings)
    np.testing.assert_allclose(value(read_json(tmp_path / "crop.json"), "fiducials"), dense.points[chosen], atol=2e-3)


@pytest.mark.slow
def test_a_cloud_that_names_no_crs_takes_the_table_s(tmp_path):
    flown(tmp_path)
    write_cloud(tmp_path / "scan.ply", Cloud(field()))
    with pytest.raises(StageError, match="scan.ply names no CRS, .*: fill the column crs, or give the cameras"):
        laid(tmp_path, tmp_path / "scan.ply")
    content, _, _ = laid(tmp_path, tmp_path / "scan.ply", crs="WGS84 UTM 32N")
    assert np.median(cameras_off(tmp_path, content)) < 0.25


def test_control_points_place_photos_without_gps_on_a_scan(tmp_path):
    write_inputs(tmp_path, FLIGHT.model(), without_gps())
    lines = gcp_lines(FLIGHT, FLIGHT.ground[:6], list("abcdef"))
    (tmp_path / "gcp_list.txt").write_text("\n".join(lines) + "\n")
    content, _, report = laid(tmp_path, written(tmp_path, field()), control=tmp_path / "gcp_list.txt")
    assert np.median(cameras_off(tmp_path, content)) < 0.15 and "so they fit scan.laz" in value(content, "reason")
    assert np.array_equal(value(content, "laid_on_cloud_by"), np.eye(4)) and value(report, "met_share") > 0.35


@pytest.mark.slow
@pytest.mark.parametrize(
    "points, crs, sentence",
    [
        (
            field() + [30_000, 0, 0],
            "EPSG:32632",
            "scan.laz has 0 points where its photos were taken, and its middle lies 30 km",
        ),
        (field(upside_down=True), "EPSG:32632", "laid on .*scan.laz, and do not fit it: only"),
        (field(), "EPSG:32618", "does not lie in WGS 84 / UTM zone 18N|km from there"),
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


@pytest.mark.parametrize("relief", [1.0, 0.0], ids=["hilly", "flat"])
def test_a_model_s_noise_is_no_relief_by_which_a_cloud_shrinks_it(relief):
    rng = np.random.default_rng(0)
    (x, y), (u, v) = (rng.uniform((-r, -r), (r, r), (n, 2)).T for r, n in ((50, 30000), (40, 300)))
    cloud, own = (np.stack([x, y, relief * (3 * np.sin(x / 15) + 2 * np.cos(y / 11))], 1) for x, y in ((x, y), (u, v)))
    own += rng.normal(0, [0.03, 0.03, 0.2], own.shape)
    start = Sim3(1.01, np.eye(3), np.array([1.0, -0.5, 0.3]))
    found = refine_on_cloud(start.apply(own), cloud + rng.normal(0, 0.01, cloud.shape)) @ start
    off = found.apply(np.zeros(3))
    # What the flat cloud does not say stays as it was.
    wanted, most = (Sim3.identity(), 0.3) if relief else (start, 0.6)
    assert np.log(found.scale / wanted.scale) == pytest.approx(0.0, abs=0.006)
    assert np.abs(off - wanted.translation)[:2].max() < most and abs(off[2]) < 0.1

"""A cloud in the coordinates of given cameras: it goes where these went, and a cloud from elsewhere is refused."""

import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import laspy
import numpy as np
import pycolmap
import pyproj
import pytest
from support.cloud_files import UTM
from support.surveyed import FRAME, MODEL_FROM_LOCAL, fly, on_earth, write_inputs

from scenefuse.cloud.clouds import Cloud, read_cloud, write_cloud
from scenefuse.cloud.write_las import write_laz
from scenefuse.core.stage import StageError, quantity, read_json, value, write_json
from scenefuse.core.transforms import fit_sim3
from scenefuse.fuse.write import frame_ledger
from scenefuse.georef.georeference import camera_poses, georegister
from scenefuse.georef.given_cloud import import_posed_cloud
from scenefuse.georef.placement import GeoreferenceSettings
from scenefuse.photos.geodesy import scene_frame
from scenefuse.photos.photos import write_photos
from scenefuse.photos.workspace import read_views

FLIGHT = fly()
SCALE = 2.5


def field(count=6000, seed=1):
    """The hilly field under the flight, east, north and up in metres, with normals."""
    x, y = np.random.default_rng(seed).uniform([-45, -30], [45, 30], (count, 2)).T
    normals = np.stack([-np.cos(x / 15) / 5, 2 * np.sin(y / 11) / 11, np.ones(count)], axis=1)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return Cloud(np.stack([x, y, 3 * np.sin(x / 15) + 2 * np.cos(y / 11)], axis=1), normals.astype(np.float32))


@pytest.fixture
def given(tmp_path):
    """A folder with given cameras, and the field as a cloud in their coordinates."""
    write_inputs(tmp_path, FLIGHT.model(), FLIGHT.photos(noise_m=0.1))
    write_cloud(tmp_path / "cloud.ply", field().transformed(MODEL_FROM_LOCAL))
    return tmp_path


def imported(folder, source=None, **more):
    """The imported cloud and its report."""
    files = {name: folder / name for name in ("sparse", "sparse.json")}
    out = {"cloud": folder / "out.ply", "report": folder / "out.json"}
    source = source or folder / "cloud.ply"
    import_posed_cloud(source=source, sparse=files["sparse"], sparse_json=files["sparse.json"], **out, **more)
    return read_cloud(out["cloud"]), read_json(out["report"])


def georeferenced(folder):
    georegister(
        sparse=folder / "sparse",
        sparse_json=folder / "sparse.json",
        photos=folder / "photos.json",
        held=True,
        georeferenced=folder / "georeferenced",
        residuals=folder / "residuals.tsv",
        report=folder / "georeference.json",
        settings=GeoreferenceSettings(),
        seed=0,
    )


def test_a_scene_s_cloud_goes_where_georeferencing_took_its_cameras(given):
    georeferenced(given)
    cloud, report = imported(given, georeference_json=given / "georeference.json")
    place = read_json(given / "georeference.json")
    truth = scene_frame(place).apply(FRAME.inverse(field().points))
    assert np.median(np.linalg.norm(cloud.points - truth, axis=1)) < 0.3  # by the noise of the positions
    assert report["spacing"]["unit"] == "m" and value(report, "source") == "cloud.ply"
    assert np.abs((cloud.normals * field().normals).sum(1) - 1).max() < 0.01
    # The cameras were moved and not adjusted: the cloud lies among them as it did.
    centres = camera_poses(pycolmap.Reconstruction(given / "sparse"))[2]
    moved = camera_poses(pycolmap.Reconstruction(given / "georeferenced"))[2]
    before = np.linalg.norm(centres[:, None] - read_cloud(given / "cloud.ply").points[:9], axis=2)
    after = np.linalg.norm(moved[:, None] - cloud.points[:9], axis=2)
    np.testing.assert_allclose(after, before * value(place, "scale"), rtol=1e-6)


def test_an_object_s_cloud_stays_among_its_cameras_and_is_scaled_with_them(given):
    cloud, report = imported(given)
    np.testing.assert_allclose(cloud.points, read_cloud(given / "cloud.ply").points, atol=1e-12)
    assert value(report, "seen_share") > 0.8 and value(report, "met_share") > 0.5
    model = pycolmap.Reconstruction(given / "sparse")
    model.transform(pycolmap.Sim3d(SCALE, pycolmap.Rotation3d(), np.zeros(3)))
    model.write(given / "sparse")
    write_json(given / "sparse.json", {"metres_per_unit": quantity(SCALE, "")})
    scaled, _ = imported(given)
    np.testing.assert_allclose(scaled.points, SCALE * cloud.points, atol=1e-12)
    assert value(frame_ledger(None, given / "out.json", None), "object_from_file")[0] == [SCALE, 0, 0, 0]


def test_what_lies_outside_an_object_s_masks_is_left_out(given):
    (given / "masks").mkdir()
    views, cloud = read_views(given / "sparse"), read_cloud(given / "cloud.ply")
    own = np.linalg.norm(field().points - [5, 0, 0], axis=1) < 10
    hull = cloud.points[own]
    for view in views:
        pixels = view.visible(hull)[1].astype(np.int32)
        mask = np.zeros((view.height, view.width), np.uint8)
        if len(pixels):
            cv2.fillConvexPoly(mask, cv2.convexHull(pixels), 255)
        cv2.imwrite(str(given / f"masks/{Path(view.name).stem}.png"), mask)
    (given / "workspace").mkdir()
    shutil.copytree(given / "sparse", given / "workspace/sparse")
    cut, report = imported(given, workspace=given / "workspace", masks=given / "masks")
    kept = {*map(tuple, cut.points)}
    assert len(kept & {*map(tuple, hull)}) == own.sum() and len(kept) < 1.3 * own.sum()
    assert value(report, "points") == len(cut) == len(cloud) - value(report, "outside_masks")
    for mask in (given / "masks").iterdir():
        cv2.imwrite(str(mask), np.zeros((views[0].height, views[0].width), np.uint8))
    with pytest.raises(StageError, match="only 0 of 6000 points of .* lie inside the masks"):
        imported(given, workspace=given / "workspace", masks=given / "masks")


@pytest.mark.parametrize("kind, off_m", [("geocentric", 0.002), ("offset", 0.02)])
def test_a_scene_s_cloud_in_the_crs_lies_where_its_project_placed_cameras_on_the_earth(given, kind, off_m):
    """Metashape places cameras about the earth's centre, OpenDroneMap in the CRS less an offset.

    The latter takes UTM for a frame of straight axes, whose plane is 0.04 % smaller than its heights.
    """
    place = on_earth(kind)
    write_json(given / "sparse.json", {"lens": quantity("held", "")} | place.report())
    model, true = pycolmap.Reconstruction(given / "sparse"), MODEL_FROM_LOCAL
    if kind == "offset":
        # In the CRS less the offset, as its cameras are then.
        corners = true.apply(field(100).points)
        turned = fit_sim3(corners, place.earth_from_model.inverse().apply(on_earth("geocentric").in_crs(corners)))
        model.transform(pycolmap.Sim3d(turned.scale, pycolmap.Rotation3d(turned.rotation), turned.translation))
        model.write(given / "sparse")
    in_crs = on_earth("geocentric").in_crs(true.apply(field().points))
    write_cloud(given / "cloud.ply", Cloud(in_crs, field().normals))
    georeferenced(given)
    cloud, report = imported(given, georeference_json=given / "georeference.json")
    content = read_json(given / "georeference.json")
    # Where the file has it, although the photos' own positions are off.
    assert value(report, "crs") == value(content, "crs") == "EPSG:32632" and value(content, "metric")
    np.testing.assert_allclose(scene_frame(content).in_crs(cloud.points), in_crs, atol=off_m)
    assert value(content, "up_cue") == "given cameras" and "UTM zone 32N" in value(content, "reason")
    assert np.abs((cloud.normals * field().normals).sum(1) - 1).max() < 0.01
    centres = camera_poses(pycolmap.Reconstruction(given / "georeferenced"))[2]
    truth = scene_frame(content).apply(FRAME.inverse(FLIGHT.centres))
    assert np.linalg.norm(centres - truth, axis=1).max() < 0.5  # as the model is bent


def test_a_cloud_in_another_crs_than_its_project_s_lies_there_too(given):
    write_json(given / "sparse.json", on_earth("geocentric").report())
    there = on_earth("geocentric").in_crs(read_cloud(given / "cloud.ply").points)
    other = np.stack(pyproj.Transformer.from_crs(32632, 3035, always_xy=True).transform(*there.T), axis=1)
    among = read_cloud(given / "cloud.ply").points
    write_laz(given / "cloud.laz", Cloud(other - other[0]), other[0], "EPSG:3035")
    cloud, report = imported(given, source=given / "cloud.laz")
    np.testing.assert_allclose(cloud.points, among, atol=2e-3 * MODEL_FROM_LOCAL.scale)
    assert value(report, "crs") == "EPSG:3035"
    # In degrees, as Metashape's menu exports it where the photos have GPS and nobody chose a CRS.
    degrees = np.stack(pyproj.Transformer.from_crs(32632, 4326, always_xy=True).transform(*there.T), axis=1)
    header = laspy.LasHeader(point_format=6, version="1.4")
    header.scales, header.offsets = [1e-9, 1e-9, 1e-3], degrees[0]
    header.add_crs(pyproj.CRS(4326))
    las = laspy.LasData(header)
    las.x, las.y, las.z = degrees.T
    las.write(given / "degrees.laz")
    # Normals, which LAZ has not, as a PLY: east, north and up.
    there_from_among = fit_sim3(among, there)
    normals = there_from_among.rotate(read_cloud(given / "cloud.ply").normals).astype(np.float32)
    write_cloud(given / "degrees.ply", Cloud(degrees, normals))
    cloud, report = imported(given, source=given / "degrees.laz")
    np.testing.assert_allclose(cloud.points, among, atol=5e-3 * MODEL_FROM_LOCAL.scale)
    assert value(report, "crs") == "EPSG:4326" and value(report, "object_from_file") is None
    write_json(given / "sparse.json", replace(on_earth("geocentric"), crs=pyproj.CRS(4326)).report())
    cloud, report = imported(given, source=given / "degrees.ply")
    # North on the grid is half a degree off north.
    assert np.abs((cloud.normals * read_cloud(given / "cloud.ply").normals).sum(1) - 1).max() < 1e-3
    write_json(given / "sparse.json", on_earth("geocentric").report())
    # What lies in no CRS, and what lies elsewhere in it.
    cloud, report = imported(given)
    np.testing.assert_allclose(cloud.points, among, atol=1e-9)
    assert value(report, "crs") is None
    write_cloud(given / "cloud.ply", Cloud(there + [300, 0, 0]))
    with pytest.raises(StageError, match="nor, taken as WGS 84 / UTM zone 32N, where these lie on the earth: only 0 %"):
        imported(given)


def test_heights_above_a_geoid_that_is_not_installed_are_one_sentence(given):
    compound = replace(on_earth("geocentric"), crs=pyproj.CRS("EPSG:25832+5783"))
    write_json(given / "sparse.json", {"lens": quantity("held", "")} | compound.report())
    with pytest.raises(StageError, match=r"need a geoid, or a grid, that is not installed; export cameras and cloud"):
        georeferenced(given)
    # Of the cloud's file likewise.
    write_json(given / "sparse.json", {"lens": quantity("held", "")} | on_earth("geocentric").report())
    there = on_earth("geocentric").in_crs(read_cloud(given / "cloud.ply").points)
    write_laz(given / "cloud.laz", Cloud(there - there[0]), there[0], "EPSG:25832+5783")
    with pytest.raises(StageError, match="need a geoid"):
        imported(given, source=given / "cloud.laz")


def test_a_project_far_from_its_photos_gps_is_refused(given):
    place, photos = on_earth("geocentric"), FLIGHT.photos(noise_m=0.1)
    # GPS may count heights from another zero than the project.
    higher = [replace(photo, altitude_m=photo.altitude_m + 47) for photo in photos]
    write_photos(given / "photos.json", higher, given, "photos", [])
    moved = replace(place.earth_from_model, translation=place.earth_from_model.translation + [0, 5000, 0])
    for found in (place, replace(place, earth_from_model=moved)):
        write_json(given / "sparse.json", {"lens": quantity("held", "")} | found.report())
        if found is place:
            georeferenced(given)
            report = read_json(given / "georeference.json")
            assert "from the photos' GPS" in value(report, "reason")
            assert value(report, "gps_shift") == pytest.approx([0, 0, 47], abs=0.5)
        else:
            with pytest.raises(StageError, match="lie .* km from where the photos' GPS saw them"):
                georeferenced(given)


@pytest.mark.parametrize(
    "moved, sentence",
    [
        (lambda points: points + UTM, r"cloud.ply does not lie in .* only 0 % of its points are in the pictures"),
        (lambda points: points[:, [0, 2, 1]], "only .* of its points .*; export cloud and cameras in the same"),
        (lambda points: MODEL_FROM_LOCAL.inverse().apply(points), "does not lie in the coordinates of the row's cam"),
        (lambda points: 3 * points, "does not lie in the coordinates of the row's cameras"),
        (lambda points: points + [0, 0.26, 0], r"% if they are moved by [23].* % of the cameras' distance"),
        (lambda points: points.mean(0) + 1.03 * (points - points.mean(0)), r"and scaled by \+[23].* % \(another datum"),
    ],
    ids=["crs", "swapped axes", "metres", "another unit", "another datum", "3 % larger"],
)
def test_a_cloud_in_other_coordinates_than_the_cameras_is_one_sentence(given, moved, sentence):
    write_cloud(given / "cloud.ply", Cloud(moved(read_cloud(given / "cloud.ply").points)))
    with pytest.raises(StageError, match=sentence):
        imported(given)
    assert not (given / "out.ply").exists()

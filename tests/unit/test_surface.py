"""Surfaces of completed clouds: classes of faces, gaps, and the files that hold them."""

import json
import os
import re
import subprocess
import sys
import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pypdfium2
import pyproj
import pytest
import rasterio
import trimesh
from PIL import Image
from scipy.spatial.transform import Rotation
from support.photographed_plane import photographs

from scenefuse import command_line
from scenefuse.cloud.clouds import Cloud, read_cloud, write_cloud
from scenefuse.cloud.crs import crs_name
from scenefuse.core.stage import StageError, quantity, read_json, value, write_json
from scenefuse.core.transforms import Sim3, look_at
from scenefuse.fuse.measure import Evidence
from scenefuse.geometry.photo_check import pack
from scenefuse.photos.cameras.metashape import metashape_place, read_metashape
from scenefuse.photos.workspace import View, read_views, write_model
from scenefuse.report.facts import scene_exports, surface_facts
from scenefuse.report.view_mesh import read_mesh
from scenefuse.report.write_pdf import write_pdf
from scenefuse.surface import drawings as drawn
from scenefuse.surface import texture, tiles
from scenefuse.surface.cameras import export_cameras
from scenefuse.surface.drawings import NOTHING, SIDES, draw, draw_surface, facade_axes, wall_turn
from scenefuse.surface.gltf import BRIDGED_TINT, Painted, earth_from_scene, place_of_scene, write_glb
from scenefuse.surface.make_surface import SurfaceInputs, make_surface, read_surface, surface_report, write_surface
from scenefuse.surface.mesh import FaceClass, Surface, make_mesh
from scenefuse.surface.texture import beyond_manifold, textured, unfolded

# Spacing of points on a sphere, and the radius of a gap in it that is narrow beside its diagonal.
STEP, NARROW = 0.014, 0.032
GEOREFERENCE = {
    "crs": quantity("EPSG:25832", ""),
    "origin_in_crs": quantity([500100.0, 5200200.0, 300.0], "m"),
    "length_unit": quantity("m", ""),
}
TOP, ASIDE = np.array([0.0, 0, 1]), np.full(3, 3**-0.5)
# Where the middle of the plate's narrow gap is, along y.
NARROW_GAP = 0.4


def with_evidence(points: np.ndarray, normals: np.ndarray, colors: np.ndarray | None = None) -> Cloud:
    fields = {
        "evidence": np.full(len(points), Evidence.MEASURED, np.uint8),
        "deviation": np.full(len(points), 0.001, np.float32),
    }
    return Cloud(points, normals.astype(np.float32), colors, fields)


def sphere(step: float) -> Cloud:
    """A unit sphere, points about a step apart, colours by height."""
    count = int(4 * np.pi / step**2)
    height = 1 - 2 * (np.arange(count) + 0.5) / count
    angle = np.arange(count) * np.pi * (3 - np.sqrt(5))
    ring = np.sqrt(1 - height**2)
    points = np.column_stack([ring * np.cos(angle), ring * np.sin(angle), height])
    colors = np.column_stack([np.full(count, 200), 128 + 100 * height, np.full(count, 40)]).astype(np.uint8)
    return with_evidence(points, points, colors)


def with_hole(cloud: Cloud, radius: float, place: np.ndarray = TOP) -> Cloud:
    """Without the points around a place."""
    return cloud[np.linalg.norm(cloud.points - place, axis=1) > radius]


def away(surface, place: np.ndarray = TOP) -> np.ndarray:
    """Distances of faces from a place."""
    return np.linalg.norm(surface.vertices.points[surface.faces].mean(1) - place, axis=1)


@pytest.fixture(scope="module")
def closed():
    """The surface of a sphere with a narrow gap at its top, whose lower half photos do not confirm."""
    cloud = with_hole(sphere(STEP), NARROW)
    cloud.fields["evidence"][cloud.points[:, 2] < 0] = Evidence.NERF_ONLY
    cloud.fields["evidence"][cloud.points[:, 2] < -0.7] = Evidence.PLAIN
    return make_mesh(cloud, [])


@pytest.fixture(scope="module")
def coarse():
    """The same of fewer points and without the gap, for drawings."""
    cloud = sphere(3 * STEP)
    cloud.fields["evidence"][cloud.points[:, 2] < 0] = Evidence.NERF_ONLY
    return make_mesh(cloud, [])


@pytest.mark.slow
def test_a_narrow_gap_is_bridged_on_the_surface_that_its_rim_goes_on_as(closed):
    bridged = closed.part(closed.classes == FaceClass.BRIDGED)
    assert away(bridged).max() < NARROW and 0.1 < bridged.areas().sum() / (np.pi * NARROW**2) < 1
    assert np.abs(np.linalg.norm(bridged.vertices.points, axis=1) - 1).max() < 0.01


@pytest.mark.slow
def test_a_wide_gap_stays_open_and_its_area_is_said():
    surface = make_mesh(with_hole(sphere(0.03), 0.4, ASIDE), [])
    assert away(surface, ASIDE).min() > 0.3
    assert 0.5 < surface.open_area / (np.pi * 0.4**2) < 1.2


def test_a_cloud_without_normals_and_photos_has_a_surface_that_faces_outwards():
    dome, ground = sphere(0.15).points, np.random.default_rng(0).normal(0, [2, 2, 0.01], (1500, 3))
    ground = ground[np.linalg.norm(ground, axis=1) > 1]
    surface = make_mesh(Cloud(np.concatenate([dome[dome[:, 2] > 0], ground])), [])
    a, b, c = (surface.vertices.points[surface.faces[:, k]] for k in range(3))
    normals, middle = np.cross(b - a, c - a), (a + b + c) / 3
    of_dome = middle[:, 2] > 0.2
    assert of_dome.sum() > 100 and ((normals * middle).sum(1)[of_dome] > 0).mean() > 0.9
    assert (normals[~of_dome, 2] > 0).mean() > 0.9


def test_a_lattice_of_points_in_one_plane_has_a_surface():
    surface = make_mesh(Cloud(plane(0.2, 0.1).points), [])
    normals = np.cross(*np.diff(surface.vertices.points[surface.faces], axis=1).swapaxes(0, 1))
    assert surface.areas().sum() == pytest.approx(4, rel=0.2) and (normals[:, 2] > 0).all()


def test_a_cloud_that_holds_every_point_twice_has_the_surface_of_once():
    once = sphere(0.15)
    areas = [make_mesh(cloud, []).areas().sum() for cloud in (once, once[np.tile(np.arange(len(once)), 2)])]
    assert areas == pytest.approx([4 * np.pi] * 2, rel=0.05)


def test_what_no_photo_confirms_is_told_apart_and_of_this_what_is_plain(closed):
    height = closed.vertices.points[closed.faces].mean(1)[:, 2]
    assert (closed.classes[(height < -2 * STEP) & (height > -0.7 + 2 * STEP)] == FaceClass.UNCONFIRMED).all()
    assert (closed.classes[height < -0.7 - 2 * STEP] == FaceClass.PLAIN).all()
    assert (closed.classes[(height > 2 * STEP) & (away(closed) > 0.1)] == FaceClass.MEASURED).all()


def test_shares_of_the_classes_sum_to_the_whole_area(closed):
    report = surface_report(closed, "m")
    closed_by = ("measured", "plain", "unconfirmed", "bridged")
    assert sum(value(report, name) for name in (*closed_by, "open")) == pytest.approx(1)
    assert sum(value(report, f"{name}_area") for name in closed_by) == pytest.approx(4 * np.pi, rel=0.02)


def plate_over_ground() -> Cloud:
    """A box over the ground; in its top two slits of 0.06 from a wide gap, and a narrow gap over a wider one below."""
    rng = np.arange(-0.6, 0.6, 0.0125)
    x, y = (a.ravel() for a in np.meshgrid(rng, rng))
    wide, narrow = np.maximum(abs(x), abs(y)), np.maximum(abs(x), abs(y - NARROW_GAP))
    top_there = (wide > 0.15) & ((abs(x) > 0.45) | (abs(y) > 0.03)) & (narrow > 0.03)
    below_there = (wide > 0.2) & (narrow > 0.08)
    far = np.arange(-1.44, 1.44, 0.03)
    ground = np.column_stack([*(a.ravel() for a in np.meshgrid(far, far)), np.zeros(len(far) ** 2)])
    up = np.tile([0.0, 0, 1], (len(x), 1))
    parts = [
        (np.column_stack([x, y, 0 * x + 1])[top_there], up[top_there]),
        (np.column_stack([x, y, 0 * x + 0.6])[below_there], -up[below_there]),
        (ground, np.tile([0.0, 0, 1], (len(ground), 1))),
    ]
    across, height = (a.ravel() for a in np.meshgrid(rng, np.arange(0.6, 1, 0.0125)))
    for turn in range(4):
        turned = Rotation.from_euler("z", 90 * turn, degrees=True).as_matrix().T
        side = np.column_stack([0 * across + 0.6, across, height]) @ turned
        parts.append((side, np.tile([1.0, 0, 0] @ turned, (len(side), 1))))
    points, normals = (np.concatenate(kind) for kind in zip(*parts))
    return with_evidence(points, normals)


@pytest.fixture(scope="module")
def plate():
    return make_mesh(plate_over_ground(), [])


def from_above(count: int = 4) -> list[View]:
    views = []
    for k in range(count):
        centre = np.array([0.1 * np.cos(k), 0.1 * np.sin(k), 5.0])
        pose = np.eye(4)
        pose[:3, :3] = look_at(centre, np.zeros(3), np.array([0, 1.0, 0]))
        pose[:3, 3] = -pose[:3, :3] @ centre
        views.append(View(str(k), np.array([[900.0, 0, 400], [0, 900, 400], [0, 0, 1]]), pose, 800, 800))
    return views


@pytest.mark.slow
def test_a_gap_that_photos_see_through_stays_open(plate):
    bridges = []
    for surface in (plate, make_mesh(plate_over_ground(), from_above())):
        middle = surface.vertices.points[surface.faces[surface.classes == FaceClass.BRIDGED]].mean(1)
        off = np.abs(middle - [0, NARROW_GAP, 1])
        bridges.append(int((off.max(1) < 0.03).sum()))
    assert bridges[0] > 5 and bridges[1] == 0


def plane(gap: float, step: float = 0.02) -> Cloud:
    """A square of two, seen from above, with a round gap in its middle."""
    x, y = (a.ravel() for a in np.meshgrid(*[np.arange(-1, 1, step)] * 2))
    square = with_evidence(np.column_stack([x, y, 0 * x]), np.tile([0, 0, 1], (len(x), 1)))
    return with_hole(square, gap, np.zeros(3))


@pytest.mark.slow
@pytest.mark.parametrize(("height", "kind"), [(0.0, FaceClass.MEASURED), (0.3, None)])
def test_a_wide_gap_is_measured_where_photos_confirm_the_surface_across_it_and_else_stays_open(height, kind):
    shift = Sim3(1.0, np.eye(3), np.array([0, 0, height]))
    surface = make_mesh(plane(0.2).transformed(shift), [], pack(photographs(8, 3.0)))
    inner = surface.classes[away(surface, np.array([0, 0, height])) < 0.15]
    assert len(inner) == 0 if kind is None else (inner == kind).mean() > 0.95 and len(inner) > 50


def test_a_slit_is_bridged_up_to_where_it_widens_and_how_exact_it_is_stays_unknown(plate):
    middle = np.abs(plate.vertices.points[plate.faces].mean(1) - [0, 0, 1])
    top = (middle[:, 1] < 0.008) & (middle[:, 2] < 0.03)
    slit = top & (middle[:, 0] > 0.3) & (middle[:, 0] < 0.4)
    assert slit.sum() > 5 and (plate.classes[slit] == FaceClass.BRIDGED).all()
    assert not (top & (middle[:, 0] < 0.1)).any()
    inner = plate.vertices.fields["class"] == FaceClass.BRIDGED
    assert inner.any() and np.isnan(plate.vertices.fields["deviation"][inner]).all()


def test_points_in_a_line_have_no_surface_and_the_stage_says_so(tmp_path: Path):
    line = np.column_stack([np.linspace(0, 1, 50), np.zeros((50, 2))])
    cloud = with_evidence(line, np.tile([0.0, 0, 1], (50, 1)))
    with pytest.raises(StageError, match="50 points have no surface"):
        make_mesh(cloud, [])
    write_cloud(tmp_path / "fused.ply", cloud)
    write_json(tmp_path / "fusion.json", {"scene_from_object": quantity(None, "m")})
    inputs = SurfaceInputs(tmp_path / "fused.ply", tmp_path / "fusion.json")
    make_surface(inputs=inputs, surface=tmp_path / "s.ply", glb=tmp_path / "s.glb", report=tmp_path / "s.json")
    assert "no surface" in value(read_json(tmp_path / "s.json"), "reason")
    assert len(read_surface(tmp_path / "s.ply").faces) == 0
    assert (tmp_path / "s.glb").read_bytes()[:4] == b"glTF"


def test_a_written_surface_is_read_as_it_was(closed, tmp_path: Path):
    write_surface(tmp_path / "surface.ply", closed, ["x y z: metres in a local frame"])
    assert b"\ncomment x y z: metres in a local frame\n" in (tmp_path / "surface.ply").read_bytes()
    again = read_surface(tmp_path / "surface.ply")
    assert np.array_equal(again.faces, closed.faces) and np.array_equal(again.classes, closed.classes)
    assert np.array_equal(again.vertices.points, closed.vertices.points)
    assert set(again.vertices.fields) == {"evidence", "deviation", "class"}


def test_colours_of_an_exported_surface_are_read_as_they_were(closed, tmp_path: Path):
    painted = replace(closed.vertices, colors=np.full((len(closed.vertices), 3), [200, 100, 5], np.uint8))
    measured = np.full_like(closed.classes, FaceClass.MEASURED)
    write_glb(tmp_path / "surface.glb", replace(closed, vertices=painted, classes=measured), {})
    assert np.abs(read_cloud(tmp_path / "surface.glb").colors.astype(int) - [200, 100, 5]).max() <= 1


def test_another_reader_finds_metres_with_y_up_and_the_classes_in_the_glb(closed, tmp_path: Path):
    path = tmp_path / "surface.glb"
    write_glb(path, closed, {"crs": "EPSG:32632"}, metres=0.3048)
    content = path.read_bytes()
    header = json.loads(content[20 : 20 + int.from_bytes(content[12:16], "little")])
    assert header["asset"]["extras"]["crs"] == "EPSG:32632"
    scene = trimesh.load_scene(path)
    assert sum(len(mesh.faces) for mesh in scene.geometry.values()) == len(closed.faces)
    low, high = scene.bounds
    assert np.allclose([low, high], [[-0.3048] * 3, [0.3048] * 3], atol=0.01)
    ids = {int(mesh.vertex_attributes["_FEATURE_ID_0"].ravel()[0]): mesh for mesh in scene.geometry.values()}
    assert set(ids) == {int(kind) for kind in FaceClass}
    assert ids[FaceClass.UNCONFIRMED].vertices[:, 1].max() < 0.05 < ids[FaceClass.BRIDGED].vertices[:, 1].min()
    assert sum(mesh.area for mesh in ids.values()) == pytest.approx(0.3048**2 * closed.areas().sum(), rel=1e-4)
    normals = ids[FaceClass.MEASURED].face_normals
    middle = ids[FaceClass.MEASURED].triangles_center
    assert ((normals * middle).sum(1) > 0).mean() > 0.999


@pytest.mark.slow
@pytest.mark.parametrize("of_points", [100, None])
def test_a_planted_picture_lands_on_the_faces_that_a_photo_shows_it_on(coarse, of_points):
    """Photos from two sides, in one of which the sphere is red on the left and blue on the right, another exposure."""
    views, pixels = from_above(3), []
    for k, _ in enumerate(views):
        picture = np.zeros((800, 800, 3), np.uint8)
        picture[:, :400], picture[:, 400:] = (200, 40, 40), (40, 40, 200)
        pixels.append((picture * (1 - 0.2 * k)).astype(np.uint8))
    colors = None if of_points is None else np.full((len(coarse.vertices), 3), of_points, np.uint8)
    grey = replace(coarse.vertices, colors=colors)
    painted = textured(replace(coarse, vertices=grey), views, lambda k: pixels[k])
    side, faces = len(painted.picture), painted.surface.faces
    middle = painted.surface.vertices.points[faces].mean(1)
    at = np.floor(painted.uv.mean(1) * side).astype(int)
    color = painted.picture[at[:, 1], at[:, 0]].astype(float)
    top = (middle[:, 2] > 0.5) & (painted.surface.classes == FaceClass.MEASURED)
    right = views[0].project(middle)[0][:, 0] > 400
    assert (color[top & (middle[:, 0] < -0.1), 0] > color[top & (middle[:, 0] < -0.1), 2]).mean() > 0.98
    assert (color[top & (middle[:, 0] > 0.1), 2] > color[top & (middle[:, 0] > 0.1), 0]).mean() > 0.98
    assert right[top & (middle[:, 0] > 0.1)].all()
    # No photo shows the lower half: the colour of the points, or grey.
    assert np.allclose(color[middle[:, 2] < -0.5], of_points or 160, atol=2)


def test_a_surface_on_which_three_faces_share_an_edge_gets_its_texture():
    """As where a sleeve touches a coat; UVAtlas takes manifold meshes only."""
    corners = np.array([[0, 0, 0], [1, 0, 0], [0.5, 1, 0], [0.5, -1, 0], [0.5, 0.3, 1.0]])
    faces = np.array([[0, 1, 2], [1, 0, 3], [0, 1, 4]])
    grey = np.full((5, 3), 100, np.uint8)
    vertices = Cloud(corners, np.zeros((5, 3), np.float32), grey, {"deviation": np.zeros(5, np.float32)})
    surface = Surface(vertices, faces, np.full(3, FaceClass.MEASURED, np.uint8), 0.0)
    photo = np.random.default_rng(0).integers(98, 103, (800, 800, 3)).astype(np.uint8)
    painted = textured(surface, from_above(1), lambda k: photo)
    at = np.floor(painted.uv.mean(1) * len(painted.picture)).astype(int)
    assert len(at) == 3 and np.allclose(painted.picture[at[:, 1], at[:, 0]], 100, atol=5)


def test_a_photo_fades_out_towards_where_it_ends():
    """A plane in two photos; one ends in its middle, and is brighter there."""
    x, y = (a.ravel() for a in np.meshgrid(np.linspace(-1, 1, 21), np.linspace(-1, 1, 21)))
    low = np.flatnonzero((x < 0.99) & (y < 0.99))
    faces = np.concatenate([np.column_stack([low, low + 1, low + 22]), np.column_stack([low, low + 22, low + 21])])
    grey, up = np.full((len(x), 3), 100, np.uint8), np.tile(np.float32([0, 0, 1]), (len(x), 1))
    vertices = Cloud(np.column_stack([x, y, 0 * x]), up, grey, {"deviation": np.zeros(len(x), np.float32)})
    surface = Surface(vertices, faces, np.full(len(faces), FaceClass.MEASURED, np.uint8), 0.0)
    centre, pose = np.array([0, 0, 5.0]), np.eye(4)
    pose[:3, :3] = look_at(centre, np.zeros(3), np.array([0, 1.0, 0]))
    pose[:3, 3] = -pose[:3, :3] @ centre
    lens = np.array([[900.0, 0, 400], [0, 900, 400], [0, 0, 1]])
    photos = np.random.default_rng(0).integers(98, 103, (2, 800, 800, 3)).astype(np.uint8)
    photos[1, :, 345:] += 60
    painted = textured(surface, [View(str(k), lens, pose, (800, 400)[k], 800) for k in (0, 1)], lambda k: photos[k])
    picture = Painted(
        painted.surface.vertices.points[faces].reshape(-1, 3),
        np.arange(3 * len(faces)).reshape(-1, 3),
        surface.classes,
        painted.uv.reshape(-1, 2),
        painted.picture,
    )
    drawing = draw(surface, picture, np.eye(3), 1 / 180)
    profile = drawing.colors[20:-20, :, 0].mean(0)
    middle = round(-drawing.left * 180)
    near = profile[middle - 50 : middle + 50]
    assert np.ptp(near) > 20 and np.abs(np.diff(near)).max() < 8
    # From behind nothing of it was measured.
    assert not draw(surface, picture, np.diag([1.0, -1, -1]), 0.02).colors.any()


# A plane that cuts the ball half a radius in front of its middle, towards east and a little north: towards which, and
# three points of it.
TOWARD = Rotation.from_euler("z", 30, degrees=True).apply([1.0, 0, 0])
CORNERS = 0.5 * TOWARD + np.array([[0, 0, -0.3], [0, 0, 0.3], np.cross([0, 0, 0.4], TOWARD)])


def ball_drawn(coarse: Surface, folder: Path, **options) -> Path:
    """The folder of drawings of the coarse ball."""
    write_surface(folder / "surface.ply", coarse)
    write_glb(folder / "surface.glb", coarse, {})
    files = {"surface": folder / "surface.ply", "glb": folder / "surface.glb", "folder": folder / "drawings"}
    draw_surface(name="ball", **files, **options)
    return folder / "drawings"


@pytest.fixture(scope="module")
def drawings(coarse, tmp_path_factory):
    return ball_drawn(coarse, tmp_path_factory.mktemp("ball"))


@pytest.fixture(scope="module")
def placed(coarse, tmp_path_factory):
    """Drawings in a CRS, with the facade of CORNERS."""
    folder = tmp_path_factory.mktemp("placed")
    write_json(folder / "g.json", GEOREFERENCE)
    return ball_drawn(coarse, folder, georeference_json=folder / "g.json", facade=tuple(CORNERS.ravel()))


@pytest.mark.slow
def test_what_is_not_measured_is_grey_on_a_sheet_for_a_wall_may_be_white(drawings):
    sheet = np.asarray(Image.open(drawings / "south.png").convert("RGB"))
    nothing = rasterio.open(drawings / "south_class.tif").read(1) == NOTHING
    grey = (sheet == 217).all(2).sum() / sheet[:, :, 0].size
    report = read_json(drawings / "drawings.json")
    page = 0.42 * 0.297 * value(report, "south_scale") ** 2
    assert grey == pytest.approx(nothing.sum() * value(report, "south_pixel") ** 2 / page, rel=0.05)


def test_an_elevation_has_the_scale_that_it_says(drawings):
    report = read_json(drawings / "drawings.json")
    for side in SIDES:
        band = rasterio.open(drawings / f"{side}_class.tif")
        pixel = value(report, f"{side}_pixel")
        assert band.res == pytest.approx((pixel, pixel)) and band.nodata == NOTHING
        shown = band.read(1) != NOTHING
        assert [n * pixel for n in (shown.any(0).sum(), shown.any(1).sum())] == pytest.approx([2, 2], abs=3 * pixel)
        assert shown.sum() * pixel**2 == pytest.approx(np.pi, rel=0.01)
        left, top = band.bounds.left, band.bounds.top
        middle = np.argwhere(shown).mean(0) + 0.5
        assert [left + middle[1] * pixel, top - middle[0] * pixel] == pytest.approx([0, 0], abs=pixel)
    assert np.nanmax(rasterio.open(drawings / "above_height.tif").read(1)) == pytest.approx(1, abs=0.01)
    said = ["height (scene units)", "distance towards the viewer (scene units)", "standard deviation (scene units)"]
    bands = ["above_height", "south_height", "south_deviation"]
    assert [rasterio.open(drawings / f"{band}.tif").descriptions[0] for band in bands] == said
    assert "1 measured, 2 bridged" in rasterio.open(drawings / "south_class.tif").descriptions[0]
    # What photos do not confirm is below.
    assert (rasterio.open(drawings / "above_class.tif").read(1) != FaceClass.UNCONFIRMED).mean() > 0.97
    assert (drawings / "drawings.pdf").read_bytes()[:4] == b"%PDF"


@pytest.mark.slow
def test_a_sheet_of_an_object_of_a_thousandth_of_a_scene_unit_is_as_large_as_one_of_a_thousand(coarse, tmp_path: Path):
    for size in (1e-3, 1e3):
        (folder := tmp_path / str(size)).mkdir()
        vertices = coarse.vertices.transformed(Sim3(size, np.eye(3), np.zeros(3)))
        report = read_json(ball_drawn(replace(coarse, vertices=vertices), folder) / "drawings.json")
        assert 2 * size / value(report, "south_scale") == pytest.approx(0.2)


@pytest.mark.slow
def test_a_drawing_names_its_day_and_a_plan_its_crs_with_an_arrow_to_the_north(drawings, placed):
    def said(folder):
        return [page.get_textpage().get_text_bounded() for page in pypdfium2.PdfDocument(folder / "drawings.pdf")]

    name = crs_name(value(read_json(placed / "drawings.json"), "crs"))
    for plain, page, side in zip(said(drawings), said(placed), SIDES):
        assert re.search(r"drawn 20\d\d-\d\d-\d\d", plain) and (name in page) == (side == "above")
        assert (re.search(r"^N\b", page, re.MULTILINE) is not None) == (side == "above")
        assert not re.search(r"^N\b", plain, re.MULTILINE)
        # Where no CRS says where it lies, its sides have their names by the axes.
        assert ("y taken for north" in plain) == (side != "above") and "y taken for north" not in page


@pytest.mark.slow
def test_a_plan_has_no_arrow_to_the_north_where_y_points_south_and_of_a_level_facade_one_looks_down(coarse, tmp_path):
    here = {"crs": quantity("EPSG:2048", ""), "origin_in_crs": quantity([1e4, 3.7e6, 300.0], "m")}
    for known, compass in ((GEOREFERENCE, ": x east, z south"), (GEOREFERENCE | here, "")):
        write_json(tmp_path / "g.json", known)
        assert place_of_scene(tmp_path / "g.json")["axes"] == f"y up; x, y, z here are x, z, -y in the scene{compass}"
    level = np.array([[0, 0, 1.0], [0.1, 0, 1], [0, 0.1, 1]])
    folder = ball_drawn(coarse, tmp_path, georeference_json=tmp_path / "g.json", facade=tuple(level.ravel()))
    pages = [page.get_textpage().get_text_bounded() for page in pypdfium2.PdfDocument(folder / "drawings.pdf")]
    assert not any(re.search(r"^N\b", page, re.MULTILINE) for page in pages)
    assert ["y taken for north" in page for page in pages] == [False, True, True, True, True, False]
    assert "facade, looking down; 1:" in pages[-1]


def test_a_drawing_of_many_pixels_is_drawn_strip_by_strip_like_one_of_few(closed, monkeypatch):
    whole = draw(closed, None, np.eye(3), 0.02)
    monkeypatch.setattr(drawn, "AT_ONCE", 700)
    strips = draw(closed, None, np.eye(3), 0.02)
    for name, band in vars(whole).items():
        np.testing.assert_array_equal(band, vars(strips)[name])


def test_what_is_bridged_has_one_tint_and_no_deviation_in_every_file(closed):
    half = replace(closed, classes=np.where(np.arange(len(closed.faces)) % 2, FaceClass.MEASURED, FaceClass.BRIDGED))
    drawing = draw(half, None, np.eye(3), 0.02)
    bridged = drawing.classes == FaceClass.BRIDGED
    assert bridged.any() and (drawing.colors[bridged, :3] == BRIDGED_TINT).all()
    assert np.isnan(drawing.deviations[bridged]).all()
    measured = drawing.classes == FaceClass.MEASURED
    assert np.isfinite(drawing.deviations[measured]).any()
    assert not (drawing.colors[measured, :3] == BRIDGED_TINT).all(1).any()


def test_texels_of_many_pixels_are_found_strip_by_strip_like_those_of_few(monkeypatch):
    square, faces = (
        np.array([[0.1, 0.1, 0], [0.9, 0.1, 0], [0.9, 0.8, 1], [0.1, 0.8, 1]]),
        np.array([[0, 1, 2], [0, 2, 3]]),
    )
    whole = texture.texels_of_faces(square, faces, square[faces][..., :2], 100)
    monkeypatch.setattr(texture, "AT_ONCE", 700)
    for a, b in zip(whole, texture.texels_of_faces(square, faces, square[faces][..., :2], 100)):
        np.testing.assert_array_equal(a, b)


def test_a_facade_is_drawn_of_the_plane_through_three_points_from_outside(coarse, placed):
    for order in ([0, 1, 2], [1, 0, 2]):
        np.testing.assert_allclose(
            facade_axes(coarse, CORNERS[order]), [np.cross([0, 0, 1], TOWARD), [0, 0, 1], TOWARD], atol=1e-9
        )
    # A wall of a hand's breadth, of which the other side has more points.
    x, z = (a.ravel() for a in np.meshgrid(np.linspace(0, 30, 300), np.linspace(0, 3, 30)))
    front, back = (np.column_stack([x[::k], 0 * x[::k] + y, z[::k]]) for k, y in ((2, 0.0), (1, 0.15)))
    outward = np.concatenate([0 * front - [0, 1, 0], 0 * back + [0, 1, 0]]).astype(np.float32)
    wall = replace(coarse, vertices=Cloud(np.concatenate([front, back]), outward))
    for order in ([0, 1, 2], [1, 0, 2]):
        assert facade_axes(wall, np.array([[0, 0, 0], [30, 0, 0], [0, 0, 3.0]])[order])[2] @ [0, -1, 0] > 0.99
    heights = rasterio.open(placed / "facade_height.tif").read(1)
    # Its front stands half a radius before the plane, and half of it lies behind.
    assert np.nanmax(heights) == pytest.approx(0.5, abs=0.01) and np.nanmin(heights) < 0
    assert {"facade.png", "facade_class.tif", "facade_deviation.tif"} <= {p.name for p in placed.iterdir()}
    report = read_json(placed / "drawings.json")
    assert value(report, "facade_scale") > 0 and "above_from_scene" not in report
    # A place of the scene, the ball's nearest to the viewer, is found in the files.
    x, y, away, _ = np.array(value(report, "facade_from_scene")) @ [*TOWARD, 1]
    assert away == pytest.approx(0.5)
    with rasterio.open(placed / "facade_height.tif") as file:
        assert next(file.sample([(x, y)]))[0] == pytest.approx(away, abs=0.01)
    with pytest.raises(StageError, match="lie in a line"):
        facade_axes(coarse, np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0]]))


@pytest.mark.slow
def test_a_facade_that_leans_far_from_the_scene_s_origin_has_the_heights_of_its_place(coarse, tmp_path: Path):
    aside = np.array([200.0, 0, 0])
    ball = replace(coarse, vertices=replace(coarse.vertices, points=coarse.vertices.points + aside))
    lean = Rotation.from_euler("y", 5, degrees=True).apply(
        np.array([[0.5, 0.3, -0.3], [0.5, -0.3, -0.3], [0.5, 0, 0.3]])
    )
    write_json(tmp_path / "g.json", GEOREFERENCE)
    options = {"facade": tuple((lean + aside).ravel())}
    for height, known in ((300, {"georeference_json": tmp_path / "g.json"}), (0, {})):
        (folder := tmp_path / str(height)).mkdir()
        drawings = ball_drawn(ball, folder, **options, **known)
        for side in ("south", "facade"):
            band = rasterio.open(drawings / f"{side}_class.tif")
            rows = np.nonzero((band.read(1) != NOTHING).any(1))[0]
            assert band.bounds.top - (rows.mean() + 0.5) * band.res[1] == pytest.approx(height, abs=0.05)


def test_a_bridge_is_not_drawn_in_the_colours_of_what_lies_behind_it(closed):
    below = closed.part(closed.vertices.points[closed.faces][..., 2].max(1) < 0)
    red = np.full((8, 8, 3), (255, 0, 0), np.uint8)
    places = np.full((len(below.vertices), 2), 0.5)
    painted = Painted(below.vertices.points, below.faces, below.classes, places, red)
    from_above = draw(closed, painted, np.eye(3), 0.02).colors
    from_below = draw(closed, painted, np.diag([1.0, -1, -1]), 0.02).colors
    shown = from_above[..., 3] > 0
    assert shown.any() and not (from_above[shown, :3] == [255, 0, 0]).all(1).any()
    assert (from_below[from_below[..., 3] > 0][:, :3] == [255, 0, 0]).all(1).mean() > 0.9


def test_a_drawing_from_above_lies_in_the_crs_of_its_scene(placed):
    picture = rasterio.open(placed / "above_height.tif")
    assert picture.bounds[:1] + picture.bounds[3:] == pytest.approx((500099, 5200201), abs=0.1)
    assert picture.crs.to_epsg() == 25832 and picture.tags(ns="IMAGE_STRUCTURE")["LAYOUT"] == "COG"
    heights = picture.read(1)
    assert np.nanmax(heights) == pytest.approx(301, abs=0.01)
    assert np.isnan(heights[0, 0])


def test_a_site_s_own_system_has_no_place_on_earth(tmp_path):
    site = 'LOCAL_CS["site",UNIT["metre",1],AXIS["X",EAST],AXIS["Y",NORTH]]'
    write_json(tmp_path / "g.json", GEOREFERENCE | {"crs": quantity(site, "")})
    assert earth_from_scene(tmp_path / "g.json", np.zeros(3)) is None


@pytest.mark.slow
def test_a_scene_in_metres_is_drawn_from_above_in_the_feet_of_its_crs(coarse, tmp_path):
    place = {"latitude_deg": 37.5, "longitude_deg": -122.0, "altitude_m": 30.48006}
    known = {f"origin_{name}": quantity(number, "") for name, number in place.items()}
    feet = known | {"crs": quantity("EPSG:2227", ""), "length_unit": quantity("m", "")}
    write_json(tmp_path / "g.json", feet)
    folder = ball_drawn(coarse, tmp_path, georeference_json=tmp_path / "g.json")
    report, above = read_json(folder / "drawings.json"), rasterio.open(folder / "above_height.tif")
    pixel = report["above_pixel"]
    assert pixel["unit"] == "US survey foot" and above.res[0] == pytest.approx(pixel["value"])
    assert pixel["value"] == pytest.approx(value(report, "south_pixel") / 0.3048006)
    assert value(report, "above_scale") == value(report, "south_scale")
    south = rasterio.open(folder / "south_class.tif")
    assert np.nanmax(above.read(1)) == pytest.approx(100 + 1 / 0.3048006, abs=0.02)
    assert south.bounds.top == pytest.approx(31.48, abs=0.05)


def test_elevations_are_turned_to_the_walls():
    points, normals = [], []
    for axis in range(4):
        turn = Rotation.from_euler("z", 90 * axis + 20, degrees=True).as_matrix()
        across, up = (a.ravel() for a in np.meshgrid(np.linspace(-1, 1, 40), np.linspace(0, 1, 20)))
        points.append(np.column_stack([0 * across + 1, across, up]) @ turn.T)
        normals.append(np.tile(turn @ [1, 0, 0], (len(across), 1)))
    surface = make_mesh(with_evidence(np.concatenate(points), np.concatenate(normals)), [])
    assert np.degrees(wall_turn(surface)) == pytest.approx(20, abs=1)


def test_cameras_of_both_sides_are_exported_in_the_frame_of_the_scene(tmp_path: Path):
    pose = Sim3(2.0, Rotation.from_euler("z", 30, degrees=True).as_matrix(), np.array([5.0, 1, 0]))
    for folder in ("scenes/yard", "objects/shed"):
        (tmp_path / folder / "undistorted/sparse").mkdir(parents=True)
        write_model(tmp_path / folder / "undistorted/sparse", from_above(3))
    write_json(tmp_path / "objects/shed/fusion.json", {"scene_from_object": quantity(pose.matrix, "m")})
    folder = tmp_path / "scenes/yard/cameras"
    scene = tmp_path / "scenes/yard/undistorted"
    export_cameras(scene_workspace=scene, objects=[tmp_path / "objects/shed"], folder=folder)
    views = {view.name: view for view in read_views(folder)}
    centre = from_above(3)[1].centre
    assert len(views) == 6
    assert np.allclose(views["scenes/yard/undistorted/images/1"].centre, centre)
    assert np.allclose(views["objects/shed/undistorted/images/1"].centre, pose.apply(centre))
    frames = {frame["file_path"]: frame for frame in read_json(folder / "transforms.json")["frames"]}
    matrix = np.array(frames["../../../objects/shed/undistorted/images/1"]["transform_matrix"])
    assert np.allclose(matrix[:3, 3], pose.apply(centre))
    # OpenGL's cameras look along -z: down, here.
    assert matrix[2, 2] > 0.99
    # A refused object in a cloud leaves none, which is no reason to end an export.
    write_json(tmp_path / "objects/shed/fusion.json", {"scene_from_object": quantity(None, "m")})
    export_cameras(objects=[tmp_path / "objects/shed"], folder=folder)
    assert not read_views(folder) and not read_json(folder / "transforms.json")["frames"]


@pytest.mark.parametrize(("crs", "easting"), [("EPSG:25832", 5e5), ("EPSG:25832+7837", 5e5), ("EPSG:31467", 3.5e6)])
def test_metashape_reads_the_cameras_and_their_place(tmp_path: Path, crs, easting):
    workspace, folder = tmp_path / "scenes/yard/undistorted", tmp_path / "scenes/yard/cameras"
    (workspace / "sparse").mkdir(parents=True)
    write_model(workspace / "sparse", from_above(3))
    origin = [easting + 100, 5200200.0, 300.0]
    place = {"crs": quantity(crs, ""), "origin_in_crs": quantity(origin, "m"), "length_unit": quantity("m", "")}
    write_json(tmp_path / "g.json", place)
    export_cameras(scene_workspace=workspace, objects=[], georeference_json=tmp_path / "g.json", folder=folder)
    found = {given.name: given for given in read_metashape(folder / "cameras.xml")[0]}
    for view in from_above(3):
        assert np.allclose(found[Path(view.name).stem].object_from_cam, view.world_from_cam)
        lens = found[Path(view.name).stem].camera
        assert np.allclose(lens.calibration_matrix(), view.intrinsics)
    place = metashape_place(folder / "cameras.xml")
    # Its numbers are on the datum of its CRS, which of DHDN lies 700 m from WGS84.
    assert place is not None and crs_name(crs[:10]).split(" (")[0] in place.crs.name
    assert place.in_crs(np.zeros((1, 3)))[0] == pytest.approx(origin, abs=0.01)


def test_tiles_hold_every_point_once_and_lie_where_the_scene_lies(closed, tmp_path: Path, monkeypatch):
    monkeypatch.setattr(tiles, "TILE_SIZE", 500)
    rng = np.random.default_rng(0)
    points = rng.uniform([0, 0, 0], [20, 10, 3], (3000, 3))
    cloud = Cloud(
        points, None, rng.integers(0, 255, points.shape).astype(np.uint8),
        {"evidence": rng.integers(0, 5, 3000).astype(np.uint8), "source": np.ones(3000, np.uint8)},
    )  # fmt: skip
    write_json(tmp_path / "completed.json", {"sources": quantity({"0": "scene", "1": "ball"}, "")})
    write_cloud(tmp_path / "completed.ply", cloud)
    (tmp_path / "ball").mkdir()
    write_surface(tmp_path / "ball/surface.ply", closed)
    write_glb(tmp_path / "ball/surface.glb", closed, {})
    write_json(tmp_path / "g.json", GEOREFERENCE)
    tiles.make_tiles(
        cloud=tmp_path / "completed.ply", report=tmp_path / "completed.json", objects=[tmp_path / "ball"],
        georeference_json=tmp_path / "g.json", folder=tmp_path / "tiles",
    )  # fmt: skip
    found = []

    def walk(tile, folder, outer):
        centre, half = np.array(tile["boundingVolume"]["box"])[:3], np.array(tile["boundingVolume"]["box"])[[3, 7, 11]]
        assert tile["geometricError"] < outer
        if "content" in tile:
            scene = trimesh.load(folder / tile["content"]["uri"])
            # Viewers turn y up to z up.
            inside = np.asarray(scene.to_geometry().vertices) @ [[1, 0, 0], [0, 0, 1], [0, -1, 0]]
            assert (np.abs(inside - centre) <= half + 1e-4).all()
            found.append((tile["content"]["uri"], inside))
        for child in tile.get("children", ()):
            walk(child, folder, tile["geometricError"])

    for name in ("points", "surfaces"):
        content = read_json(tmp_path / f"tiles/{name}/tileset.json")
        assert content["asset"]["version"] == "1.1"
        walk(content["root"], tmp_path / "tiles" / name, np.inf)
        earth = np.array(content["root"]["transform"]).reshape(4, 4).T
        top = earth @ [20, 10, 3, 1]
        easting, northing, _ = pyproj.Transformer.from_crs("EPSG:4978", "EPSG:25832").transform(*top[:3])
        assert (easting, northing) == pytest.approx((500120, 5200210), abs=0.01)
    # What the numbers of features are stands in the file of the tiles.
    extras = {
        name: read_json(tmp_path / f"tiles/{name}/tileset.json")["asset"]["extras"] for name in ("points", "surfaces")
    }
    assert extras["points"]["sources"] == {"0": "scene", "1": "ball"} and extras["points"]["evidence"]["measured"] == 1
    assert "classes" not in extras["points"] and extras["surfaces"]["classes"]["bridged"] == FaceClass.BRIDGED
    data = (tmp_path / "tiles/points/r.glb").read_bytes()
    (mesh,) = json.loads(data[20 : 20 + int.from_bytes(data[12:16], "little")])["meshes"]
    (primitive,) = mesh["primitives"]
    ids = primitive["extensions"]["EXT_mesh_features"]["featureIds"]
    assert [one["label"] for one in ids] == ["source", "evidence"] and ids[0]["featureCount"] == 2
    assert all(f"_FEATURE_ID_{one['attribute']}" in primitive["attributes"] for one in ids)
    every = np.concatenate([part for uri, part in found if uri.startswith("r")])
    assert np.allclose(every[np.lexsort(every.T)], points[np.lexsort(points.astype(np.float32).T)], atol=1e-5)
    counts = [len(part) for uri, part in found if uri.startswith("ball")]
    assert len(counts) == 2 and 1000 < counts[0] < 10_000 and counts[1] >= len(closed.vertices)


def test_tiles_and_cameras_kilometres_from_the_origin_of_their_scene_lie_where_the_crs_says(tmp_path: Path):
    """As in a given cloud of 1.2 km, whose origin is a round place."""
    far, folder = np.array([-5000.0, -5000, 400]), tmp_path / "scenes/yard"
    write_cloud(tmp_path / "completed.ply", Cloud(far + np.eye(3)))
    write_json(tmp_path / "g.json", GEOREFERENCE | {"origin_in_crs": quantity([46e4, 521e4, 0.0], "m")})
    here = {"georeference_json": tmp_path / "g.json"}
    write_json(tmp_path / "c.json", {"sources": quantity({"0": "scene"}, "")})
    given = {"cloud": tmp_path / "completed.ply", "report": tmp_path / "c.json"}
    tiles.make_tiles(**given, objects=[], folder=folder / "tiles", **here)
    earth = np.array(read_json(folder / "tiles/points/tileset.json")["root"]["transform"]).reshape(4, 4).T
    found = pyproj.Transformer.from_crs("EPSG:4978", "EPSG:4979", always_xy=True).transform(*(earth @ [*far, 1])[:3])
    there = pyproj.Transformer.from_crs("EPSG:4326", "EPSG:25832", always_xy=True).transform(*found[:2])
    assert [*there, found[2]] == pytest.approx([455e3, 5205e3, 400], abs=0.01)
    (folder / "undistorted/sparse").mkdir(parents=True)
    moved = Sim3(1.0, np.eye(3), -far).matrix
    views = [replace(view, cam_from_world=view.cam_from_world @ moved) for view in from_above(3)]
    write_model(folder / "undistorted/sparse", views)
    export_cameras(scene_workspace=folder / "undistorted", objects=[], folder=folder / "cameras", **here)
    place = metashape_place(folder / "cameras/cameras.xml")
    assert place.in_crs(far[None])[0] == pytest.approx([455e3, 5205e3, 400], abs=0.01)


def write_tables(scenes: list[str], objects: list[str]) -> None:
    """The tables of a project in this folder."""
    Path("config").mkdir(exist_ok=True)
    Path("config/scenes.tsv").write_text("scene\tcloud\n" + "".join(f"{name}\ta.ply\n" for name in scenes))
    rows = "".join(f"{name}\t{scenes[0]}\tb.ply\n" for name in objects)
    Path("config/objects.tsv").write_text(f"object\tscene\tcloud\n{rows}")


def test_export_asks_for_finished_objects_and_says_where_they_are(tmp_path: Path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["scenefuse", "export"])
    with pytest.raises(SystemExit, match=r"no results/objects/NAME/fused.ply is here \(.*\); run the workflow first"):
        command_line.main()
    write_tables(["yard", "field"], ["shed", "barn"])
    for name in ("objects/shed/fused.ply", "objects/barn/fused.ply", "scenes/yard/dense.ply", "summary/report.html"):
        (tmp_path / "results" / name).parent.mkdir(parents=True)
        (tmp_path / "results" / name).touch()
    runs, done = [], subprocess.CompletedProcess([], 0)
    monkeypatch.setattr(subprocess, "run", lambda words, **_: runs.append(words) or done)
    words = ["scenefuse", "export", "--object", "shed", "--cores", "2"]
    monkeypatch.setattr(sys, "argv", words)
    with pytest.raises(SystemExit) as ended:
        command_line.main()
    # No side has photos, and the scene is not completed.
    assert ended.value.code == 0 and not any("cameras" in word or "tiles" in word for word in runs[0][:6])
    assert {"results/objects/shed/surface.glb", "results/objects/shed/drawings", "2"} <= set(runs[0])
    # Drawings are no inputs of the page that shows them.
    assert "results/summary/report.html" in runs[1] and runs[1][runs[1].index("--forcerun") + 1] == "write_report"
    exported = "Export: results/objects/shed/surface.glb, results/objects/shed/drawings, results/summary/report.pdf\n"
    assert capsys.readouterr().out == exported
    for scene in ("yard/completed.ply", "field/dense.ply"):
        (tmp_path / "results/scenes" / scene).parent.mkdir(exist_ok=True)
        (tmp_path / "results/scenes" / scene).touch()
    monkeypatch.setattr(sys, "argv", ["scenefuse", "export", "--what", "tiles"])
    with pytest.raises(SystemExit):
        command_line.main()
    assert [word for word in runs[2] if word.endswith("/tiles")] == ["results/scenes/yard/tiles"]
    monkeypatch.setattr(sys, "argv", ["scenefuse", "export", "--object", "shed", "--object", "barn"])
    with pytest.raises(SystemExit):
        command_line.main()
    assert {"results/objects/shed/surface.glb", "results/objects/barn/surface.glb"} <= set(runs[4])
    # Rows are removed from the tables, and their results stay.
    write_tables(["field"], ["barn"])
    monkeypatch.setattr(sys, "argv", ["scenefuse", "export"])
    with pytest.raises(SystemExit):
        command_line.main()
    made = {word for word in runs[6] if word.startswith("results/")}
    assert made == {
        f"results/{name}" for name in ("objects/barn/surface.glb", "objects/barn/drawings", "summary/report.pdf")
    }
    write_tables(["yard", "field"], ["shed", "barn"])
    (tmp_path / "results/scenes/yard/completed.ply").unlink()
    for last in ("9", "nan", "inf"):
        monkeypatch.setattr(sys, "argv", ["scenefuse", "export", "--object", "shed", "--facade", *"12345678", last])
        with pytest.raises(SystemExit, match="the three points of --facade lie in a line or are no numbers"):
            command_line.main()
    assert not Path("results/objects/shed/facade.txt").exists()
    facade = ["--facade", *["1", "-2", "3", "4", "5", "6", "7", "8", "10.5"]]
    monkeypatch.setattr(sys, "argv", ["scenefuse", "export", *facade])
    with pytest.raises(SystemExit, match="name it by --object"):
        command_line.main()
    monkeypatch.setattr(sys, "argv", ["scenefuse", "export", "--object", "shed", *facade])
    with pytest.raises(SystemExit):
        command_line.main()
    assert Path("results/objects/shed/facade.txt").read_text() == "1.0 -2.0 3.0 4.0 5.0 6.0 7.0 8.0 10.5"


def test_export_makes_no_surface_of_an_object_that_was_not_added(tmp_path: Path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    write_tables(["yard"], ["barn", "shed", "mill"])
    for name, status in (("barn", "fused"), ("shed", "unregistered")):
        write_json(tmp_path / f"results/objects/{name}/fusion.json", {"status": quantity(status, "")})
        (tmp_path / f"results/objects/{name}/fused.ply").touch()
    for name in ("scenes/yard/dense.ply", "scenes/yard/completed.ply", "summary/report.html"):
        (tmp_path / "results" / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "results" / name).touch()
    runs = []
    monkeypatch.setattr(subprocess, "run", lambda words, **_: runs.append(words) or subprocess.CompletedProcess([], 0))

    def export(*words: str) -> set[str]:
        runs.clear()
        monkeypatch.setattr(sys, "argv", ["scenefuse", "export", *words])
        with pytest.raises(SystemExit, match="^0$"):
            command_line.main()
        return {word.removeprefix("results/") for word in runs[0] if word.startswith("results/")}

    of_all = {"scenes/yard/tiles", "summary/report.pdf"}
    assert export() == {"objects/barn/surface.glb", "objects/barn/drawings", *of_all}
    said = capsys.readouterr().out
    assert "Left out: shed, not added to the scene; results/summary/summary.txt says why" in said
    assert "Left out: mill, not finished, or in no scene; results/summary/summary.txt says why" in said
    write_tables(["yard"], ["shed"])
    assert export() == of_all
    for words, sentence in (
        (
            ["--object", "shed"],
            "shed was not added to the scene, so there is no surface of it; results/summary/summary",
        ),
        (["--object", "shad"], "unknown object 'shad'; config/objects.tsv lists: shed"),
        (["-d", "elsewhere"], "go to the folder of the project, and export there"),
        (["--what", "surface"], "there is nothing to export as surface; results/summary/summary.txt says"),
    ):
        monkeypatch.setattr(sys, "argv", ["scenefuse", "export", *words])
        with pytest.raises(SystemExit, match=sentence):
            command_line.main()
    Path("config/objects.tsv").write_text("object\tphotos\tprompts\nbust\tphotos\tclicks.tsv\n")
    monkeypatch.setattr(sys, "argv", ["scenefuse", "export"])
    with pytest.raises(SystemExit, match="bust lies in no scene: its result is results/objects/bust/object.ply"):
        command_line.main()


def test_a_zip_holds_the_page_and_what_it_links_to_so_that_links_work_where_it_is_unpacked(
    tmp_path: Path, monkeypatch, capsys
):
    results = tmp_path / "results"
    for name in ("objects/shed/fused.ply", "objects/shed/drawings/plan.png", "scenes/yard/dense.ply", "secret.txt"):
        (results / name).parent.mkdir(parents=True, exist_ok=True)
        (results / name).write_text(name)
    monkeypatch.chdir(tmp_path)
    write_tables(["yard"], ["shed"])
    monkeypatch.setattr(subprocess, "run", lambda words, **_: subprocess.CompletedProcess(words, 0))
    words = ["scenefuse", "export", "--zip", "to/send.zip"]
    monkeypatch.setattr(sys, "argv", words)
    with pytest.raises(SystemExit, match="--zip needs results/summary/report.html, which is not here"):
        command_line.main()
    links = '<a href="../objects/shed/fused.ply">results/a</a><a href="../gone.ply">b</a><a href="#shed">c</a>'
    (results / "summary").mkdir()
    (results / "summary/report.html").write_text(links, encoding="utf-8")
    (results / "summary/report.pdf").touch()
    (results / "objects/shed/drawings/.timestamp").touch()
    os.utime(results / "objects/shed/fused.ply", (0, 0))  # as copies have it that lost their dates
    (tmp_path / "to").mkdir()
    monkeypatch.setattr(sys, "argv", words)
    with pytest.raises(SystemExit) as ended:
        command_line.main()
    assert ended.value.code == 0 and "To send: to/send.zip (0 MB)" in capsys.readouterr().out
    with zipfile.ZipFile("to/send.zip") as archive:
        files = {"report.html", "report.pdf", "objects/shed/fused.ply", "objects/shed/drawings/plan.png"}
        assert set(archive.namelist()) == files
        assert '<a href="objects/shed/fused.ply">a</a>' in archive.read("report.html").decode()
    for bad in ("to", "nowhere/send.zip"):
        monkeypatch.setattr(sys, "argv", ["scenefuse", "export", "--zip", bad])
        with pytest.raises(SystemExit, match=f"error: {bad} cannot be written"):
            command_line.main()


def test_the_report_says_of_a_surface_where_it_is_in_which_frame_and_what_is_interpolated(closed, tmp_path: Path):
    assert surface_facts(tmp_path, {}) == {}
    (tmp_path / "fused.ply").touch()
    write_json(tmp_path / "surface.json", surface_report(closed, "m") | {"reason": quantity("", "")})
    # A mesh that was deleted leaves the page without it, not without a page.
    for kind in ("ply", "glb"):
        assert surface_facts(tmp_path, {}) == {} and read_mesh(tmp_path, "m") is None
        (tmp_path / f"surface.{kind}").touch()
    found = surface_facts(tmp_path, {})["Mesh"]
    assert f"objects/{tmp_path.name}/surface.ply (local frame, metres; for CloudCompare, MeshLab)" in found
    assert "surface.glb (the same, metres, y up; for Blender, web viewers)" in found
    areas = {"measured": 920, "plain": 0, "unconfirmed": 50, "bridged": 10, "open": 20}
    faces = {f"{kind}_area": quantity(area, "m2") for kind, area in areas.items()}
    shares = {kind: quantity(area / 1000, "of the area") for kind, area in areas.items()}
    write_json(tmp_path / "surface.json", surface_report(closed, "m") | faces | shares)
    assert surface_facts(tmp_path, {})["Mesh area"] == (
        "1,000 m² with its surroundings: 92.0 % measured, 5.0 % beside points that photos do not confirm, or that were"
        " not checked, 1.0 % interpolated over narrow gaps (purple in the drawings), 2.0 % left open as gaps"
    )
    # A run makes what was exported before again, also of an object that it refuses now.
    write_json(tmp_path / "fusion.json", {"status": quantity("unregistered", "")})
    assert surface_facts(tmp_path, {}) == {}
    (tmp_path / "fusion.json").unlink()
    # Without a scale, glTF's metres are none.
    assert "surface.glb (the same, scene units, y up;" in surface_facts(tmp_path, {"unit": "scene units"})["Mesh"]
    pdf, made = tmp_path / "drawings/drawings.pdf", (tmp_path / "surface.json").stat().st_mtime
    pdf.parent.mkdir()
    pdf.touch()
    for age, listed in ((10, False), (-10, True)):
        os.utime(pdf, (made - age, made - age))
        assert ("Drawings" in surface_facts(tmp_path, {})) == listed
    assert surface_facts(tmp_path, {})["Drawings"].endswith("drawings.pdf, to scale")
    assert surface_facts(tmp_path, {"unit": "scene units"})["Drawings"].endswith("scale bars, to no scale in metres")
    named = surface_facts(tmp_path, {"crs": pyproj.CRS("EPSG:25832+7837").to_wkt("WKT1_GDAL")})["Drawings"]
    assert named.endswith("above.tif beside it, for QGIS, is in ETRS89 / UTM zone 32N + DHHN2016 height")


def test_the_report_says_of_a_scene_where_its_exports_are(tmp_path: Path):
    assert scene_exports(tmp_path) == {}
    for name in ("cameras/transforms.json", "completed.ply", "tiles/points/tileset.json"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).touch()
    found = scene_exports(tmp_path)
    assert "without distortion" in found["Cameras"] and found["Tiles"].endswith("tileset.json (3D Tiles 1.1)")
    os.utime(tmp_path / "tiles/points/tileset.json", (0, 0))  # of a scene that was completed again since
    assert "Tiles" not in scene_exports(tmp_path)


def test_paper_begins_with_an_overview_and_gives_an_object_two_pages_with_its_sides_to_scale(drawings, tmp_path: Path):
    shed, summary = tmp_path / "objects/shed", tmp_path / "summary"
    (shed / "figures").mkdir(parents=True)
    summary.mkdir()
    (shed / "drawings").symlink_to(drawings)
    for name in ("before", "after", "missing"):
        Image.new("RGB", (400, 300)).save(shed / f"figures/{name}.png")
    table = {"object": "shed", "status": "registered", "length": 11.4, "width": 10, "height": 8.1, "unit": "m"}
    (summary / "objects.tsv").write_text("\t".join(table) + "\n" + "\t".join(map(str, table.values())) + "\n")
    (summary / "scenes.tsv").write_text("scene\tcrs\tlength_unit\nyard\tEPSG:25832\tm\n")
    write_pdf(
        summary=summary,
        scenes=(tmp_path / "scenes/yard",),
        objects=(shed,),
        title="Hof Müller",
        report=tmp_path / "r.pdf",
    )
    pages = [page.get_textpage().get_text_bounded() for page in pypdfium2.PdfDocument(tmp_path / "r.pdf")]
    assert len(pages) == 3
    # Nothing runs off the page.
    assert all(
        box[2] < 595 for box in (one.get_bounds() for one in pypdfium2.PdfDocument(tmp_path / "r.pdf")[0].get_objects())
    )
    assert "Hof Müller" in pages[0] and "Scene yard" in pages[0] and "ETRS89 / UTM zone 32N (EPSG:25832)" in pages[0]
    assert "completed" in pages[0] and "11.4 m × 10.0 m, 8.10 m high" in pages[0] and "11.4 m" in pages[1]
    assert "from the north" in pages[2] and "y taken for north" in pages[2]
    assert "1.00 scene units" in pages[2] and "1:" not in pages[2]


def test_four_sides_on_paper_are_to_the_round_scale_that_is_written_below(placed, tmp_path: Path):
    (tmp_path / "shed").mkdir()
    (tmp_path / "shed/drawings").symlink_to(placed)
    (tmp_path / "objects.tsv").write_text("object\tstatus\nshed\tregistered\n")
    write_pdf(summary=tmp_path, objects=(tmp_path / "shed",) * 2, title="yard", report=tmp_path / "r.pdf")
    page, other = (pypdfium2.PdfDocument(tmp_path / "r.pdf")[k] for k in (2, 3))
    # The grey of what is not measured does not run into the next object's table.
    grey, none = ((each.render().to_numpy() == 217).all(2).mean() for each in (page, other))
    assert none < 0.001 < 0.01 < grey
    assert "y taken for north" not in page.get_textpage().get_text_bounded()
    scale = int(re.search(r"1:(\d+) on A4", page.get_textpage().get_text_bounded())[1])
    known = read_json(tmp_path / "shed/drawings/drawings.json")
    with rasterio.open(tmp_path / "shed/drawings/south.tif") as file:
        wide_m = file.width * value(known, "south_pixel")
    left, _, right, _ = next(iter(page.get_objects([3]))).get_bounds()
    assert (right - left) / 72 * 0.0254 * scale == pytest.approx(wide_m, rel=0.01)
    # The bar is as long as it says, a millimetre high.
    bounds = [one.get_bounds() for one in page.get_objects([2])]
    (bar,) = {round(r - a, 1) for a, b, r, t in bounds if t - b == pytest.approx(72 / 25.4, abs=0.05)}
    says = float(re.search(r"bar: ([\d.]+) m", page.get_textpage().get_text_bounded())[1])
    assert bar / 72 * 0.0254 * scale == pytest.approx(says, rel=0.005)
    assert scale in {round(k * 10.0**power) for k in (1, 1.5, 2, 2.5, 3, 4, 5, 7.5) for power in range(4)}


@pytest.mark.parametrize(
    ("unit", "pixel", "said"),
    [("m", 0.001, "1:2.5 on A4; bar: 10.0 cm"), ("scene units", 1e-5, "bar: 0.00100 scene units")],
)
def test_four_sides_of_a_small_object_fill_their_place_on_paper_and_no_more(tmp_path: Path, unit, pixel, said):
    drawings = tmp_path / "shed/drawings"
    drawings.mkdir(parents=True)
    pixels = {f"{side}_pixel": quantity(pixel, unit) for side in ("south", "east", "north", "west")}
    write_json(
        drawings / "drawings.json", pixels | {"has_north": quantity(True, ""), "wall_turn": quantity(20.0, "deg")}
    )
    for name in pixels:
        Image.new("RGB", (220, 100), "red").save(drawings / f"{name.removesuffix('_pixel')}.tif")
    (tmp_path / "objects.tsv").write_text("object\tstatus\nshed\tregistered\n")
    write_pdf(summary=tmp_path, objects=(tmp_path / "shed",), title="yard", report=tmp_path / "r.pdf")
    page = pypdfium2.PdfDocument(tmp_path / "r.pdf")[2]
    assert "what is missing" not in page.get_textpage().get_text_bounded()  # of clouds nothing says it
    (left, *_, right, _), (beside, *_, end, _), *_ = (image.get_bounds() for image in page.get_objects([3]))
    assert right - left > 200 and right < beside and end < 595
    text = page.get_textpage().get_text_bounded()
    assert said in text and "from the south, looking towards 340°" in text and "west, looking towards 70°" in text
    # A drawing that was deleted leaves the report without the page of the four sides, not without the report.
    (drawings / "east.tif").unlink()
    write_pdf(summary=tmp_path, objects=(tmp_path / "shed",), title="yard", report=tmp_path / "r.pdf")
    assert len(pypdfium2.PdfDocument(tmp_path / "r.pdf")) == 2


def test_long_names_do_not_run_off_the_paper(tmp_path: Path):
    folders = [
        tmp_path / "the_north_wing_of_the_old_mill_seen_from_the_other_bank_",
        tmp_path / "THE_SOUTH_WING_OF_THE_OLD_MILL_AS_SEEN_FROM_THE_OTHER_BANK",
    ]
    table = "\n".join(["object\tstatus", *(f"{folder.name}\tregistered" for folder in folders)])
    (tmp_path / "objects.tsv").write_text(table + "\n")
    write_pdf(summary=tmp_path, objects=tuple(folders), report=tmp_path / "r.pdf")
    pages = pypdfium2.PdfDocument(tmp_path / "r.pdf")
    assert max(one.get_bounds()[2] for page in pages for one in page.get_objects()) < 595


@pytest.mark.parametrize("command", ["", " 0123.jpg" * 2000])
def test_a_report_on_paper_of_what_failed_says_so(tmp_path: Path, command):
    (tmp_path / "objects.tsv").write_text(f"object\tstatus\terror\nshed\tfailed\ttoo little overlap{command}\n")
    (tmp_path / "shed/figures").mkdir(parents=True)
    Image.new("RGB", (400, 300)).save(tmp_path / "shed/figures/before.png")
    write_pdf(summary=tmp_path, objects=(tmp_path / "shed",), title="yard", report=tmp_path / "r.pdf")
    pages = list(pypdfium2.PdfDocument(tmp_path / "r.pdf"))
    assert len(pages) == 2 and all("oo little overlap" in page.get_textpage().get_text_bounded() for page in pages)
    # The picture is from an earlier run.
    assert not any(list(page.get_objects([3])) for page in pages)


@pytest.mark.slow
def test_pictures_below_a_long_text_on_paper_go_on_on_a_new_page(tmp_path: Path):
    (tmp_path / "shed/figures").mkdir(parents=True)
    for name in ("before", "after"):
        Image.new("RGB", (400, 300)).save(tmp_path / f"shed/figures/{name}.png")
    known = {"unit": "m", "length": 3, "width": 2, "height": 1, "frames": 9, "registered": 9, "added_points": 5}
    known |= {"scale_sd_log": 0.01, "world_deviation": 0.01, "surface_missing": 0.1, "surface_never_seen": 0.1}
    for words in range(380, 500, 15):
        row = {"object": "shed", "status": "registered", "advice": "overlap " * words} | known
        (tmp_path / "objects.tsv").write_text("\n".join("\t".join(map(str, part)) for part in (row, row.values())))
        write_pdf(summary=tmp_path, objects=(tmp_path / "shed",), title="yard", report=tmp_path / "r.pdf")
        images = [one for page in pypdfium2.PdfDocument(tmp_path / "r.pdf") for one in page.get_objects([3])]
        assert len(images) == 2 and all(top - low > 40 for _, low, _, top in (image.get_bounds() for image in images))


def test_faces_that_share_two_edges_are_unfolded_by_themselves():
    # UVAtlas ends the stage on a face whose back is another one, or that is folded upon its neighbour at a point.
    square, twin, fold = [[0, 1, 2], [1, 3, 2]], [[2, 1, 0]], [[2, 0, 4], [4, 0, 2]]
    assert not beyond_manifold(np.array(square)).any()
    assert beyond_manifold(np.array(square + twin)).sum() == 1
    assert beyond_manifold(np.array(square + fold)).sum() >= 1
    points = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0], [-1, 1, 0.0]])
    uv = unfolded(points, np.array(square + twin), 64)
    assert uv.shape == (3, 3, 2) and np.isfinite(uv).all()

"""What is still missing of a painted sphere, by class, and the photos that show it."""

import csv
import json
from dataclasses import replace

import cv2
import numpy as np
import pyproj
import pytest
from support.changed_scene import write_changes
from support.painted_sphere import CENTER, RADIUS, sphere_views

from scenefuse.cloud.clouds import Cloud, concatenate, read_cloud, write_cloud
from scenefuse.core.stage import StageError, quantity, read_json, value, write_json
from scenefuse.core.transforms import Sim3, look_at
from scenefuse.fuse.find_missing import POSITION, MissingInputs, MissingOutputs, find_missing, photo_rows
from scenefuse.fuse.measure import Evidence
from scenefuse.fuse.missing import Free, Lack, Plan, Station, find_missing_surface, plan_stations
from scenefuse.geometry.photo_check import pack
from scenefuse.photos.geodesy import GridFrame, LocalFrame
from scenefuse.photos.workspace import View, write_model

UP = np.array([0.0, 0.0, 1.0])
NOBODY = pack([])


def photographed(arc, count=24, waves=30.0):
    """Photos of the sphere from an arc around it, for the check, and their masks."""
    images, masks, intrinsics, poses, _ = sphere_views(count, 200, arc, waves)
    views = [
        View(f"{i}.png", k, np.linalg.inv(pose), 200, 200, cv2.cvtColor(image, cv2.COLOR_RGB2GRAY))
        for i, (image, k, pose) in enumerate(zip(images, intrinsics, poses))
    ]
    silhouettes = [View(v.name, v.intrinsics, v.cam_from_world, 200, 200, mask) for v, mask in zip(views, masks)]
    return pack(views), silhouettes


@pytest.fixture(autouse=True)
def coarse_cells(monkeypatch):
    """Cells of an 80th of the diagonal, for speed."""
    monkeypatch.setattr("scenefuse.fuse.missing.RESOLUTION", 1 / 80)


def ball(count=14000):
    """Points spread evenly over the sphere."""
    k = np.arange(count) + 0.5
    height, turn = 1 - 2 * k / count, np.pi * (1 + np.sqrt(5)) * k
    flat = np.sqrt(1 - height**2)
    normals = np.stack([flat * np.cos(turn), flat * np.sin(turn), height], axis=1)
    return Cloud(CENTER + RADIUS * normals, normals.astype(np.float32))


def shown(cloud, views, least=3):
    """The points that several photos show from their front."""
    count = np.zeros(len(cloud))
    for view in views:
        towards = view.centre - cloud.points
        count += (towards * cloud.normals).sum(1) > 0.3 * np.linalg.norm(towards, axis=1)
    return cloud[count >= least]


@pytest.fixture(scope="module")
def half():
    """Photos from one side, and the part of the sphere that they measure."""
    photos, masks = photographed(np.pi)
    return photos, masks, shown(ball(), photos.views)


def test_a_sphere_photographed_from_all_sides_lacks_nothing_but_its_foot():
    photos, masks = photographed(2 * np.pi)
    cloud = shown(ball(), photos.views)
    missing = find_missing_surface(cloud, cloud, (photos, NOBODY), masks)
    assert missing.covered_cells > 1000
    assert (missing.cells.points[:, 2] < CENTER[2] - 0.6 * RADIUS).all()
    assert missing.share(Lack.UNTEXTURED) + missing.share(Lack.CONTRADICTED) < 0.002


@pytest.mark.slow
def test_the_side_without_photos_was_never_seen_and_stations_stand_before_it(half):
    photos, masks, cloud = half
    missing = find_missing_surface(cloud, cloud, (photos, NOBODY), masks)
    assert (
        missing.share(Lack.NEVER_SEEN) > 0.1
        and missing.share(Lack.UNTEXTURED) + missing.share(Lack.CONTRADICTED) < 0.02
    )
    plan = plan_stations(missing, cloud, cloud, photos.views)
    # The photos are from y > 0.
    assert all(station.photos[1].centre[1] < CENTER[1] for station in plan.stations)
    assert plan.stations[0].shows > 0.3 and plan.reachable > 0.5
    assert sum(station.shows for station in plan.stations) <= plan.reachable <= 1
    # What the stations show is no longer missing, where they said so.
    more = pack([View(v.name, v.intrinsics, v.cam_from_world, 200, 200, np.full((200, 200), 128, np.uint8))
                 for station in plan.stations for v in station.photos])  # fmt: skip
    grown = shown(ball(), photos.views + more.views)
    left = find_missing_surface(grown, grown, (photos, more), masks)
    before, after = ((found.cells.points[:, 2] > CENTER[2] - 0.4 * RADIUS).sum() for found in (missing, left))
    assert after < 0.5 * before


@pytest.mark.slow
@pytest.mark.parametrize(("waves", "kind"), [(0.0, Lack.UNTEXTURED), (30.0, Lack.CONTRADICTED)])
def test_points_that_no_photo_confirms_are_told_apart_by_texture(waves, kind):
    photos, masks = photographed(2 * np.pi, waves=waves)
    obj = shown(ball(), photos.views)
    gone = np.linalg.norm(obj.points - CENTER - [0, 0, RADIUS], axis=1) < 0.5 * RADIUS
    missing = find_missing_surface(obj, obj[~gone], (photos, NOBODY), masks)
    top = missing.cells[missing.cells.points[:, 2] > CENTER[2]]
    assert len(top) > 100 and (top.fields["missing"] == kind).mean() > 0.9
    stations = plan_stations(missing, obj, obj, photos.views).stations
    assert (len(stations) > 0 and stations[0].photos[1].centre[2] > CENTER[2]) == (kind == Lack.CONTRADICTED)


@pytest.mark.slow
def test_surface_with_plain_points_only_is_there_and_counted_as_plain(half):
    photos, masks, cloud = half
    plain = cloud.points[:, 2] > 0.5 * cloud.points[:, 2].max()
    known = replace(cloud, fields={"evidence": np.where(plain, Evidence.PLAIN, Evidence.MEASURED)})
    found, without = (find_missing_surface(cloud, c, (photos, NOBODY), masks) for c in (known, cloud))
    assert (found.covered_cells, found.share(Lack.NEVER_SEEN)) == (
        without.covered_cells,
        without.share(Lack.NEVER_SEEN),
    )
    assert found.plain == pytest.approx(
        plain.mean() * found.covered_cells / (found.covered_cells + len(found.cells)), abs=0.03
    )
    assert without.plain == 0


def test_what_photos_see_through_is_not_missing(half):
    photos, masks, cloud = half
    floating = Cloud(CENTER + [0, RADIUS + 0.4, 0] + 0.2 * (ball(500).points - CENTER), ball(500).normals)
    alone = find_missing_surface(cloud, cloud, (photos, NOBODY), masks)
    both = find_missing_surface(concatenate([cloud, floating]), cloud, (photos, NOBODY), masks)
    assert abs(both.share(Lack.NEVER_SEEN) - alone.share(Lack.NEVER_SEEN)) < 0.05
    assert not (both.cells.points[:, 1] > CENTER[1] + RADIUS).any()


def test_nothing_is_missing_inside_the_wall_that_a_niche_is_in():
    """Close-ups from its front, a flight from higher up; the wall goes on where the object's surroundings end."""

    def sheet(low, high, normal, count):
        points = np.random.default_rng(0).uniform(low, high, (count, 3))
        return Cloud(points, np.tile(np.array(normal, np.float32), (count, 1)))

    front, floor = (0, -1, 0), (0, 0, 1)
    wall, ground = sheet((-8, 0, 0), (8, 0, 6), front, 200_000), sheet((-8, -9, 0), (8, 0, 0), floor, 200_000)
    at = wall.points
    wall = wall[(np.abs(at[:, 0]) > 1) | (at[:, 2] > 3)]
    niche = [sheet((-1, 1, 0), (1, 1, 3), front, 12_000), sheet((-1, 0, 0), (1, 1, 0), floor, 4_000)]
    niche += [sheet((x, 0, 0), (x, 1, 3), (-x, 0, 0), 6_000) for x in (-1, 1)]
    niche += [sheet((-1, 0, 3), (1, 1, 3), (0, 0, -1), 4_000)]
    obj = concatenate([*niche, wall[(np.abs(wall.points[:, 0]) < 1.5) & (wall.points[:, 2] < 3.5)]])

    def photo(name, eye, middle):
        k, pose = np.array([[180.0, 0, 120], [0, 180, 100], [0, 0, 1]]), np.eye(4)
        pose[:3, :3] = look_at(np.array(eye), np.array(middle), UP)
        pose[:3, 3] = -pose[:3, :3] @ eye
        return View(name, k, pose, 240, 200, np.full((200, 240), 128, np.uint8))

    def mask(view):
        pixels = np.stack([*np.meshgrid(np.arange(240) + 0.5, np.arange(200) + 0.5), np.ones((200, 240))], axis=-1)
        rays = pixels @ np.linalg.inv(view.intrinsics).T @ view.cam_from_world[:3, :3]
        at = view.centre - rays * (view.centre[1] / rays[..., 1])[..., None]
        return replace(view, pixels=(np.abs(at[..., 0]) < 1.5) & (at[..., 2] > 0) & (at[..., 2] < 3.5))

    turns = np.radians(np.linspace(-60, 60, 9))
    close = [photo(f"{z}{a}", (5 * np.sin(a), -5 * np.cos(a), z), (0, 0, 1.5)) for a in turns for z in (1.2, 2.6)]
    flight = [photo(f"{x}{y}", (x, y, 2.5 - y), (0.3 * x, 0, 2)) for x in np.linspace(-8, 8, 8) for y in (-5.0, -7.0)]
    completed = concatenate([obj, wall, ground])
    missing = find_missing_surface(obj, completed, (pack(close), pack(flight)), [mask(view) for view in close])
    x, y, z = missing.cells.points.T
    within_wall = (y > 0) & (z > 0) & ((np.abs(x) > 1) | (z > 3) | (y > 1))
    assert within_wall.sum() < 0.01 * missing.covered_cells


def test_without_masks_only_the_own_points_count_and_a_note_says_so(half):
    photos, _, cloud = half
    missing = find_missing_surface(cloud, cloud, (photos, NOBODY), [])
    assert len(missing.cells) == 0 and "0 masks" in missing.notes[0]
    assert plan_stations(missing, cloud, cloud, photos.views) == Plan([], 0.0)


@pytest.mark.slow
def test_no_station_lies_below_the_ground_or_in_a_wall(half):
    photos, masks, cloud = half
    missing = find_missing_surface(cloud, cloud, (photos, NOBODY), masks)
    x, y = (a.ravel() for a in np.meshgrid(np.arange(-12, 12, 0.1), np.arange(-12, 12, 0.1)))
    ground = Cloud(CENTER + np.stack([x, y, np.full_like(x, -RADIUS)], 1), np.tile(np.float32([0, 0, 1]), (len(x), 1)))
    # A wall right behind the sphere: from beyond it nothing is seen.
    wall = Cloud(CENTER + np.stack([x, np.full_like(x, -4.0), y], 1), np.tile(np.float32([0, 1, 0]), (len(x), 1)))
    plan = plan_stations(missing, cloud, concatenate([cloud, ground, wall]), photos.views)
    eyes = np.array([view.centre for station in plan.stations for view in station.photos]) - CENTER
    assert len(eyes) and (eyes[:, 2] > -RADIUS).all() and (eyes[:, 1] > -4.0).all()


def test_no_line_of_sight_steps_through_a_fence():
    x, z = (a.ravel() for a in np.meshgrid(np.arange(-1, 1, 0.025), np.arange(-0.5, 1, 0.025)))
    free = Free(np.stack([x, np.full_like(x, -2.0), z], 1), np.zeros(3), 0.6, 0.05)
    eyes = np.stack([np.full(100, 0.01), -np.linspace(2.2, 8, 100), np.full(100, 0.3)], 1)
    assert not any(free.ways(eye[None]) or free.sees(eye[None], np.zeros((1, 3))).any() for eye in eyes)
    assert free.sees(eyes[-1:], eyes[:1]).all()


@pytest.mark.slow
def test_what_a_wall_far_from_the_object_hides_is_not_shown_though_a_slit_shows_the_middle(half):
    photos, masks, cloud = half
    missing = find_missing_surface(cloud, cloud, (photos, NOBODY), masks)
    slit, away = 0.45, 2.9
    turn, z = (a.ravel() for a in np.meshgrid(np.linspace(0, 2 * np.pi, 240), np.arange(-6, 6, 0.08)))
    around = np.stack([away * np.cos(turn), away * np.sin(turn), z], 1)[abs(z) > slit]
    x, y = (a.ravel() for a in np.meshgrid(np.arange(-9, 9, 0.1), np.arange(-9, 9, 0.1)))
    ground = Cloud(CENTER + np.stack([x, y, np.full_like(x, -6.0)], 1), np.tile(np.float32([0, 0, 1]), (len(x), 1)))
    wall = Cloud(CENTER + around, np.float32(-around / np.linalg.norm(around, axis=1)[:, None]))
    stations = plan_stations(missing, cloud, concatenate([cloud, ground, wall]), photos.views).stations
    for station in stations:
        eye, cells = station.photos[1].centre - CENTER, missing.cells.points - CENTER
        places = eye + np.linspace(0, 1, 400)[:, None, None] * (cells - eye)
        inside = (np.linalg.norm(places[..., :2], axis=2) < away).argmax(0)
        hidden = (inside > 0) & (abs(places[inside, np.arange(len(cells)), 2]) > slit)
        facing = ((eye - cells) * missing.cells.normals).sum(1) > 0
        assert station.shows <= (facing & ~hidden).mean()
    assert stations


def test_rows_say_where_to_stand_and_where_to_look(half):
    photos, masks, cloud = half
    missing = find_missing_surface(cloud, cloud, (photos, NOBODY), masks)
    plan = plan_stations(missing, cloud, cloud, photos.views)
    frame = LocalFrame(47.4, 8.5, 400.0)
    rows = photo_rows(plan, CENTER[2] - RADIUS, frame)
    assert len(rows) == 3 * len(plan.stations)
    for row in rows:
        eye = np.array([row[f"local_{axis}_m"] for axis in "xyz"])
        back = frame.apply(np.array([[row[k] for k in ("latitude_deg", "longitude_deg", "altitude_m")]]))[0]
        np.testing.assert_allclose(back, eye, atol=0.01)
        ahead, heading, pitch = CENTER - eye, np.radians(row["heading_deg"]), np.radians(row["pitch_deg"])
        looks = [np.sin(heading) * np.cos(pitch), np.cos(heading) * np.cos(pitch), np.sin(pitch)]
        assert looks @ ahead > 0.99 * np.linalg.norm(ahead)
        assert row["above_foot_m"] == pytest.approx(eye[2] - CENTER[2] + RADIUS, abs=1e-2)
        for name, ahead in (("north", np.cos(heading)), ("east", np.sin(heading)), ("south", -np.cos(heading))):
            assert (name in row["looking"]) == (ahead > np.sin(np.pi / 8))
    bare = photo_rows(plan, 0.0, None, unit="scene units")[0]
    assert "longitude_deg" not in bare and "looking" not in bare and bare["local_z_scene_units"] == rows[0]["local_z_m"]
    # What a station shows is said once, of its three photos together.
    shares = [row["station_shows_percent_of_missing"] for row in rows]
    assert set(shares[1::3] + shares[2::3]) == {""}
    assert sum(shares[::3]) == pytest.approx(100 * sum(station.shows for station in plan.stations), abs=0.2)
    # GPS may count heights from another zero than the scene does.
    higher = photo_rows(plan, 0.0, frame, gps_higher=47.0)
    assert {round(b["altitude_m"] - a["altitude_m"], 2) for a, b in zip(rows, higher)} == {47.0}


@pytest.mark.parametrize("crs", ["EPSG:2048", "EPSG:32734", "EPSG:3031"])
def test_headings_count_from_north_wherever_the_axes_of_the_crs_point(crs):
    to_crs = pyproj.Transformer.from_crs("EPSG:4326", crs, always_xy=True)
    place = 19.0, -75.0 if crs == "EPSG:3031" else -33.0
    eye, north_east = (np.array([*to_crs.transform(*at), 0.0]) for at in (place, np.add(place, [1e-5, 1e-5])))
    pose = np.eye(4)
    pose[:3, :3] = look_at(np.zeros(3), north_east - eye, UP)
    plan = Plan([Station([View("1", np.eye(3), pose, 9, 9)], 1.0)], 1.0)
    (row,) = photo_rows(plan, 0.0, GridFrame(crs, eye))
    wanted = np.degrees(np.arctan(np.cos(np.radians(place[1]))))
    assert row["heading_deg"] == pytest.approx(wanted, abs=0.3)
    assert row["looking"] == ("north" if crs == "EPSG:3031" else "north-east")
    assert "looking" not in photo_rows(plan, 0.0, GridFrame(None, eye))[0]


def test_an_object_of_which_nothing_came_into_the_scene_is_missing_as_a_whole(half):
    photos, masks, cloud = half
    nothing = Cloud(np.zeros((0, 3)), np.zeros((0, 3), np.float32))
    missing = find_missing_surface(cloud, nothing, (photos, NOBODY), masks)
    assert missing.covered_cells == 0 and len(missing.cells) > 1000
    assert plan_stations(missing, cloud, nothing, photos.views) == Plan([], 0.0)


@pytest.fixture
def files(tmp_path, half):
    """What the stage reads: the half sphere, registered where it is, in a scene with one photo of its own."""
    photos, masks, cloud = half
    for name, views in (("object", masks), ("scene", masks[:4])):
        (tmp_path / name / "sparse").mkdir(parents=True), (tmp_path / name / "images").mkdir()
        write_model(tmp_path / name / "sparse", views)
        for view in views:
            cv2.imwrite(str(tmp_path / name / "images" / view.name), view.pixels.astype(np.uint8) * 200)
    (tmp_path / "masks").mkdir()
    for view in masks:
        cv2.imwrite(str(tmp_path / "masks" / view.name), view.pixels.astype(np.uint8) * 255)
    write_cloud(tmp_path / "object.ply", cloud)
    write_cloud(tmp_path / "dense.ply", cloud)
    write_changes(tmp_path, cloud, cloud[:0])
    fusion = {"status": "fused", "reason": "", "scene_from_object": Sim3.identity().matrix}
    write_json(tmp_path / "fusion.json", {k: quantity(v, "") for k, v in fusion.items()})
    write_json(tmp_path / "georeference.json", {"length_unit": quantity("m", ""), **{
        f"origin_{k}": quantity(v, "") for k, v in (("latitude_deg", 47.4), ("longitude_deg", 8.5), ("altitude_m", 400))
    }})  # fmt: skip
    names = ("object.ply", "dense.ply", "fused.ply", "checked.ply", "fusion.json", "georeference.json")
    inputs = MissingInputs(*(tmp_path / name for name in (*names, "object", "scene", "masks")))
    outputs = MissingOutputs(*(tmp_path / name for name in ("missing.ply", "next.csv", "next.geojson", "missing.json")))
    return inputs, outputs


@pytest.mark.slow
def test_the_stage_writes_cells_photos_and_shares(files):
    inputs, outputs = files
    find_missing(inputs=inputs, outputs=outputs)
    report, cells = read_json(outputs.report), read_cloud(outputs.missing)
    share = sum(value(report, name) for name in ("never_seen", "untextured", "contradicted"))
    assert value(report, "missing") == pytest.approx(share) and value(report, "missing") > 0.1
    assert len(cells) > 100
    with open(outputs.next_photos, newline="") as file:
        rows = list(csv.DictReader(file))
    features = json.loads(outputs.geojson.read_text())["features"]
    assert len(rows) == len(features) == 3 * value(report, "stations") > 0
    assert features[0]["geometry"]["coordinates"] == [float(rows[0][k]) for k in POSITION]
    assert value(report, "of") == "its surface"
    # Of heights that count from the middle camera no altitude is made.
    relative = read_json(inputs.georeference_json) | {"heights": quantity("relative", "")}
    write_json(inputs.georeference_json, relative)
    find_missing(inputs=inputs, outputs=outputs)
    features = json.loads(outputs.geojson.read_text())["features"]
    assert len(features[0]["geometry"]["coordinates"]) == 2 and "altitude" not in outputs.next_photos.read_text()
    find_missing(inputs=replace(inputs, masks=None), outputs=outputs)
    report = read_json(outputs.report)
    assert (
        value(report, "of") == "what its own cloud holds" and "0 masks: what they do not" in value(report, "notes")[0]
    )


def test_of_an_unregistered_object_the_stage_writes_the_reason(files):
    inputs, outputs = files
    fusion = {"status": "unregistered", "reason": "too few points", "scene_from_object": None}
    write_json(inputs.fusion_json, {k: quantity(v, "") for k, v in fusion.items()})
    find_missing(inputs=inputs, outputs=outputs)
    assert value(read_json(outputs.report), "reason") == "too few points"
    assert json.loads(outputs.geojson.read_text())["features"] == []
    assert outputs.next_photos.read_text().strip() == "station,photo" and outputs.missing.is_file()


def test_a_mask_of_another_size_is_one_sentence(files):
    inputs, outputs = files
    cv2.imwrite(str(inputs.masks / "3.png"), np.zeros((50, 60), np.uint8))
    with pytest.raises(StageError, match="3.png is 60 x 50 pixels, but its camera is made for 200 x 200"):
        find_missing(inputs=inputs, outputs=outputs)
    assert not outputs.missing.exists()


def test_of_an_object_without_photos_the_stage_writes_that_nothing_was_looked_for(files):
    inputs, outputs = files
    find_missing(inputs=replace(inputs, object_workspace=None, masks=None), outputs=outputs)
    report = read_json(outputs.report)
    assert value(report, "status") == "not_looked_for" and "the object has no photos" in value(report, "reason")
    assert "missing" not in report and len(outputs.next_photos.read_text().splitlines()) == 1

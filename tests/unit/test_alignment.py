"""The alignment from shared features finds a planted similarity, and refuses where nothing is shared."""

import os
from dataclasses import asdict, dataclass, replace

import numpy as np
import pycolmap
import pytest
from scipy.spatial.transform import Rotation

from scenefuse.core.stage import StageError, quantity, read_json, value, write_json
from scenefuse.core.transforms import Sim3, rotation_angle_deg
from scenefuse.georef.align_models import AlignmentSettings, align_models, find_consensus
from scenefuse.georef.landmarks import match_landmarks, read_landmarks
from scenefuse.georef.reprojection import match_errors, minimise_reprojection, observations
from scenefuse.photos.geodesy import LocalFrame
from scenefuse.photos.photos import Photo

SETTINGS = AlignmentSettings()


@dataclass(frozen=True)
class World:
    """Points, what they look like (unit vectors, 128), and photos that look at them: centre, target, focal length."""

    points: np.ndarray
    looks: np.ndarray


def world(seed, count=400, spread=(5, 5, 2)):
    rng = np.random.default_rng(seed)
    return World(rng.uniform(-1, 1, (count, 3)) * spread, rng.gamma(0.5, 1, (count, 128)))


def ring(radius, height, count, target=(0, 0, 0)):
    angles = np.linspace(0, 2 * np.pi, count, endpoint=False)
    centres = np.stack([radius * np.cos(angles), radius * np.sin(angles), np.full(count, float(height))], axis=1)
    return [(centre + target, np.array(target, float)) for centre in centres]


def capture(folder, name, seen, views, seed, *, model_from_world=None, noise_px=0.3, focal=700.0, names=None):
    """A sparse model of some points from some views, in its own frame, and the database with the descriptors."""
    rng = np.random.default_rng(seed)
    move = model_from_world or Sim3.identity()
    camera = pycolmap.Camera(model="SIMPLE_RADIAL", width=800, height=600, params=[focal, 400, 300, 0.05], camera_id=1)
    model = pycolmap.Reconstruction()
    model.add_camera_with_trivial_rig(camera)
    tracks = [[] for _ in seen.points]
    with pycolmap.Database.open(folder / f"{name}.db") as database:
        database.write_camera(camera, use_camera_id=True)
        for k, (centre, target) in enumerate(views, 1):
            z = (target - centre) / np.linalg.norm(target - centre)
            x = np.cross(z, [0, 0.1, 1.0])
            x /= np.linalg.norm(x)
            rotation = np.stack([x, np.cross(z, x), z])
            in_cam = (seen.points - centre) @ rotation.T
            xy = np.asarray(camera.img_from_cam(in_cam)).reshape(-1, 2)
            inside = (in_cam[:, 2] > 0.5) & (xy > 0).all(1) & (xy < [800, 600]).all(1)
            rows = np.flatnonzero(inside)
            rows = rng.permutation(rows)[: int(0.8 * len(rows))]
            noisy = xy[rows] + rng.normal(0, noise_px, (len(rows), 2))
            looks = seen.looks[rows] * rng.uniform(0.7, 1.3, (len(rows), 128))
            looks = np.sqrt(looks / looks.sum(1, keepdims=True))
            image = pycolmap.Image(
                name=names[k - 1] if names else f"{name}{k}.jpg",
                camera_id=1,
                image_id=k,
                points2D=[pycolmap.Point2D(p) for p in noisy],
            )
            turned = rotation @ move.rotation.T
            pose = pycolmap.Rigid3d(pycolmap.Rotation3d(turned), -turned @ move.apply(centre))
            model.add_image_with_trivial_frame(image, pose)
            database.write_image(pycolmap.Image(name=image.name, camera_id=1, image_id=k), use_image_id=True)
            database.write_descriptors(
                k, pycolmap.FeatureDescriptors(pycolmap.FeatureExtractorType.SIFT, (512 * looks).astype(np.uint8))
            )
            for j, row in enumerate(rows):
                tracks[row].append(pycolmap.TrackElement(k, j))
    points = move.apply(seen.points) + move.scale * rng.normal(0, 0.002, seen.points.shape)
    for point, track in zip(points, tracks):
        if len(track) >= 2:
            model.add_point3D(point, pycolmap.Track(track), np.zeros(3, np.uint8))
    (folder / name).mkdir()
    model.write(folder / name)
    return folder / name, folder / f"{name}.db"


def aligned(folder, obj, scene, settings=SETTINGS, seed=0, **files):
    align_models(
        **files,
        object_sparse=obj[0],
        object_features=obj[1],
        scene_sparse=scene[0],
        scene_features=scene[1],
        report=folder / "alignment.json",
        seed=seed,
        settings=settings,
    )
    return read_json(folder / "alignment.json")


OBJECT_FROM_WORLD = Sim3(
    3.7, Rotation.from_euler("xyz", [130, -40, 75], degrees=True).as_matrix(), np.array([4.0, -9, 2])
)


def part(whole, chosen):
    return World(whole.points[chosen], whole.looks[chosen])


def near(whole, radius=2.5):
    return part(whole, np.linalg.norm(whole.points[:, :2], axis=1) < radius)


@pytest.fixture(scope="module")
def pair(tmp_path_factory):
    """A flight over a world, and an orbit of its middle in another frame; each also sees points of its own."""
    folder = tmp_path_factory.mktemp("pair")
    whole, strange = world(1), world(2, 150, (2, 2, 1))
    scene = capture(folder, "scene", whole, ring(6, 14, 12), 3)
    middle = near(whole)
    both = World(np.concatenate([middle.points, strange.points]), np.concatenate([middle.looks, strange.looks]))
    obj = capture(folder, "object", both, ring(6, 2.5, 10), 4, model_from_world=OBJECT_FROM_WORLD)
    return obj, scene


@pytest.fixture(scope="module")
def found(pair, tmp_path_factory):
    """The alignment of the pair; only to be read."""
    return aligned(tmp_path_factory.mktemp("found"), *pair)


@pytest.mark.slow
def test_a_planted_similarity_is_found(found):
    assert value(found, "found") is True
    truth = OBJECT_FROM_WORLD.inverse()
    pose = Sim3.from_matrix(np.array(value(found, "scene_from_object")))
    assert value(found, "scale") == pytest.approx(pose.scale, rel=1e-12)
    assert pose.scale == pytest.approx(truth.scale, rel=3e-3)
    assert rotation_angle_deg(pose.rotation @ truth.rotation.T) < 0.2
    centre = OBJECT_FROM_WORLD.apply(np.zeros(3))
    assert np.linalg.norm(pose.apply(centre) - truth.apply(centre)) < 0.02
    # The errors are a few standard deviations at most.
    assert abs(np.log(pose.scale / truth.scale)) < 5 * value(found, "scale_sd_log") < 0.02
    assert value(found, "shared_points") > 40 and value(found, "reprojection_px") < 2
    assert value(found, "object_photos") == 10 and value(found, "scene_photos") == 12


@pytest.mark.slow
def test_a_scene_that_is_bent_far_away_does_not_bend_the_pose_of_what_the_photos_look_at(tmp_path):
    whole = world(1)
    far = np.maximum(np.linalg.norm(whole.points, axis=1) - 3, 0)
    bent = replace(whole, points=whole.points + np.outer(0.02 * far, [1, 0, 0]))
    scene = capture(tmp_path, "scene", bent, ring(6, 14, 12), 3)
    obj = capture(tmp_path, "object", whole, ring(6, 2.5, 10), 4, model_from_world=OBJECT_FROM_WORLD)
    truth, centre = OBJECT_FROM_WORLD.inverse(), OBJECT_FROM_WORLD.apply(np.zeros(3))
    shifts = []
    for count in (100, 1000):
        found = aligned(tmp_path, obj, scene, replace(SETTINGS, nearest_points=count))
        pose = Sim3.from_matrix(np.array(value(found, "scene_from_object")))
        shifts.append(np.linalg.norm(pose.apply(centre) - truth.apply(centre)))
        if count == 100:
            assert shifts[0] < 3 * value(found, "translation_sd")
    assert shifts[0] < 0.5 * shifts[1]


@pytest.mark.slow
def test_how_certain_the_place_is_does_not_depend_on_what_lies_behind_the_object(pair, found, tmp_path):
    behind, own, strange = world(5, 900, (4, 3, 2)), near(world(1)), world(2, 150, (2, 2, 1))
    seen = World(
        np.concatenate([own.points, strange.points, behind.points + [0, 14, 0]]),
        np.concatenate([own.looks, strange.looks, behind.looks]),
    )
    obj = capture(tmp_path, "object", seen, ring(6, 2.5, 10), 4, model_from_world=OBJECT_FROM_WORLD)
    again = aligned(tmp_path, obj, pair[1])
    assert value(again, "translation_sd") < 2 * value(found, "translation_sd")


@pytest.mark.slow
def test_the_same_input_gives_the_same_output_and_is_not_written_to(pair, found, tmp_path):
    databases = [side[1] for side in pair]
    for database in databases:
        os.utime(database, (1e9, 1e9))
    again = aligned(tmp_path, *pair)
    assert again == found
    assert [database.stat().st_mtime for database in databases] == [1e9, 1e9]


@pytest.mark.slow
def test_another_place_is_not_found(pair, tmp_path):
    elsewhere = capture(tmp_path, "elsewhere", world(7), ring(6, 14, 12), 8)
    found = aligned(tmp_path, pair[0], elsewhere)
    assert value(found, "found") is False and value(found, "scene_from_object") is None
    # Without a ratio test every point has a partner, and still nothing is found.
    found = aligned(tmp_path, pair[0], elsewhere, replace(SETTINGS, max_ratio=1.0))
    assert value(found, "matches") > 50
    assert value(found, "found") is False and "are needed" in value(found, "reason")


def positions(folder, shift=(0, 0, 0), noise_m=0.3, scene_sd_m=0.3):
    """The files that say where the photos of an orbit of the world's middle were taken, moved by `shift`."""
    frame = LocalFrame(47.5, 8.5, 400.0)
    centres = np.array([centre for centre, _ in ring(6, 2.5, 10)]) + shift
    centres += np.random.default_rng(0).normal(0, noise_m, centres.shape)
    # Another flight's heights have another zero.
    places = frame.inverse(centres) + [0, 0, 40]
    listed = [
        Photo(f"object{k}.jpg", 800, 600, "", *place, horizontal_sd_m=noise_m) for k, place in enumerate(places, 1)
    ]
    write_json(folder / "photos.json", {"photos": [asdict(photo) for photo in listed]})
    origin = {"origin_latitude_deg": 47.5, "origin_longitude_deg": 8.5, "origin_altitude_m": 400.0}
    write_json(folder / "scene.json", {name: quantity(number, "") for name, number in origin.items()})
    flight = [Photo("a.jpg", 800, 600, "", 47.5, 8.5, 430.0, horizontal_sd_m=scene_sd_m)]
    write_json(folder / "flight.json", {"photos": [asdict(photo) for photo in flight]})
    return {
        "object_photos": folder / "photos.json",
        "scene_photos": folder / "flight.json",
        "scene_json": folder / "scene.json",
    }


@pytest.mark.slow
def test_gps_says_the_same(pair, found, tmp_path):
    beside = aligned(tmp_path, *pair, **positions(tmp_path))
    assert value(beside, "scene_from_object") == value(found, "scene_from_object")
    assert value(beside, "gps_photos") == 10 and value(beside, "gps_miss") < 3 and value(beside, "notes") == []
    assert value(beside, "gps_shift_apart") < 0.5 and abs(value(beside, "gps_heading_apart_deg")) < 6
    assert value(found, "gps_photos") == 0 and value(found, "gps_miss") is None


@pytest.fixture(scope="module")
def consensus(pair):
    """What the pair's points agree on without GPS; only to be read."""
    obj, scene = (read_landmarks(*side) for side in pair)
    return find_consensus(observations(obj, scene, match_landmarks(obj, scene, SETTINGS.max_ratio)), 0)


@pytest.fixture
def aligned_pair(pair, consensus, tmp_path, monkeypatch):
    """Call it with the files of GPS: the pair's alignment without searching again for what its points agree on."""
    monkeypatch.setattr("scenefuse.georef.align_models.find_consensus", lambda seen, seed: consensus)
    return lambda files: aligned(tmp_path, *pair, **files)


@pytest.mark.slow
def test_gps_that_contradicts_the_pose_is_a_note(aligned_pair, found, tmp_path):
    beside = aligned_pair(positions(tmp_path, (9, 0, 0)))
    assert value(beside, "scene_from_object") == value(found, "scene_from_object")
    assert value(beside, "gps_shift_apart") == pytest.approx(9, abs=0.5)
    assert "GPS of 10 of its photos contradicts the pose" in value(beside, "notes")[0]


def test_exact_close_ups_do_not_contradict_a_pose_in_a_scene_of_ordinary_gps(aligned_pair, tmp_path):
    exact = positions(tmp_path, (2, 1, 0), noise_m=0.02, scene_sd_m=3.0)
    beside = aligned_pair(exact)
    assert value(beside, "gps_miss") < 3 and value(beside, "notes") == []
    assert value(beside, "gps_shift_apart") == pytest.approx(5**0.5, abs=0.1)


def test_a_flight_whose_base_was_off_does_not_contradict_the_pose(aligned_pair, tmp_path):
    exact = positions(tmp_path, (2, 1, 0), noise_m=0.02, scene_sd_m=0.02)
    assert value(aligned_pair(exact), "gps_miss") > 4
    scene = read_json(exact["scene_json"])
    write_json(exact["scene_json"], scene | {"gps_shift": quantity([2.0, 1.0, 30.0], "m")})
    assert value(aligned_pair(exact), "gps_miss") < 3


def test_gps_says_where_to_click_on_an_object_that_shares_nothing(pair, tmp_path):
    elsewhere = capture(tmp_path, "elsewhere", world(7), ring(6, 14, 12), 8)
    lost = aligned(tmp_path, pair[0], elsewhere, **positions(tmp_path, (9, 0, 0)))
    assert value(lost, "found") is False and "m east and" in value(lost, "notes")[0]
    assert value(lost, "gps_place")[0] == pytest.approx(9, abs=0.5)


def test_gps_that_spreads_too_little_says_nothing(aligned_pair, tmp_path):
    beside = aligned_pair(positions(tmp_path, noise_m=3.0))
    assert value(beside, "found") is True and value(beside, "gps_photos") == 0


@pytest.mark.slow
@pytest.mark.parametrize("shift", [0.0, 12.0])
def test_gps_tells_an_object_from_its_twin(tmp_path, shift):
    obj, scene = with_twin(tmp_path)
    found = aligned(tmp_path, obj, scene, **positions(tmp_path, (shift, 0, 0)))
    place = Sim3.from_matrix(np.array(value(found, "scene_from_object"))).apply(OBJECT_FROM_WORLD.apply(np.zeros(3)))
    assert value(found, "found") is True and np.linalg.norm(place - [shift, 0, 0]) < 0.1
    assert value(found, "settled_by_gps") is True and "GPS distinguishes it from its like" in value(found, "reason")


@pytest.mark.slow
def test_an_object_that_stands_there_twice_is_not_placed(tmp_path):
    found = aligned(tmp_path, *with_twin(tmp_path))
    assert value(found, "found") is False and "twice" in value(found, "reason")


def with_twin(tmp_path):
    """Its twin looks the same where it looks like anything: each half of the matches agrees on another place."""
    whole = world(1)
    middle = near(whole)
    rng = np.random.default_rng(0)
    half = rng.random(len(middle.points)) < 0.5
    twin = World(middle.points[half] + [12, 0, 0], middle.looks[half])
    rest = part(whole, np.linalg.norm(whole.points[:, :2], axis=1) >= 2.5)
    own = part(middle, ~half)
    points = np.concatenate([rest.points, own.points, twin.points])
    looks = np.concatenate([rest.looks, own.looks, twin.looks])
    scene = capture(tmp_path, "scene", World(points, looks), ring(6, 25, 12, (6, 0, 0)), 3)
    obj = capture(tmp_path, "object", middle, ring(6, 2.5, 10), 4, model_from_world=OBJECT_FROM_WORLD)
    return obj, scene


@pytest.mark.slow
def test_points_along_one_line_leave_the_rotation_open(tmp_path):
    whole = world(1, 300)
    line = World(whole.points.copy(), whole.looks)
    line.points[:40] = np.linspace([-2, 0, 0], [2, 0, 0], 40) + 0.002 * line.points[:40]
    scene = capture(tmp_path, "scene", line, ring(6, 14, 12), 3)
    obj = capture(
        tmp_path, "object", part(line, np.arange(40)), ring(6, 2.5, 10), 4, model_from_world=OBJECT_FROM_WORLD
    )
    found = aligned(tmp_path, obj, scene)
    assert value(found, "found") is False and "rotation open" in value(found, "reason")


@pytest.mark.slow
def test_photos_in_both_models(tmp_path):
    """The scene made from every second photo of the object: the same files, the same features."""
    whole = near(world(1))
    views = ring(6, 2.5, 12)
    names = [f"{k}.jpg" for k in range(12)]
    obj = capture(tmp_path, "object", whole, views, 4, model_from_world=OBJECT_FROM_WORLD, names=names)
    scene = capture(tmp_path, "scene", whole, views[::2], 4, names=names[::2])
    found = aligned(tmp_path, obj, scene)
    assert value(found, "found") is True
    assert value(found, "scale") == pytest.approx(1 / 3.7, rel=2e-3)


def test_photos_side_by_side_along_a_front_look_at_what_they_show(tmp_path):
    seen, rng = world(11, 300, spread=(8, 1, 3)), np.random.default_rng(2)
    # Axes that spread a little: they meet behind the photographer.
    views = [
        (np.array([x, -9.0, 0]), np.array([1.4 * x, 0, 0]) + rng.normal(0, 0.1, 3)) for x in np.linspace(-4, 4, 10)
    ]
    capture(tmp_path, "front", seen, views, 0)
    place = read_landmarks(tmp_path / "front", tmp_path / "front.db").looked_at()
    assert abs(place[1]) < 1.5 and np.abs(place[[0, 2]]).max() < 2


def test_refinement_undoes_a_wrong_start(pair):
    obj, scene = (read_landmarks(model, database) for model, database in pair)
    seen = observations(obj, scene, match_landmarks(obj, scene, 0.8))
    truth = OBJECT_FROM_WORLD.inverse()
    seen = seen.subset(match_errors(seen, truth) < 6)
    tilt = Rotation.from_rotvec([0.06, -0.03, 0.09]).as_matrix()
    start = Sim3(1.06, tilt, np.array([0.15, 0.06, -0.12])) @ truth
    assert np.median(match_errors(seen, start)) > 6
    found = minimise_reprojection(seen, start, 3.0)
    assert np.median(match_errors(seen, found)) < 2
    assert found.scale == pytest.approx(truth.scale, rel=3e-3)


def test_a_cap_keeps_the_points_seen_most(pair):
    few, all_points = (read_landmarks(*pair[1], most) for most in (50, 10000))
    assert len(few.points) == 50 < len(all_points.points)
    assert np.diff(few.start).min() >= np.sort(np.diff(all_points.start))[-50]
    assert len(few.rays) == few.start[-1]


def test_matching_does_not_depend_on_the_size_of_blocks(pair):
    obj, scene = (read_landmarks(model, database) for model, database in pair)
    whole = match_landmarks(obj, scene, 0.85)
    np.testing.assert_array_equal(match_landmarks(obj, scene, 0.85, block=37), whole)


def test_a_database_of_other_photos_is_refused(pair, tmp_path):
    with pytest.raises(StageError, match="rerun the matching"):
        aligned(tmp_path, (pair[0][0], pair[1][1]), pair[1])

import os
import shutil
import signal
import sys
import time
from dataclasses import replace

import numpy as np
import pycolmap
import pytest
from PIL import Image
from scipy.ndimage import gaussian_filter

from scenefuse.core.stage import StageError, quantity, read_json, value, write_json
from scenefuse.core.transforms import fit_sim3
from scenefuse.georef.georeference import camera_poses
from scenefuse.mvs.undistort import UndistortSettings, undistort_photos, undistort_picture
from scenefuse.photos.frames import FrameSettings, VideoSettings, extract_frames, list_photos
from scenefuse.photos.geodesy import LocalFrame
from scenefuse.photos.photos import Photo, inspect_photo, photo_notes, read_photos, write_photos
from scenefuse.photos.workspace import View, write_model
from scenefuse.sfm import mapping
from scenefuse.sfm.colmap import cancellable, doubtful_photos, explained_matches, require_database
from scenefuse.sfm.features import FeatureSettings, camera_groups, extract_features
from scenefuse.sfm.lens import CENTRED, Choice
from scenefuse.sfm.mapping import MappingSettings, map_photos
from scenefuse.sfm.matches import (
    MAX_DISTANCE,
    MatchSettings,
    alike_pairs,
    choose_pairs,
    match_features,
    sequential_pairs,
    spatial_pairs,
)

PAIRS = MatchSettings(spatial_from=10, exhaustive_up_to=20, neighbours=3, overlap=2, loop_every=4)
FEATURES = FeatureSettings(max_image_size_px=1000, max_features=800, first_octave=0, camera_mode="auto")
MAPPING = MappingSettings(min_registered_share=0.8)
FRAME = LocalFrame(47.0, 8.0, 400.0)
# COLMAP's lists separate by blanks and take # for a comment.
NAMES = ["# 0.png", "1 {1}.png", "2 Süd.png", "3.png", "4.png", "5.png"]


def photo(name, position=None, size=(640, 480), camera="", focal=None):
    where = (None, None, None) if position is None else tuple(float(v) for v in FRAME.inverse(np.array([position]))[0])
    return Photo(name, *size, "", *where, focal, camera)


def strip(count, step=10.0):
    return [photo(f"{i:03d}.jpg", (i * step, 0.0, 50.0)) for i in range(count)]


def chosen(photos, settings, is_video=False, alike=()):
    """The kind of pairs, why, and the pairs, where `alike` are those that look alike."""
    return choose_pairs(photos, is_video, settings, lambda count: list(alike))


def test_pairs_are_chosen_by_what_is_known():
    def kind_of(photos, is_video=False):
        return chosen(photos, PAIRS, is_video)[0]

    assert kind_of(strip(8)) == "exhaustive"
    assert kind_of(strip(12)) == "spatial"
    assert kind_of(strip(12, step=0.1)) == "exhaustive"  # all at one place: GPS says nothing
    without = [photo(f"{i:03d}.jpg") for i in range(30)]
    assert kind_of(without[:20]) == "exhaustive"
    assert kind_of(without[:20], True) == "sequential"
    assert kind_of(without) == "sequential"
    kind, reason, pairs = chosen(without[:5], replace(PAIRS, pairs="spatial"))
    assert (kind, len(pairs)) == ("exhaustive", 10) and "too few photos" in reason


def test_spatial_pairs_are_neighbours_and_connected():
    photos = strip(6) + [photo(f"far{i}.jpg", (5000 + 10 * i, 0.0, 50.0)) for i in range(3)]
    pairs = spatial_pairs(photos, 2)
    assert ("000.jpg", "001.jpg") in pairs and ("000.jpg", "002.jpg") in pairs
    assert ("000.jpg", "004.jpg") not in pairs
    assert ("005.jpg", "far0.jpg") in pairs  # the spanning tree
    assert len(set(pairs)) == len(pairs)


def test_photos_without_a_position_are_compared_with_all_or_in_large_sets_with_those_that_look_alike():
    photos, alike = [*strip(30), photo("no_gps.jpg")], [("no_gps.jpg", "007.jpg"), ("003.jpg", "029.jpg")]
    few, many = (chosen(photos, replace(PAIRS, exhaustive_up_to=most), alike=alike)[2] for most in (40, 20))
    assert [sum("no_gps.jpg" in pair for pair in pairs) for pairs in (few, many)] == [30, 1]
    assert ("007.jpg", "no_gps.jpg") in many and ("003.jpg", "029.jpg") not in many
    assert set(many) < set(few)


def test_of_photos_without_features_none_look_alike(tmp_path):
    with pycolmap.Database.open(tmp_path / "features.db") as database:
        camera = database.write_camera(pycolmap.Camera(model="PINHOLE", width=9, height=9, params=[9, 9, 4, 4]))
        database.write_image(pycolmap.Image(name="a.jpg", camera_id=camera))
    assert alike_pairs(tmp_path / "features.db", 5) == []


def test_a_long_sequence_closes_loops_where_photos_look_alike():
    photos = [photo(f"{i:03d}.jpg") for i in range(30)]
    kind, reason, pairs = chosen(photos, PAIRS, alike=[("029.jpg", "003.jpg")])
    assert kind == "sequential" and "look alike" in reason
    assert ("003.jpg", "029.jpg") in pairs and len(pairs) == 29 + 28 + 1


def test_flights_up_a_facade_and_flights_at_two_heights_hold_together():
    columns = [photo(f"{c}_{r:02d}.jpg", (4.0 * c, 0.0, 2.0 * r)) for c in range(4) for r in range(12)]
    pairs = set(spatial_pairs(columns, 10))
    for one in range(3):
        beside = [(f"{one}_{r:02d}.jpg", f"{one + 1}_{r:02d}.jpg") for r in range(12)]
        assert pairs.issuperset(beside)
    floors = [photo(f"{f}_{k:02d}.jpg", (2.0 * k, 0.0, 40.0 * f)) for f in range(2) for k in range(20)]
    pairs = set(spatial_pairs(floors, 10))
    assert pairs.issuperset([(f"0_{k:02d}.jpg", f"1_{k:02d}.jpg") for k in range(20)])
    unknown = [replace(p, altitude_m=None) if k % 3 == 0 else p for k, p in enumerate(floors)]
    assert len(spatial_pairs(unknown, 10)) > 0


def test_strips_of_close_photos_hold_together():
    flight = [photo(f"{s}_{k:02d}.jpg", (2.0 * k, 40.0 * s + 0.1 * (k % 3), 80.0)) for s in range(4) for k in range(40)]
    pairs = spatial_pairs(flight, 20)
    between = [(int(a[0]), int(b[0])) for a, b in pairs if a[0] != b[0]]
    # By the nearest alone there are three.
    assert min(between.count((s, s + 1)) for s in range(3)) >= 40


def test_one_wild_position_does_not_let_the_noise_of_the_others_choose_the_pairs():
    photos = [photo(f"{k:02d}.jpg", place) for k, place in enumerate(np.random.default_rng(0).normal(0, 5, (60, 3)))]
    wild = [photo("wild.jpg", (3000.0, 0.0, 0.0)), *photos]
    assert chosen(photos, MatchSettings())[0] == chosen(wild, MatchSettings())[0] == "exhaustive"


def test_positions_that_a_phone_repeats_do_not_choose_the_pairs():
    """A phone writes its last fix into dozens of photos: all distances among these are 0."""
    repeated = [photo(f"{i:03d}.jpg", (40.0 * (i // 30), 0.0, 50.0)) for i in range(120)]
    settings = MatchSettings()
    assert chosen(repeated, settings)[0] == "exhaustive"
    assert chosen(repeated, replace(settings, exhaustive_up_to=100))[0] == "sequential"
    hovering = strip(120) + [photo(f"z{i:03d}.jpg", (500.0, 0.0, 50.0)) for i in range(12)]
    assert chosen(hovering, settings)[0] == "spatial"
    pairs = set(spatial_pairs(hovering, 6))
    assert pairs.issuperset([(f"z{i:03d}.jpg", f"z{i + 1:03d}.jpg") for i in range(11)])


def test_sequential_pairs_close_loops():
    pairs = sequential_pairs([str(i) for i in range(9)], 2, 4)
    assert ("0", "2") in pairs and ("0", "3") not in pairs
    assert ("0", "8") in pairs and ("4", "8") in pairs
    assert len(pairs) == 8 + 7 + 3


def test_photos_counted_without_leading_zeros_are_paired_in_the_order_they_were_taken_in():
    photos = [photo(name) for name in sorted(f"b/IMG_{k}.JPG" for k in range(1, 31))]
    kind, _, pairs = chosen(photos, PAIRS)
    names = [p.name for p in photos]
    assert kind == "sequential" and pairs == sorted(pairs, key=lambda p: (names.index(p[0]), names.index(p[1])))
    assert all(names.index(a) < names.index(b) for a, b in pairs)
    found = {frozenset(int(name[6:-4]) for name in pair) for pair in pairs}
    assert all(frozenset((k, k + step)) in found for step in (1, 2) for k in range(1, 31 - step))


def test_cameras_are_shared_by_size_model_and_focal_length():
    photos = [photo("a/1"), photo("a/2", camera="X", focal=500.0), photo("b/3"), photo("b/4", camera="X", focal=700.0)]
    assert camera_groups(photos, "auto") == [["a/1", "b/3"], ["a/2"], ["b/4"]]
    assert camera_groups(photos, "single") == [["a/1", "a/2", "b/3", "b/4"]]
    assert camera_groups(photos, "per_folder") == [["a/1", "a/2"], ["b/3", "b/4"]]
    assert len(camera_groups(photos, "per_photo")) == 4
    with pytest.raises(StageError, match=r"differ in size: 640x480 \(a/1\), 320x240 \(c\)"):
        camera_groups([*photos, photo("c", size=(320, 240))], "single")


def test_a_zoom_lens_that_does_not_tell_its_35_mm_equivalent_is_a_camera_for_each_focal_length(tmp_path):
    folder = tmp_path / "p"
    folder.mkdir()
    for number, focal_mm in enumerate((18.0, 55.0, 55.2, 18.0, 200.0, None)):
        exif = Image.Exif()
        exif[0x0110], exif[0x0112] = "EOS 600D", 6 if number % 2 else 1
        if focal_mm:
            exif[0x8769] = {0x920A: focal_mm}
        Image.new("RGB", (40, 40), (number, 0, 0)).save(folder / f"{number}.jpg", exif=exif)
    wanted = [["0.jpg", "3.jpg"], ["1.jpg", "2.jpg"], ["4.jpg"], ["5.jpg"]]
    list_photos(source=folder, upright=tmp_path / "upright", photos=tmp_path / "scene.json", settings=VideoSettings())
    settings = FrameSettings(max_width_px=20)
    extract_frames(source=folder, frames=tmp_path / "frames", photos=tmp_path / "object.json", settings=settings)
    for name in ("scene", "object"):
        assert camera_groups(read_photos(tmp_path / f"{name}.json"), "auto") == wanted
    # The equivalent says the same, and more; a lens that tells a little more at another distance stays one camera.
    prime = [replace(photo(f"{mm}", focal=900.0), focal_mm=mm) for mm in (35.0, 36.4)]
    assert len(camera_groups(prime, "auto")) == 1


def test_photos_that_were_cropped_have_cameras_of_their_own_and_no_focal_length_by_exif(tmp_path):
    (tmp_path / "p").mkdir()
    taken_as = [(6000, 4000), (4000, 6000), (6000, 3376), (3376, 6000), (0, 0), None]
    for number, sizes in enumerate(taken_as):
        exif = Image.Exif()
        exif[0x8769] = {0xA405: 24} | (dict(zip((0xA002, 0xA003), sizes)) if sizes else {})
        Image.new("RGB", (60, 40), (number, 0, 0)).save(tmp_path / "p" / f"{number}.jpg", exif=exif)
    photos = [inspect_photo(tmp_path / "p", f"{number}.jpg") for number in range(6)]
    assert [p.name for p in photos if p.cropped] == ["2.jpg", "3.jpg"]
    assert [p.focal_px for p in photos] == [40.0, 40.0, None, None, 40.0, 40.0]
    assert camera_groups(photos, "auto") == [["0.jpg", "1.jpg", "4.jpg", "5.jpg"], ["2.jpg"], ["3.jpg"]]
    assert len(camera_groups(photos, "single")) == 1
    assert photo_notes(photos, 0) == [
        "2 photos were cropped, by the size in EXIF: each has a principal point of its own"
    ]


def test_photos_of_another_digital_zoom_have_a_camera_of_their_own(tmp_path):
    (tmp_path / "p").mkdir()
    for number, zoom in enumerate((None, 0.0, 1.0, 1.3, 2.0, 1.3)):
        exif = Image.Exif()
        exif[0x0110], exif[0x8769] = "E-M1", {0x920A: 12.0} | ({} if zoom is None else {0xA404: zoom})
        Image.new("RGB", (40, 40), (number, 0, 0)).save(tmp_path / "p" / f"{number}.jpg", exif=exif)
    photos = [inspect_photo(tmp_path / "p", f"{number}.jpg") for number in range(6)]
    assert camera_groups(photos, "auto") == [["0.jpg", "1.jpg", "2.jpg"], ["3.jpg", "5.jpg"], ["4.jpg"]]


def test_an_error_in_a_worker_reaches_the_caller():
    def fail(cancellation_token):
        raise ValueError("inside")

    with pytest.raises(ValueError, match="inside"):
        cancellable(fail)


def test_a_signal_ends_a_long_function_and_waits_for_it():
    ended = []

    def work(cancellation_token):
        time.sleep(0.3)
        os.kill(os.getpid(), signal.SIGUSR1)
        while not cancellation_token.is_cancelled:
            time.sleep(0.01)
        time.sleep(0.5)
        ended.append(True)

    before = signal.signal(signal.SIGUSR1, lambda *_: sys.exit(3))
    try:
        with pytest.raises(SystemExit):
            cancellable(work)
    finally:
        signal.signal(signal.SIGUSR1, before)
    assert ended


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    """Six photos of two textured walls that meet in a corner, seen from an arc, and the true camera centres."""
    folder = tmp_path_factory.mktemp("capture")
    (folder / "photos").mkdir()
    rng = np.random.default_rng(0)
    texture = np.stack(
        [sum(gaussian_filter(rng.standard_normal((256, 512)), s) * s for s in (1, 2, 4)) for _ in range(3)], axis=2
    )
    texture = (np.clip(texture / np.abs(texture).std() * 45 + 128, 0, 255)).astype(np.uint8)
    columns, rows = np.meshgrid(np.arange(240) + 0.5, np.arange(180) + 0.5)
    rays = np.stack([(columns - 120) / 200, (rows - 90) / 200, np.ones_like(rows)], axis=2)
    centres = []
    for index, angle in enumerate(np.radians(np.linspace(-35, 35, 6))):
        centre = np.array([4 * np.sin(angle), -0.3 * (index % 2), -4 * np.cos(angle)])
        z = -centre / np.linalg.norm(centre)
        x = np.cross([0, 1, 0], z) / np.linalg.norm(np.cross([0, 1, 0], z))
        directions = rays @ np.stack([x, np.cross(z, x), z])
        # Walls z = |x| / 2 + ..., one for each sign of x; the nearer hit in front of the camera counts.
        best = np.full(rows.shape, np.inf)
        for sign in (-1.0, 1.0):
            normal = np.array([sign * 0.6, 0.0, 1.0])
            distance = (1.5 - centre @ normal) / (directions @ normal)
            hit = centre + distance[..., None] * directions
            valid = (distance > 0) & (sign * hit[..., 0] >= 0)
            best = np.where(valid & (distance < best), distance, best)
        hit = centre + np.where(np.isfinite(best), best, 0)[..., None] * directions
        u, v = (hit[..., 0] * 75 + 256) % 512, (hit[..., 1] * 75 + 128) % 256
        Image.fromarray(texture[v.astype(int), u.astype(int)]).save(folder / "photos" / NAMES[index])
        centres.append(centre)
    list_photos(
        source=folder / "photos", upright=folder / "upright", photos=folder / "photos.json", settings=VideoSettings()
    )
    return folder, np.array(centres)


@pytest.mark.slow
def test_features_matches_and_mapping_recover_the_cameras(capture, tmp_path, monkeypatch):
    # Two threads add in another order now and then, on a busy machine; one is the same bit for bit.
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    folder, truth = capture
    extract_features(
        folder=folder / "upright",
        photos=folder / "photos.json",
        features=tmp_path / "features.db",
        settings=FEATURES,
    )
    for name in ("first", "second"):
        match_features(
            photos=folder / "photos.json",
            features=tmp_path / "features.db",
            database=tmp_path / f"{name}.db",
            matches=tmp_path / "matches.json",
            settings=PAIRS,
            seed=0,
        )
        map_photos(
            folder=folder / "upright",
            photos=folder / "photos.json",
            database=tmp_path / f"{name}.db",
            sparse=tmp_path / name,
            report=tmp_path / f"{name}.json",
            settings=MAPPING,
            seed=0,
        )
    matches = read_json(tmp_path / "matches.json")
    assert value(matches, "pairs_choice") == "exhaustive" and value(matches, "pairs") == 15
    report = read_json(tmp_path / "first.json")
    assert value(report, "registered") == 6 and value(report, "not_registered") == []
    assert value(report, "mean_reprojection_error_px") < 1.0
    model = pycolmap.Reconstruction(tmp_path / "first")
    names, _, centres = camera_poses(model)
    assert names == NAMES
    assert np.linalg.norm(fit_sim3(centres, truth).apply(centres) - truth, axis=1).max() < 0.15
    again = camera_poses(pycolmap.Reconstruction(tmp_path / "second"))[2]
    np.testing.assert_array_equal(centres, again)
    assert sorted(p.name for p in tmp_path.iterdir() if p.name.startswith(".")) == []

    undistort_photos(
        folder=folder / "upright",
        photos=folder / "photos.json",
        sparse=tmp_path / "first",
        workspace=tmp_path / "dense",
        report=tmp_path / "dense.json",
        settings=UndistortSettings(max_size_px=120),
    )
    dense = pycolmap.Reconstruction(tmp_path / "dense" / "sparse")
    assert {c.model_name for c in dense.cameras.values()} == {"PINHOLE"}
    report = read_json(tmp_path / "dense.json")
    assert max(value(report, "sizes_px")[0]) <= 120 and value(report, "photos") == 6
    assert sorted(p.name for p in (tmp_path / "dense").iterdir()) == ["images", "sparse"]
    # The arc is level: up is the direction orthogonal to the plane of the camera centres.
    plane = np.linalg.svd(centres[::2] - centres[::2].mean(0))[2][2]
    assert abs(plane @ value(report, "up_in_camera_frame")) > 0.99
    with pytest.raises(StageError, match="6 photos are missing in"):
        undistort_photos(
            folder=tmp_path,
            photos=folder / "photos.json",
            sparse=tmp_path / "first",
            workspace=tmp_path / "none",
            report=tmp_path / "none.json",
            settings=UndistortSettings(max_size_px=120),
        )
    assert not (tmp_path / "none").exists()


@pytest.mark.slow
def test_features_and_matches_that_a_signal_ended_are_gone_on_with(capture, tmp_path, monkeypatch):
    folder, _ = capture
    # With more, which photo is done first decides its number.
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    photos, sizes = folder / "photos.json", []

    def stopped(function, *arguments, **options):
        """Half of the photos or pairs, then a signal."""
        if "image_names" in options:
            options["image_names"] = options["image_names"][:3]
        else:
            listed = options["pairing_options"].match_list_path
            listed.write_text("".join(listed.read_text().splitlines(keepends=True)[:6]))
        function(*arguments, **options)
        raise SystemExit(143)

    def run(name):
        features = tmp_path / f"{name}.features.db"
        for stage in (
            lambda: extract_features(folder=folder / "upright", photos=photos, features=features, settings=FEATURES),
            lambda: match_features(
                photos=photos, features=features, database=tmp_path / f"{name}.db",
                matches=tmp_path / f"{name}.json", settings=PAIRS, seed=0,
            ),
        ):  # fmt: skip
            if name == "again":
                with monkeypatch.context() as patch, pytest.raises(SystemExit):
                    for module in ("features", "matches"):
                        patch.setattr(f"scenefuse.sfm.{module}.cancellable", stopped)
                    stage()
                sizes.append([p.stat().st_size for p in tmp_path.glob(".again*part-*.db")])
            stage()
        with pycolmap.Database.open(tmp_path / f"{name}.db") as opened:
            counts = [opened.num_keypoints_for_image(i.image_id) for i in opened.read_all_images()]
            return len(opened.read_all_cameras()), counts, inliers_of(tmp_path / f"{name}.db")

    assert run("once") == run("again")
    assert all(len(kept) == 1 for kept in sizes) and not list(tmp_path.glob(".*"))


def test_matches_of_other_features_are_not_gone_on_with(capture, tmp_path, monkeypatch):
    folder, _ = capture
    paths = {
        "photos": folder / "photos.json",
        "features": tmp_path / "features.db",
        "database": tmp_path / "matches.db",
    }
    extract_features(folder=folder / "upright", photos=paths["photos"], features=paths["features"], settings=FEATURES)

    def run():
        match_features(**paths, matches=tmp_path / "matches.json", settings=PAIRS, seed=0)

    def stopped(*arguments, **options):
        raise SystemExit(143)

    monkeypatch.setattr("scenefuse.sfm.matches.cancellable", stopped)
    with pytest.raises(SystemExit):
        run()
    monkeypatch.undo()
    with pycolmap.Database.open(paths["features"]) as opened:
        first = opened.read_all_images()[0].image_id
        moved = opened.read_keypoints(first)
        moved[:, 0] += 1
        opened.update_keypoints(first, moved)
    run()
    with pycolmap.Database.open(paths["database"]) as opened:
        np.testing.assert_array_equal(opened.read_keypoints(first), moved)


@pytest.mark.slow
def test_matches_under_another_calibration_are_not_gone_on_with(capture, tmp_path, monkeypatch):
    folder, _ = capture
    photos, features, database = folder / "photos.json", tmp_path / "features.db", tmp_path / "matches.db"

    def run(calibration=None):
        given = {"folder": folder / "upright", "photos": photos, "features": features, "calibration": calibration}
        extract_features(**given, settings=FEATURES)
        match_features(
            photos=photos, features=features, database=database,
            matches=tmp_path / "matches.json", settings=PAIRS, seed=0,
        )  # fmt: skip

    def stopped(*arguments, **options):
        raise SystemExit(143)

    with monkeypatch.context() as patch, pytest.raises(SystemExit):
        patch.setattr("scenefuse.sfm.matches.cancellable", stopped)
        run()
    (tmp_path / "camera.txt").write_text("1 PINHOLE 240 180 200 200 121 92")
    run(tmp_path / "camera.txt")
    with pycolmap.Database.open(database) as opened:
        (camera,) = opened.read_all_cameras()
    assert camera.model_name == "PINHOLE" and camera.params.tolist() == [200, 200, 121, 92]


def test_photos_that_look_alike_are_found_by_their_features(tmp_path):
    rng = np.random.default_rng(0)
    places = rng.integers(0, 256, (5, 40, 128))
    with pycolmap.Database.open(tmp_path / "features.db") as database:
        camera = database.write_camera(
            pycolmap.Camera(model="SIMPLE_RADIAL", width=64, height=64, params=[50, 32, 32, 0])
        )
        for k in range(15):
            image = database.write_image(pycolmap.Image(name=f"{k:02d}.jpg", camera_id=camera))
            noisy = np.clip(places[k % 5] + rng.normal(0, 20, (40, 128)), 0, 255).astype(np.uint8)
            database.write_descriptors(image, pycolmap.FeatureDescriptors(pycolmap.FeatureExtractorType.SIFT, noisy))
    found = alike_pairs(tmp_path / "features.db", 2)
    assert len(found) == 30 and all(int(a[:2]) % 5 == int(b[:2]) % 5 for a, b in found)


def test_guided_matches_are_those_of_colmap(capture, tmp_path):
    folder, _ = capture
    photos, features = folder / "photos.json", tmp_path / "features.db"
    extract_features(folder=folder / "upright", photos=photos, features=features, settings=FEATURES)
    shutil.copyfile(features, tmp_path / "colmap.db")
    options = pycolmap.FeatureMatchingOptions(use_gpu=False, guided_matching=True)
    options.sift.max_ratio, options.sift.max_distance = PAIRS.max_ratio, MAX_DISTANCE
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = 0
    pycolmap.match_exhaustive(tmp_path / "colmap.db", options, verification_options=verification)
    for name, guided in (("plain", False), ("ours", True)):
        match_features(
            photos=photos, features=features, database=tmp_path / f"{name}.db", matches=tmp_path / f"{name}.json",
            settings=replace(PAIRS, guided_matching=guided), seed=0,
        )  # fmt: skip
    plain, ours, theirs = (inliers_of(tmp_path / f"{name}.db") for name in ("plain", "ours", "colmap"))
    assert len(ours & theirs) > 0.97 * max(len(ours), len(theirs)) and len(ours) > 1.03 * len(plain)
    assert read_json(tmp_path / "ours.json")["inlier_matches"]["value"] == len(ours)


def inliers_of(database):
    """Photos and features of all verified matches."""
    with pycolmap.Database.open(database) as opened:
        pairs = map(pycolmap.pair_id_to_image_pair, opened.read_two_view_geometry_num_inliers()[0])
        return {(*p, *m) for p in pairs for m in opened.read_two_view_geometry(*p).inlier_matches.tolist()}


def test_a_model_that_is_upright_already_says_so_in_its_workspace(capture, tmp_path):
    folder, _ = capture
    views = [View(name, np.array([[200.0, 0, 120], [0, 200, 90], [0, 0, 1]]), np.eye(4), 240, 180) for name in NAMES]
    (tmp_path / "sparse").mkdir()
    write_model(tmp_path / "sparse", views)
    write_json(tmp_path / "georeference.json", {"up_cue": quantity("GPS", "")})
    undistort_photos(
        folder=folder / "upright",
        photos=folder / "photos.json",
        sparse=tmp_path / "sparse",
        georeference=tmp_path / "georeference.json",
        workspace=tmp_path / "workspace",
        report=tmp_path / "undistorted.json",
        settings=UndistortSettings(max_size_px=240),
    )
    report = read_json(tmp_path / "undistorted.json")
    assert value(report, "up_in_camera_frame") == [0, 0, 1] and value(report, "up_cue") == "GPS"


def test_a_photo_that_was_replaced_is_named_by_those_who_read_it(tmp_path):
    (tmp_path / "photos").mkdir()
    for index in range(3):
        Image.new("RGB", (40, 30), (100 + index, 0, 0)).save(tmp_path / "photos" / f"{index}.png")
    list_photos(
        source=tmp_path / "photos",
        upright=tmp_path / "upright",
        photos=tmp_path / "photos.json",
        settings=VideoSettings(),
    )
    Image.new("RGB", (40, 30), (200, 0, 0)).save(tmp_path / "photos" / "1.png")
    reading = {"folder": tmp_path / "upright", "photos": tmp_path / "photos.json"}
    with pytest.raises(StageError, match=r"1\.png is not the photo that was listed any more"):
        extract_features(**reading, features=tmp_path / "features.db", settings=FEATURES)
    with pytest.raises(StageError, match=r"1\.png is not the photo that was listed any more"):
        undistort_photos(
            **reading,
            sparse=tmp_path / "sparse",
            workspace=tmp_path / "workspace",
            report=tmp_path / "undistorted.json",
            settings=UndistortSettings(),
        )


def features_of(folder, calibration=None):
    """Lists a folder's photos and finds their features."""
    upright, photos = folder / "upright", folder / "photos.json"
    list_photos(source=folder / "photos", upright=upright, photos=photos, settings=VideoSettings())
    extract_features(
        folder=upright, photos=photos, features=folder / "features.db", calibration=calibration, settings=FEATURES
    )


def matches_of(folder):
    """Matches the features of a folder's photos."""
    match_features(
        photos=folder / "photos.json",
        features=folder / "features.db",
        database=folder / "database.db",
        matches=folder / "matches.json",
        settings=PAIRS,
        seed=0,
    )


def test_photos_of_low_contrast_have_features_too(capture, tmp_path):
    (tmp_path / "photos").mkdir()
    for index, name in enumerate(NAMES):
        picture = np.asarray(Image.open(capture[0] / "photos" / name), dtype=float)
        contrast = 0.06 if index in (1, 4) else 1.0
        Image.fromarray(np.uint8(np.round((picture - 128) * contrast + 128))).save(tmp_path / "photos" / name)
    features_of(tmp_path)
    with pycolmap.Database.open(tmp_path / "features.db") as database:
        counts = [database.num_keypoints_for_image(i.image_id) for i in database.read_all_images()]
        assert len(counts) == 6 and len(database.read_all_cameras()) == 1
    assert min(counts) > 0.5 * max(counts)
    matches_of(tmp_path)
    assert value(mapped(tmp_path), "registered") == 6


def test_what_is_burned_into_photos_of_different_things_makes_no_pair(tmp_path):
    (tmp_path / "photos").mkdir()
    display, *things = (
        np.clip(gaussian_filter(np.random.default_rng(k).normal(128, 250, (240, 320)), 2), 0, 255).astype(np.uint8)
        for k in range(4)
    )
    for index, thing in enumerate(things):
        thing[:24], thing[-24:] = display[:24], display[-24:]
        Image.fromarray(thing).save(tmp_path / "photos" / f"{index}.png")
    features_of(tmp_path)
    with pytest.raises(StageError, match="none of the 3 pairs .* show the same thing"):
        matches_of(tmp_path)


def test_a_portrait_photo_of_a_scene_has_a_portrait_camera(tmp_path):
    (tmp_path / "photos").mkdir()
    noise = np.random.default_rng(0).integers(0, 255, (120, 160, 3), dtype=np.uint8)
    exif = Image.Exif()
    exif[0x0112] = 6
    for index in range(3):
        Image.fromarray(noise).save(tmp_path / "photos" / f"{index}.jpg", exif=exif)
    features_of(tmp_path)
    with pycolmap.Database.open(tmp_path / "features.db") as database:
        assert {(c.width, c.height) for c in database.read_all_cameras()} == {(120, 160)}


@pytest.mark.parametrize("stored", [True, False])
def test_a_calibration_is_turned_along_with_photos_that_exif_rotates(tmp_path, stored):
    (tmp_path / "photos").mkdir()
    for index, orientation in enumerate((1, 6, 3, 8) if stored else (6, 6, 6)):
        exif = Image.Exif()
        exif[0x0112] = orientation
        noise = np.random.default_rng(index).integers(0, 255, (120, 160, 3), dtype=np.uint8)
        Image.fromarray(noise).save(tmp_path / "photos" / f"{index}.jpg", exif=exif)
    (tmp_path / "camera.txt").write_text("1 PINHOLE 160 120 150 151 70 52" if stored else "1 PINHOLE 120 160 9 9 50 70")
    features_of(tmp_path, tmp_path / "camera.txt")
    with pycolmap.Database.open(tmp_path / "features.db") as opened:
        found = [opened.read_camera(i.camera_id) for i in sorted(opened.read_all_images(), key=lambda i: i.name)]
    # Right of the upright photo is what was its lower side: 68 of 120 rows away from where columns begin now.
    turned = [[150, 151, 70, 52], [151, 150, 68, 70], [150, 151, 90, 68], [151, 150, 52, 90]]
    assert [c.params.tolist() for c in found] == (turned if stored else [[9, 9, 50, 70]] * 3)


def test_photos_that_exif_turns_otherwise_have_a_camera_of_their_own_unless_they_are_few(tmp_path):
    (tmp_path / "photos").mkdir()
    for index, orientation in enumerate((1, 3, 1, 3, 1, 3, 1, 6, 8, 8, 8)):
        exif = Image.Exif()
        exif[0x0112] = orientation
        noise = np.random.default_rng(index).integers(0, 255, (24, 32, 3), dtype=np.uint8)
        Image.fromarray(noise).save(tmp_path / "photos" / f"{index:02}.png", exif=exif)
    features_of(tmp_path)
    with pycolmap.Database.open(tmp_path / "features.db") as opened:
        cameras = {i.name: i.camera_id for i in opened.read_all_images()}
    # Three upside down have their own; one quarter turn to the right does not, beside three to the left.
    shared = [{n[:2] for n in cameras if cameras[n] == number} for number in set(cameras.values())]
    assert sorted(map(sorted, shared)) == [["00", "02", "04", "06"], ["01", "03", "05"], ["07", "08", "09", "10"]]


LENSES = {
    "OPENCV": [180.0, 182, 118, 92, -0.12, 0.02, 0.001, -0.001],
    "SIMPLE_RADIAL": [190.0, 120, 90, 0.05],
    "PINHOLE": [180.0, 182, 118, 92],
}


@pytest.mark.parametrize("shrink", [1.0, 0.4])
@pytest.mark.parametrize("lens", LENSES)
def test_a_picture_is_undistorted_as_colmap_does_it(lens, shrink):
    camera = pycolmap.Camera(model=lens, width=240, height=180, params=LENSES[lens])
    noise = gaussian_filter(np.random.default_rng(0).uniform(0, 255, (180, 240, 3)), (2, 2, 0))
    picture = ((noise - noise.min()) / np.ptp(noise) * 255).astype(np.uint8)
    options = pycolmap.UndistortCameraOptions(max_image_size=round(240 * shrink))
    bitmap, target = pycolmap.undistort_image(options, pycolmap.Bitmap.from_array(picture), camera)
    view = View("", target.calibration_matrix(), np.eye(4), target.width, target.height)
    mine = undistort_picture(picture, camera, view)
    inner = (slice(3, -3), slice(3, -3))
    difference = np.abs(mine.astype(float) - bitmap.to_array())[inner]
    assert mine.shape == bitmap.to_array().shape and difference.mean() < (1 if shrink == 1 else 3)
    half = picture[::2, ::2, 0].astype(np.float32)
    assert undistort_picture(half, camera, view).shape == mine.shape[:2]


def test_a_fine_pattern_is_averaged_not_sampled_where_the_view_is_much_smaller():
    camera = pycolmap.Camera(model="PINHOLE", width=400, height=400, params=[400, 400, 200, 200])
    checks = (np.indices((400, 400)).sum(0) % 2 * 255).astype(np.uint8)
    view = View("", np.array([[100.0, 0, 50], [0, 100, 50], [0, 0, 1]]), np.eye(4), 100, 100)
    assert undistort_picture(checks, camera, view).std() < 2


@pytest.mark.parametrize(
    ("seen", "advice"), [(1, "check that they overlap"), (0, "they have 0 features in the median")]
)
def test_photos_that_show_different_things_or_nothing(tmp_path, seen, advice):
    rng = np.random.default_rng(1)
    (tmp_path / "photos").mkdir()
    for index in range(3):
        noise = gaussian_filter(rng.uniform(0, 255, (120, 160)), 1.5)
        noise = (noise - noise.min()) / np.ptp(noise) * 140 * seen + 110 + index
        Image.fromarray(noise.astype(np.uint8)).save(tmp_path / "photos" / f"{index}.png")
    features_of(tmp_path)
    with pytest.raises(StageError, match=f"none of the 3 pairs of photos .*{advice}"):
        matches_of(tmp_path)
    assert not (tmp_path / "database.db").exists() and not (tmp_path / "matches.json").exists()


def test_too_few_registered_photos(tmp_path):
    pycolmap.set_random_seed(0)
    options = pycolmap.SyntheticDatasetOptions(num_rigs=5, num_cameras_per_rig=1, num_frames_per_rig=1)
    options.num_points3D = 200
    with pycolmap.Database.open(tmp_path / "database.db") as database:
        synthetic = pycolmap.synthesize_dataset(options, database)
    names = [i.name for i in synthetic.images.values()] + [f"extra{i}.jpg" for i in range(5)]
    write_photos(tmp_path / "photos.json", [photo(n) for n in names], tmp_path, "photos", [])
    with pytest.raises(StageError, match=r"only 5 of 10 photos were registered.*extra0\.jpg.*min_registered_share"):
        map_photos(
            folder=tmp_path,
            photos=tmp_path / "photos.json",
            database=tmp_path / "database.db",
            sparse=tmp_path / "sparse",
            report=tmp_path / "sparse.json",
            settings=MAPPING,
            seed=0,
        )
    assert not (tmp_path / "sparse").exists() and not (tmp_path / "sparse.json").exists()


def small_capture(tmp_path, weak=None, more=()):
    """A model of eight photos and its database, where the pairs of the photo of number `weak` have 20 matches each;
    `more` are names of photos without matches."""
    pycolmap.set_random_seed(0)
    options = pycolmap.SyntheticDatasetOptions(num_rigs=8, num_cameras_per_rig=1, num_frames_per_rig=1)
    options.num_points3D = 200
    with pycolmap.Database.open(tmp_path / "database.db") as database:
        synthetic = pycolmap.synthesize_dataset(options, database)
        for other in [i for i in synthetic.reg_image_ids() if weak not in (None, i)]:
            geometry = database.read_two_view_geometry(*sorted((weak, other)))
            geometry.inlier_matches = geometry.inlier_matches[20 * other : 20 * other + 20]
            database.update_two_view_geometry(*sorted((weak, other)), geometry)
    names = [i.name for i in synthetic.images.values()] + list(more)
    write_photos(tmp_path / "photos.json", [photo(n) for n in names], tmp_path, "photos", [])
    return synthetic


def mapped(tmp_path):
    map_photos(
        folder=tmp_path,
        photos=tmp_path / "photos.json",
        database=tmp_path / "database.db",
        sparse=tmp_path / "sparse",
        report=tmp_path / "sparse.json",
        settings=MAPPING,
        seed=0,
    )
    return read_json(tmp_path / "sparse.json")


def test_a_photo_in_a_wrong_place_is_named(tmp_path):
    model = small_capture(tmp_path)
    right = explained_matches(model, tmp_path / "database.db")
    assert right.total == right.matches.sum() > 0 and doubtful_photos(model, right) == {}
    moved = model.images[3]
    turned = pycolmap.Rotation3d(np.array([0, np.radians(10), 0]))
    model.frames[moved.frame_id].set_cam_from_world(
        moved.camera_id, pycolmap.Rigid3d(turned, np.zeros(3)) * moved.cam_from_world()
    )
    assert list(doubtful_photos(model, explained_matches(model, tmp_path / "database.db"))) == [moved.name]


def test_a_photo_in_a_wrong_place_is_left_out_where_enough_others_remain(tmp_path, monkeypatch):
    small_capture(tmp_path)
    name = mapping.read_photos(tmp_path / "photos.json")[2].name
    monkeypatch.setattr(mapping, "doubtful_photos", lambda *_: {name: 0.5})
    report = mapped(tmp_path)
    model = pycolmap.Reconstruction(tmp_path / "sparse")
    assert name not in {model.images[i].name for i in model.reg_image_ids()} and model.num_points3D()
    assert value(report, "registered") == 7 and value(report, "not_registered") == [name]
    assert all(len(point.track.elements) > 1 for point in model.points3D.values())
    monkeypatch.setattr(mapping, "doubtful_photos", lambda model, _: {i.name: 0.5 for i in model.images.values()})
    report = mapped(tmp_path)
    assert value(report, "registered") == 8 == len(value(report, "doubtful_photos"))


def test_a_further_attempt_that_fails_loses_nothing(tmp_path, monkeypatch, capsys):
    small_capture(tmp_path)
    asked, choose = [], mapping.choose_lens

    def once(*arguments):
        asked.append(arguments)
        if len(asked) == 2:
            raise StageError("only 3 of 8 photos were registered")
        return choose(*arguments)

    monkeypatch.setattr(mapping, "choose_lens", once)
    monkeypatch.setattr(mapping, "doubtful_photos", lambda *_: {"a.jpg": 0.5})
    report = mapped(tmp_path)
    assert (value(report, "registered"), value(report, "attempts"), len(asked)) == (8, 3, 3)
    assert "attempt 2 of 3 is left out: only 3 of 8 photos were registered" in capsys.readouterr().out


def test_photos_with_weak_pairs_only_come_in_by_all_of_them(tmp_path):
    small_capture(tmp_path, weak=8)
    report = mapped(tmp_path)
    assert value(report, "registered") == 8 and value(report, "least_matches_of_a_pair") == 15


def test_weak_pairs_are_not_used_where_strong_ones_do(tmp_path):
    small_capture(tmp_path)
    report = mapped(tmp_path)
    assert value(report, "registered") == 8 and value(report, "least_matches_of_a_pair") == 30
    assert value(report, "doubtful_photos") == {}


@pytest.mark.parametrize(
    ("missing", "weak", "mappings"), [((), None, 1), (("something_else.jpg",), None, 1), ((), 8, 3)]
)
def test_photos_are_mapped_again_with_the_lens_that_was_found_where_some_with_matches_are_missing(
    tmp_path, monkeypatch, missing, weak, mappings
):
    small_capture(tmp_path, weak, missing)
    if weak is not None:
        with pycolmap.Database.open(tmp_path / "database.db") as database:
            # With wrong matches in all pairs COLMAP tries for 20 s.
            for other in range(1, weak):
                geometry = database.read_two_view_geometry(other, weak)
                wrong = np.array(geometry.inlier_matches)[: 20 * (other >= weak - 2)]
                wrong[:, 1] = np.roll(wrong[:, 1], 1)
                geometry.inlier_matches = wrong
                database.update_two_view_geometry(other, weak, geometry)
    calls, incremental = [], pycolmap.incremental_mapping
    monkeypatch.setattr(mapping, "choose_lens", lambda *_: Choice(CENTRED, None))
    monkeypatch.setattr(
        pycolmap, "incremental_mapping", lambda *a, **options: calls.append(a) or incremental(*a, **options)
    )
    report = mapped(tmp_path)
    assert (value(report, "lens"), len(calls)) == ("centred", mappings)
    assert value(report, "registered") == 8 - (weak is not None)
    assert set(missing) <= set(value(report, "not_registered"))
    assert value(report, "mean_reprojection_error_px") < 0.5


def test_a_database_that_is_cut_short_is_named(tmp_path):
    path = tmp_path / "database.db"
    with pycolmap.Database.open(path) as database:
        database.write_camera(pycolmap.Camera(model="PINHOLE", width=4, height=4, params=[1, 1, 2, 2]))
    require_database(path)
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    with pytest.raises(StageError, match=r"database\.db is damaged .*; delete it and run again"):
        require_database(path)
    path.unlink()
    with pytest.raises(StageError, match=r"database\.db does not exist"):
        require_database(path)

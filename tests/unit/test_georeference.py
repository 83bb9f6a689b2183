from dataclasses import replace

import numpy as np
import pycolmap
import pyproj
import pytest
from scipy.spatial.transform import Rotation

from scenefuse.cloud.crs import read_crs, to_wgs84
from scenefuse.core.stage import StageError, quantity, read_json, value, write_json
from scenefuse.core.transforms import UP, Sim3, rotation_angle_deg
from scenefuse.georef.georeference import camera_poses, georeference, georegister
from scenefuse.georef.placement import GeoreferenceSettings, GpsCameras, fit_level, place_by_gps
from scenefuse.photos.geodesy import GridFrame, LocalFrame, local_frame, scene_frame
from scenefuse.photos.photos import Photo, write_photos
from scenefuse.photos.workspace import View, write_model

SETTINGS = GeoreferenceSettings(use_gps=True, gps_accuracy_m=2.0)
FRAME = LocalFrame(47.37, 8.55, 430.0)
PLANTED = Sim3(7.5, Rotation.from_euler("xyz", [150, 20, -80], degrees=True).as_matrix(), np.array([30.0, -12.0, 55.0]))


def flight(rows=5, columns=6, seed=3):
    """Camera centres of a flight, east, north, up in metres."""
    x, y = np.meshgrid(np.arange(columns) * 12.0, np.arange(rows) * 12.0)
    z = np.random.default_rng(seed).normal(60, 2, x.size)
    return np.stack([x.ravel(), y.ravel(), z], axis=1)


def test_local_frame_is_east_north_up_in_metres():
    # One arc second of latitude is 30.9 m; the meridian and the parallel through the origin are the axes.
    enu = FRAME.apply(np.array([[47.37, 8.55, 440.0], [47.37 + 1 / 3600, 8.55, 430.0], [47.37, 8.55 + 1 / 3600, 430]]))
    np.testing.assert_allclose(enu[0], [0, 0, 10], atol=1e-6)
    np.testing.assert_allclose(enu[1], [0, 30.88, 0], atol=0.02)
    np.testing.assert_allclose(enu[2], [20.97, 0, 0], atol=0.02)
    there_and_back = FRAME.inverse(enu)
    np.testing.assert_allclose(FRAME.apply(there_and_back), enu, atol=1e-6)


@pytest.mark.parametrize("longitude, latitude, crs", [(8.55, 47.37, "EPSG:32632"), (-70.2, -33.5, "EPSG:32719")])
def test_similarity_to_utm_agrees_with_pyproj(longitude, latitude, crs):
    frame = LocalFrame(latitude, longitude, 430.0)
    assert frame.crs == crs
    local = np.array([[120.0, -80.0, 15.0], [-60.0, 150.0, -5.0]])
    geographic = frame.inverse(local)
    easting, northing = pyproj.Transformer.from_crs(4326, crs, always_xy=True).transform(
        geographic[:, 1], geographic[:, 0]
    )
    in_crs = frame.crs_from_local().apply(local)
    np.testing.assert_allclose(in_crs[:, :2], np.stack([easting, northing], axis=1), atol=0.02)
    np.testing.assert_allclose(in_crs[:, 2], 430.0 + local[:, 2], atol=0.02)


def test_heights_of_a_crs_in_feet_are_in_feet_near_the_origin():
    frame, local = LocalFrame(40.7, -74.0, 100.0, grid="EPSG:2263"), np.array([[0.0, 0, 0], [3, 4, 5]])
    np.testing.assert_allclose(frame.crs_from_local().apply(local), frame.in_crs(local), atol=0.01)
    assert frame.in_crs(local)[0, 2] == pytest.approx(328.083, abs=1e-3)


def test_heights_of_degrees_are_in_the_unit_of_their_vertical_part():
    feet = read_crs("EPSG:4269+6360", "here")
    assert to_wgs84(feet, np.array([[-74.0, 40.7, 100.0]]), "here")[0, 2] == pytest.approx(30.48006)
    station = GridFrame("EPSG:2263+6360", np.array([1e6, 2e5, 0.0]))
    assert station.inverse(np.array([[0.0, 0.0, 328.0833]]))[0, 2] == pytest.approx(100.0, abs=1e-3)


def test_a_datum_that_only_a_proj_string_knows_is_not_lost():
    bessel = "+proj=tmerc +lat_0=0 +lon_0=15 +k=0.9996 +x_0=500000 +y_0=-5000000 +ellps=bessel +units=m +no_defs"
    place = np.array([[500_000.0, 320_000.0, 300.0]])
    plain, moved = (
        local_frame(to_wgs84(read_crs(text, "here"), place, "here")).inverse(np.zeros((1, 3)))[0]
        for text in (bessel, f"{bessel} +towgs84=577.326,90.129,463.919,5.137,1.474,5.297,2.4232")
    )
    assert 30 < 111_000 * np.hypot(*(moved - plain)[:2]) < 300


def test_places_beside_the_antimeridian_are_in_their_zone():
    assert to_wgs84(read_crs("EPSG:32760", "here"), np.array([[826_000.0, 8_000_000.0, 0]]), "here")[0, 1] < -179


def test_axes_that_mirror_the_ground_are_refused():
    with pytest.raises(StageError, match="point south and west"):
        read_crs("EPSG:5513", "here")


def test_points_five_kilometres_away_are_projected_not_turned():
    frame = LocalFrame(47.37, 8.55, 430.0)
    far = np.array([[5000.0, 0.0, 0.0], [0.0, 5000.0, 0.0], [3000.0, -4000.0, 60.0]])
    in_crs = frame.in_crs(far)
    # Height above the ellipsoid is up plus the drop of the tangent plane, d^2 / 2R; a similarity misses it.
    np.testing.assert_allclose(in_crs[:, 2], 430.0 + far[:, 2] + 5000.0**2 / (2 * 6.38e6), atol=0.01)
    there = pyproj.Transformer.from_crs(frame.crs, 4979, always_xy=True).transform(*in_crs.T)
    np.testing.assert_allclose(frame.apply(np.stack([there[1], there[0], there[2]], axis=1)), far, atol=1e-3)
    assert np.abs(frame.crs_from_local().apply(far)[:, 2] - in_crs[:, 2]).min() > 1.9


def test_one_wild_position_does_not_move_the_origin():
    positions = FRAME.inverse(flight())
    wild = positions.copy()
    wild[3] = [12.0, 77.0, 9000.0]
    moved = FRAME.apply(np.array([[*(getattr(local_frame(wild), k) for k in ("latitude_deg", "longitude_deg"))] + [0]]))
    assert np.linalg.norm(moved[0, :2]) < 60 and local_frame(wild).altitude_m == pytest.approx(490, abs=1)


def test_longitudes_on_both_sides_of_the_antimeridian_are_neighbours():
    frame = local_frame(np.array([[-17.0, 179.999, 10.0], [-17.0, -179.997, 10.0], [-17.0, -179.999, np.nan]]))
    assert (frame.longitude_deg, frame.altitude_m) == (-179.999, 10.0)


def test_origin_is_rounded_mean():
    frame = local_frame(np.array([[10.123456, 20.0, 99.6], [10.123466, 20.2, 100.0]]))
    assert (frame.latitude_deg, frame.longitude_deg, frame.altitude_m) == (10.12346, 20.1, 100.0)


def test_planted_similarity_with_noise_and_two_wild_positions():
    target = flight()
    centres = PLANTED.inverse().apply(target)
    noisy = target + np.random.default_rng(1).normal(0, 0.5, target.shape)
    noisy[[4, 17]] += [[80, 0, 0], [0, -60, 40]]
    placement = place_by_gps(centres, noisy, PLANTED.rotation.T @ [0, 0, 1], SETTINGS, seed=0)
    assert placement.status == "georeferenced"
    assert list(np.flatnonzero(~placement.inliers)) == [4, 17]
    fitted = placement.local_from_model
    assert fitted.scale == pytest.approx(PLANTED.scale, rel=0.01)
    assert rotation_angle_deg(fitted.rotation.T @ PLANTED.rotation) < 1.5
    assert np.linalg.norm(fitted.apply(centres) - target, axis=1).max() < 1.0


def test_positions_whose_axes_are_swapped_in_a_grid_that_holds_both_turn_no_model_upside_down():
    target, up = flight(), PLANTED.rotation.T @ [0, 0, 1]
    with pytest.raises(StageError, match="the photos' positions .* turn the model upside down, as swapped axes do"):
        place_by_gps(PLANTED.inverse().apply(target), target[:, [1, 0, 2]], up, SETTINGS, seed=0)


def test_one_strip_is_levelled_by_the_cameras():
    target = flight(rows=1, columns=12)
    target[:, 2] = 60.0
    centres = PLANTED.inverse().apply(target)
    up = PLANTED.rotation.T @ np.array([0.0, 0.0, 1.0])
    noisy = target + np.random.default_rng(1).normal(0, 0.3, target.shape)
    placement = place_by_gps(centres, noisy, up, SETTINGS, seed=0)
    assert "levelled by the cameras" in placement.reason
    assert rotation_angle_deg(placement.local_from_model.rotation.T @ PLANTED.rotation) < 1.0
    assert placement.local_from_model.scale == pytest.approx(PLANTED.scale, rel=0.02)


def test_fit_level_is_exact_without_noise():
    target = flight()
    fitted, inliers = fit_level(PLANTED.inverse().apply(target), target, PLANTED.rotation.T @ [0, 0, 1.0], 8.0)
    assert inliers.all()
    np.testing.assert_allclose(fitted.matrix, PLANTED.matrix, atol=1e-9)


def tilted(unknown, seed=5):
    """A flight, and its placement by noisy positions, some heights unknown, with cameras that lean by 3 degrees."""
    target = flight()
    noisy = target + np.random.default_rng(seed).normal(0, [0.5, 0.5, 1.0], target.shape)
    noisy[unknown, 2] = np.nan
    up = PLANTED.rotation.T @ Rotation.from_euler("x", 3, degrees=True).apply([0.0, 0.0, 1.0])
    return target, place_by_gps(PLANTED.inverse().apply(target), noisy, up, SETTINGS, seed=0)


def test_unknown_heights_of_some_photos_take_no_part():
    target, placement = tilted(slice(0, None, 2))
    assert "15 of them have no GPS height" in placement.reason and placement.heights == "measured"
    assert placement.inliers.all() and not placement.levelled
    fitted = placement.local_from_model
    assert rotation_angle_deg(fitted.rotation.T @ PLANTED.rotation) < 1.5
    assert np.linalg.norm(fitted.apply(PLANTED.inverse().apply(target)) - target, axis=1).max() < 1.5
    # Where heights are filled in and fitted, the model leans: the mean height of all stands for half of the photos.
    lifted = flight() + np.arange(30)[:, None] % 6 * [0, 0, 5.0]  # six columns, each five metres higher
    heights = np.where(np.arange(30) % 2, lifted[:, 2], np.nan)
    partly = np.column_stack([lifted[:, :2], heights])
    up = PLANTED.rotation.T @ np.array([0.0, 0.0, 1.0])
    fitted = place_by_gps(PLANTED.inverse().apply(lifted), partly, up, SETTINGS, seed=0).local_from_model
    assert rotation_angle_deg(fitted.rotation.T @ PLANTED.rotation) < 0.01
    assert fitted.scale == pytest.approx(PLANTED.scale, rel=1e-4)


@pytest.mark.slow
def test_a_phones_heights_do_not_tilt_a_walk_whose_cameras_say_which_way_is_up():
    turns, leans = np.arange(32) * 2 * np.pi / 32, {}
    walked = np.stack([25 * np.cos(turns), 25 * np.sin(turns), np.full(32, 1.6)], axis=1)
    up = PLANTED.rotation.T @ np.array([0.0, 0.0, 1.0])
    for seed in range(10):
        # Errors that drift along the walk, 4 m in the plane and 6 m in height.
        rng = np.random.default_rng(seed)
        drift = [np.cos(turns[:, None] + rng.uniform(0, 6.3, 3)) * [4, 4, 6] + rng.normal(0, 0.5, (32, 3))]
        for sure in (False, True):
            there = PLANTED.inverse().apply(walked), walked + drift[0]
            placement = place_by_gps(*there, up, GeoreferenceSettings(), seed=0, sure_up=sure)
            turn = placement.local_from_model.rotation @ PLANTED.rotation.T
            leans.setdefault(sure, []).append(np.degrees(np.arccos(np.clip(turn[2, 2], -1, 1))))
            assert placement.status == "georeferenced"
    assert np.median(leans[False]) > 8 and max(leans[True]) <= 3.0
    # Positions that agree with the cameras, and exact ones that do not, say it themselves.
    assert not place_by_gps(PLANTED.inverse().apply(walked), walked, up, SETTINGS, seed=0, sure_up=True).levelled
    wrong = Rotation.from_euler("x", 10, degrees=True).apply(up)
    exact = place_by_gps(PLANTED.inverse().apply(walked), walked, wrong, SETTINGS, seed=0, sd_m=0.05, sure_up=True)
    assert not exact.levelled


def test_without_any_height_the_cameras_level_the_model_and_heights_are_relative():
    target, placement = tilted(slice(None))
    assert placement.status == "georeferenced" and placement.heights == "relative" and placement.levelled
    assert "levelled by the cameras" in placement.reason and "heights are relative" in placement.reason
    fitted = placement.local_from_model
    assert rotation_angle_deg(fitted.rotation.T @ PLANTED.rotation) == pytest.approx(3.0, abs=0.5)
    assert fitted.scale == pytest.approx(PLANTED.scale, rel=0.02)
    heights = fitted.apply(PLANTED.inverse().apply(target))[:, 2]
    assert np.median(heights) == pytest.approx(0, abs=1e-6)


def test_wild_positions_do_no_harm_without_heights_or_along_one_line():
    for rows, columns in ((5, 6), (1, 12)):
        target = flight(rows, columns)
        centres, wild = PLANTED.inverse().apply(target), target.copy()
        wild[[2, 7], :2] += [[4000, 100], [-80, 300]]
        wild[:, 2] = np.nan if rows > 1 else 60.0
        placement = place_by_gps(centres, wild, PLANTED.rotation.T @ [0, 0, 1.0], SETTINGS, seed=0)
        assert placement.status == "georeferenced" and placement.levelled
        assert list(np.flatnonzero(~placement.inliers)) == [2, 7]
        assert placement.local_from_model.scale == pytest.approx(PLANTED.scale, rel=0.01)


def test_a_fix_that_a_phone_writes_into_dozens_of_photos_counts_once():
    angle = np.linspace(0, 2 * np.pi, 60, endpoint=False)
    around = np.stack([20 * np.cos(angle), 20 * np.sin(angle), np.full(60, 1.5)], axis=1)
    for seed in range(3):
        target = around + np.random.default_rng(seed).normal(0, 1.0, around.shape)
        target[30:58] = target[30]
        found = place_by_gps(around / 10, target, np.array([0.0, 0, 1]), GeoreferenceSettings(), 0)
        assert found.inliers.sum() > 30 and not found.inliers[31:58].any()
        assert found.local_from_model.scale == pytest.approx(10, rel=0.04)


# The second is two batteries of a drone with a barometer.
@pytest.mark.parametrize("step_m, noise_m", [(16.0, 1.0), (6.0, 0.3)])
def test_heights_of_two_flights_that_count_from_different_zeros_do_not_tilt_the_model(step_m, noise_m):
    truth = flight(rows=6)
    noisy = truth + np.random.default_rng(0).normal(0, noise_m, truth.shape)
    photos = [f"{k:02d}.jpg" for k in range(36)]
    counted = noisy + np.where(np.arange(36) < 17, step_m, 0.0)[:, None] * UP
    found = [
        georeference(
            GpsCameras(photos, PLANTED.inverse().apply(truth), FRAME.inverse(there), np.full((36, 2), 2.0)),
            None,
            PLANTED.inverse().rotate(UP),
            SETTINGS,
            0,
        )
        for there in (noisy, counted)
    ]
    assert [f.placement.status for f in found] == ["georeferenced"] * 2
    tilts = [f.placement.local_from_model.rotate(PLANTED.inverse().rotate(UP)) @ UP for f in found]
    assert np.degrees(np.arccos(tilts)).max() < 2
    assert abs(found[1].placement.local_from_model.scale / PLANTED.scale - 1) < 0.02
    np.testing.assert_allclose(found[1].gps.positions[:, 2], 430 + noisy[:, 2], atol=1.5)
    assert ["heights of 17 photos are moved by -" in f.placement.reason for f in found] == [False, True]


@pytest.mark.parametrize("zeros", [(0, 30, -25), (0, 40, 0), (0, 20, 40)])
def test_heights_of_three_flights_each_with_a_zero_of_its_own_do_not_tilt_the_model(zeros):
    truth = np.concatenate([flight() + [k * 90, k * 7, 0] for k in range(3)])
    counted = truth + np.random.default_rng(0).normal(0, 1.5, truth.shape) + np.repeat(zeros, 30)[:, None] * UP
    names, up = [f"{k:02d}.jpg" for k in range(90)], PLANTED.inverse().rotate(UP)
    gps = GpsCameras(names, PLANTED.inverse().apply(truth), FRAME.inverse(counted), np.full((90, 2), 3.0))
    placement = georeference(gps, None, up, GeoreferenceSettings(), 0).placement
    assert np.degrees(np.arccos(placement.local_from_model.rotate(up) @ UP)) < 1
    assert abs(placement.local_from_model.scale / PLANTED.scale - 1) < 0.01
    assert "are moved by " in placement.reason and placement.inliers.all()


def test_positions_that_hardly_move_give_no_scale():
    target = flight() * 0.02
    placement = place_by_gps(PLANTED.inverse().apply(target), target, np.array([0, 0, 1.0]), SETTINGS, seed=0)
    assert placement.status == "upright" and "spread over" in placement.reason
    assert placement.local_from_model.scale == 1.0


def test_positions_that_contradict_the_cameras_give_no_scale():
    target = flight()
    wild = np.random.default_rng(0).uniform(0, 500, target.shape)
    placement = place_by_gps(PLANTED.inverse().apply(target), wild, np.array([0, 0, 1.0]), SETTINGS, seed=0)
    assert placement.status == "upright" and "agree with the cameras" in placement.reason


@pytest.fixture
def model(tmp_path):
    """A synthetic model in an arbitrary frame, and the metric one it comes from."""
    pycolmap.set_random_seed(1)
    options = pycolmap.SyntheticDatasetOptions(num_rigs=8, num_cameras_per_rig=1, num_frames_per_rig=1)
    options.num_points3D = 50
    options.sensor_from_rig_translation_stddev = 0.0
    options.sensor_from_rig_rotation_stddev = 0.0
    synthetic = pycolmap.synthesize_dataset(options)
    synthetic.transform(pycolmap.Sim3d(20.0, pycolmap.Rotation3d(), np.zeros(3)))
    names, _, truth = camera_poses(synthetic)
    undo = PLANTED.inverse()
    synthetic.transform(pycolmap.Sim3d(undo.scale, pycolmap.Rotation3d(undo.rotation), undo.translation))
    (tmp_path / "sparse").mkdir()
    synthetic.write(tmp_path / "sparse")
    return tmp_path, names, truth


def listed(names, centres):
    positions = FRAME.inverse(centres)
    return [Photo(n, 100, 100, "", *(float(v) for v in p)) for n, p in zip(names, positions)]


def georegister_in(folder, photos, crs=None):
    write_photos(folder / "photos.json", photos, folder, "photos", [])
    write_json(folder / "sparse.json", {"lens": quantity("held", "")})
    georegister(
        sparse=folder / "sparse",
        sparse_json=folder / "sparse.json",
        photos=folder / "photos.json",
        crs=crs,
        georeferenced=folder / "georeferenced",
        residuals=folder / "residuals.tsv",
        report=folder / "georeference.json",
        settings=SETTINGS,
        seed=0,
    )
    return read_json(folder / "georeference.json"), pycolmap.Reconstruction(folder / "georeferenced")


def test_stage_brings_a_model_into_metres(model):
    folder, names, truth = model
    report, moved = georegister_in(folder, listed(names, truth))
    assert value(report, "status") == "georeferenced" and value(report, "length_unit") == "m"
    assert value(report, "gps_residual_rms_m") < 1e-3
    _, _, centres = camera_poses(moved)
    origin = LocalFrame(*(value(report, f"origin_{k}") for k in ("latitude_deg", "longitude_deg", "altitude_m")))
    np.testing.assert_allclose(centres, origin.apply(FRAME.inverse(truth)), atol=1e-3)
    crs_from_scene = Sim3.from_matrix(np.array(value(report, "crs_from_scene")))
    np.testing.assert_allclose(crs_from_scene.translation, value(report, "origin_in_crs"))


@pytest.mark.slow
def test_lengths_are_known_as_well_as_noisy_positions_fix_the_scale(model):
    folder, names, truth = model
    exact = value(georegister_in(folder, listed(names, truth))[0], "scale")
    rng, ratios = np.random.default_rng(0), []
    for _ in range(12):
        report, _ = georegister_in(folder, listed(names, truth + rng.normal(0, 0.5, truth.shape)))
        ratios.append(np.log(value(report, "scale") / exact) / value(report, "gps_scale_sd_log"))
    assert 0.5 < np.sqrt(np.mean(np.square(ratios))) < 2


def test_results_are_in_the_crs_that_the_table_names(model):
    folder, names, truth = model
    report, _ = georegister_in(folder, listed(names, truth), "EPSG:2056")
    assert value(report, "crs") == "EPSG:2056" and value(report, "status") == "georeferenced"
    assert np.allclose(value(report, "origin_in_crs")[:2], [2_684_000, 1_247_000], atol=2000)
    for crs, sentence in {
        "EPSG:2056+5728": r"heights of GPS are not those of .*; name its plane alone, EPSG:2056",
        "EPSG:32618": "the column crs: the scene: .* does not lie in WGS 84 / UTM zone 18N",
        "EPSG:4326": "is in degrees",
    }.items():
        with pytest.raises(StageError, match=sentence):
            georegister_in(folder, listed(names, truth), crs)
    with pytest.raises(StageError, match="nothing says where the scene lies: 0 registered photos have a GPS position"):
        georegister_in(folder, [Photo(n, 100, 100, "") for n in names], "EPSG:2056")


def test_stage_without_altitudes_says_so(tmp_path):
    views, truth = [], flight()
    for k, centre in enumerate(PLANTED.inverse().apply(truth)):
        heading = Rotation.from_euler("z", 40 * k, degrees=True).as_matrix()
        level_cam = heading @ np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])  # x right, y down, z ahead
        pose = np.eye(4)
        pose[:3, :3] = level_cam.T @ PLANTED.rotation
        pose[:3, 3] = -pose[:3, :3] @ centre
        views.append(View(f"{k:02d}.jpg", np.diag([80.0, 80, 1]), pose, 100, 80))
    (tmp_path / "sparse").mkdir()
    write_model(tmp_path / "sparse", views)
    photos = [replace(photo, altitude_m=None) for photo in listed([view.name for view in views], truth)]
    report, moved = georegister_in(tmp_path, photos)
    heights = camera_poses(moved)[2][:, 2]
    np.testing.assert_allclose(heights, truth[:, 2] - np.median(truth[:, 2]), atol=0.01)
    assert value(report, "heights") == "relative" and "heights are relative" in value(report, "reason")
    assert value(report, "origin_altitude_m") is None
    assert value(report, "gps_residual_vertical_rms_m") is None and value(report, "up_cue") != "GPS"
    assert scene_frame(report) is not None


def test_stage_without_gps_names_no_metre(model):
    folder, names, _ = model
    report, moved = georegister_in(folder, [Photo(n, 100, 100, "") for n in names])
    assert value(report, "status") == "upright"
    assert {entry["unit"] for entry in report.values()}.isdisjoint({"m"})
    assert value(report, "length_unit") == "scene units"
    assert value(report, "scale") == 1.0
    assert moved.num_reg_images() == 8


def test_cameras_in_the_coordinates_of_a_map_that_nothing_names_come_near_zero(model):
    folder, names, truth = model
    far, at = pycolmap.Reconstruction(folder / "sparse"), np.array([450_000.0, 5_200_000, 300])
    far.transform(pycolmap.Sim3d(1.0, pycolmap.Rotation3d(np.eye(3)), at))
    before = camera_poses(far)[2]
    far.write(folder / "sparse")
    report, moved = georegister_in(folder, [Photo(n, 100, 100, "") for n in names])
    _, _, centres = camera_poses(moved)
    # Meshes are made, and drawn, in float32.
    assert np.abs(centres).max() < 20 * np.ptp(centres, axis=0).max()
    there = Sim3.from_matrix(np.array(value(report, "scene_from_sparse"))).apply(before)
    np.testing.assert_allclose(centres, there, atol=1e-6)

"""The demo capture: truth that agrees with the photos, and the same bytes for the same seed."""

from collections.abc import Iterator
from dataclasses import replace
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import open3d as o3d
import pytest
from PIL import Image

from demo import capture, clicks, textures
from demo.bodies import DRONE, IDEAL, PHONE, Body, Exposure, blur_kernel, draw_exposure, expose, vignetting
from demo.truth import Cameras, pinhole, read_cameras, visible
from demo.world import ORIGIN, World, build_world, openness
from scenefuse.core.stage import StageError, read_json, value
from scenefuse.marks.clicks import read_points
from scenefuse.photos.geodesy import LocalFrame

FLIGHT = capture.FlightSettings(
    columns=2,
    rows=2,
    obliques=2,
    width_px=80,
    supersampling=1,
    gps_noise_horizontal=0.0,
    gps_noise_vertical=0.0,
)
ORBIT = capture.OrbitSettings(views=4, width_px=64, supersampling=1)
MESH = World.mesh
# Far more than a camera's, so that a photo of few pixels shows it.
DISTORTED = Body(shift=(0.06, -0.05), distortion=(-0.15, 0.04, 0.01, -0.008))


@pytest.fixture(scope="module")
def world() -> World:
    return build_world(0)


@pytest.fixture(autouse=True, scope="module")
def one_world(world: World) -> Iterator[None]:
    """Every stage gets the world that is already there, with an open sky, and each of its meshes once."""
    meshes = cache(lambda owner: MESH(world, owner))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(World, "mesh", lambda _, owner: meshes(owner))
        patch.setattr(capture, "build_world", lambda seed: world)
        patch.setattr(clicks, "build_world", lambda seed: world)
        patch.setattr(capture, "openness", lambda w, *_: np.ones(len(w.vertices), dtype=np.float32))
        yield


@pytest.fixture(scope="module")
def rendered(tmp_path_factory: pytest.TempPathFactory, one_world: None) -> Path:
    """A folder with scene and house, rendered; only to be read."""
    root = tmp_path_factory.mktemp("rendered")
    render_all(root)
    return root


def render_all(root: Path) -> None:
    scene = {"photos": root / "scene", "truth": root / "truth/scene"}
    capture.render_scene(**scene, settings=FLIGHT, camera="real", seed=0)
    house = {"photos": root / "house", "truth": root / "truth/house"}
    capture.render_object(name="house", **house, settings=ORBIT, camera="real", seed=0)


@pytest.mark.slow
def test_same_seed_same_bytes_and_all_files(tmp_path: Path, rendered: Path, world: World) -> None:
    render_all(tmp_path)
    again, once = MESH(world, world.owner("house")), world.mesh(world.owner("house"))
    assert all(map(np.array_equal, again, once))
    files, others = (
        {f.relative_to(r).as_posix(): f.read_bytes() for f in r.rglob("*.*")} for r in (rendered, tmp_path)
    )
    assert files == others
    assert sum(name.startswith("scene/") for name in files) == 6
    assert sum(name.startswith("truth/house/masks/") for name in files) == 4
    assert {"truth/house/mesh.ply", "truth/scene/meshes/world.ply", "truth/scene/meshes/balloon.ply"} <= set(files)


def test_masks_and_photos_agree_with_the_true_cameras(rendered: Path, world: World) -> None:
    cameras = read_cameras(rendered / "truth/house/cameras.json")
    middle = np.array(value(read_json(rendered / "truth/house/cameras.json")["object"], "middle"))
    assert np.allclose(middle, world.bounds("house").mean(0))
    for k, name in enumerate(cameras.names):
        mask = cv2.imread(str(rendered / f"truth/house/masks/{Path(name).stem}.png"), cv2.IMREAD_GRAYSCALE)
        assert set(np.unique(mask)) == {0, 255}
        rows = np.flatnonzero(mask.any(1))
        assert 0.35 < (rows[-1] - rows[0] + 1) / 48 < 0.95
        pixel, inside = cameras.project(k, middle[None])
        assert inside[0] and mask[int(pixel[0, 1]), int(pixel[0, 0])] == 255


@pytest.mark.parametrize("body", [IDEAL, DRONE, DISTORTED], ids=["ideal", "drone", "distorted"])
def test_a_ray_through_a_pixel_projects_back_to_it(world: World, body: Body) -> None:
    cameras = capture.flight(world, FLIGHT, body, 0)
    rays = np.empty((80 * 60 * 4, 6), dtype=np.float32)
    centre, turn = cameras.centres[5], np.ascontiguousarray(cameras.cam_from_world[5].T)
    textures.world_rays(rays, centre, turn, cameras.rays(2))
    pixels, inside = cameras.project(5, (rays[:, :3] + 30.0 * rays[:, 3:]).astype(np.float64))
    assert inside.all()
    of_pixel = pixels.reshape(60, 80, 4, 2)
    expected = np.array([[20.25, 10.25], [20.75, 10.25], [20.25, 10.75], [20.75, 10.75]])
    assert np.abs(of_pixel[10, 20] - expected).max() < 1e-3
    assert np.abs(of_pixel[0, 0, 0] - 0.25).max() < 1e-3 and np.abs(of_pixel[-1, -1, 3] - [79.75, 59.75]).max() < 1e-3


def test_distortion_is_that_of_opencv(world: World) -> None:
    cameras = capture.flight(world, FLIGHT, DISTORTED, 0)
    points = world.vertices[world.triangles[world.owners > 0].ravel()[::500]].astype(np.float64)
    pixels, inside = cameras.project(5, points)
    pose = cameras.cam_from_world[5]
    expected, _ = cv2.projectPoints(
        points, cv2.Rodrigues(pose)[0], -pose @ cameras.centres[5], cameras.intrinsics, np.array(DISTORTED.distortion)
    )
    assert inside.sum() > 20
    assert np.abs(pixels[inside] - expected[inside, 0]).max() < 1e-6


def test_what_lies_far_outside_a_photo_is_not_folded_into_it(world: World) -> None:
    cameras = capture.orbit(world, "house", ORBIT, PHONE, 0)
    aside = np.array([[2.0, 0.0, 1.0], [0.1, 0.0, 1.0], [0.1, 0.0, -1.0]]) @ cameras.cam_from_world[0]
    # Brown's polynomial puts the first of them, 63 degrees off the axis, into the photo.
    folded = cameras.camera.img_from_cam(np.array([[2.0, 0.0, 1.0]]))[0]
    assert (folded > 0).all() and (folded < [64, 48]).all()
    assert cameras.project(0, cameras.centres[0] + aside)[1].tolist() == [False, True, False]


def test_clicks_and_masks_lie_on_what_a_distorted_photo_shows(world: World) -> None:
    settings = replace(ORBIT, width_px=160)
    cameras = capture.orbit(world, "sculpture", settings, DISTORTED, 0)
    undistorted = replace(cameras, distortion=np.zeros(4), intrinsics=pinhole(140.0, 160, 120))
    landmarks = np.array(list(world.landmarks("sculpture").values()))
    sky, found, missed = np.ones(len(world.vertices), dtype=np.float32), [], []
    for k in range(len(cameras.names)):
        owners = capture.render(world, cameras, k, cameras.rays(1), sky, 0.0)[1][..., 0]
        grown = cv2.dilate((owners == world.owner("sculpture")).astype(np.uint8), np.ones((3, 3), np.uint8))
        pixels, seen = (part[k] for part in visible(world.scene, cameras, landmarks, clicks.HIDDEN_M))
        x, y = pixels[seen].astype(int).T
        found.append(grown[y, x])
        x, y = np.clip(undistorted.project(k, landmarks[seen])[0].astype(int), 0, [159, 119]).T
        missed.append(grown[y, x])
    assert len(np.concatenate(found)) > 20 and np.concatenate(found).all()
    assert not np.concatenate(missed).all()


def test_exif_position_is_the_true_one_when_noise_is_zero(rendered: Path) -> None:
    cameras = read_cameras(rendered / "truth/scene/cameras.json")
    for name, centre in zip(cameras.names, cameras.centres):
        exif = Image.open(rendered / "scene" / name).getexif()
        gps = exif.get_ifd(0x8825)
        degrees = [sum(float(v) / 60**i for i, v in enumerate(gps[tag])) for tag in (2, 4)]
        found = LocalFrame(*ORIGIN).apply(np.array([[*degrees, float(gps[6])]]))
        assert np.abs(found[0] - centre).max() < 0.01
        # 35 mm equivalent by the diagonal: 70 px on a diagonal of 100 px.
        assert exif.get_ifd(0x8769)[0xA405] == round(0.7 * 43.267)
    assert not Image.open(rendered / "house/house_0001.jpg").getexif().get_ifd(0x8825)


def test_clicks_without_noise_meet_at_the_landmarks(tmp_path: Path, world: World) -> None:
    folders = {"photos": tmp_path / "p", "truth": tmp_path / "t"}
    capture.render_object(name="sculpture", **folders, settings=ORBIT, camera="real", seed=0)
    table = tmp_path / "clicks.tsv"
    clicks.click_points(
        name="sculpture",
        cameras=tmp_path / "t/cameras.json",
        clicks=table,
        settings=clicks.ClickSettings(photos=4, separation_deg=20.0, miss_px=(0.0, 0.0)),
        seed=0,
    )
    cameras = read_cameras(tmp_path / "t/cameras.json")
    lines = [line.split("\t") for line in table.read_text().splitlines()]
    assert lines[0] == ["point", "photo", "x_px", "y_px"]
    landmarks, seen = world.landmarks("sculpture"), {}
    for point, photo, x, y in lines[1:]:
        pixel, inside = cameras.project(cameras.names.index(photo), landmarks[point][None])
        assert inside[0] and np.abs(pixel[0] - [float(x), float(y)]).max() < 0.01
        seen[point] = seen.get(point, 0) + 1
    assert len(seen) >= 6 and min(seen.values()) >= 2


def test_an_object_is_clicked_in_the_photo_that_shows_most_of_it_some_pixels_off(tmp_path: Path) -> None:
    (tmp_path / "masks").mkdir()
    shown = np.zeros((120, 160), dtype=np.uint8)
    shown[30:90, 40:120] = 255
    for name, mask in (("a", shown // 2), ("b", shown), ("c", np.zeros_like(shown))):
        cv2.imwrite(str(tmp_path / f"masks/{name}.png"), mask)
    settings = clicks.PromptSettings()
    for seed in range(5):
        clicks.click_object(truth=tmp_path, clicks=tmp_path / "prompts.tsv", settings=settings, seed=seed)
        marked = read_points(tmp_path / "prompts.tsv")
        assert (
            marked.kind == "labels"
            and marked.labels == ["inside"] * 3 + ["box"] * 2
            and set(marked.photos) == {"b.jpg"}
        )
        off = np.linalg.norm(marked.pixels[3:] - [[40, 30], [120, 90]], axis=1)
        assert (off > 2.9).all() and (off < 10.1).all()
        apart = np.linalg.norm(marked.pixels[:3, None] - marked.pixels[:3], axis=2)
        assert apart[np.triu_indices(3, 1)].min() > 25
        assert ((marked.pixels[:3] > [30, 20]) & (marked.pixels[:3] < [130, 100])).all()
    cv2.imwrite(str(tmp_path / "masks/b.png"), np.zeros_like(shown))
    cv2.imwrite(str(tmp_path / "masks/a.png"), np.zeros_like(shown))
    with pytest.raises(StageError, match="no mask in .* shows the object"):
        clicks.click_object(truth=tmp_path, clicks=tmp_path / "clicks.tsv", settings=settings, seed=0)


def test_an_ideal_camera_changes_nothing(world: World) -> None:
    cameras, rng = capture.orbit(world, "balloon", ORBIT, IDEAL, 0), np.random.default_rng(0)
    column, row = np.meshgrid(np.arange(64) + 0.5, np.arange(48) + 0.5)
    assert np.array_equal(cameras.rays(1), np.stack([(column - 32) / 56, (row - 24) / 56], axis=-1).reshape(-1, 2))
    light, expected = 3.0 * rng.random((48, 64, 3)) ** 3, np.empty((48, 64, 3), dtype=np.uint8)
    textures.encode(expected, light)
    assert np.array_equal(expose(light, IDEAL, draw_exposure(IDEAL, rng), cameras, rng), expected)


def test_exposure_differs_from_photo_to_photo_as_designed(rendered: Path) -> None:
    gains = np.log([draw_exposure(PHONE, np.random.default_rng([7, k])).gains / PHONE.gains for k in range(2000)])
    assert gains.mean(0) == pytest.approx(0, abs=0.01)
    assert gains[:, 1].std() == pytest.approx(0.08, rel=0.1)
    assert (gains[:, [0, 2]] - gains[:, [1]]).std(0) == pytest.approx([0.03, 0.03], rel=0.1)
    mean = {}
    for capture_name in ("scene", "house"):
        exposures = read_json(rendered / f"truth/{capture_name}/cameras.json")["exposures"]
        found = np.array([value(photo, "gains") for photo in exposures.values()])
        assert len(np.unique(found[:, 1])) == len(found)
        mean[capture_name] = found.mean(0)
    assert (mean["house"] > 1.02 * mean["scene"]).all()


def test_a_longer_exposure_is_a_brighter_photo(world: World) -> None:
    cameras, light = capture.orbit(world, "house", ORBIT, PHONE, 0), np.full((48, 64, 3), 0.3)
    drawn, brightness = [], []
    for k in range(12):
        rng = np.random.default_rng(k)
        drawn.append(draw_exposure(PHONE, rng))
        brightness.append(expose(light, PHONE, drawn[-1], cameras, rng)[..., 1].mean())
    order = np.argsort([exposure.gains[1] for exposure in drawn])
    assert np.all(np.diff(np.array(brightness)[order]) > 0) and np.ptp(brightness) > 5


def test_vignetting_noise_and_blur_have_the_size_they_should(world: World) -> None:
    cameras, rng = capture.flight(world, FLIGHT, DRONE, 0), np.random.default_rng(0)
    share = vignetting(cameras, 0.75)
    # The principal point is at (40.8, 29.52): the farthest corner is the lower left one.
    assert share[29, 40] == pytest.approx(1.0, abs=1e-3) and share.argmin() == 59 * 80
    assert 0.75 < share.min() < 0.76
    body, light = Body(shot=4e-4, read=5e-3), np.full((60, 80, 3), 0.3)
    sharp = Exposure(np.ones(3), 0.0, np.zeros(2))
    sd, pair = np.sqrt(4e-4 * 0.3 + 5e-3**2), np.empty((2, 1, 1), dtype=np.uint8)
    textures.encode(pair, 0.3 + 5 * sd * np.array([[[-1.0]], [[1.0]]]))
    assert expose(light, body, sharp, cameras, rng).std() == pytest.approx(np.ptp(pair.astype(float)) / 10, rel=0.1)
    kernel = blur_kernel(Exposure(np.ones(3), 0.8, np.array([0.0, 3.0])))
    at = np.arange(len(kernel)) - len(kernel) // 2
    assert kernel.sum() == pytest.approx(1.0)
    assert kernel.sum(0) @ at**2 == pytest.approx(0.64, rel=0.05)
    assert kernel.sum(1) @ at**2 == pytest.approx(0.64 + 3.0**2 / 12, rel=0.05)


def test_close_ups_are_a_phones_jpegs(rendered: Path) -> None:
    sampling = {
        name: Image.open(next((rendered / name).glob("*.jpg"))).layer[0][1:3]  # type: ignore[attr-defined]
        for name in ("scene", "house")
    }
    assert sampling == {"scene": (1, 1), "house": (2, 2)}


def test_the_sky_of_a_real_camera_is_white_and_has_no_texture(world: World) -> None:
    cameras, sky = capture.orbit(world, "balloon", ORBIT, PHONE, 0), np.ones(len(world.vertices), dtype=np.float32)
    light, owners = capture.render(world, cameras, 0, cameras.rays(1), sky, PHONE.haze)
    above = owners[..., 0] == -1
    assert above.mean() > 0.1
    assert light[above].min() > 1.2 and (np.ptp(light[above], axis=1) < 0.2).all()
    neighbours = above[:, 1:] & above[:, :-1]
    assert np.abs(np.diff(light, axis=1))[neighbours].max() < 0.02 < np.ptp(light[above][:, 1])


def test_landmarks_lie_on_their_object(world: World) -> None:
    for owner, name in enumerate(world.names, start=1):
        vertices, triangles = world.mesh(owner)
        scene = o3d.t.geometry.RaycastingScene()
        scene.add_triangles(
            o3d.core.Tensor.from_numpy(vertices), o3d.core.Tensor.from_numpy(triangles.astype(np.uint32))
        )
        points = np.array(list(world.landmarks(name).values()), dtype=np.float32)
        assert scene.compute_distance(o3d.core.Tensor.from_numpy(points)).numpy().max() < 0.05


def test_nothing_is_seen_through_a_wall(world: World) -> None:
    low, high = world.bounds("house")
    middle = (low + high) / 2
    points = np.stack([middle, middle + [0, 0, 30.0]])
    cameras = capture.orbit(world, "house", ORBIT, IDEAL, 0)
    far = Cameras(
        cameras.names, cameras.intrinsics * [[0.2], [0.2], [1]] + [[0, 0, 25.6], [0, 0, 19.2], [0, 0, 0]], 64, 48,
        cameras.cam_from_world, cameras.centres,
    )  # fmt: skip
    seen = visible(world.scene, far, points, 0.05)[1]
    assert not seen[:, 0].any() and seen[:, 1].any()


@pytest.mark.slow
def test_the_sky_is_hidden_under_the_balloon(world: World) -> None:
    sky = openness(world, 8, 0)
    x, y = world.bounds("balloon").mean(0)[:2]
    ground = np.unique(world.triangles[world.materials == textures.Material.TERRAIN])
    away = np.hypot(world.vertices[ground, 0] - x, world.vertices[ground, 1] - y)
    assert sky[ground[away < 1.5]].mean() < 0.7 < 0.85 < sky[ground[(away > 9) & (away < 12)]].mean()


def test_noise_fades_out_where_a_pixel_is_larger_than_it() -> None:
    points = np.random.default_rng(0).uniform(-5, 5, (500, 3))
    full = np.array([textures.fractal_noise(*p, 1.0, 5, 1.0, 1e-3, 1) for p in points])
    coarse = np.array([textures.fractal_noise(*p, 1.0, 5, 1.0, 3.0, 1) for p in points])
    assert full.std() > 0.2 and np.all(coarse == 0)
    assert np.allclose(full, textures.noise_at(points, 5, 1.0, 1))


@pytest.mark.parametrize(
    ("name", "settings", "sentence"),
    [
        ("castle", ORBIT, "no object 'castle'; use one of house, balloon, sculpture"),
        ("house", replace(ORBIT, views=0), "without photos"),
        ("house", replace(ORBIT, width_px=4), "4 x 3 pixels"),
        ("house", replace(ORBIT, elevations_deg=()), "needs an elevation"),
    ],
)
def test_bad_input_is_one_sentence(tmp_path: Path, name: str, settings, sentence: str) -> None:
    with pytest.raises(StageError, match=sentence):
        folders = {"photos": tmp_path / "p", "truth": tmp_path / "t"}
        capture.render_object(name=name, **folders, settings=settings, camera="real", seed=0)
    assert not any(tmp_path.iterdir())

"""The demo capture: truth that agrees with the photos, and the same bytes for the same seed."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import open3d as o3d
import pytest
from PIL import Image

from scenefuse.demo import capture, clicks, textures
from scenefuse.demo.cameras import read_cameras, visible
from scenefuse.demo.world import ORIGIN, World, build_world, openness
from scenefuse.sfm.geodesy import LocalFrame
from scenefuse.stage import StageError, manifest, read_json, value

FLIGHT = capture.FlightSettings(
    columns=2,
    rows=2,
    obliques=2,
    width_px=80,
    height_px=60,
    focal_px=60.0,
    supersampling=1,
    gps_noise_horizontal=0.0,
    gps_noise_vertical=0.0,
)
ORBIT = capture.OrbitSettings(views=4, width_px=64, height_px=48, focal_px=56.0, supersampling=1)


@pytest.fixture(scope="module")
def world() -> World:
    return build_world(0)


@pytest.fixture(autouse=True, scope="module")
def one_world(world: World) -> Iterator[None]:
    """Every stage gets the world that is already there, with an open sky."""
    with pytest.MonkeyPatch.context() as patch:
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
    capture.render_scene(photos=root / "scene", truth=root / "truth/scene", settings=FLIGHT, seed=0)
    capture.render_object(name="house", photos=root / "house", truth=root / "truth/house", settings=ORBIT, seed=0)


def test_same_seed_same_bytes_and_all_files(tmp_path: Path, rendered: Path) -> None:
    render_all(tmp_path)
    files = manifest(rendered)
    assert files == manifest(tmp_path)
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


def test_a_ray_through_a_pixel_projects_back_to_it(world: World) -> None:
    cameras = capture.flight(world, FLIGHT, 0)
    rays = np.empty((80 * 60, 6), dtype=np.float32)
    k = cameras.intrinsics
    centre, turn = cameras.centres[5], np.ascontiguousarray(cameras.cam_from_world[5].T)
    textures.pixel_rays(rays, centre, turn, k[0, 0], k[1, 1], k[0, 2], k[1, 2], 80, 1)
    points = (rays[:, :3] + 30.0 * rays[:, 3:]).astype(np.float64)
    pixels, _ = cameras.project(5, points)
    assert np.abs(pixels.reshape(60, 80, 2)[10, 20] - [20.5, 10.5]).max() < 1e-3


def test_exif_position_is_the_true_one_when_noise_is_zero(rendered: Path) -> None:
    cameras = read_cameras(rendered / "truth/scene/cameras.json")
    for name, centre in zip(cameras.names, cameras.centres):
        exif = Image.open(rendered / "scene" / name).getexif()
        gps = exif.get_ifd(0x8825)
        degrees = [sum(float(v) / 60**i for i, v in enumerate(gps[tag])) for tag in (2, 4)]
        found = LocalFrame(*ORIGIN).apply(np.array([[*degrees, float(gps[6])]]))
        assert np.abs(found[0] - centre).max() < 0.01
        # 35 mm equivalent by the diagonal: 60 px on a diagonal of 100 px.
        assert exif.get_ifd(0x8769)[0xA405] == round(0.6 * 43.267)
    assert not Image.open(rendered / "house/house_0001.jpg").getexif().get_ifd(0x8825)


def test_clicks_without_noise_meet_at_the_landmarks(tmp_path: Path, world: World) -> None:
    capture.render_object(name="sculpture", photos=tmp_path / "p", truth=tmp_path / "t", settings=ORBIT, seed=0)
    table = tmp_path / "prompts.tsv"
    clicks.click_points(
        name="sculpture",
        cameras=tmp_path / "t/cameras.json",
        clicks=table,
        settings=clicks.ClickSettings(photos=4, separation_deg=20.0, noise_px=0.0),
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
    cameras = capture.orbit(world, "house", ORBIT, 0)
    far = capture.Cameras(
        cameras.names, cameras.intrinsics * [[0.2], [0.2], [1]] + [[0, 0, 25.6], [0, 0, 19.2], [0, 0, 0]], 64, 48,
        cameras.cam_from_world, cameras.centres,
    )  # fmt: skip
    seen = visible(world.scene, far, points, 0.05)[1]
    assert not seen[:, 0].any() and seen[:, 1].any()


def test_the_sky_is_hidden_under_the_balloon(world: World) -> None:
    sky = openness(world, 8, 0)
    x, y = world.bounds("balloon").mean(0)[:2]
    ground = np.unique(world.triangles[world.materials == textures.TERRAIN])
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
        ("house", replace(ORBIT, views=0), "asked for 0 photos"),
        ("house", replace(ORBIT, width_px=4, height_px=4), "4 x 4 pixels"),
        ("house", replace(ORBIT, elevations_deg=()), "needs an elevation"),
    ],
)
def test_bad_input_is_one_sentence(tmp_path: Path, name: str, settings, sentence: str) -> None:
    with pytest.raises(StageError, match=sentence):
        capture.render_object(name=name, photos=tmp_path / "p", truth=tmp_path / "t", settings=settings, seed=0)
    assert not any(tmp_path.iterdir())

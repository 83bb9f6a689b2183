"""Plain points: a gap in a measured surface is filled by what continues it, and nothing is added beyond its border."""

import numpy as np
import pytest

from scenefuse.cloud.clouds import Cloud, concatenate
from scenefuse.core.transforms import look_at
from scenefuse.fuse.compare import compare
from scenefuse.fuse.measure import Measured, plain_points
from scenefuse.geometry.photo_check import Matches
from scenefuse.photos.workspace import View

TEXTURED, BLANK = 20.0, 0.0


def known(cloud: Cloud, surface: np.ndarray, texture: np.ndarray | None = None) -> Measured:
    """A cloud of which photos confirm some points (N,); what they do not confirm is plain, or has `texture`."""
    count = len(cloud)
    texture = np.where(surface, TEXTURED, BLANK) if texture is None else texture
    deviation = np.where(surface, 0.001, np.inf)
    photos = np.where(surface, 5, 0)
    matches = Matches(np.ones(count), np.ones(count), photos, photos, deviation, texture, np.full(count, 0.01))
    return Measured(cloud, matches, surface)


def lattice(low: float, high: float, step: float) -> tuple[np.ndarray, np.ndarray]:
    """Coordinates (N,), (N,) of a square lattice."""
    along = np.arange(low, high + step / 2, step)
    return tuple(axis.ravel() for axis in np.meshgrid(along, along))


def wall(bulge: float = 0.0) -> tuple[Cloud, np.ndarray]:
    """A wall of 10 x 10 in the plane y = 0, and which of its points lie in its middle, `bulge` before it."""
    x, z = lattice(-5, 5, 0.05)
    middle = (np.abs(x) < 0.5) & (np.abs(z) < 0.5)
    points = np.column_stack([x, np.where(middle, -bulge, 0.0), z])
    return Cloud(points, np.tile(np.float32([0, -1, 0]), (len(points), 1))), middle


def nothing(obj: Measured) -> np.ndarray:
    return np.zeros(len(obj.cloud), dtype=bool)


def test_the_plain_middle_of_a_measured_wall_is_taken_whole():
    cloud, middle = wall()
    obj = known(cloud, ~middle)
    assert np.array_equal(plain_points(obj, nothing(obj)), middle)


def test_what_photos_see_through_or_could_have_matched_is_not():
    cloud, middle = wall()
    obj = known(cloud, ~middle)
    through = middle & (cloud.points[:, 0] > 0)
    assert np.array_equal(plain_points(obj, through), middle & ~through)
    textured = known(cloud, ~middle, np.full(len(cloud), TEXTURED))
    assert not plain_points(textured, nothing(textured)).any()


def test_a_plain_part_before_or_behind_its_wall_is_not():
    # The diagonal is 14: the resolution is 0.14.
    for bulge, taken in ((0.05, 1.0), (0.5, 0.0), (-0.5, 0.0)):
        cloud, middle = wall(bulge)
        obj = known(cloud, ~middle)
        assert plain_points(obj, nothing(obj))[middle].mean() == pytest.approx(taken, abs=0.02)


def test_nothing_is_taken_beyond_the_border_of_what_is_measured():
    cloud, _ = wall()
    beyond = cloud.points[:, 0] > 3
    obj = known(cloud, ~beyond)
    side = 0.01 * cloud.diagonal
    assert plain_points(obj, nothing(obj))[cloud.points[:, 0] > 3 + 2 * side].mean() < 0.02


def test_the_plain_side_of_a_ball_continues_its_curve():
    rng = np.random.default_rng(0)
    normals = rng.normal(size=(20_000, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    cap = normals[:, 0] > np.cos(np.radians(8))
    obj = known(Cloud(normals, normals.astype(np.float32)), ~cap)
    assert plain_points(obj, nothing(obj))[cap].mean() > 0.95


def test_without_measured_surface_nothing_is_plain():
    cloud, middle = wall()
    obj = known(cloud, np.zeros(len(cloud), dtype=bool))
    assert not plain_points(obj, nothing(obj)).any()


def camera(place: list[float], name: str) -> View:
    """A camera that looks at the middle of the house."""
    pose = np.eye(4)
    pose[:3, :3] = look_at(np.array(place), np.zeros(3), np.array([0.0, 0, 1]))
    pose[:3, 3] = -pose[:3, :3] @ place
    return View(name, np.array([[400.0, 0, 150], [0, 400, 150], [0, 0, 1]]), pose, 300, 300)


def test_a_plain_wall_is_not_seen_through_though_nothing_measured_hides_the_ground_behind():
    x, y = lattice(-6, 6, 0.1)
    apart = (np.abs(x) > 1) | (np.abs(y) > 1)
    ground = Cloud(
        np.column_stack([x, y, np.full(len(x), -1.0)])[apart], np.tile(np.float32([0, 0, 1]), (apart.sum(), 1))
    )
    x, z = lattice(-1, 1, 0.1)
    sides = [np.column_stack([x, np.full(len(x), s), z]) for s in (-1, 1)]
    sides += [np.column_stack([np.full(len(x), s), x, z]) for s in (-1, 1)]
    facing = [[0, -1, 0], [0, 1, 0], [-1, 0, 0], [1, 0, 0]]
    walls = Cloud(np.concatenate(sides), np.repeat(np.float32(facing), len(x), axis=0))
    roof = Cloud(np.column_stack([x, z, np.ones(len(x))]), np.tile(np.float32([0, 0, 1]), (len(x), 1)))
    house = concatenate([walls, roof])
    around = [[12 * np.cos(a), 12 * np.sin(a), 5] for a in np.radians(np.arange(0, 360, 20))]
    views = [camera(place, f"{row}") for row, place in enumerate(around)]
    obj = known(house, house.points[:, 2] > 0.95)
    scene = known(ground, np.ones(len(ground), dtype=bool))
    _, contradicted, _ = compare(obj, scene, np.zeros(len(ground), dtype=bool), views)
    assert not contradicted.any()
    # What is not there at all, before the house, shows the ground behind.
    hovering = concatenate([house, Cloud(walls.points[:400] + [0, -3, 0], walls.normals[:400])])
    false = np.arange(len(hovering)) >= len(house)
    obj = known(hovering, (hovering.points[:, 2] > 0.95) & ~false, np.where(false, TEXTURED, BLANK))
    _, contradicted, _ = compare(obj, scene, np.zeros(len(ground), dtype=bool), views)
    assert contradicted[false].mean() > 0.8

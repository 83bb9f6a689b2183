"""Ground goes only where an object stands on it: on walls, slopes, pillars and under beams nothing is taken for it."""

from dataclasses import dataclass

import numpy as np
import pytest
from support.planted import plant

from scenefuse.cloud.clouds import Cloud, write_cloud
from scenefuse.core.stage import read_json, value
from scenefuse.crop.crop_cloud import CropSettings, crop_cloud
from scenefuse.crop.crop_scene import CropInputs, crop_scene
from scenefuse.two_clouds.find import cut_scene

Z = np.array([0.0, 0.0, 1.0])
SETTINGS = CropSettings()


@dataclass(frozen=True)
class Scene:
    """An object, what is around it, and the object's fiducials; metres, z up."""

    object: np.ndarray
    around: np.ndarray
    fiducials: np.ndarray

    @property
    def cloud(self):
        return Cloud(np.concatenate([self.object, self.around]))

    def crop(self, **settings):
        """The crop, and which points of the object and of the rest it keeps."""
        cut = crop_cloud(self.cloud, self.fiducials, Z, CropSettings(**settings))
        return cut, cut.keep[: len(self.object)], cut.keep[len(self.object) :]


def patch(x, y, z, count, seed=0, noise=0.01):
    """Noisy points on a patch: x and y are ranges, z a range or a height, or a function of x and y."""
    rng = np.random.default_rng(seed)
    spans = [(span, span) if np.isscalar(span) else span for span in (x, y, 0 if callable(z) else z)]
    points = np.stack([rng.uniform(*span, count) for span in spans], axis=1)
    if callable(z):
        points[:, 2] = z(points[:, 0], points[:, 1])
    return points + rng.normal(0, noise, points.shape)


def block(low, high, count=4000):
    """Points on the faces of an upright block, and its eight corners."""
    rng = np.random.default_rng(1)
    points = rng.uniform(0, 1, (count, 3))
    points[np.arange(count), rng.integers(0, 3, count)] = rng.integers(0, 2, count)
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)])
    low, size = np.array(low, float), np.subtract(high, low)
    return low + points * size, low + corners * size


def balcony(*around):
    """A balcony on a wall, 8 m above the street, with what else is around."""
    wall = patch((-12, 12), 0.0, (0, 16), 30000, noise=0.04)
    return Scene(*(lambda b: (b[0], np.concatenate([wall, *around]), b[1]))(block((-2, -1.4, 8), (2, 0, 9.2))))


STREET = patch((-12, 12), (-12, 0), 0.0, 20000)
TERRACE = patch((-12, 12), (0, 12), 10.0, 20000)
LEDGE = patch((-12, 12), (-0.4, 0), 7.9, 6000)


@pytest.mark.parametrize(
    "around",
    [(), (STREET,), (TERRACE,), (STREET, TERRACE), (LEDGE,)],
    ids=["wall", "street", "terrace", "both", "ledge"],
)
def test_a_balcony_on_a_wall_stays_whole_and_the_wall_below_stays_outside(around):
    cut, own, _ = balcony(*around).crop()
    assert own.all() and not cut.on_ground.any()
    assert cut.low[2] > 7.5
    assert "nothing was removed as ground" in cut.notes[0] or "not extended down to it" in cut.notes[0]


def on_slope(angle_deg):
    """A block, 3 by 3 m and 2 m high above its middle, on a slope; clicks at its top and at its downhill foot."""
    rise = np.tan(np.radians(angle_deg))
    own, corners = block((-1.5, -1.5, -1.5 * rise), (1.5, 1.5, 2), 6000)
    own = own[own[:, 2] > rise * own[:, 0]]
    marks = corners[(corners[:, 2] > 1) | (corners[:, 0] < 0)]
    return Scene(own, patch((-8, 8), (-8, 8), lambda x, y: rise * x, 30000), marks)


@pytest.mark.parametrize("angle_deg", [6, 12, 18])
def test_a_slope_goes_uphill_and_downhill_of_a_block(angle_deg):
    scene = on_slope(angle_deg)
    cut, kept, rest = scene.crop()
    over = scene.object[:, 2] - cut.ground.height(scene.object[:, :2])
    assert kept[over > cut.ground.tolerance].all() and rest.sum() < 0.02 * kept.sum() and cut.notes == []


def test_a_block_on_a_steep_slope_stays_whole_and_the_slope_is_called_too_steep():
    cut, kept, _ = on_slope(25).crop()
    assert kept.all() and not cut.on_ground.any()
    assert "rises by 25 degrees, ground by 20 at most" in cut.notes[0]


def test_a_statue_on_a_pillar_stays_whole_without_the_pillar():
    own, corners = block((-0.4, -0.4, 5), (0.4, 0.4, 7))
    pillar, _ = block((-0.6, -0.6, 0), (0.6, 0.6, 4.98))
    cut, kept, rest = Scene(own, np.concatenate([pillar, patch((-8, 8), (-8, 8), 0.0, 30000)]), corners).crop()
    assert kept.all() and not cut.on_ground.any()
    below = np.concatenate([pillar, np.zeros((30000, 3))])[:, 2] < 4.5
    assert not rest[below].any()
    assert "the box was not extended down to it" in cut.notes[0] and "mark its foot" in cut.notes[0]


def test_a_lamp_under_a_beam_stays_whole():
    own, corners = block((-0.2, -0.2, 3), (0.2, 0.2, 3.6), 2000)
    beam, _ = block((-4, -0.15, 3.7), (4, 0.15, 4))
    cut, kept, rest = Scene(own, np.concatenate([beam, patch((-4, 4), (-4, 4), 0.0, 30000)]), corners).crop()
    assert kept.all() and not cut.on_ground.any() and not rest[-30000:].any()


def test_a_statue_in_a_sunken_court_keeps_its_legs():
    own, corners = block((-0.5, -0.5, -1.5), (0.5, 0.5, 1.5))
    lawn = patch((-8, 8), (-8, 8), 0.0, 40000)
    lawn = lawn[np.abs(lawn[:, :2]).max(1) > 0.7]
    cut, kept, _ = Scene(own, lawn, corners).crop()
    assert kept.all() and "over the lowest tenth of the fiducials' height" in cut.notes[0]


def test_beside_a_fiducial_under_the_surface_nothing_is_ground():
    """A block on flat ground with a light well; one fiducial lies at its bottom."""
    own, corners = block((-2, -2, 0.0), (2, 2, 12))
    well, _ = block((2, -0.3, -0.9), (2.6, 0.3, 0.5), 2000)
    lawn = patch((-16, 16), (-16, 16), 0.0, 60000)
    scene = Scene(np.concatenate([own, well]), lawn, np.concatenate([corners, [[2.6, 0.0, -0.9]]]))
    cut, kept, rest = scene.crop()
    assert kept[len(own) :].all()
    assert cut.on_ground[-len(lawn) :].sum() > 10 * rest.sum()


def test_a_few_stray_votes_under_the_ground_do_not_keep_it():
    """Masks mark an object with all its points; a few of their votes go astray."""
    own, _ = block((-2, -1.5, 0.0), (2, 1.5, 3))
    lawn = patch((-8, 8), (-8, 8), 0.0, 30000)
    strays = np.random.default_rng(0).uniform([-2, -1.5, -3], [2, 1.5, -1], (30, 3))
    scene = Scene(own, np.concatenate([lawn, strays]), np.concatenate([own, strays]))
    cut, kept, rest = scene.crop()
    assert kept[own[:, 2] > cut.ground.tolerance + 0.01].all() and not rest[: len(lawn)].any()


def test_flat_ground_goes_and_what_stands_on_it_stays():
    own, corners = block((-2, -1.5, 0.0), (2, 1.5, 3))
    lawn = patch((-8, 8), (-8, 8), 0.0, 30000)
    cut, kept, rest = Scene(own, lawn, corners).crop()
    assert kept[own[:, 2] > cut.ground.tolerance + 0.01].all()
    inside = (np.abs(lawn[:, :2]) < [2, 1.5]).all(1)
    assert inside.sum() > 1000 and not rest.any() and cut.notes == []
    assert cut.on_ground[len(own) :][inside].all()


def test_a_low_slab_keeps_its_top():
    """Its top is within the thickness that the ground is given, but over a tenth of the fiducials' height."""
    own, corners = block((-3, -2, 0.0), (3, 2, 0.1))
    cut, kept, _ = Scene(own, patch((-10, 10), (-10, 10), 0.0, 40000, noise=0.003), corners).crop()
    assert cut.ground.tolerance > 0.1 and cut.on_ground.sum() > 1000
    assert kept[own[:, 2] > 0.02].all()


def test_ground_between_terraces_is_found_though_they_are_larger():
    own, corners = block((-1.5, -1.5, 0.0), (1.5, 1.5, 3))
    lawn, terraces = patch((-8, 8), (-8, 8), 0.0, 30000), patch((-8, 8), (-8, 8), 4.0, 30000)
    court = (np.abs(lawn[:, 1]) < 2) & (lawn[:, 0] < 2)
    around = np.concatenate([lawn[court], terraces[(np.abs(terraces[:, 1]) > 2) | (terraces[:, 0] > 2)]])
    cut, kept, rest = Scene(own, around, corners).crop()
    assert kept[own[:, 2] > cut.ground.tolerance + 0.01].all() and not rest.any()


def test_marks_on_the_upper_half_still_reach_the_ground():
    own, corners = block((-2, -1.5, 0.0), (2, 1.5, 4))
    marks = np.concatenate([corners[corners[:, 2] > 1], corners[corners[:, 2] > 1] - [0, 0, 2.0]])
    cut, kept, rest = Scene(own, patch((-8, 8), (-8, 8), 0.0, 30000), marks).crop()
    assert kept[own[:, 2] > cut.ground.tolerance + 0.01].all() and not rest.any()


def test_a_platform_apart_from_the_ground_around_it_stays():
    """A platform on piles in a pond: as low as the shore, but not connected with it."""
    own, corners = block((-1, -1, 0.0), (1, 1, 3))
    shore = patch((-9, 9), (-9, 9), 0.0, 40000)
    apart = np.abs(shore[:, :2]).max(1)
    shore = shore[(apart < 1.2) | (apart > 2.2)]
    cut, kept, _ = Scene(own, shore, corners).crop()
    assert kept.all() and not cut.on_ground.any()
    assert "does not continue into it" in cut.notes[0]


def test_uneven_ground_under_a_house_goes():
    trial = plant("house", 3, noise=0.003, slope=0.08, object_points=6000, density_ratio=1.0, depth_maps=False)
    own = np.arange(len(trial.scene)) < round(6000 * trial.coverage)
    cut = crop_cloud(trial.scene, trial.fiducials, Z, SETTINGS)
    surface = cut.ground.height(trial.scene.points[:, :2])
    assert cut.keep[own & (trial.scene.points[:, 2] > surface + cut.ground.tolerance)].mean() > 0.98
    assert (cut.keep & ~own).sum() < 0.03 * cut.keep.sum() and cut.on_ground.sum() > 2000


def bed():
    """A flower bed with a post in its middle: nearly all of what is there is ground."""
    own, _ = block((-0.03, -0.03, 0.0), (0.03, 0.03, 0.3), 400)
    marks = np.array([[0, 0, 0.3], [1, 1, 0], [1, -1, 0], [-1, 1, 0], [-1, -1, 0]])
    return Scene(own, patch((-4, 4), (-4, 4), 0.0, 200000), marks)


def test_ground_goes_though_it_was_measured_much_more_densely_than_the_object():
    own, corners = block((0, 0, 0), (6, 4, 3), 540)
    cut, kept, rest = Scene(own, patch((-6, 12), (-6, 10), 0.0, 80000), corners).crop()
    assert kept[own[:, 2] > 0.3].all() and not rest.any() and cut.notes == []


def test_a_dense_bush_in_the_box_leaves_a_house_of_few_points_in_one_part():
    own, corners = block((0, 0, 0), (6, 4, 3), 800)
    on_sphere = np.random.default_rng(0).normal(size=(20000, 3))
    on_sphere /= np.linalg.norm(on_sphere, axis=1, keepdims=True)
    scene = Scene(own, np.concatenate([[6.25, 4.1, 0.6] + [0.3, 0.3, 0.6] * on_sphere, STREET]), corners)
    assert scene.crop()[1][own[:, 2] > 0.3].all()


@pytest.mark.slow
def test_ground_that_would_be_nearly_everything_is_left_in_and_that_is_recorded_and_printed(tmp_path, capsys):
    scene = bed()
    write_cloud(tmp_path / "dense.ply", scene.cloud)
    rows = [f"p{k}\t{x}\t{y}\t{z}" for k, (x, y, z) in enumerate(scene.fiducials)]
    (tmp_path / "marks.tsv").write_text("point\tx\ty\tz\n" + "\n".join(rows) + "\n")
    inputs = CropInputs(scene=tmp_path / "dense.ply", sparse=tmp_path, fiducials=tmp_path / "marks.tsv")
    crop_scene(inputs=inputs, crop=tmp_path / "crop.ply", report=tmp_path / "crop.json", settings=SETTINGS)
    report = read_json(tmp_path / "crop.json")
    note = value(report, "notes")[0]
    assert "points in the box would be ground: nothing was removed as ground" in note
    assert note in capsys.readouterr().out
    assert value(report, "ground_points") == 0
    assert value(report, "crop_points") > 10000


def test_registering_two_clouds_says_what_was_not_removed(tmp_path):
    scene = balcony(STREET, TERRACE)
    np.savetxt(tmp_path / "marks.txt", scene.fiducials)
    part, searched = cut_scene(scene.cloud, SETTINGS, Z, tmp_path / "marks.txt")
    assert len(part) >= len(scene.object) and "no ground removed; the ground around the box is 8 below" in searched
    flat = Scene(*(lambda b: (b[0], STREET + [0, 6, 0], b[1]))(block((-2, -1.5, 0.0), (2, 1.5, 3))))
    np.savetxt(tmp_path / "marks.txt", flat.fiducials)
    assert "the ground removed" in cut_scene(flat.cloud, SETTINGS, Z, tmp_path / "marks.txt")[1]


def test_parts_are_kept_where_those_near_a_fiducial_would_be_next_to_nothing():
    own, _ = block((-2, 0.3, 0), (-1.9, 0.5, 0.4), 600)
    _, marks = block((-2, -0.5, 0), (2, 0.5, 3))
    scene = Scene(own, patch(2.35, (-0.5, 0.5), (0, 3), 20000, noise=0.003), marks)
    cut, kept, rest = scene.crop(remove_ground=False)
    assert kept.all() and rest.all()
    assert cut.notes == ["parts near a fiducial have only 600 of 20600 points in the box: all were kept"]

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from scenefuse.core.transforms import Sim3, fit_sim3, fit_sim3_robust, look_at, rotation_angle_deg, rotation_between


def random_sim3(seed: int) -> Sim3:
    rng = np.random.default_rng(seed)
    return Sim3(float(np.exp(rng.normal())), Rotation.random(random_state=seed).as_matrix(), rng.normal(0, 1e6, 3))


@pytest.mark.parametrize("seed", range(5))
def test_inverse_and_composition(seed):
    a, b = random_sim3(seed), random_sim3(seed + 10)
    assert np.allclose((a @ a.inverse()).matrix, np.eye(4), atol=1e-8)
    points = np.random.default_rng(seed).normal(size=(10, 3))
    assert np.allclose((a @ b).apply(points), a.apply(b.apply(points)))
    assert np.allclose(Sim3.from_matrix(a.matrix).matrix, a.matrix)


def test_from_matrix_refuses_shear_and_mirror():
    shear = np.eye(4)
    shear[0, 1] = 0.5
    with pytest.raises(ValueError, match="not a scaled rotation"):
        Sim3.from_matrix(shear)
    with pytest.raises(ValueError, match="determinant"):
        Sim3.from_matrix(np.diag([1.0, 1.0, -1.0, 1.0]))


@pytest.mark.parametrize("seed", range(3))
def test_fit_recovers_a_planted_similarity(seed):
    planted = random_sim3(seed)
    x = np.random.default_rng(seed).normal(size=(30, 3))
    assert np.allclose(fit_sim3(x, planted.apply(x)).matrix, planted.matrix, rtol=1e-9, atol=1e-6)


def test_fit_with_a_fixed_scale_does_not_change_it():
    x = np.random.default_rng(0).normal(size=(30, 3))
    assert fit_sim3(x, 3.0 * x, scale=1.0).scale == 1.0


def test_fit_of_points_on_a_line_is_refused():
    line = np.arange(5.0)[:, None] * np.ones((1, 3))
    with pytest.raises(ValueError, match="one line"):
        fit_sim3(line, line)


def test_robust_fit_ignores_a_third_of_outliers():
    planted = Sim3(2.0, Rotation.random(random_state=3).as_matrix(), np.array([1.0, 2.0, 3.0]))
    rng = np.random.default_rng(3)
    x = rng.normal(size=(60, 3))
    y = planted.apply(x) + rng.normal(0, 1e-3, (60, 3))
    y[:20] += rng.normal(0, 5, (20, 3))
    fitted, inliers = fit_sim3_robust(x, y, threshold=0.01)
    assert not inliers[:20].any() and inliers[20:].all()
    assert abs(fitted.scale - 2.0) < 2e-3


def test_rotation_angle_and_shortest_rotation():
    for angle in (0.0, 1e-4, 90.0, 180.0):
        rotation = Rotation.from_rotvec(np.radians(angle) * np.array([0, 0, 1.0])).as_matrix()
        assert rotation_angle_deg(rotation) == pytest.approx(angle, abs=1e-6)
    a, b = np.array([0.0, 0, 2]), np.array([1.0, 1, 0])
    assert np.allclose(rotation_between(a, b) @ [0, 0, 1], b / np.linalg.norm(b))
    assert np.allclose(rotation_between(a, -a) @ [0, 0, 1], [0, 0, -1])


@pytest.mark.parametrize("eye", [[3.0, 1.0, 2.0], [0.0, -10.0, 5.0], [0.0, 0.0, 4.0]])
def test_look_at_is_a_rotation_with_up_upwards(eye):
    rotation = look_at(eye, [0.0, 0.0, 0.0], [0.0, 0.0, 1.0])
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(rotation) == pytest.approx(1.0)
    np.testing.assert_allclose(rotation @ eye, [0, 0, -np.linalg.norm(eye)], atol=1e-12)
    assert (rotation @ [0, 0, 1])[1] < 0 or eye[:2] == [0, 0]

"""The ground near an object: a parabolic height field, and its fit to what surrounds a box."""

from dataclasses import dataclass

import numpy as np

from scenefuse.core.transforms import SD_OVER_MEDIAN, Array, inside_box
from scenefuse.geometry.icp import MAX_TRIPLES

# Cells along each side of the square around the ring; one low point stands for each, and half as many fix the ground.
CELLS = 40
# The plane must hold this share of the cells, and rise by less than 45 degrees.
MIN_SHARE = 0.3
# Cells of a strip narrower than this share of its length, a ledge or the foot of a wall, fix no slope across it.
MIN_BREADTH = 0.2


@dataclass(frozen=True)
class Ground:
    """A height field z = a + b x + c y + d x^2 + e x y + f y^2 about a centre.

    Attributes:
        coefficients: (6,) in the order above.
        centre: (2,) subtracted from x and y.
        tolerance: points lower than this above it are ground.
    """

    coefficients: Array
    centre: Array
    tolerance: float = 0.0

    def height(self, xy: Array) -> Array:
        """Heights (N,) at (N, 2)."""
        return quadratic_terms(xy - self.centre) @ self.coefficients

    def height_of(self, points: Array) -> Array:
        """Heights (N,) of (N, 3) points over the ground."""
        return points[:, 2] - self.height(points[:, :2])

    def rise(self, xy: Array) -> Array:
        """Slopes (N,) at (N, 2): the tangent of the angle with the horizontal."""
        x, y = (xy - self.centre).T
        _, b, c, d, e, f = self.coefficients
        return np.hypot(b + 2 * d * x + e * y, c + e * x + 2 * f * y)


def fit_ground(points: Array, low: Array, high: Array, ring: float, tolerance: float, seed: int = 0) -> Ground | None:
    """Fit the ground on a ring around a box, never inside it, so that the object itself cannot pass for ground.

    The lowest points of cells of the ring are fitted by a plane (RANSAC over triples), then by a parabolic height
    field with Tukey weights.

    Args:
        points: (N, 3), z up.
        low: (3,) corner of the box.
        high: (3,) opposite corner.
        ring: width of the ring.
        tolerance: height within which points are ground.
        seed: of the triples.

    Returns:
        The ground, or None when the ring is empty, no plane below 45 degrees fits at least 30 % of it, or what it fits
        is a narrow strip.
    """
    near = inside_box(points[:, :2], low[:2], high[:2], ring)
    around = points[near & ~inside_box(points[:, :2], low[:2], high[:2])]
    if not len(around):
        return None
    lowest = _lowest(around, low[:2] - ring, float((high[:2] - low[:2] + 2 * ring).max()) / CELLS)
    if len(lowest) < CELLS // 2:
        return None
    centre = (low[:2] + high[:2]) / 2
    plane = _plane_by_triples(lowest[:, :2] - centre, lowest[:, 2], 2 * tolerance, seed)
    if plane is None or _breadth(lowest, centre, plane, 2 * tolerance) < MIN_BREADTH:
        return None
    coefficients = _height_field(lowest[:, :2] - centre, lowest[:, 2], plane, tolerance)
    # A noisy cloud's ground is thick: its own spread about the surface widens the tolerance.
    off = around[:, 2] - quadratic_terms(around[:, :2] - centre) @ coefficients
    off = off[np.abs(off) < 4 * tolerance]
    if len(off):
        coefficients[0] += float(np.median(off))
        spread = SD_OVER_MEDIAN * np.median(np.abs(off - np.median(off)))
        tolerance = float(np.clip(2.5 * spread, tolerance, 3 * tolerance))
    return Ground(coefficients, centre, tolerance)


def _breadth(cells: Array, centre: Array, plane: Array, tolerance: float) -> float:
    """Breadth over length, as standard deviations seen from above, of the cells (M, 3) on a plane (3,)."""
    xy = cells[:, :2] - centre
    xy = xy[np.abs(quadratic_terms(xy)[:, :3] @ plane - cells[:, 2]) <= tolerance]
    narrow, long = np.linalg.svd(xy - xy.mean(0), compute_uv=False)[[1, 0]]
    return float(narrow / long)


def _lowest(points: Array, corner: Array, edge: float) -> Array:
    """(M, 3) one low point of each cell of `edge` from a corner (2,).

    The tenth percentile of a cell, not its lowest point: dense clouds have strays below the ground.
    """
    cell = np.floor((points[:, :2] - corner) / edge).astype(np.int64)
    key = cell[:, 0] * (2 * CELLS) + cell[:, 1]
    order = np.lexsort((points[:, 2], key))
    _, starts, counts = np.unique(key[order], return_index=True, return_counts=True)
    return points[order[starts + (0.1 * counts).astype(int)]]


def _height_field(xy: Array, z: Array, plane: Array, tolerance: float) -> Array:
    """The (6,) coefficients fitted to heights from a first plane (3,): a plane, then a parabola, by Tukey weights.

    The parabola is kept only where it stays near the plane in the middle, of which a ring says little.
    """
    terms, coefficients = quadratic_terms(xy), np.concatenate([plane, np.zeros(3)])
    flat = coefficients
    for columns in (3, 6, 6):
        for _ in range(10):
            residual = z - terms @ coefficients
            weight = (1 - np.minimum(np.abs(residual) / (3 * tolerance), 1) ** 2) ** 2
            root = np.sqrt(weight)[:, None]
            if (weight > 0).sum() < CELLS // 2:
                break
            solved = np.linalg.lstsq(root * terms[:, :columns], root[:, 0] * z, rcond=None)[0]
            coefficients = np.concatenate([solved, np.zeros(6 - columns)])
        if columns == 3:
            flat = coefficients
    return flat if abs(float(coefficients[0] - flat[0])) > 3 * tolerance else coefficients


def _plane_by_triples(xy: Array, z: Array, tolerance: float, seed: int) -> Array | None:
    """The (3,) plane a + b x + c y with most points within `tolerance`, or None."""
    rng = np.random.default_rng(seed)
    triples = rng.integers(0, len(xy), (MAX_TRIPLES, 3))
    terms = quadratic_terms(xy)[:, :3]
    matrices = terms[triples]
    good = np.abs(np.linalg.det(matrices)) > 1e-6 * np.ptp(xy, axis=0).max() ** 2
    if not good.any():
        return None
    planes = np.linalg.solve(matrices[good], z[triples[good]][..., None])[..., 0]
    planes = planes[np.hypot(planes[:, 1], planes[:, 2]) < 1]
    if len(planes) == 0:
        return None
    counts = (np.abs(planes @ terms.T - z) <= tolerance).sum(1)
    best = int(counts.argmax())
    return planes[best] if counts[best] >= MIN_SHARE * len(z) else None


def quadratic_terms(xy: Array) -> Array:
    """(N, 6) terms 1, x, y, x^2, x y, y^2 of (N, 2) coordinates."""
    x, y = xy[:, 0], xy[:, 1]
    return np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=1)

"""Which way is up in a reconstruction that no GPS has turned upright."""

import numpy as np

from scenefuse.core.transforms import SD_OVER_MEDIAN, Array

# RMS sine (about 8 degrees) by which the cameras' x axes have to leave one line to fix the vertical on their own.
MIN_AXIS_SPREAD = 0.15
# Headings fix the vertical to the scatter of the x axes about it, over their spread and the root of the number of
# independent ones. With a larger standard deviation it is no measurement.
MAX_VERTICAL_SD_DEG = 2.5
# A hand rolls a camera by so many degrees at least, as far as a few photos show.
MIN_ROLL_DEG = 1.0
# Up by these is off by as much as the photos are not level, or not straight down: good enough for pictures.
UNSURE_CUES = ("image up", "viewing direction", "few headings")


def estimate_up(world_from_cam: Array, centres: Array, there: Array | None = None) -> tuple[Array, str]:
    """The direction opposite to gravity, and the cue it comes from.

    Photos are mostly held level: a camera's x axis is horizontal whatever its heading and pitch. Where headings
    differ, up is the direction most nearly orthogonal to all x axes (robustly: a few rolled photos do no harm).
    Where all x axes lie on one line (a nadir flight in strips, or a walk along a wall), up may be any direction
    around that line; it is then the mean image-up side, or opposite to the mean viewing direction, whichever of the two

    - keeps more cameras from standing on their head (a flight back along the next strip turns photos by 180 degrees),
    - else lets the camera centres move less along it (flights and walks keep their height), or, where GPS gives
      heights, leaves less of these: photos of a facade, row above row, look like those of a flight in strips.

    One nadir strip and a walk along a wall, both straight, look the same; the walk is assumed.

    Args:
        world_from_cam: (N, 3, 3) camera rotations, OpenCV axes, in the order of the photos.
        centres: (N, 3) camera centres, in any unit.
        there: (N, 3) positions by GPS in metres, the last column upwards; NaN where unknown.

    Returns:
        (3,) unit vector in the world frame, and "headings", "few headings", "image up" or "viewing direction".
    """
    x, y, z = (world_from_cam[:, :, k] for k in range(3))
    up, spread = _orthogonal_to_all(x)
    if spread >= MIN_AXIS_SPREAD:
        # Image-up sides and looking down both give the sign; for nadir photos only the latter does.
        roll_deg = max(SD_OVER_MEDIAN * roll_spread_deg(world_from_cam, up), MIN_ROLL_DEG)
        sure = roll_deg / (spread * np.sqrt(_independent(x @ up))) <= MAX_VERTICAL_SD_DEG
        return (up if -(y @ up + z @ up).sum() >= 0 else -up), "headings" if sure else "few headings"
    line = np.linalg.eigh(x.T @ x)[1][:, 2]
    candidates = {"image up": -y.mean(0), "viewing direction": -z.mean(0)}
    levelled = {cue: _unit(d - (d @ line) * line) for cue, d in candidates.items() if np.linalg.norm(d) > 0.1}
    if not levelled:
        return up, "headings"
    upright = {cue: float(np.mean(-(y @ d) > -0.2)) for cue, d in levelled.items()}
    best = max(upright.values())
    fair = [cue for cue in levelled if upright[cue] > best - 0.2]
    heights = _heights(centres, there)
    left = {cue: centres @ levelled[cue] - heights for cue in fair}
    travel = {cue: float(np.nanmedian(np.abs(off - np.nanmedian(off)))) for cue, off in left.items()}
    # Image up comes first in the dictionary, so it wins unless the other is clearly better.
    chosen = min(fair, key=lambda cue: travel[cue] * (1.0 if cue == "image up" else 2.0))
    return levelled[chosen], chosen


def _heights(centres: Array, there: Array | None) -> Array:
    """(N,) heights by GPS in the unit of the centres, NaN where unknown; zeros where half of the photos have none."""
    if there is not None and (known := np.isfinite(there).all(1)).mean() > 0.5:
        away = (part[known] - np.median(part[known], axis=0) for part in (centres, there))
        size, size_m = (float(np.median(np.linalg.norm(part, axis=1))) for part in away)
        if size_m > 0:
            return there[:, 2] * size / size_m
    return np.zeros(len(centres))


def roll_spread_deg(world_from_cam: Array, up: Array) -> float:
    """Median angle in degrees between the cameras' x axes and the horizontal plane: small when `up` explains them."""
    return float(np.degrees(np.median(np.arcsin(np.clip(np.abs(world_from_cam[:, :, 0] @ up), 0.0, 1.0)))))


def _independent(rolls: Array) -> float:
    """How many independent values (N,) are worth, by the correlation of each with the next: a hand that leans to one
    side for some photos is one error, not many."""
    away = rolls - rolls.mean()
    alike = float(away[:-1] @ away[1:] / max(away @ away, 1e-12))
    return max(len(rolls) * (1 - alike) / (1 + alike), 1.0) if alike > 0 else float(len(rolls))


def _orthogonal_to_all(x: Array) -> tuple[Array, float]:
    """The direction most nearly orthogonal to (N, 3) axes by robust least squares, and their RMS spread across it."""
    weights = np.ones(len(x))
    for _ in range(20):
        moment = (weights[:, None] * x).T @ x / weights.sum()
        values, vectors = np.linalg.eigh(moment)
        sine = x @ vectors[:, 0]
        weights = 1.0 / (1.0 + (sine / 0.1) ** 2)
    return vectors[:, 0], float(np.sqrt(max(values[1], 0.0)))


def _unit(direction: Array) -> Array:
    return direction / np.linalg.norm(direction)

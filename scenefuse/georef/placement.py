"""Where a model lies: the similarity that brings it into metres by control points or GPS, or turns it upright."""

import contextlib
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from scenefuse.core.stage import StageError, setting
from scenefuse.core.transforms import (
    FIXING_POINTS,
    MAX_DEVIATIONS,
    SD_OVER_MEDIAN,
    UP,
    Sim3,
    fit_sim3,
    fit_sim3_robust,
    rotation_between,
)
from scenefuse.georef.control import LocatedPoint, check_spread, describe_misses
from scenefuse.photos.geodesy import MAX_GPS_OFF_M, MAX_MEDIAN_DISTANCES, local_frame
from scenefuse.sfm.gravity import MAX_VERTICAL_SD_DEG

Array = NDArray[np.float64]

# Heights of GPS have twice the error of the plane. Errors drift slowly: so many photos beside each other have one, and
# no fewer place a model.
HEIGHT_ERROR, PHOTOS_OF_ONE_ERROR = 2.0, 5
# How far a model may be bent, as a share of its extent: away from exact positions before it is adjusted to them, and
# an object's before its pose is of no use.
MAX_BENT = 0.1
# In standard deviations: error of a control point or a position at which it loses half its weight (Cauchy).
ROBUST_SD = 3.0


@dataclass(frozen=True)
class GeoreferenceSettings:
    """When GPS is used, and how strictly."""

    use_gps: bool = setting(True)
    """Whether GPS positions bring the model into metres."""
    gps_accuracy_m: float = setting(3, unit="m", above=0)
    """Standard error of a GPS position; positions farther than four times this from their cameras are outliers."""


@dataclass(frozen=True)
class Placement:
    """How a model was placed.

    Attributes:
        status: "georeferenced" (metres, in a CRS), "scaled" (metres by known lengths), "upright" (scene units).
        reason: why, in words.
        local_from_model: similarity into the new frame.
        inliers: (N,) bool over the GPS positions used, or empty.
        heights: "measured" by GPS or control points, "relative" to the middle camera, or "" where there is no metric
            frame.
        levelled: whether the cameras say which way is up, not GPS.
        used: (P,) bool over the surveyed points: control points that agree.
        gps_shift: (3,) metres that GPS positions are off control points, given cameras or a cloud; zero without these.
    """

    status: str
    reason: str
    local_from_model: Sim3
    inliers: NDArray[np.bool_]
    heights: str = ""
    levelled: bool = True
    used: NDArray[np.bool_] = field(default_factory=lambda: np.zeros(0, dtype=bool))
    gps_shift: Array = field(default_factory=lambda: np.zeros(3))


@dataclass(frozen=True)
class GpsCameras:
    """The registered photos that have a GPS position.

    Attributes:
        names: N of them.
        centres: (N, 3) camera centres in the model's frame.
        positions: (N, 3) latitude (deg), longitude (deg), altitude (m; NaN where unknown).
        sd_m: (N, 2) standard deviations of the positions, horizontal (of each axis) and vertical.
    """

    names: list[str]
    centres: Array
    positions: Array
    sd_m: Array


def of_one_zero(gps: GpsCameras, accuracy_m: float) -> tuple[GpsCameras, str]:
    """GPS heights of flights that count from different zeros, as ellipsoid and sea, brought to that of most photos; and
    what was done, "" for nothing. Such steps turn the model, and residuals hardly show it.

    Steps are tried one after the other, each where it explains most beside those before. They are removed where a third
    of the positions that contradict the cameras then agree with them: a bent model's heights in steps do less.

    Args:
        gps: photos in the order of their names: one flight after the other.
        accuracy_m: standard error of a position, which a step has to exceed, and the noise from one photo to the next,
            of which a barometer's heights have little, as far as four of these errors.
    """
    known, few = np.flatnonzero(np.isfinite(gps.positions[:, 2])), PHOTOS_OF_ONE_ERROR
    if len(known) < 4 * few:
        return gps, ""
    heights, order, starts = gps.positions[known, 2], np.arange(len(known)), np.arange(few, len(known) - few + 1)
    linear, steps = np.c_[gps.centres[known], np.ones(len(known))], np.zeros(0, dtype=np.int64)
    apart_m = np.abs(np.diff(heights - linear @ np.linalg.lstsq(linear, heights)[0]))
    noise_m = MAX_DEVIATIONS * SD_OVER_MEDIAN * np.median(apart_m) / np.sqrt(2)
    least_m = float(np.clip(noise_m, accuracy_m, MAX_DEVIATIONS * accuracy_m))
    best, note, least = gps, "", _disagreeing(gps, least_m)
    # A day has no more flights.
    while least > few and len(starts) and len(steps) < 10:
        explained = np.linalg.qr(np.c_[linear, order[:, None] >= steps])[0]
        off = heights - explained @ (explained.T @ heights)
        # A step, 1 from a start on, times a column is the sum of that column's end.
        along, in_explained = (np.cumsum(part[::-1], axis=0)[::-1][starts] for part in (off, explained))
        gains = along**2 / np.maximum(len(known) - starts - (in_explained**2).sum(1), 1e-9)
        steps = np.append(steps, starts[gains.argmax()])
        starts = starts[np.abs(starts - steps[-1]) >= 2 * few]
        level = _levels(heights, linear, steps, least_m)
        if level.any():
            positions = gps.positions.copy()
            positions[known, 2] -= level
            moved = replace(gps, positions=positions)
            if (now := _disagreeing(moved, least_m)) < least * 2 / 3:
                shifts = ", ".join(f"{-shift:+.1f}" for shift in np.unique(level[level != 0]))
                best, least, photos = moved, now, np.count_nonzero(level)
                note = f"; GPS heights of {photos} photos are moved by {shifts} m, to the zero of the others"
    return best, note


def _levels(heights: Array, linear: Array, steps: NDArray[np.int64], least_m: float) -> Array:
    """(N,) how much higher heights (N,) count than most, by those of some steps, rows at which they begin, that are
    larger than `least_m` and rise at once, as no bent model does; `linear` (N, 4) explains the others."""
    order, few = np.arange(len(heights)), PHOTOS_OF_ONE_ERROR
    while len(steps):
        fitted = np.linalg.lstsq(np.c_[linear, order[:, None] >= steps], heights)[0]
        sizes, stepped = fitted[4:], heights - linear @ fitted[:4]
        at_once = np.array([stepped[k : k + few].mean() - stepped[k - few : k].mean() for k in steps])
        worth = np.minimum(np.abs(sizes) / least_m, 2 * at_once * sizes / np.maximum(sizes**2, 1e-12))
        if worth.min() > 1:
            levels, of_photo, counts = np.unique(
                (order[:, None] >= steps) @ sizes, return_inverse=True, return_counts=True
            )
            return np.asarray((levels - levels[counts.argmax()])[of_photo])
        steps = np.delete(steps, worth.argmin())
    return np.zeros(len(heights))


def _disagreeing(gps: GpsCameras, limit_m: float) -> float:
    """How many of the positions with heights are far from their cameras; those within the limit count by its square."""
    there = local_frame(gps.positions).apply(gps.positions)
    known = np.isfinite(there[:, 2])
    try:
        fitted, _ = fit_sim3_robust(gps.centres[known], there[known], limit_m)
    except ValueError:  # no three positions agree
        return float(known.sum())
    off = np.linalg.norm(fitted.apply(gps.centres[known]) - there[known], axis=1) / limit_m
    return float(np.minimum(off**2, 1.0).sum())


def place_by_control(
    located: list[LocatedPoint], target: Array, up: Array, where: str, seed: int
) -> tuple[Placement, list[str]]:
    """Fit local_from_model to surveyed points in the model and their coordinates (P, 3) in metres.

    Unknown heights are NaN and take no part; check points neither. Control points that do not agree with the others are
    left out.

    Args:
        located: P surveyed points.
        target: their coordinates.
        up: (3,) the cameras' up direction in the model.
        where: the file, for messages.
        seed: of RANSAC.

    Returns:
        The placement, and a line for each control point left out.

    Raises:
        StageError: points along one line, too few that agree, or a model that they turn upside down.
    """
    rows = np.array([k for k, s in enumerate(located) if not (s.problem or s.point.check)])
    names = [located[k].point.name for k in rows]
    there, start = target[rows], np.array([located[k].x_in_model for k in rows])
    whole = np.isfinite(there).all(1)
    check_spread(there[whole], [n for n, w in zip(names, whole) if w], where)
    sd_m = max(max(located[k].point.sd_m) for k in rows)
    limit = max(MAX_DEVIATIONS * sd_m, MAX_BENT * float(np.linalg.norm(np.ptp(there[whole], axis=0))))
    try:
        fitted, inliers = fit_measured(start, there, limit, seed)
    except ValueError:
        inliers = np.zeros(len(rows), dtype=bool)
    if inliers.sum() < max(FIXING_POINTS, len(rows) // 2 + 1):
        raise StageError(
            f"{where}: only {inliers.sum()} of {len(rows)} control points agree with the model within {limit:.2g} m;"
            " check their coordinates, whether x is easting and y northing, and where each was clicked"
        )
    agree = whole & inliers
    check_spread(there[agree], [n for n, a in zip(names, agree) if a], where)
    _check_upright(fitted, up, f"{where}: the control points")
    used = np.zeros(len(located), dtype=bool)
    used[rows[inliers]] = True
    notes = [
        f"{names[k]} is left out: {describe_misses(located[rows[k]], fitted, target[rows[k]])}"
        for k in np.flatnonzero(~inliers)
    ]
    reason = f"{inliers.sum()} of {len(rows)} control points"
    none = np.zeros(0, dtype=bool)
    return Placement("georeferenced", reason, fitted, none, "measured", False, used), notes


def _check_upright(fitted: Sim3, up: Array, what: str) -> None:
    """StageError where a fit to what was surveyed turns the cameras' up direction (3,) down."""
    # Swapped axes turn it by half a turn; what photos say of up may be a quarter off.
    if fitted.rotate(up)[2] < -0.5:
        raise StageError(
            f"{what} turn the model upside down, as swapped axes do; x has to be easting or longitude, y northing or"
            " latitude"
        )


def beside_gps(
    placement: Placement,
    located: list[LocatedPoint],
    there: Array,
    gps: GpsCameras,
    target: Array,
    where: str,
    settings: GeoreferenceSettings,
) -> Placement:
    """A placement by control points, refined by GPS positions up to a shift that all of them share.

    Another datum, heights above a geoid or a base station of its own move all positions alike: the control points say
    where the model lies, the positions help to turn and scale it: a least-squares fit of both about their own means, in
    which points that the others contradict count for less and less (Cauchy): one wrong point among exact positions
    would else move all of these.

    Args:
        placement: by control points.
        located: P surveyed points.
        there: (P, 3) their coordinates in the local frame; NaN where a height is unknown.
        gps: N photos with positions.
        target: (N, 3) the positions in the local frame, likewise.
        where: the control points' file, for messages.
        settings: for the limit of outliers.

    Raises:
        StageError: GPS saw the cameras more than a kilometre away.
    """
    fitted, points = placement.local_from_model, placement.used
    difference = target - fitted.apply(gps.centres)
    shift = middle_of(difference)
    if np.linalg.norm(shift[:2]) > MAX_GPS_OFF_M:
        raise StageError(
            f"{where}: the control points lie {np.linalg.norm(shift[:2]) / 1000:.3g} km from where GPS saw the cameras;"
            " correct their CRS or swapped axes, or switch use_gps off if GPS is wrong"
        )
    accuracy_m, extent = float(np.median(gps.sd_m[:, 0])), _extent(target)[0]
    inliers = np.sqrt(np.nansum((difference - shift) ** 2, axis=1)) <= _limit(accuracy_m, extent, settings)
    inliers &= _first_at(target) & _tells_scale(extent, accuracy_m)
    if not inliers.any():
        return replace(placement, inliers=inliers, gps_shift=shift)
    start = [np.array([s.x_in_model for s, u in zip(located, points) if u]), gps.centres[inliers]]
    wanted = [there[points], target[inliers]]
    stated = np.array([s.point.sd_m[0] for s, u in zip(located, points) if u])
    for _ in range(30):  # each halves what filling in half of the heights leaves to be found
        here = [fitted.apply(part) for part in start]
        here[1] += shift
        off = np.abs(wanted[0] - here[0])
        # Clicks add to what was stated of the coordinates.
        each = np.maximum(stated, SD_OVER_MEDIAN * float(np.nanmedian(off)))
        sd_m = [each * np.hypot(1.0, np.sqrt(np.nansum(off**2, axis=1)) / (ROBUST_SD * each)), gps.sd_m[inliers, 0]]
        filled = [np.where(np.isfinite(b), b, a) for a, b in zip(here, wanted)]
        means = [
            [np.average(part, axis=0, weights=sd**-2.0) for part, sd in zip(side, sd_m)] for side in (start, filled)
        ]
        centred = [np.concatenate([p - m for p, m in zip(side, mean)]) for side, mean in zip((start, filled), means)]
        turn = fit_sim3(centred[0], centred[1], np.concatenate(sd_m) ** -2.0)
        fitted = replace(turn, translation=means[1][0] - turn.scale * turn.rotation @ means[0][0])
        shift = means[1][1] - fitted.apply(means[0][1])
    return replace(placement, local_from_model=fitted, inliers=inliers, gps_shift=shift)


def _limit(sd_m: float, extent: float, settings: GeoreferenceSettings) -> float:
    """How far a position may be from its camera after a similarity: its noise, or for exact ones the model's bend."""
    return max(MAX_DEVIATIONS * sd_m, min(MAX_DEVIATIONS * settings.gps_accuracy_m, MAX_BENT * extent))


def _tells_scale(extent: float, accuracy_m: float) -> bool:
    """Whether positions spread so far that they say more than where they are."""
    return bool(extent >= MAX_DEVIATIONS * accuracy_m)


def _first_at(target: Array) -> NDArray[np.bool_]:
    """(N,) the first photo at each position (N, 3): phones write their last fix into those that follow."""
    first = np.zeros(len(target), dtype=bool)
    first[np.unique(np.nan_to_num(target), axis=0, return_index=True)[1]] = True
    return first


def middle_of(difference: Array) -> Array:
    """(3,) medians of (N, 3) differences; 0 where none is known."""
    known = np.isfinite(difference)
    return np.array([np.median(column[k]) if k.any() else 0.0 for column, k in zip(difference.T, known.T)])


def place_by_gps(
    centres: Array,
    target: Array,
    up: Array,
    settings: GeoreferenceSettings,
    seed: int,
    sd_m: float | None = None,
    sure_up: bool = False,
) -> Placement:
    """Fit local_from_model to camera centres (N, 3) in model units and their GPS positions (N, 3) in metres.

    Unknown heights are NaN and take no part. Positions along one line leave the roll about it open, and horizontal ones
    the tilt: then the cameras' up direction (3,) closes it; also where it is sure, and heights that fix the tilt less
    well contradict it, as a phone's do on a walk around a house. Positions within four times the GPS accuracy of each
    other say nothing about scale: then the model is only turned upright. `sd_m` is the accuracy that the positions
    state.

    Raises:
        StageError: positions that turn the model upside down.
    """
    fresh = _first_at(target)
    accuracy_m, extent = sd_m or settings.gps_accuracy_m, _extent(target[fresh])
    limit = _limit(accuracy_m, extent[0], settings)
    if not _tells_scale(extent[0], accuracy_m):
        reason = f"GPS positions spread over {extent[0]:.1f} m only, with an accuracy of {accuracy_m:g} m"
        return upright(up, reason)
    inliers = fresh.copy()
    fitted, inliers[fresh], levelled = _fit(centres[fresh], target[fresh], up, accuracy_m, limit, seed, sure_up)
    if inliers.sum() < max(PHOTOS_OF_ONE_ERROR, 0.5 * fresh.sum()):
        reason = f"only {inliers.sum()} of {len(target)} GPS positions agree with the cameras within {limit:g} m"
        return upright(up, reason)
    _check_upright(fitted, up, "the photos' positions (EXIF, geo.txt; use_gps: false leaves them out)")
    reason = f"{inliers.sum()} of {len(target)} photos by GPS"
    if levelled:
        line = "along one line, " if not _tells_scale(_extent(target[inliers])[1], accuracy_m) else ""
        reason += f", {line}levelled by the cameras"
    unknown = np.isnan(target[:, 2])
    if unknown.all():
        reason += "; no photo has a GPS height, so heights are relative to the middle camera"
    elif unknown.any():
        reason += f"; {unknown.sum()} of them have no GPS height and do not constrain heights"
    return Placement("georeferenced", reason, fitted, inliers, "relative" if unknown.all() else "measured", levelled)


def _fit(
    centres: Array, target: Array, up: Array, accuracy_m: float, limit: float, seed: int, sure_up: bool
) -> tuple[Sim3, NDArray[np.bool_], bool]:
    """Similarity, inliers, and whether the cameras had to level it, because the positions that agree do not."""
    has_height = np.isfinite(target[:, 2])

    def fixes_tilt(rows: NDArray[np.bool_]) -> bool:
        return bool(rows.sum() >= PHOTOS_OF_ONE_ERROR and _tells_scale(_extent(target[rows])[1], accuracy_m))

    def leans(fitted: Sim3, rows: NDArray[np.bool_]) -> bool:
        lean = np.degrees(np.arccos(np.clip(fitted.rotate(up)[2] / np.linalg.norm(up), -1, 1)))
        sd = np.degrees(
            HEIGHT_ERROR * accuracy_m * np.sqrt(PHOTOS_OF_ONE_ERROR / rows.sum()) / _extent(target[rows])[1]
        )
        return bool(sure_up and min(lean, sd) > MAX_VERTICAL_SD_DEG)

    if fixes_tilt(has_height):
        with contextlib.suppress(ValueError):  # no three positions agree
            fitted, inliers = fit_measured(centres, target, limit, seed)
            used = inliers & has_height
            if inliers.sum() >= 0.5 * len(target) and fixes_tilt(used) and not leans(fitted, used):
                return fitted, inliers, False
    return *fit_level(centres, target, up, limit, seed), True


def upright(up: Array, reason: str) -> Placement:
    """Only turn the model so that `up` (3,) becomes z; scale and origin stay."""
    rotation = rotation_between(up, UP)
    return Placement("upright", reason, Sim3(1.0, rotation, np.zeros(3)), np.zeros(0, dtype=bool))


def scaled(placement: Placement, metres_per_unit: float, lengths: int) -> Placement:
    """An upright placement in metres, by known lengths."""
    one = replace(placement.local_from_model, scale=metres_per_unit)
    return replace(
        placement, status="scaled", reason=f"{placement.reason}; {lengths} known lengths", local_from_model=one
    )


def fit_measured(centres: Array, target: Array, limit: float, seed: int) -> tuple[Sim3, NDArray[np.bool_]]:
    """Similarity by RANSAC over positions whose height is known, then least squares over all measured coordinates.

    Unknown heights (NaN in `target`) are set to those of the fit, again and again, which is least squares without them
    (expectation maximisation).

    Returns:
        local_from_model and the (N,) inliers within `limit` metres.
    """
    known = np.isfinite(target)
    whole = known.all(1)
    fitted, inliers = fit_sim3_robust(centres[whole], target[whole], limit, seed=seed)
    if whole.all():
        return fitted, inliers
    for _ in range(30):  # as in `beside_gps`
        here = fitted.apply(centres)
        filled = np.where(known, target, here)
        inliers = np.linalg.norm(filled - here, axis=1) <= limit
        fitted = fit_sim3(centres[inliers], filled[inliers])
    return fitted, inliers


def fit_level(centres: Array, target: Array, up: Array, limit: float, seed: int = 0) -> tuple[Sim3, NDArray[np.bool_]]:
    """Similarity with its vertical given: heading, scale and shift from horizontal positions, height from the mean.

    RANSAC over pairs, then least squares, reweighted with Cauchy weights of width `limit` / 2 (metres). Unknown heights
    (NaN) take no part; where none is known, the median camera gets height 0.
    """
    levelling = rotation_between(up, UP)
    levelled = centres @ levelling.T
    # A heading alone is a rotation in the plane: one complex factor, scale and angle together.
    a, b = levelled[:, 0] + 1j * levelled[:, 1], target[:, 0] + 1j * target[:, 1]
    known = np.isfinite(target[:, 2])
    weights = _agreeing_pair(a, b, limit, seed).astype(np.float64)
    for _ in range(30):
        w = weights / weights.sum()
        centred = a - w @ a
        factor = (w @ (centred.conj() * (b - w @ b))) / (w @ np.abs(centred) ** 2)
        scale, angle = abs(factor), np.angle(factor)
        turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1.0]])
        rotation = turn @ levelling
        offset = target - scale * centres @ rotation.T
        height = w[known] @ offset[known, 2] / w[known].sum() if known.any() else -np.median(scale * levelled[:, 2])
        fitted = Sim3(scale, rotation, np.array([*(w @ offset[:, :2]), height]))
        distance = np.sqrt(np.nansum((fitted.apply(centres) - target) ** 2, axis=1))
        weights = 1.0 / (1.0 + (2.0 * distance / limit) ** 2)
    return fitted, distance <= limit


def _agreeing_pair(a: NDArray[np.complex128], b: NDArray[np.complex128], limit: float, seed: int) -> NDArray[np.bool_]:
    """Which of N positions in the plane the similarity b ~ factor a + shift through some two of them explains: most."""
    rng, best = np.random.default_rng(seed), np.zeros(len(a), dtype=bool)
    for _ in range(300):
        i, j = rng.choice(len(a), 2, replace=False)
        if a[i] != a[j]:
            inliers = np.abs((b[j] - b[i]) / (a[j] - a[i]) * (a - a[i]) + b[i] - b) <= limit
            best = inliers if inliers.sum() > best.sum() else best
    return best if best.any() else ~best


def _extent(target: Array) -> Array:
    """RMS extent in metres of positions (N, 3) along the two axes of their horizontal spread, far ones left out."""
    centred = target[:, :2] - np.median(target[:, :2], axis=0)
    distance = np.linalg.norm(centred, axis=1)
    centred = centred[distance <= MAX_MEDIAN_DISTANCES * np.median(distance)]
    return np.linalg.svd(centred, compute_uv=False) / np.sqrt(len(centred))

"""Which pairs of photos are compared: all of them, neighbours by GPS, or neighbours in time with loops."""

import re
from dataclasses import dataclass
from itertools import combinations
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.sparse.csgraph import minimum_spanning_tree
from scipy.spatial.distance import cdist

from scenefuse.core.stage import setting
from scenefuse.photos.geodesy import local_frame
from scenefuse.photos.photos import Photo, gps_positions

Pair = tuple[str, str]


# GPS positions that spread less (RMS, metres) than this do not tell neighbours from others: five times the standard
# error of a plain receiver.
MIN_GPS_SPREAD_M = 15.0
# Positions so near each other are one: a phone writes its last fix into dozens of photos.
SAME_POSITION_M = 0.1
# Share of the photos that may stand at one position with more photos than each is compared with.
MOST_REPEATED = 0.1


@dataclass(frozen=True)
class MatchSettings:
    """Which pairs of photos are compared, and how."""

    pairs: Literal["auto", "exhaustive", "spatial", "sequential"] = setting("auto")
    """Pairs of photos that are compared; auto: by GPS where most photos have it, in sequence for a video, all pairs of
    a small set, else in sequence."""
    exhaustive_up_to: int = setting(200, least=0)
    """Auto compares all pairs up to this many photos."""
    max_ratio: float = setting(0.7, above=0)
    """Lowe's ratio test: best over second-best descriptor distance."""
    guided_matching: bool = setting(True)
    """Match again along the epipolar lines once a pair is verified."""
    spatial_from: int = 40
    """Auto compares GPS neighbours only from this many photos on: all pairs of fewer cost little."""
    neighbours: int = 20
    """Spatial: nearest photos that each photo is compared with: half of them by horizontal distance, for flights at two
    heights, half in space, for flights up and down a facade."""
    overlap: int = 10
    """Sequential: following photos that each photo is compared with."""
    loop_every: int = 5
    """Sequential: every n-th photo is compared with every other n-th photo, which closes loops."""


def choose_pairs(photos: list[Photo], is_video: bool, settings: MatchSettings) -> tuple[str, str, list[Pair]]:
    """The kind of pairs, why, and the pairs themselves, sorted by the photos' order (method M5).

    Args:
        photos: in name order.
        is_video: whether they are frames of a video, in order of time.
        settings: see there.
    """
    names = [p.name for p in photos]
    kind, reason = settings.pairs, "as configured"
    if kind == "auto":
        kind, reason = _automatic(photos, is_video, settings)
    if kind == "spatial" and not _gps_usable(photos, settings.neighbours):
        kind, reason = "exhaustive", "pairs are set to spatial, but too few photos have a useful GPS position"
    if kind == "exhaustive":
        return kind, reason, list(combinations(names, 2))
    if kind == "spatial":
        return kind, reason, spatial_pairs(photos, settings.neighbours)
    in_time, order = sorted(names, key=_counted), {name: index for index, name in enumerate(names)}
    pairs = sequential_pairs(in_time, settings.overlap, settings.loop_every)
    return kind, reason, sorted((_ordered(a, b, order) for a, b in pairs), key=lambda p: (order[p[0]], order[p[1]]))


def spatial_pairs(photos: list[Photo], neighbours: int) -> list[Pair]:
    """Each photo with its nearest ones by GPS, with all photos where its own position is unknown.

    A minimum spanning tree over the positions is added, so that no group of photos stays apart.
    """
    names = [p.name for p in photos]
    known, positions = gps_positions(photos)
    at = {name: row for row, name in enumerate(known)}
    order = {name: index for index, name in enumerate(names)}
    metric = _metric(positions)
    chosen = {_ordered(a, b, order) for a in names if a not in at for b in names if a != b}
    distance = cdist(metric[:, :2], metric[:, :2])
    # Of photos at one position those next to each other in the order of their names.
    rows = np.arange(len(known))
    apart = np.abs(rows[:, None] - rows)
    by_ground, by_space = (np.lexsort((apart, d)) for d in (distance, cdist(metric, metric)))
    for row, name in enumerate(known):
        others = [c for c in by_ground[row] if c != row][: neighbours // 2]
        others += [c for c in by_space[row] if c != row and c not in others][: neighbours - len(others)]
        chosen |= {_ordered(name, known[c], order) for c in others}
    # Coincident positions would be no edge at all in a sparse graph, hence the small constant.
    tree = minimum_spanning_tree(distance + 1e-6).tocoo()
    chosen |= {_ordered(known[a], known[b], order) for a, b in zip(tree.row, tree.col)}
    return sorted(chosen, key=lambda pair: (order[pair[0]], order[pair[1]]))


def sequential_pairs(names: list[str], overlap: int, loop_every: int) -> list[Pair]:
    """Each frame with the next `overlap` ones, and every `loop_every`-th frame with all others of these."""
    count = len(names)
    chosen = {(i, j) for i in range(count) for j in range(i + 1, min(i + overlap, count - 1) + 1)}
    chosen |= set(combinations(range(0, count, max(loop_every, 1)), 2))
    return [(names[i], names[j]) for i, j in sorted(chosen)]


def gps_spread_m(positions: NDArray[np.float64]) -> float:
    """RMS horizontal distance of WGS84 positions (N, 3) from their mean, in metres."""
    horizontal = local_frame(positions).apply(positions)[:, :2]
    return float(np.sqrt(((horizontal - horizontal.mean(0)) ** 2).sum(1).mean()))


def _automatic(
    photos: list[Photo], is_video: bool, settings: MatchSettings
) -> tuple[Literal["exhaustive", "spatial", "sequential"], str]:
    count = len(photos)
    if count >= settings.spatial_from and _gps_usable(photos, settings.neighbours):
        return "spatial", f"{count} photos with GPS, {settings.neighbours} neighbours each"
    if is_video and count > settings.overlap * 2:
        return "sequential", "frames of a video"
    if count <= settings.exhaustive_up_to:
        return "exhaustive", f"{count} photos, no more than {settings.exhaustive_up_to}"
    return "sequential", f"{count} photos without GPS, more than {settings.exhaustive_up_to}"


def _gps_usable(photos: list[Photo], neighbours: int) -> bool:
    """Whether most photos have a position, and these tell which photos are neighbours."""
    known, positions = gps_positions(photos)
    if len(known) < max(3, 0.8 * len(photos)) or gps_spread_m(positions) <= MIN_GPS_SPREAD_M:
        return False
    cells = np.rint(_metric(positions) / SAME_POSITION_M)
    _, at, counts = np.unique(cells, axis=0, return_inverse=True, return_counts=True)
    return float((counts[at.ravel()] > neighbours).mean()) <= MOST_REPEATED


def _metric(positions: NDArray[np.float64]) -> NDArray[np.float64]:
    """WGS84 positions (N, 3) in metres, unknown heights in the middle of the others."""
    metric = local_frame(positions).apply(positions)
    heights = metric[:, 2][np.isfinite(metric[:, 2])]
    metric[:, 2] = np.nan_to_num(metric[:, 2], nan=np.median(heights) if len(heights) else 0.0)
    return metric


def _counted(name: str) -> list[str | int]:
    """A photo's name with its numbers as such: img2 was taken before img10."""
    parts = re.split(r"(\d+)", name)
    return [int(part) if index % 2 else part for index, part in enumerate(parts)]


def _ordered(a: str, b: str, order: dict[str, int]) -> Pair:
    return (a, b) if order[a] < order[b] else (b, a)

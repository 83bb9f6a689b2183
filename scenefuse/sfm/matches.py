"""Which pairs of photos are compared (all of them, neighbours by GPS, or neighbours in time with loops), and their
matching and geometric verification with COLMAP.

He et al. 2026, section on the scene: largest descriptor distance 0.7, mutual best match, guided re-matching. The ratio
test is Lowe's (2004), 0.8, not the paper's 0.7, at which wide turns lose their links (docs/experiments.md).
"""

import contextlib
import re
import shutil
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from itertools import combinations
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pycolmap
from numpy.typing import NDArray
from scipy.cluster.vq import kmeans2, vq
from scipy.sparse.csgraph import minimum_spanning_tree
from scipy.spatial import Delaunay, QhullError
from scipy.spatial.distance import cdist

from scenefuse.core.stage import (
    StageError,
    atomic_file,
    quantity,
    read_json,
    resumed_file,
    setting,
    threads,
    value,
    write_json,
)
from scenefuse.photos.geodesy import MAX_MEDIAN_DISTANCES, local_frame
from scenefuse.photos.photos import Photo, gps_positions, read_photos
from scenefuse.sfm.colmap import cancellable, require_database
from scenefuse.sfm.features import FEW_FEATURES, match_guided

Pair = tuple[str, str]


# GPS positions that spread less (RMS, metres) than this do not separate neighbours from others: five times the standard
# error of a plain receiver.
MIN_GPS_SPREAD_M = 15.0
# Share of the photos that may stand at one position with more photos than each is compared with: a phone writes its
# last fix into dozens.
MAX_REPEATED_SHARE = 0.1
# Why photos have next to no features: those that are dark as a whole are brightened before (photos.photos).
DULL = "blur, fog, darkness with a few lamps, or surfaces without texture; look at them"
# Largest descriptor distance of a match (the paper's).
MAX_DISTANCE = 0.7


@dataclass(frozen=True)
class MatchSettings:
    """Which pairs of photos are compared, and how."""

    pairs: Literal["auto", "exhaustive", "spatial", "sequential"] = setting("auto")
    """Pairs of photos that are compared; auto: by GPS where most photos have it, in sequence for a video, all pairs of
    a small set, else in sequence and by likeness."""
    exhaustive_up_to: int = 200
    """Auto compares all pairs up to this many photos."""
    max_ratio: float = setting(0.8, above=0)
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
    """Sequential: every n-th photo is compared with every other n-th photo, which closes loops; of more than
    `exhaustive_up_to` photos each one with `neighbours` that look alike."""


def match_features(
    *, photos: Path, features: Path, database: Path, matches: Path, settings: MatchSettings, seed: int
) -> None:
    """Match the features of chosen pairs of photos and verify each pair's geometry.

    Args:
        photos: JSON list of the photos.
        features: COLMAP database with features.
        database: output, COLMAP database with matches as well.
        matches: output, JSON: the choice of pairs and what came of it.
        settings: which photos are compared, and how.
        seed: of RANSAC.

    Raises:
        StageError: no pair of photos could be verified.
    """
    require_database(features)
    is_video = value(read_json(photos), "kind") == "video"
    choice, reason, pairs = choose_pairs(read_photos(photos), is_video, settings, partial(alike_pairs, features))
    print(f"{choice} pairs ({reason}): {len(pairs)}", flush=True)
    pycolmap.set_random_seed(seed)
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = seed
    # What is burned into photos, a date or a drone's display, stays where it is and holds cameras together.
    verification.filter_stationary_matches = True
    sift = pycolmap.SiftMatchingOptions(max_ratio=settings.max_ratio, max_distance=MAX_DISTANCE, cross_check=True)
    with pycolmap.Database.open(features) as opened:
        names = {image.image_id: image.name for image in opened.read_all_images()}
        counts = [opened.num_keypoints_for_image(number) for number in names]
        marks = [zlib.crc32(opened.read_keypoints(number).tobytes()) for number in names]
        lenses = [image.camera_id for image in opened.read_all_images()], opened.read_all_cameras()
    with resumed_file(database, settings, seed, pairs, names, marks, lenses) as temporary:
        if temporary.is_file():
            print("going on with the pairs that a killed run left", flush=True)
        else:
            with atomic_file(temporary) as copy:
                shutil.copyfile(features, copy)
        with _pair_list(temporary, names, pairs) as listed:
            cancellable(
                pycolmap.match_image_pairs,
                temporary,
                matching_options=pycolmap.FeatureMatchingOptions(num_threads=threads(), use_gpu=False, sift=sift),
                # COLMAP looks at a cancellation only between two blocks of pairs.
                pairing_options=pycolmap.ImportedPairingOptions(match_list_path=listed, block_size=100),
                verification_options=verification,
                device=pycolmap.Device.cpu,
            )
        with pycolmap.Database.open(temporary) as opened:
            if settings.guided_matching:
                error_px = verification.ransac.max_error
                match_guided(opened, error_px, settings.max_ratio, MAX_DISTANCE)
            _, per_pair = opened.read_two_view_geometry_num_inliers()
        verified, inliers = int(np.count_nonzero(per_pair)), int(np.sum(per_pair))
        if verified == 0:
            advice = "check that they overlap, are sharp and textured"
            if np.median(counts) < FEW_FEATURES:
                advice = f"they have {np.median(counts):.0f} features in the median, too few to match: {DULL}"
            raise StageError(f"none of the {len(pairs)} pairs of photos of {photos} show the same thing; {advice}")
    print(f"{verified} of {len(pairs)} pairs verified, {inliers} matches", flush=True)
    content: dict[str, Any] = {
        "pairs_choice": quantity(choice, ""),
        "pairs_reason": quantity(reason, ""),
        "pairs": quantity(len(pairs), "1"),
        "inlier_matches": quantity(inliers, "1"),
    }
    write_json(matches, content)


@contextlib.contextmanager
def _pair_list(database: Path, names: dict[int, str], pairs: list[Pair]) -> Iterator[Path]:
    """A list of pairs as COLMAP reads it. Meanwhile the photos of the database are called by their numbers, since names
    with blanks, or with # in front, are misread."""
    with pycolmap.Database.open(database) as opened:
        images = opened.read_all_images()
        _rename(opened, images, {number: str(number) for number in names})
    number_of = {name: number for number, name in names.items()}
    listed = database.with_name(f"{database.name}.pairs.txt")
    listed.write_text("".join(f"{number_of[a]} {number_of[b]}\n" for a, b in pairs))
    yield listed
    with pycolmap.Database.open(database) as opened:
        _rename(opened, images, names)


def _rename(database: pycolmap.Database, images: list[pycolmap.Image], names: dict[int, str]) -> None:
    for image in images:
        image.name = names[image.image_id]
        database.update_image(image)


def choose_pairs(
    photos: list[Photo], is_video: bool, settings: MatchSettings, alike: Callable[[int], list[Pair]]
) -> tuple[str, str, list[Pair]]:
    """The kind of pairs, why, and the pairs themselves, sorted by the photos' order (method M5).

    Args:
        photos: in name order.
        is_video: whether they are frames of a video, in order of time.
        settings: see there.
        alike: pairs of each photo with so many that look alike; called for many photos only.
    """
    names = [p.name for p in photos]
    kind, reason = settings.pairs, "as configured"
    if kind == "auto":
        kind, reason = _automatic(photos, is_video, settings)
    few, order = len(names) <= settings.exhaustive_up_to, {name: index for index, name in enumerate(names)}
    if kind == "spatial" and not _gps_usable(photos, settings.neighbours):
        kind = "exhaustive" if few else "sequential"
        reason = "pairs are set to spatial, but too few photos have a useful GPS position"
    if kind == "exhaustive":
        pairs = list(combinations(names, 2))
    elif kind == "spatial":
        pairs = spatial_pairs(photos, settings.neighbours)
        if unknown := {p.name for p in photos if not p.has_gps}:
            others = combinations(names, 2) if few else alike(settings.neighbours)
            pairs += [pair for pair in others if not unknown.isdisjoint(pair)]
    else:
        loop_every = settings.loop_every if few else len(names)
        pairs = sequential_pairs(sorted(names, key=_counted), settings.overlap, loop_every)
        if not few:
            pairs += alike(settings.neighbours)
            reason += f", each also with {settings.neighbours} that look alike"
    unique = {_ordered(a, b, order) for a, b in pairs}
    return kind, reason, sorted(unique, key=lambda pair: (order[pair[0]], order[pair[1]]))


def spatial_pairs(photos: list[Photo], neighbours: int) -> list[Pair]:
    """Each photo whose position is known with its nearest ones by GPS.

    A minimum spanning tree over the positions is added, so that no group of photos stays apart, and their Delaunay
    triangulation: where a strip's photos are close, or look in five directions each, all the nearest are in that strip.
    """
    names, positions = gps_positions(photos)
    metric = _metric(positions)
    distance = cdist(metric[:, :2], metric[:, :2])
    # Of photos at one position those next to each other in the order of their names.
    rows = np.arange(len(names))
    apart = np.abs(rows[:, None] - rows)
    by_ground, by_space = (np.lexsort((apart, d)) for d in (distance, cdist(metric, metric)))
    # Coincident positions would be no edge at all in a sparse graph, hence the small constant.
    tree = minimum_spanning_tree(distance + 1e-6).tocoo()
    chosen = set(zip(tree.row.tolist(), tree.col.tolist()))
    with contextlib.suppress(QhullError):  # positions on one line
        for triangle in Delaunay(metric[:, :2]).simplices.tolist():
            chosen |= set(combinations(triangle, 2))
    for row in rows.tolist():
        others = [c for c in by_ground[row] if c != row][: neighbours // 2]
        others += [c for c in by_space[row] if c != row and c not in others][: neighbours - len(others)]
        chosen |= {(row, int(other)) for other in others}
    return [(names[a], names[b]) for a, b in sorted({(min(pair), max(pair)) for pair in chosen})]


def sequential_pairs(names: list[str], overlap: int, loop_every: int) -> list[Pair]:
    """Each frame with the next `overlap` ones, and every `loop_every`-th frame with all others of these."""
    count = len(names)
    chosen = {(i, j) for i in range(count) for j in range(i + 1, min(i + overlap, count - 1) + 1)}
    chosen |= set(combinations(range(0, count, max(loop_every, 1)), 2))
    return [(names[i], names[j]) for i, j in sorted(chosen)]


def alike_pairs(features: Path, count: int) -> list[Pair]:
    """Each photo of a database with the `count` whose features are most alike, by VLAD (Jégou et al. 2010): one vector
    a photo, how its descriptors lie about their nearest of a few mean ones."""
    with pycolmap.Database.open(features) as opened:
        images = [i for i in opened.read_all_images() if opened.num_descriptors_for_image(i.image_id)]
        if not images:
            return []

        def descriptors(image: pycolmap.Image) -> NDArray[np.float32]:
            return np.asarray(opened.read_descriptors(image.image_id).data, np.float32)

        rng = np.random.default_rng(0)
        # Half or twice as many means find the same photos.
        drawn = [rng.permutation(descriptors(image))[:FEW_FEATURES] for image in images]
        means, _ = kmeans2(np.concatenate(drawn), FEW_FEATURES, minit="++", rng=rng)
        vectors = np.stack([_vlad(descriptors(image), means) for image in images])
    vectors -= vectors.mean(0)
    vectors /= np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-6)
    likeness = vectors @ vectors.T
    np.fill_diagonal(likeness, -np.inf)
    best = np.argsort(-likeness, axis=1)[:, :count]
    return [(images[a].name, images[b].name) for a, others in enumerate(best) for b in others]


def _vlad(descriptors: NDArray[np.float32], means: NDArray[np.float32]) -> NDArray[np.float32]:
    """Sums of the differences of (N, D) descriptors to the nearest of (K, D) means, each of length 1, in one row."""
    nearest = vq(descriptors, means)[0]
    sums = np.zeros_like(means)
    np.add.at(sums, nearest, descriptors - means[nearest])
    return (sums / np.maximum(np.linalg.norm(sums, axis=1, keepdims=True), 1.0)).ravel()


def gps_spread_m(positions: NDArray[np.float64]) -> float:
    """RMS horizontal distance of WGS84 positions (N, 3) from their middle, in metres; wild ones are left out."""
    horizontal = local_frame(positions).apply(positions)[:, :2]
    distance = np.linalg.norm(horizontal - np.median(horizontal, axis=0), axis=1)
    near = distance[distance <= MAX_MEDIAN_DISTANCES * np.median(distance)]
    return float(np.sqrt((near**2).mean()))


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
    """Whether most photos have a position, and these separate neighbours from others."""
    known, positions = gps_positions(photos)
    if len(known) < max(3, 0.8 * len(photos)) or gps_spread_m(positions) <= MIN_GPS_SPREAD_M:
        return False
    _, at, counts = np.unique(np.nan_to_num(positions), axis=0, return_inverse=True, return_counts=True)
    return float((counts[at.ravel()] > neighbours).mean()) <= MAX_REPEATED_SHARE


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

"""Matching and geometric verification of pairs of photos with COLMAP.

He et al. 2026, section on the scene: ratio test 0.7, largest descriptor distance 0.7, mutual best match, guided
re-matching.
"""

import contextlib
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap

from scenefuse.core.stage import StageError, atomic_file, quantity, read_json, threads, value, write_json
from scenefuse.photos.photos import read_photos
from scenefuse.sfm.interrupt import cancellable
from scenefuse.sfm.pairs import MatchSettings, Pair, choose_pairs

# Largest descriptor distance of a match (the paper's).
MAX_DISTANCE = 0.7
# Fewest verified matches for a pair of photos to count; COLMAP's own.
MIN_INLIERS = 15
# COLMAP looks at a cancellation only between two blocks of pairs.
BLOCK = 100


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
    is_video = value(read_json(photos), "kind") == "video"
    choice, reason, pairs = choose_pairs(read_photos(photos), is_video, settings)
    print(f"{choice} pairs ({reason}): {len(pairs)}", flush=True)
    pycolmap.set_random_seed(seed)
    with atomic_file(database) as temporary:
        shutil.copyfile(features, temporary)
        with _pair_list(temporary, pairs) as listed:
            cancellable(
                pycolmap.match_image_pairs,
                temporary,
                matching_options=_matching(settings),
                pairing_options=pycolmap.ImportedPairingOptions(match_list_path=listed, block_size=BLOCK),
                verification_options=_verification(seed),
                device=pycolmap.Device.cpu,
            )
        with pycolmap.Database.open(temporary) as opened:
            _, per_pair = opened.read_two_view_geometry_num_inliers()
        verified, inliers = int(np.count_nonzero(per_pair)), int(np.sum(per_pair))
        if verified == 0:
            raise StageError(
                f"none of the {len(pairs)} pairs of photos of {photos} show the same thing; "
                f"check that the photos overlap, are sharp and textured"
            )
    print(f"{verified} of {len(pairs)} pairs verified, {inliers} matches", flush=True)
    content: dict[str, Any] = {
        "pairs_choice": quantity(choice, ""),
        "pairs_reason": quantity(reason, ""),
        "pairs": quantity(len(pairs), "1"),
        "verified_pairs": quantity(verified, "1"),
        "inlier_matches": quantity(inliers, "1"),
        "guided_matching": quantity(settings.guided_matching, ""),
        "max_ratio": quantity(settings.max_ratio, "1"),
        "max_distance": quantity(MAX_DISTANCE, "1"),
    }
    write_json(matches, content)


def _matching(settings: MatchSettings) -> pycolmap.FeatureMatchingOptions:
    options = pycolmap.FeatureMatchingOptions()
    options.num_threads = threads()
    options.use_gpu = False
    options.guided_matching = settings.guided_matching
    options.sift.max_ratio = settings.max_ratio
    options.sift.max_distance = MAX_DISTANCE
    options.sift.cross_check = True
    return options


def _verification(seed: int) -> pycolmap.TwoViewGeometryOptions:
    options = pycolmap.TwoViewGeometryOptions()
    options.min_num_inliers = MIN_INLIERS
    options.ransac.random_seed = seed
    return options


@contextlib.contextmanager
def _pair_list(database: Path, pairs: list[Pair]) -> Iterator[Path]:
    """A list of pairs as COLMAP reads it. Meanwhile the photos of the database are called by their numbers, since names
    with blanks, or with # in front, are misread."""
    with pycolmap.Database.open(database) as opened:
        images = opened.read_all_images()
        names = {image.image_id: image.name for image in images}
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

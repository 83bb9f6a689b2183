"""Features and matches with COLMAP, the first half of structure from motion; the same code serves scenes and objects.

He et al. 2026, section on the scene: SIFT, ratio test 0.7, largest descriptor distance 0.7, mutual best match,
guided re-matching.
"""

import contextlib
import shutil
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pycolmap

from scenefuse.sfm.interrupt import cancellable
from scenefuse.sfm.pairs import PairSettings, choose_pairs
from scenefuse.sfm.photos import Photo, read_photos
from scenefuse.stage import (
    StageError,
    atomic_file,
    quantity,
    read_json,
    setting,
    threads,
    value,
    write_json,
)


@dataclass(frozen=True)
class FeatureSettings:
    """SIFT and the camera model."""

    max_image_size_px: int = setting(2000, unit="px", least=0)
    """Longest side at which features are looked for; larger photos are scaled down for this stage only."""
    max_features: int = setting(1500, least=0)
    """Most features kept per photo, the largest first."""
    first_octave: int = setting(-1, least=-1)
    """-1 looks for features in photos enlarged twice as well: more small features, four times the work; 0 does not."""
    camera_model: Literal["SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV"] = setting("SIMPLE_RADIAL")
    """COLMAP's camera model; focal length and distortion are refined."""
    camera_mode: Literal["auto", "single", "per_folder", "per_photo"] = setting("single")
    """Which photos share one camera; auto: those with one size, EXIF camera and focal length."""


@dataclass(frozen=True)
class MatchSettings:
    """How descriptors are matched and pairs verified."""

    max_ratio: float = setting(0.7, least=0)
    """Lowe's ratio test: best over second-best descriptor distance."""
    max_distance: float = setting(0.7, least=0)
    """Largest descriptor distance of a match."""
    cross_check: bool = setting(True)
    """Keep only matches that are mutually the best."""
    guided_matching: bool = setting(True)
    """Match again along the epipolar lines once a pair is verified."""
    min_inliers: int = setting(15, least=0)
    """Fewest verified matches for a pair of photos to count."""


def extract_features(*, folder: Path, photos: Path, features: Path, settings: FeatureSettings) -> None:
    """Find SIFT features in every photo and write them, with cameras and GPS priors, to a COLMAP database.

    Args:
        folder: folder of photos.
        photos: JSON list of them.
        features: output, COLMAP database.
        settings: SIFT and camera settings.

    Raises:
        StageError: `camera_mode` is single and the photos differ in size, or a photo yields no features at all.
    """
    listed = read_photos(photos)
    groups = camera_groups(listed, settings.camera_mode)
    options = pycolmap.FeatureExtractionOptions()
    options.max_image_size = settings.max_image_size_px
    options.num_threads = threads()
    options.use_gpu = False
    options.sift.max_num_features = settings.max_features
    options.sift.first_octave = settings.first_octave
    reader = pycolmap.ImageReaderOptions(camera_model=settings.camera_model)
    with atomic_database(features) as temporary:
        for names in groups:
            cancellable(
                pycolmap.extract_features,
                temporary,
                folder,
                image_names=names,
                camera_mode=pycolmap.CameraMode.SINGLE,
                reader_options=reader,
                extraction_options=options,
                device=pycolmap.Device.cpu,
            )
        counts = _feature_counts(temporary)
    missing = [p.name for p in listed if p.name not in counts]
    if missing:
        raise StageError(
            f"COLMAP could not read {len(missing)} photos, {missing[0]} for one; save them again as JPEG or PNG"
        )
    few = [name for name, count in counts.items() if count < 100]
    if few:
        print(f"note: {len(few)} photos have fewer than 100 features, {few[0]} for one", flush=True)
    middle = int(np.median(list(counts.values())))
    print(f"{middle} features in the median photo, {len(groups)} cameras", flush=True)


def match_features(
    *,
    photos: Path,
    features: Path,
    database: Path,
    matches: Path,
    pair_settings: PairSettings,
    settings: MatchSettings,
    seed: int,
) -> None:
    """Match the features of chosen pairs of photos and verify each pair's geometry.

    Args:
        photos: JSON list of the photos.
        features: COLMAP database with features.
        database: output, COLMAP database with matches as well.
        matches: output, JSON: the choice of pairs and what came of it.
        pair_settings: which photos are compared.
        settings: how they are compared.
        seed: of RANSAC.

    Raises:
        StageError: no pair of photos could be verified.
    """
    listed = read_photos(photos)
    is_video = value(read_json(photos), "kind") == "video"
    choice, reason, pairs = choose_pairs(listed, is_video, pair_settings)
    print(f"{choice} pairs ({reason}): {len(pairs)}", flush=True)
    options = pycolmap.FeatureMatchingOptions()
    options.num_threads = threads()
    options.use_gpu = False
    options.guided_matching = settings.guided_matching
    options.sift.max_ratio = settings.max_ratio
    options.sift.max_distance = settings.max_distance
    options.sift.cross_check = settings.cross_check
    verification = pycolmap.TwoViewGeometryOptions()
    verification.min_num_inliers = settings.min_inliers
    verification.ransac.random_seed = seed
    pycolmap.set_random_seed(seed)
    with atomic_database(database) as temporary:
        shutil.copyfile(features, temporary)
        pair_list = temporary.with_suffix(".txt")
        try:
            pair_list.write_text("".join(f"{a} {b}\n" for a, b in pairs))
            # Small blocks: COLMAP looks at a cancellation only between two of them.
            pairing = pycolmap.ImportedPairingOptions(match_list_path=pair_list, block_size=100)
            cancellable(
                pycolmap.match_image_pairs,
                temporary,
                matching_options=options,
                pairing_options=pairing,
                verification_options=verification,
                device=pycolmap.Device.cpu,
            )
        finally:
            pair_list.unlink(missing_ok=True)
        with pycolmap.Database.open(temporary) as opened:
            _, per_pair = opened.read_two_view_geometry_num_inliers()
            verified, inliers = int(np.count_nonzero(per_pair)), int(np.sum(per_pair))
        if verified == 0:
            raise StageError(
                f"none of the {len(pairs)} pairs of photos of {photos} show the same thing; "
                f"check that the photos overlap, are sharp and textured"
            )
    print(f"{verified} of {len(pairs)} pairs verified, {inliers} matches", flush=True)
    content = {
        "pairs_choice": quantity(choice, ""),
        "pairs_reason": quantity(reason, ""),
        "pairs": quantity(len(pairs), "1"),
        "verified_pairs": quantity(verified, "1"),
        "inlier_matches": quantity(inliers, "1"),
        "guided_matching": quantity(settings.guided_matching, ""),
        "max_ratio": quantity(settings.max_ratio, "1"),
        "max_distance": quantity(settings.max_distance, "1"),
    }
    write_json(matches, content)


@contextlib.contextmanager
def atomic_database(path: Path) -> Iterator[Path]:
    """As atomic_file, and the journals that SQLite leaves beside an interrupted database are removed as well."""
    with atomic_file(path) as temporary:
        try:
            yield temporary
        finally:
            for ending in ("-wal", "-shm", "-journal"):
                temporary.with_name(temporary.name + ending).unlink(missing_ok=True)


def camera_groups(photos: list[Photo], mode: str) -> list[list[str]]:
    """Photo names grouped by the camera they share, in order of first appearance.

    Raises:
        StageError: mode "single" and photos of different sizes.
    """
    keys: dict[str, Callable[[Photo], Any]] = {
        "auto": lambda p: (p.width, p.height, p.camera, p.focal_px and round(p.focal_px)),
        "single": lambda p: (p.width, p.height),
        "per_folder": lambda p: (str(Path(p.name).parent), p.width, p.height),
        "per_photo": lambda p: p.name,
    }
    groups: dict[Any, list[str]] = {}
    for photo in photos:
        groups.setdefault(keys[mode](photo), []).append(photo.name)
    if mode == "single" and len(groups) > 1:
        sizes = ", ".join(f"{w}x{h} ({names[0]})" for (w, h), names in groups.items())
        raise StageError(f"camera_mode is single but the photos differ in size: {sizes}; set it to auto")
    return list(groups.values())


def _feature_counts(database: Path) -> dict[str, int]:
    with pycolmap.Database.open(database) as opened:
        return {i.name: opened.num_keypoints_for_image(i.image_id) for i in opened.read_all_images()}

"""Incremental mapping with COLMAP, the second half of structure from motion; the same code serves scenes and objects.

He et al. 2026, section on the scene: bundle adjustment with 100 iterations, 200 of the linear solver.
"""

import contextlib
import copy
import shutil
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap

from scenefuse.core.stage import (
    StageError,
    atomic_directory,
    quantity,
    read_json,
    scratch_directory,
    setting,
    threads,
    value,
    write_json,
)
from scenefuse.marks.triangulation import read_lengths
from scenefuse.photos.cameras.read_cameras import place_of
from scenefuse.photos.frames import original_sizes
from scenefuse.photos.photos import read_photos
from scenefuse.sfm.colmap import (
    ADJUSTMENT_TOLERANCE,
    ITERATIONS,
    MIN_PHOTOS,
    STRONG_PAIR,
    cancellable,
    doubtful_photos,
    drop_outliers,
    explained_matches,
    require_database,
)
from scenefuse.sfm.given_cameras import triangulated
from scenefuse.sfm.lens import DISTORTED, HELD, KNOWN, Choice, Lens, choose_lens

# All cameras are adjusted together when there are so many times the photos or points of the last time; by COLMAP's 1.1
# that is 60 % of a mapping, and the last adjustment ends at the same cameras.
GLOBAL_GROWTH = 1.3
# What to do about photos without a camera, where cameras were given and where they were not.
GIVEN_ADVICE = (
    "Export the cameras of all photos, take the photos that have none out of the folder, or lower min_registered_share"
)
MAPPING_ADVICE = (
    "Likely reasons: too little overlap between neighbouring photos, a camera that did not move, blur, surfaces without"
    " texture, or pairs that were not compared. Add photos from places between them, set pairs to exhaustive, raise"
    " max_features, or lower min_registered_share"
)
# Mappings are tried with so many seeds while photos seem to stand in wrong places.
ATTEMPTS = 3


@dataclass(frozen=True)
class MappingSettings:
    """Incremental mapping and bundle adjustment."""

    # Half: then no other model can hold more of them.
    min_registered_share: float = setting(0.5, least=0, most=1)
    """Smallest share of the photos that have to be registered, 0 to 1; fewer is an error."""


@dataclass(frozen=True)
class Job:
    """What is mapped.

    Attributes:
        names: of the photos.
        folder: that holds them.
        database: with their verified matches.
        sparse: where the model will be; files in between lie beside it.
        share: smallest share of the photos that have to be registered.
        cropped: names of the photos whose principal point may be anywhere.
    """

    names: list[str]
    folder: Path
    database: Path
    sparse: Path
    share: float
    cropped: frozenset[str] = frozenset()


def map_photos(
    *,
    folder: Path,
    photos: Path,
    database: Path,
    sparse: Path,
    report: Path,
    calibrated: bool = False,
    cameras: Path | None = None,
    lengths: Path | None = None,
    settings: MappingSettings,
    seed: int,
) -> None:
    """Recover cameras and sparse points by incremental mapping, choose the lens, then a last bundle adjustment.

    Args:
        folder: folder of photos (for the points' colours).
        photos: JSON list of them.
        database: COLMAP database with verified matches.
        sparse: output, COLMAP model, the one with most photos.
        report: output, JSON: photos registered, errors, the lens and why, models left out.
        calibrated: whether the database holds a known calibration; it is held then.
        cameras: cameras that another program found, see `triangulated`; nothing is mapped or adjusted then.
        lengths: known lengths between clicked points (`read_lengths`), which bring the model into metres.
        settings: mapping settings.
        seed: of RANSAC and of the choice of the first pair.

    Raises:
        StageError: too small a share of the photos is registered; what `triangulated` and `read_lengths` say.
    """
    require_database(database)
    listed = read_photos(photos)
    cropped = frozenset(p.name for p in listed if p.cropped)
    job = Job([p.name for p in listed], folder, database, sparse, settings.min_registered_share, cropped)
    if cameras is not None:
        model, content = _taken(job, cameras, read_json(photos), seed)
    else:
        model, content = _mapped(job, calibrated, seed)
    content |= in_metres(model, lengths, original_sizes(read_json(photos)))
    with atomic_directory(sparse) as temporary:
        model.write(temporary)
    write_json(report, content | {"seed": quantity(seed, "1")})


def in_metres(
    model: pycolmap.Reconstruction, lengths: Path | None, sizes: Mapping[str, tuple[int, int]]
) -> dict[str, Any]:
    """Scale a model in place by known lengths, where there are any; its unit and how far they are off, as quantities.

    Raises:
        StageError: what `read_lengths` says.
    """
    if lengths is None:
        return {}
    known = read_lengths(lengths, model, sizes)
    model.transform(pycolmap.Sim3d(known.scale, pycolmap.Rotation3d(), np.zeros(3)))
    off = dict(zip(known.names, known.off_m.tolist()))
    print("in metres by known lengths, off by " + ", ".join(f"{n} {o:+.3g} m" for n, o in off.items()), flush=True)
    return {
        "length_unit": quantity("m", ""),
        "metres_per_unit": quantity(known.scale, "m per unit of the model before"),
        "lengths_off_m": quantity(off, "m"),
    }


def _mapped(job: Job, calibrated: bool, seed: int) -> tuple[pycolmap.Reconstruction, dict[str, Any]]:
    """The model of photos by name, and what it is, as quantities: of a few attempts the one that explains most matches.

    One attempt is enough where no photo is doubtful. A further one that registers too few photos is left out. Photos
    that are doubtful in the best one are left out where enough others remain.
    """
    attempts: list[tuple[int, pycolmap.Reconstruction, Choice, dict[str, Any]]] = []
    for attempt in range(ATTEMPTS):
        try:
            model, choice, content = _attempt(job, calibrated, seed + attempt)
        except StageError as error:
            if not attempts:
                raise
            print(f"attempt {attempt + 1} of {ATTEMPTS} is left out: {error}", flush=True)
            continue
        found = explained_matches(model, job.database)
        doubtful = doubtful_photos(model, found)
        content["doubtful_photos"] = quantity(doubtful, "1")
        content["notes"] = quantity([_doubt(doubtful)] if doubtful else [], "")
        attempts.append((found.total, model, choice, content))
        if not doubtful:
            break
        print(f"attempt {attempt + 1} of {ATTEMPTS}: {_doubt(doubtful)}", flush=True)
    _, model, choice, content = max(attempts, key=lambda attempt: attempt[0])
    if doubtful := value(content, "doubtful_photos"):
        rest = copy.deepcopy(model)
        for image in [rest.images[i] for i in rest.reg_image_ids()]:
            if image.name in doubtful:
                rest.deregister_frame(image.frame_id)
        if _are_enough(rest, job):
            # They bend what holds them.
            model = choice.lens.fit(rest)
            drop_outliers(model)
            content |= _describe(model, job.names, *choice)
    return model, content | {"attempts": quantity(attempt + 1, "1")}


def _attempt(job: Job, calibrated: bool, seed: int) -> tuple[pycolmap.Reconstruction, Choice, dict[str, Any]]:
    """The model that one seed gives, its lens, and what it is, as quantities."""
    ranked, least_matches = _mapped_first(job, calibrated, seed)
    _check_registered(ranked, job)
    choice = choose_lens(ranked[0], (KNOWN,) if calibrated else DISTORTED, job.cropped)
    lens, mappings = choice.lens, 1
    if lens not in (HELD, KNOWN):
        ranked, mappings = _with_lens(ranked, lens, job, _mapper_options(job, True, seed, least_matches))
    model = lens.fit(ranked[0])
    drop_outliers(model)
    summary = _describe(model, job.names, *choice)
    print(
        f"{summary['registered']['value']} of {len(job.names)} photos registered, "
        f"{summary['mean_reprojection_error_px']['value']:.3f} px, {summary['points']['value']} points, "
        f"{lens.words}",
        flush=True,
    )
    reason = "not connected to the largest model by enough verified matches"
    left_out = [{"photos": sorted(_registered_names(m)), "reason": reason} for m in ranked[1:]]
    for entry in left_out:
        print(f"note: a separate model of {len(entry['photos'])} photos is left out", flush=True)
    report = {
        **summary,
        "mappings": quantity(mappings, "1"),
        "least_matches_of_a_pair": quantity(least_matches, "1"),
        "models_left_out": quantity(left_out, ""),
    }
    return model, choice, report


def _mapped_first(job: Job, calibrated: bool, seed: int) -> tuple[list[pycolmap.Reconstruction], int]:
    """Models from strong pairs alone, or, where these explain more, from all that were verified; fewest matches used.

    Pairs that chance verified put photos in wrong places; but some photos have no other pairs. Photos of something else
    have none at all.
    """
    strong = mapped_models(job, _mapper_options(job, calibrated, seed, STRONG_PAIR))
    if strong and not explained_matches(strong[0], job.database).can_grow():
        return strong, STRONG_PAIR
    options = _mapper_options(job, calibrated, seed)
    every = mapped_models(job, options)
    if every and (not strong or _explained(every[0], job) > _explained(strong[0], job)):
        return every, options.min_num_matches
    return strong, STRONG_PAIR


def _explained(model: pycolmap.Reconstruction, job: Job) -> int:
    """Verified matches that a model explains."""
    return explained_matches(model, job.database).total


def _doubt(doubtful: dict[str, float]) -> str:
    """A sentence on photos that may stand wrong, by name, with the share of their matches that the model explains."""
    shares = ", ".join(f"{name} {share:.2f}" for name, share in doubtful.items())
    return f"photos that may stand in wrong places, with the share of their matches that the model explains: {shares}"


def _taken(
    job: Job, cameras: Path, photos: dict[str, Any], seed: int
) -> tuple[pycolmap.Reconstruction, dict[str, Any]]:
    """The same from given cameras."""
    work, place = job.sparse.with_name(f"{job.sparse.name}-given"), place_of(cameras)
    options = _mapper_options(job, True, seed)
    model, turned = triangulated(cameras, job.folder, photos, job.database, work, options)
    _check_registered([model], job, given=cameras)
    drop_outliers(model)
    summary = _describe(model, job.names, KNOWN)
    print(f"{summary['registered']['value']} of {len(job.names)} photos have a camera in {cameras}", flush=True)
    notes = [f"cameras are those of {cameras.name}, held", *turned]
    on_earth = {} if place is None else place.report()
    return model, summary | on_earth | {"models_left_out": quantity([], ""), "notes": quantity(notes, "")}


def mapped_models(
    job: Job, options: pycolmap.IncrementalPipelineOptions, database: Path | None = None
) -> list[pycolmap.Reconstruction]:
    """The models of incremental mapping, that with most photos first."""
    pycolmap.set_random_seed(options.random_seed)
    with scratch_directory(job.sparse.with_name(f"{job.sparse.name}-models")) as work:
        models = cancellable(pycolmap.incremental_mapping, database or job.database, job.folder, work, options=options)
    return sorted(models.values(), key=lambda m: (-m.num_reg_images(), -m.num_points3D()))


def _with_lens(
    ranked: list[pycolmap.Reconstruction], lens: Lens, job: Job, options: pycolmap.IncrementalPipelineOptions
) -> tuple[list[pycolmap.Reconstruction], int]:
    """Models with the lens that the first was found to have, and how many mappings they took.

    The first model's points are triangulated again, for a poorer lens splits tracks and drops matches. It may also have
    left out photos with matches, or put some at wrong places, where an adjustment leaves them: then photos are mapped
    again.
    """
    model = lens.fit(ranked[0])
    found = explained_matches(model, job.database)
    with _calibrated(model, job) as database:
        if not found.can_grow() and not doubtful_photos(model, found):
            folders = job.folder, database.parent
            return [cancellable(pycolmap.triangulate_points, model, database, *folders, options=options)], 1
        again = mapped_models(job, options, database)
    if again and _explained(lens.fit(again[0]), job) > found.total:
        return again, 2
    return [model, *ranked[1:]], 1


@contextlib.contextmanager
def _calibrated(model: pycolmap.Reconstruction, job: Job) -> Iterator[Path]:
    """A copy of the database that holds the lenses of a model as known ones, in a folder that goes afterwards."""
    with scratch_directory(job.sparse.with_name(f"{job.sparse.name}-calibrated")) as work:
        calibrated = work / "database.db"
        shutil.copyfile(job.database, calibrated)
        with pycolmap.Database.open(calibrated) as opened:
            for camera in model.cameras.values():
                known = pycolmap.Camera(camera.todict())
                known.has_prior_focal_length = True
                opened.update_camera(known)
        yield calibrated


def _describe(
    model: pycolmap.Reconstruction, names: list[str], lens: Lens, beyond: Lens | None = None
) -> dict[str, Any]:
    """What a model holds, as quantities: photos registered, errors, points, cameras, lens and the one beyond it, photos
    left out."""
    registered = _registered_names(model)
    cameras = [
        {"model": c.model_name, "width": c.width, "height": c.height, "params": list(c.params)}
        for _, c in sorted(model.cameras.items())
    ]
    return {
        "registered": quantity(len(registered), "1"),
        "total": quantity(len(names), "1"),
        "registered_share": quantity(len(registered) / len(names), "1"),
        "mean_reprojection_error_px": quantity(model.compute_mean_reprojection_error(), "px"),
        "points": quantity(model.num_points3D(), "1"),
        "not_registered": quantity(sorted(set(names) - registered), ""),
        "cameras": quantity(cameras, "px"),
        "lens": quantity(lens.name, ""),
        "next_lens": quantity(beyond and beyond.name, ""),
    }


def _mapper_options(
    job: Job, calibrated: bool, seed: int, least_matches: int | None = None
) -> pycolmap.IncrementalPipelineOptions:
    options = pycolmap.IncrementalPipelineOptions()
    options.min_num_matches = least_matches or options.min_num_matches
    options.ba_refine_focal_length = options.ba_refine_extra_params = not calibrated
    options.num_threads = threads()
    options.random_seed = seed
    options.mapper.random_seed = seed
    options.triangulation.random_seed = seed
    options.ba_global_max_num_iterations = ITERATIONS
    options.ba_global_function_tolerance = options.ba_local_function_tolerance = ADJUSTMENT_TOLERANCE
    options.ba_global_frames_ratio = options.ba_global_points_ratio = GLOBAL_GROWTH
    options.min_model_size = MIN_PHOTOS
    if calibrated:
        # COLMAP leaves photos out whose lens looks like a failed adjustment: with coefficients over 1, as those of a
        # rational lens, which nearly cancel. A lens that is known is not doubted.
        options.max_extra_param = np.inf
    # A second attempt from another pair stops, by default, once it shares twenty photos with the first, however small
    # that one stayed; here every attempt goes on as far as it can, and the largest is taken.
    options.max_model_overlap = len(job.names)
    return options


def _check_registered(models: list[pycolmap.Reconstruction], job: Job, given: Path | None = None) -> None:
    """StageError when the largest model, or that of the given cameras, holds too few of the photos."""
    count = models[0].num_reg_images() if models else 0
    if models and _are_enough(models[0], job):
        return
    others = f" (and {len(models) - 1} separate smaller models)" if len(models) > 1 else ""
    missing = sorted(set(job.names) - (_registered_names(models[0]) if models else set()))
    some = f"{', '.join(missing[:5])}{', ...' if len(missing) > 5 else ''}"
    what = f"only {count} of {len(job.names)} photos " + (
        f"have a camera in {given}" if given else f"were registered{others}"
    )
    raise StageError(
        f"{what}, fewer than the share of {job.share:g} that min_registered_share requires; without one: {some}. "
        + (GIVEN_ADVICE if given else MAPPING_ADVICE)
    )


def _are_enough(model: pycolmap.Reconstruction, job: Job) -> bool:
    """Whether a model holds so many photos that it is of use."""
    return bool(model.num_reg_images() >= max(MIN_PHOTOS, job.share * len(job.names)))


def _registered_names(model: pycolmap.Reconstruction) -> set[str]:
    return {model.images[i].name for i in model.reg_image_ids()}

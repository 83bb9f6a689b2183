"""How far a model may be bent: the same photos adjusted again and again, with other photos left out or another lens.

A sparse model's errors are not those of its points one by one: poses, points and lens err together, so that whole
regions are shifted, turned and scaled (drift, the bowl of self-calibration). An ensemble of models shows it without a
truth (method M10): a delete-group jackknife over photos (Shao and Tu 1995), and one model with the next richer lens,
which the photos do not rule out.
"""

import copy
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap
from numpy.typing import NDArray

from scenefuse.core.stage import StageError, atomic_file, read_json, value
from scenefuse.core.transforms import Array, Sim3, fit_sim3
from scenefuse.geometry.icp import change_between
from scenefuse.photos.workspace import read_model
from scenefuse.sfm.colmap import ADJUSTMENT_TOLERANCE, MIN_PHOTOS, adjust
from scenefuse.sfm.lens import LENSES, MAX_POINTS, Lens

# Groups of photos, each left out once.
GROUPS = 8
# Points around a place whose common motion is its motion.
NEAREST_POINTS = 200
# Points that moved more than so many times the median beside the common motion do not count for it.
MAX_ERROR_MEDIANS = 3.0


@dataclass(frozen=True)
class Spread:
    """An ensemble of models beside one model.

    Attributes:
        points: (P, 3) of the model, in its frame.
        moved: (M, P, 3) the same points in each model of the ensemble, after the similarity that moves its cameras
            nearest to the model's; not a number where a model lacks a point.
        whole: (M,) bool, True where a model's deviation counts whole, False for a jackknife's.
    """

    points: Array
    moved: Array
    whole: NDArray[np.bool_]

    def covariance_at(self, place: Array) -> Array | None:
        """(7, 7) covariance of the model around a place (3,): rotation vector (radians), shift, log scale about it.

        Each model's similarity of the 200 points nearest to the place is a deviation; those of a jackknife of K groups
        add (K - 1) / K times the squares about their mean, the others their squares. None where no photos could be left
        out: three at most.
        """
        near = np.argsort(np.linalg.norm(self.points - place, axis=1))[:NEAREST_POINTS]
        deviations, whole = [], []
        for moved, counts_whole in zip(self.moved[:, near], self.whole):
            seen = np.isfinite(moved).all(1)
            if seen.sum() >= MIN_PHOTOS:
                motion = _common_motion(self.points[near][seen], moved[seen])
                deviations.append(change_between(Sim3.identity(), motion, place))
                whole.append(counts_whole)
        deviation, counts = np.array(deviations).reshape(-1, 7), np.array(whole, dtype=bool)
        left_out, richer = deviation[~counts], deviation[counts]
        if len(left_out) == 0:
            return None
        about = left_out - left_out.mean(0)
        return np.asarray(richer.T @ richer + (len(left_out) - 1) / len(left_out) * about.T @ about)


def estimate_spread(*, sparse: Path, sparse_json: Path, spread: Path) -> None:
    """Adjust a model again without each of its photos' groups and with a richer lens; see `Spread`.

    Args:
        sparse: COLMAP model.
        sparse_json: JSON of the mapping stage, for the lens.
        spread: output, NPZ of a `Spread`, in the model's frame.
    """
    known = read_json(sparse_json)
    model = read_model(sparse)
    beyond = value(known, "next_lens")
    found = spread_of(model, LENSES[value(known, "lens")], None if beyond is None else LENSES[beyond])
    write_spread(spread, found)
    print(f"{len(found.whole)} models, {len(found.points)} points", flush=True)


def spread_of(model: pycolmap.Reconstruction, lens: Lens, beyond: Lens | None) -> Spread:
    """The ensemble of a model.

    Args:
        model: bundle-adjusted with `lens`; it is not changed.
        lens: what is refined.
        beyond: the next richer lens, or None.
    """
    ids = sorted(model.point3D_ids(), key=lambda p: (-model.points3D[p].track.length(), p))[:MAX_POINTS]
    points = np.array([model.points3D[p].xyz for p in ids]).reshape(-1, 3)
    names = sorted((model.images[i].name, i) for i in model.reg_image_ids())
    groups = min(GROUPS, len(names)) if len(names) > MIN_PHOTOS else 0
    moved = []
    for group in range(groups):
        fewer = copy.deepcopy(model)
        for _, image in names[group::groups]:
            fewer.deregister_frame(fewer.images[image].frame_id)
        # Ten times mapping's tolerance gives the same spread to 1 % in half the time.
        adjust(fewer, lens.freedom, 10 * ADJUSTMENT_TOLERANCE)
        moved.append(_moved(fewer, model, ids))
    if beyond is not None:
        moved.append(_moved(beyond.fit(model), model, ids))
    return Spread(points, np.array(moved).reshape(-1, len(ids), 3), np.arange(len(moved)) >= groups)


def write_spread(path: Path, spread: Spread) -> None:
    """Write a spread as NPZ."""
    with atomic_file(path) as temporary, open(temporary, "wb") as file:
        np.savez_compressed(file, points=spread.points, moved=spread.moved.astype(np.float32), whole=spread.whole)


def read_spread(path: Path) -> Spread:
    """Read a spread.

    Raises:
        StageError: the file holds no spread.
    """
    try:
        with np.load(path) as content:
            return Spread(content["points"], content["moved"].astype(np.float64), content["whole"])
    except (OSError, ValueError, KeyError) as error:
        raise StageError(f"{path} is no spread of a model; delete it and run the workflow again") from error


def _moved(other: pycolmap.Reconstruction, model: pycolmap.Reconstruction, ids: list[int]) -> Array:
    """(P, 3) a model's points in another, brought into its frame by the cameras; not a number where they are gone.

    Of each camera the centre counts, and the ends of short axes: these turn photos in a row about it, and hardly any
    others.
    """
    shared = sorted(other.reg_image_ids())
    poses = [np.array([m.images[i].cam_from_world().inverse().matrix() for i in shared]) for m in (other, model)]
    reach = 0.1 * np.sqrt(poses[1][:, :, 3].var(0).sum())
    ends = [(p[:, :, 3:] + reach * p[:, :, :3] @ np.eye(3, 4, 1)).transpose(0, 2, 1).reshape(-1, 3) for p in poses]
    frame = fit_sim3(*ends)
    missing = np.full(3, np.nan)
    there = np.array([other.points3D[p].xyz if p in other.points3D else missing for p in ids])
    return frame.apply(there)


def _common_motion(before: Array, after: Array) -> Sim3:
    """The similarity that most points share."""
    motion = fit_sim3(before, after)
    error = np.linalg.norm(motion.apply(before) - after, axis=1)
    good = error <= MAX_ERROR_MEDIANS * np.median(error)
    return fit_sim3(before[good], after[good]) if good.sum() >= MIN_PHOTOS else motion

"""Which photos are matched with which, and between which depths: from the sparse points that they share."""

from dataclasses import dataclass

import numpy as np

from scenefuse.core.stage import StageError
from scenefuse.core.transforms import Array
from scenefuse.photos.workspace import View, Workspace

# Sparse points that a photo has to have, and to share with a source: fewer do not determine depths and angles.
MIN_SHARED_POINTS = 8
# Between two rays to a point: below there is little baseline to measure with, above surfaces look different.
GOOD_ANGLES_DEG = (8, 25)
# Standard deviations with which a point's weight falls off below and above them.
FALLOFF_DEG = (4.0, 10.0)


@dataclass(frozen=True)
class Reference:
    """A photo to estimate depths of.

    Attributes:
        view: its camera.
        sources: views to match it with, the best first.
        near, far: depths to search between, in the model's unit.
    """

    view: View
    sources: list[View]
    near: float
    far: float


def select_views(workspace: Workspace, sources: int, min_angle_deg: float) -> dict[str, Reference]:
    """Sources and depth range of every photo that has any, by name, from the sparse points.

    Sources are ranked by `pair_worth`.

    Args:
        workspace: posed photos and sparse points.
        sources: at most so many for each photo.
        min_angle_deg: smallest median angle between the rays of a photo and a source.

    Raises:
        StageError: fewer than two photos or no sparse points, or no photo with a source.
    """
    if len(workspace.views) < 2 or len(workspace.points) == 0:
        raise StageError(
            f"{workspace.folder} has {len(workspace.views)} photos and {len(workspace.points)} sparse points; "
            "stereo needs two photos and points they share"
        )
    seen = [np.unique(rows) for rows in workspace.seen]
    found = {}
    for k, view in enumerate(workspace.views):
        if len(seen[k]) < MIN_SHARED_POINTS:
            continue
        worth = []
        for j, other in enumerate(workspace.views):
            shared = np.intersect1d(seen[k], seen[j], assume_unique=True) if j != k else np.empty(0)
            if len(shared) < MIN_SHARED_POINTS:
                continue
            value, angle_deg = pair_worth(workspace.points[shared], view.centre, other.centre)
            if angle_deg >= min_angle_deg:
                worth.append((-value, j))
        if worth:
            chosen = [workspace.views[j] for _, j in sorted(worth)[:sources]]
            found[view.name] = Reference(view, chosen, *_depth_range(view, workspace.points[seen[k]]))
    if not found:
        raise StageError(
            f"no photo in {workspace.folder} shares points with another at {min_angle_deg} degrees or more; "
            "check the sparse model, or lower min_angle_deg"
        )
    return found


def _depth_range(view: View, points: Array) -> tuple[float, float]:
    """Depths between which the surface is, from (N, 3) sparse points that the photo sees."""
    z = points @ view.cam_from_world[2, :3] + view.cam_from_world[2, 3]
    z = np.sort(z[z > 0])
    # Sparse points miss tops and distant ground, and a tall thing may hold few of them: the third nearest counts.
    near = min(0.75 * np.percentile(z, 1), 0.85 * z[min(2, len(z) - 1)])
    return float(near), float(1.25 * np.percentile(z, 99))


def pair_worth(points: Array, a: Array, b: Array) -> tuple[float, float]:
    """What matching two photos at a and b (3,) is worth, and the median angle between their rays to shared points.

    The sum over the points (N, 3) of a weight that falls off below 8 and above 25 degrees, in the manner of MVSNet's
    and COLMAP's view selection.
    """
    if len(points) == 0:
        return 0.0, 0.0
    u, v = points - a, points - b
    cosine = (u * v).sum(1) / (np.linalg.norm(u, axis=1) * np.linalg.norm(v, axis=1))
    angles = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
    (low, high), (below, above) = GOOD_ANGLES_DEG, FALLOFF_DEG
    width = np.where(angles < low, below, np.where(angles > high, above, 1.0))
    weight = np.exp(-0.5 * ((angles - np.clip(angles, low, high)) / width) ** 2)
    return float(weight.sum()), float(np.median(angles))

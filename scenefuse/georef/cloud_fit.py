"""How well a cloud and the cameras that saw the same scene fit: whether both are in the same coordinates."""

from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from scipy.spatial import cKDTree

from scenefuse.cloud.clouds import spacing
from scenefuse.core.stage import StageError, quantity, threads, value
from scenefuse.core.transforms import Array, rotation_angle_deg
from scenefuse.geometry.icp import refine_on_cloud
from scenefuse.photos.workspace import View, posed_images, view_of

# So many photos have to frame a point for it to count as seen; fewer confirm none (method F4).
LEAST_PHOTOS = 3
# A cloud in other coordinates than the cameras has a smaller share of its points in their pictures than this, or is
# met by a smaller share of the points that the photos' own matches give in its box. Of four right clouds 66 % were met
# or more; with mirrored or swapped axes, half a turn, or 5 % larger, 17 % or fewer.
LEAST_SEEN, LEAST_MET = 0.1, 0.2
# Of a right cloud as dense as the photos allow more is met. Where so much more is met once it is moved, it is off, and
# where that moves it by more of the cameras' distance, turns it by more degrees, or scales it by more per cent.
USUALLY_MET, BETTER_MET, MOST_OFF = 0.6, 0.15, (0.01, 1.0, 1.0)
# What is met by the cloud: within this share of the distance to the nearest camera, or within a spacing of the cloud.
NEAR = 0.002
# What is told of a fit in any case.
FIT = ("seen_share", "met_share")
# The cloud's box leaves out so much of it on each side; fewer points in it say that the cloud is elsewhere.
STRAY_PERCENT, LEAST_POINTS = 1.0, 10
# Points of the cloud that are projected into all photos, and that are compared with the cameras' own points.
MOST_PROJECTED, MOST_COMPARED = 10_000, 200_000


def fit_to_cameras(points: Array, model: pycolmap.Reconstruction) -> dict[str, Any]:
    """How a cloud's points (N, 3) and a sparse model in its frame fit: shares, as quantities.

    `seen_share` of the points lie in the pictures of three photos or more; `met_share` of the model's own points in the
    cloud's box lie on the cloud. Where that is little, how much it would be if the cloud were moved, and by what.
    """
    views = [view_of(model, image) for image in posed_images(model)]
    own = np.array([point.xyz for point in model.points3D.values()]).reshape(-1, 3)
    seen, centres = _seen(points[:: max(1, len(points) // MOST_PROJECTED)], views), np.array([v.centre for v in views])
    points = points[:: max(1, len(points) // MOST_COMPARED)]
    own = _in_box_of(points, own)
    met = _met(points, own, centres)
    content = {"seen_share": quantity(seen, "1"), "met_share": quantity(met, "1")}
    if seen < LEAST_SEEN or len(own) < LEAST_POINTS or met > USUALLY_MET:
        return content
    moved = refine_on_cloud(own, points)
    middle = own.mean(0)
    off = float(np.linalg.norm(moved.apply(middle) - middle))
    return content | {
        "met_share_if_moved": quantity(_met(points, moved.apply(own), centres), "1"),
        "moved_by": quantity(off, "units of the given cameras"),
        "moved_by_over_distance": quantity(off / float(np.median(np.linalg.norm(centres - middle, axis=1))), "1"),
        "turned_by_deg": quantity(rotation_angle_deg(moved.rotation), "deg"),
        "scaled_by_pct": quantity(100 * (moved.scale - 1), "%"),
    }


def misfit(fit: dict[str, Any]) -> str:
    """What says that a cloud lies in other coordinates than the cameras; "" where nothing does. Of `fit_to_cameras`."""
    seen, met = value(fit, "seen_share"), value(fit, "met_share")
    if seen < LEAST_SEEN:
        return f"{100 * seen:.0f} % of its points are in the pictures of {LEAST_PHOTOS} photos"
    words = f"{100 * met:.0f} % of the points where the photos' matches meet lie on it"
    if "met_share_if_moved" in fit and _is_off(fit):
        by = f"{100 * value(fit, 'moved_by_over_distance'):.2g} % of the cameras' distance"
        turned, scaled = value(fit, "turned_by_deg"), value(fit, "scaled_by_pct")
        return (
            f"{words}, and {100 * value(fit, 'met_share_if_moved'):.0f} % if they are moved by {by}, turned by"
            f" {turned:.2g} degrees and scaled by {scaled:+.2g} % (another datum, geoid, zone or unit?)"
        )
    return words if met < LEAST_MET else ""


def _is_off(fit: dict[str, Any]) -> bool:
    """Whether a cloud lies beside where it would be met by more points."""
    better = value(fit, "met_share_if_moved") - value(fit, "met_share")
    off = (value(fit, "moved_by_over_distance"), value(fit, "turned_by_deg"), value(fit, "scaled_by_pct"))
    return bool(better > BETTER_MET or (better > 0 and (np.abs(off) > MOST_OFF).any()))


def check_fit(source: Path, fit: dict[str, Any], also: str = "") -> None:
    """StageError where a cloud lies in other coordinates than the cameras.

    Args:
        source: its file.
        fit: of `fit_to_cameras`.
        also: where else it was looked for, for the message.
    """
    found = misfit(fit)
    if found:
        raise StageError(
            f"{source} does not lie in the coordinates of the row's cameras{also}: only {found}; export cloud and"
            " cameras in the same coordinates, with the same axes, or empty the cell cameras or the cell cloud"
        )


def _seen(points: Array, views: list[View]) -> float:
    """Share of points (N, 3) that lie in enough pictures; a lens's distortion is left out."""
    count = np.zeros(len(points), np.int64)
    for view in views:
        count[view.visible(points)[0]] += 1
    return float((count >= LEAST_PHOTOS).mean())


def _in_box_of(points: Array, own: Array) -> Array:
    """Those of a model's points (M, 3) that are in the box of a cloud (N, 3)."""
    low, high = np.percentile(points, [STRAY_PERCENT, 100 - STRAY_PERCENT], axis=0)
    return own[((own >= low) & (own <= high)).all(1)]


def _met(points: Array, own: Array, centres: Array) -> float:
    """Share of a model's points (M, 3) that lie on a cloud (N, 3); centres (V, 3): of cameras."""
    if len(own) < LEAST_POINTS:
        return 0.0
    reach = np.maximum(NEAR * cKDTree(centres).query(own)[0], spacing(points))
    return float((cKDTree(points).query(own, workers=threads())[0] <= reach).mean())

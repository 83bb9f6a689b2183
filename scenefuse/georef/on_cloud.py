"""A sparse model and a cloud of the same scene: whether they fit, and how a model that GPS or control points placed is
laid on the cloud, which is more exact than either."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import pyproj
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from scenefuse.cloud.cloud_file import CloudFile
from scenefuse.cloud.clouds import spacing
from scenefuse.cloud.crs import check_place, grid_name, to_wgs84, usable
from scenefuse.cloud.formats import readable
from scenefuse.cloud.import_cloud import crs_of
from scenefuse.cloud.readers.las import check_projected
from scenefuse.core.stage import StageError, quantity, threads, value
from scenefuse.core.transforms import Array, Sim3, box_corners, inside_box, rotation_angle_deg
from scenefuse.geometry.depth_test import CONFIRMING_PHOTOS
from scenefuse.geometry.icp import refine_on_cloud
from scenefuse.geometry.surface import SAMPLED_POINTS, ends_of
from scenefuse.georef.placement import middle_of
from scenefuse.georef.residuals import Georeference
from scenefuse.photos.geodesy import LocalFrame
from scenefuse.photos.workspace import View, posed_images, view_of

# ICP goes on until a round of steps moves no point by more than this share of the model's extent.
MAX_STEP = 1e-3
# Points of a cloud that a model is compared with or laid on.
MAX_COMPARED = 200_000
# A cloud in other coordinates than the cameras has a smaller share of its points in their pictures than the first, or
# is met by a smaller share of the points that the photos' own matches give in its box than the second. Of four right
# clouds 66 % were met or more; with mirrored or swapped axes, half a turn, or 5 % larger, 17 % or fewer.
MIN_SEEN, MIN_MET = 0.1, 0.2
# More than the first share of a right cloud as dense as the photos allow is met. Where so much more is met once it is
# moved, it is off, and where that moves it by more of the cameras' distance, turns it by more degrees, or scales it by
# more per cent.
USUAL_MET, MIN_BETTER_MET, MAX_OFF = 0.6, 0.15, (0.01, 1.0, 1.0)
# What is met by the cloud: within this share of the distance to the nearest camera, or within a spacing of the cloud.
MAX_MET_SHARE = 0.002
# Fewer points of a model in the cloud's box, or over it, neither show whether the two fit nor lay the model on it.
MIN_OVER = 50
# What GPS is off at most, in metres: the cloud is looked at so far beyond the model.
MAX_GPS_ERROR_M = 30.0
# What is reported of a fit in any case.
FIT = ("seen_share", "met_share")


def cloud_crs(cloud: Path, crs: str | None) -> pyproj.CRS:
    """The CRS of a scene's cloud: its file's, or the one that the table names.

    Raises:
        StageError: neither says one, both differ, it is in degrees, or the file is damaged.
    """
    with readable(cloud):
        check_projected(cloud)
        named = crs_of(cloud, crs)
    if named is None:
        raise StageError(
            f"{cloud} names no CRS, so nothing says where the photos lie in it: fill the column crs, or give the"
            " cameras of the cloud's project in the column cameras"
        )
    return usable(named, str(cloud))


def fit_to_cameras(points: Array, model: pycolmap.Reconstruction) -> dict[str, Any]:
    """How a cloud's points (N, 3) and a sparse model in its frame fit: shares, as quantities.

    `seen_share` of the points lie in the pictures of three photos or more; `met_share` of the model's own points in the
    cloud's box lie on the cloud. Where that is little, how much it would be if the cloud were moved, and by what.
    """
    views = [view_of(model, image) for image in posed_images(model)]
    own = np.array([point.xyz for point in model.points3D.values()]).reshape(-1, 3)
    seen, centres = _seen(points[:: max(1, len(points) // SAMPLED_POINTS)], views), np.array([v.centre for v in views])
    points = points[:: max(1, len(points) // MAX_COMPARED)]
    own = own[inside_box(own, *ends_of(points))]
    met = _met(points, own, centres)
    content = {"seen_share": quantity(seen, "1"), "met_share": quantity(met, "1")}
    if seen < MIN_SEEN or len(own) < MIN_OVER or met > USUAL_MET:
        return content
    moved = refine_on_cloud(own, points)
    middle = own.mean(0)
    off = float(np.linalg.norm(moved.apply(middle) - middle))
    return content | {
        "met_share_if_moved": quantity(_met(points, moved.apply(own), centres), "1"),
        "moved_by_over_distance": quantity(off / float(np.median(np.linalg.norm(centres - middle, axis=1))), "1"),
        "turned_by_deg": quantity(rotation_angle_deg(moved.rotation), "deg"),
        "scaled_by_pct": quantity(100 * (moved.scale - 1), "%"),
    }


def misfit(fit: dict[str, Any]) -> str:
    """Why a cloud lies in other coordinates than the cameras, by `fit_to_cameras`; "" where it lies in theirs."""
    seen, met = value(fit, "seen_share"), value(fit, "met_share")
    if seen < MIN_SEEN:
        return f"{100 * seen:.0f} % of its points are in the pictures of {CONFIRMING_PHOTOS} photos"
    words = f"{100 * met:.0f} % of the points where the photos' matches meet lie on it"
    if "met_share_if_moved" in fit and _is_off(fit):
        by = f"{100 * value(fit, 'moved_by_over_distance'):.2g} % of the cameras' distance"
        turned, scaled = value(fit, "turned_by_deg"), value(fit, "scaled_by_pct")
        return (
            f"{words}, and {100 * value(fit, 'met_share_if_moved'):.0f} % if they are moved by {by}, turned by"
            f" {turned:.2g} degrees and scaled by {scaled:+.2g} % (another datum, geoid, zone or unit?)"
        )
    return words if met < MIN_MET else ""


def _is_off(fit: dict[str, Any]) -> bool:
    """Whether a cloud lies beside where it would be met by more points."""
    better = value(fit, "met_share_if_moved") - value(fit, "met_share")
    off = (value(fit, "moved_by_over_distance"), value(fit, "turned_by_deg"), value(fit, "scaled_by_pct"))
    return bool(better > MIN_BETTER_MET or (better > 0 and (np.abs(off) > MAX_OFF).any()))


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


def lay_on_cloud(
    model: pycolmap.Reconstruction, found: Georeference, cloud: Path, crs: str | None
) -> tuple[Georeference, dict[str, Any]]:
    """Move a georeferenced model in place onto a cloud: first in height, then by ICP (method M14).

    Args:
        model: in the frame of `found`.
        found: where it lies.
        cloud: of the scene, in a CRS.
        crs: the cloud's, where its file does not say it.

    Returns:
        where it lies now, with results in the cloud's CRS, and quantities: how it was moved, how well it fits.

    Raises:
        StageError: nothing places the model, or the cloud lies elsewhere or in no CRS, or does not fit.
    """
    grid = cloud_crs(cloud, crs)
    if found.frame is None or found.placement.status != "georeferenced":
        raise StageError(
            f"nothing says where the photos lie in {cloud}: {found.placement.reason}; give photos with GPS, control"
            " points (column control), or the cameras of the cloud's project (column cameras)"
        )
    frame = replace(found.frame, grid=grid_name(grid))
    own = np.array([point.xyz for point in model.points3D.values()]).reshape(-1, 3)
    there = _beside(cloud, own, grid, frame)
    moved, said = Sim3.identity(), f"{found.placement.reason}; so they fit {cloud.name}"
    # Control points are as exact as a cloud, and their coordinates may well be of the same survey.
    fit = fit_to_cameras(there, model)
    if not found.used.any() or misfit(fit):
        moved = _onto(there, own, str(cloud))
        off = moved.apply(own.mean(0)) - own.mean(0)
        turned, scaled = rotation_angle_deg(moved.rotation), 100 * (moved.scale - 1)
        said = (
            f"{found.placement.reason}; then laid on {cloud.name}, by {np.linalg.norm(off[:2]):.2f} m and"
            f" {off[2]:+.2f} m in height, {turned:.2g} degrees and {scaled:+.2g} %"
        )
        model.transform(pycolmap.Sim3d(moved.scale, pycolmap.Rotation3d(moved.rotation), moved.translation))
        fit = fit_to_cameras(there, model)
    if misfit(fit):
        raise StageError(
            f"the photos were placed by {found.placement.reason} and laid on {cloud}, and do not fit it: only"
            f" {misfit(fit)}; is it of this scene, as it was when they were taken, and in the CRS that it says? Control"
            " points (column control) place photos better than GPS, and the cameras of the cloud's project (column"
            " cameras) best"
        )
    names, positions = found.gps.names, frame.apply(found.gps.positions)
    centres = np.array([model.find_image_with_name(name).projection_center() for name in names]).reshape(-1, 3)
    placement = replace(
        found.placement,
        reason=said,
        local_from_model=moved @ found.placement.local_from_model,
        heights="measured",
        gps_shift=middle_of(positions - centres),
    )
    quantities = {"laid_on_cloud_by": quantity(moved.matrix, "m")} | {name: fit[name] for name in FIT}
    return replace(found, placement=placement, frame=frame), quantities


def in_local(points: Array, crs: pyproj.CRS, frame: LocalFrame, where: Path) -> Array:
    """Points (N, 3) of a cloud in a CRS in a scene's frame; heights keep their zero."""
    return frame.apply(to_wgs84(crs, points, str(where)))


def _beside(cloud: Path, own: Array, crs: pyproj.CRS, frame: LocalFrame) -> Array:
    """The points (N, 3) of a cloud that lie over or near a model (M, 3), in the scene's frame."""
    low, high = ends_of(own)
    corners = frame.in_crs(box_corners(low - MAX_GPS_ERROR_M, high + MAX_GPS_ERROR_M))
    low, high = corners.min(0), corners.max(0)
    low[2], high[2] = -np.inf, np.inf
    file = CloudFile.of(cloud, (low, high), MAX_COMPARED)
    check_place(crs, file.summary.sample, cloud)
    if len(file.part) < MIN_OVER:
        off = in_local(np.median(file.summary.sample, axis=0)[None], crs, frame, cloud)[0, :2] - np.median(
            own[:, :2], axis=0
        )
        raise StageError(
            f"{cloud} has {len(file.part)} points where its photos were taken, and its middle lies"
            f" {np.linalg.norm(off) / 1000:.3g} km from there; give the cloud of this scene, or correct its CRS"
        )
    return in_local(file.part.points, crs, frame, cloud)


def _onto(cloud: Array, own: Array, name: str) -> Sim3:
    """The similarity that lays a model (M, 3) on a cloud (N, 3), from metres away: ICP until it stays, by the points of
    the model that lie over the cloud."""
    over = _over(cloud, own)
    if over.sum() < MIN_OVER:
        raise StageError(
            f"{over.sum()} of the {len(own)} points that the photos' matches give lie over {name}, {MIN_OVER} are"
            " needed; give a cloud that shows more of what the photos do"
        )
    moved = Sim3(1.0, np.eye(3), np.array([0.0, 0.0, _height_above(cloud, own[over])]))
    stays = MAX_STEP * float(np.linalg.norm(np.ptp(own, axis=0)))
    for _ in range(10):
        here = moved.apply(own)
        here = here[_over(cloud, here)]
        if len(here) < MIN_OVER:
            break
        step = refine_on_cloud(here, cloud)
        moved = step @ moved
        if np.linalg.norm(step.apply(here) - here, axis=1).max() < stays:
            break
    return moved


def _over(cloud: Array, own: Array) -> NDArray[np.bool_]:
    """(M,) which points of a model lie over a cloud (N, 3)."""
    return inside_box(own[:, :2], *ends_of(cloud[:, :2]))


def _height_above(cloud: Array, own: Array) -> float:
    """How much higher a cloud (N, 3) is than a model (M, 3): GPS counts heights from another zero than most clouds."""
    nearest = cKDTree(cloud[:, :2]).query(own[:, :2], workers=threads())[1]
    return float(np.median(cloud[nearest, 2] - own[:, 2]))


def _seen(points: Array, views: list[View]) -> float:
    """Share of points (N, 3) that lie in enough pictures; a lens's distortion is left out."""
    count = np.zeros(len(points), np.int64)
    for view in views:
        count[view.visible(points)[0]] += 1
    return float((count >= CONFIRMING_PHOTOS).mean())


def _met(points: Array, own: Array, centres: Array) -> float:
    """Share of a model's points (M, 3) that lie on a cloud (N, 3); centres (V, 3): of cameras."""
    if len(own) < MIN_OVER:
        return 0.0
    reach = np.maximum(MAX_MET_SHARE * cKDTree(centres).query(own)[0], spacing(points))
    return float((cKDTree(points).query(own, workers=threads())[0] <= reach).mean())

"""A model that GPS or control points placed, laid on a cloud of the same scene, which is more exact than either."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import pyproj
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from scenefuse.cloud.cloud_file import CloudFile
from scenefuse.cloud.crs import check_place, grid_name, to_wgs84, usable
from scenefuse.cloud.formats import check_projected, readable
from scenefuse.cloud.import_cloud import crs_of
from scenefuse.core.stage import StageError, quantity, threads
from scenefuse.core.transforms import Array, Sim3, box_corners, rotation_angle_deg
from scenefuse.geometry.icp import refine_on_cloud
from scenefuse.georef.cloud_fit import FIT, fit_to_cameras, misfit
from scenefuse.georef.placement import middle_of
from scenefuse.georef.residuals import Georeference
from scenefuse.photos.geodesy import LocalFrame

# Points of the cloud that the model is laid on, about, and of the model that have to lie over it at least.
MOST_COMPARED, LEAST_OVER = 200_000, 50
# What GPS is off at most, and how far beyond the model the cloud is looked at, as a share of the model's extent.
OFF_M, BESIDE = 30.0, 0.1
# Strays of either on each side, in percent, do not say how far it reaches.
STRAY_PERCENT = 1.0
# ICP goes on in so many rounds of steps, until one moves no point by more than this share of the model's extent.
ROUNDS, STAYS = 10, 1e-3
# Heights are compared with those of so many points of the cloud about each of the model's, seen from above.
NEIGHBOURS = 8


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
    return usable(pyproj.CRS.from_user_input(named), str(cloud))


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
    if found.control is None or misfit(fit):
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
    quantities = {"laid_on_cloud_by": quantity(moved.matrix, "m"), "gps_shift": quantity(placement.gps_shift, "m")}
    return replace(found, placement=placement, frame=frame), quantities | {name: fit[name] for name in FIT}


def in_local(points: Array, crs: pyproj.CRS, frame: LocalFrame, where: Path) -> Array:
    """Points (N, 3) of a cloud in a CRS in a scene's frame; heights keep their zero."""
    return frame.apply(to_wgs84(crs, points, str(where)))


def _beside(cloud: Path, own: Array, crs: pyproj.CRS, frame: LocalFrame) -> Array:
    """The points (N, 3) of a cloud that lie over or near a model (M, 3), in the scene's frame."""
    low, high = np.percentile(own, [STRAY_PERCENT, 100 - STRAY_PERCENT], axis=0)
    reach = BESIDE * float(np.linalg.norm(high - low)) + OFF_M
    corners = frame.in_crs(box_corners(low - reach, high + reach))
    low, high = corners.min(0), corners.max(0)
    low[2], high[2] = -np.inf, np.inf
    file = CloudFile.of(cloud, (low, high), MOST_COMPARED)
    check_place(crs.to_wkt(), file.survey.sample, cloud)
    if len(file.part) < LEAST_OVER:
        off = in_local(np.median(file.survey.sample, axis=0)[None], crs, frame, cloud)[0, :2] - np.median(
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
    moved = Sim3(1.0, np.eye(3), np.array([0.0, 0.0, _height_above(cloud, own[_over(cloud, own, name)])]))
    stays = STAYS * float(np.linalg.norm(np.ptp(own, axis=0)))
    for _ in range(ROUNDS):
        here = moved.apply(own)
        here = here[_over(cloud, here, name)]
        step = refine_on_cloud(here, cloud)
        moved = step @ moved
        if np.linalg.norm(step.apply(here) - here, axis=1).max() < stays:
            break
    return moved


def _over(cloud: Array, own: Array, name: str) -> NDArray[np.bool_]:
    """(M,) which points of a model lie over a cloud (N, 3)."""
    low, high = np.percentile(cloud[:, :2], [STRAY_PERCENT, 100 - STRAY_PERCENT], axis=0)
    over = ((own[:, :2] >= low) & (own[:, :2] <= high)).all(1)
    if over.sum() < LEAST_OVER:
        raise StageError(
            f"{over.sum()} of the {len(own)} points that the photos' matches give lie over {name}, {LEAST_OVER} are"
            " needed; give a cloud that shows more of what the photos do"
        )
    return np.asarray(over)


def _height_above(cloud: Array, own: Array) -> float:
    """How much higher a cloud (N, 3) is than a model (M, 3): GPS counts heights from another zero than most clouds."""
    index = cKDTree(cloud[:, :2]).query(own[:, :2], NEIGHBOURS, workers=threads())[1]
    return float(np.median(np.median(cloud[index, 2], axis=1) - own[:, 2]))

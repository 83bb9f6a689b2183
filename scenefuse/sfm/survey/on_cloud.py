"""A model that GPS or control points placed, laid on a cloud of the same scene, which is more exact than either."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap
import pyproj
from scipy.spatial import cKDTree

from scenefuse.io.crs import check_place, grid_name, to_wgs84, usable
from scenefuse.io.formats import las_crs
from scenefuse.io.import_cloud import survey
from scenefuse.io.tiles.parts import columns_in_parts
from scenefuse.sfm.geodesy import LocalFrame
from scenefuse.sfm.given.fit import fit_to_cameras, misfit
from scenefuse.sfm.given.offset import cloud_from_own
from scenefuse.sfm.survey.placement import middle_of
from scenefuse.sfm.survey.residuals import Georeference
from scenefuse.stage import StageError, threads
from scenefuse.transforms import Array, Sim3, rotation_angle_deg

# Points of the cloud that the model is laid on.
MOST_COMPARED = 200_000
# ICP goes on in so many rounds of steps, until one moves no point by more than this share of the model's extent.
ROUNDS, STAYS = 10, 1e-3
# Heights are compared with those of so many points of the cloud about each of the model's, seen from above.
NEIGHBOURS = 8


def cloud_crs(cloud: Path, crs: str | None) -> pyproj.CRS:
    """The CRS of a scene's cloud: its file's, or the one that the table names.

    Raises:
        StageError: neither says one.
    """
    named = las_crs(cloud)
    if named is None and crs is None:
        raise StageError(
            f"{cloud} names no CRS, so nothing says where the photos lie in it: fill the column crs, or give the"
            " cameras of the cloud's project in the column cameras"
        )
    return usable(pyproj.CRS.from_user_input(named or crs), str(cloud))


def lay_on_cloud(
    model: pycolmap.Reconstruction, found: Georeference, cloud: Path, crs: str | None
) -> tuple[Georeference, Sim3]:
    """Move a georeferenced model in place onto a cloud: first in height, then by ICP (method M14).

    Args:
        model: in the frame of `found`.
        found: where it lies.
        cloud: of the scene, in a CRS.
        crs: the cloud's, where its file does not say it.

    Returns:
        where it lies now, with results in the cloud's CRS, and how it was moved.

    Raises:
        StageError: nothing places the model, or the cloud lies elsewhere or in no CRS.
    """
    grid = cloud_crs(cloud, crs)
    if found.frame is None or found.placement.status != "georeferenced":
        raise StageError(
            f"nothing says where the photos lie in {cloud}: {found.placement.reason}; give photos with GPS, control"
            " points (column control), or the cameras of the cloud's project (column cameras)"
        )
    sample = survey(cloud, columns_in_parts(cloud)).sample
    check_place(grid.to_wkt(), sample, cloud)
    there = in_local(sample[:: max(1, len(sample) // MOST_COMPARED)], grid, found.frame, cloud)
    own = np.array([point.xyz for point in model.points3D.values()]).reshape(-1, 3)
    _check_near(there, own, cloud)
    moved, said = Sim3.identity(), f"{found.placement.reason}; so they fit {cloud.name}"
    # Control points are as exact as a cloud, and their coordinates may well be of the same survey.
    if found.control is None or misfit(fit_to_cameras(there, model)):
        moved = _onto(there, own)
        off = moved.apply(own.mean(0)) - own.mean(0)
        turned, scaled = rotation_angle_deg(moved.rotation), 100 * (moved.scale - 1)
        said = (
            f"{found.placement.reason}; then laid on {cloud.name}, by {np.linalg.norm(off[:2]):.2f} m and"
            f" {off[2]:+.2f} m in height, {turned:.2g} degrees and {scaled:+.2g} %"
        )
        model.transform(pycolmap.Sim3d(moved.scale, pycolmap.Rotation3d(moved.rotation), moved.translation))
    frame = replace(found.frame, grid=grid_name(grid.sub_crs_list[0] if grid.is_compound else grid))
    names, positions = found.gps.names, frame.apply(found.gps.positions)
    centres = np.array([model.find_image_with_name(name).projection_center() for name in names]).reshape(-1, 3)
    placement = replace(
        found.placement,
        reason=said,
        local_from_model=moved @ found.placement.local_from_model,
        heights="measured",
        gps_shift=middle_of(positions - centres),
    )
    return replace(found, placement=placement, frame=frame), moved


def in_local(points: Array, crs: pyproj.CRS, frame: LocalFrame, where: Path) -> Array:
    """Points (N, 3) of a cloud in a CRS in a scene's frame; heights keep their zero."""
    return frame.apply(to_wgs84(crs, points, str(where)))


def _onto(cloud: Array, own: Array) -> Sim3:
    """The similarity that lays a model (M, 3) on a cloud (N, 3), from metres away: ICP until it stays."""
    moved = Sim3(1.0, np.eye(3), np.array([0.0, 0.0, _height_above(cloud, own)]))
    stays = STAYS * float(np.linalg.norm(np.ptp(own, axis=0)))
    for _ in range(ROUNDS):
        here = moved.apply(own)
        step = cloud_from_own(cloud, here)
        moved = step @ moved
        if np.linalg.norm(step.apply(here) - here, axis=1).max() < stays:
            break
    return moved


def _check_near(cloud: Array, own: Array, path: Path) -> None:
    """StageError where the model (M, 3) lies beside the cloud's box (N, 3), seen from above."""
    low, high = cloud[:, :2].min(0), cloud[:, :2].max(0)
    reach = float(np.linalg.norm(high - low))
    middle = np.median(own[:, :2], axis=0)
    off = np.maximum(np.maximum(low - middle, middle - high), 0)
    if np.linalg.norm(off) > reach:
        raise StageError(
            f"{path} lies {np.linalg.norm(off) / 1000:.3g} km from where its photos were taken; give the cloud of this"
            " scene, or correct its CRS"
        )


def _height_above(cloud: Array, own: Array) -> float:
    """How much higher a cloud (N, 3) is than a model (M, 3): GPS counts heights from another zero than most clouds."""
    index = cKDTree(cloud[:, :2]).query(own[:, :2], NEIGHBOURS, workers=threads())[1]
    return float(np.median(np.median(cloud[index, 2], axis=1) - own[:, 2]))

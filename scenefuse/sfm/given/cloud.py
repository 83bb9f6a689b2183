"""The dense cloud of another program's project, in the coordinates of the cameras that it found."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from scenefuse.io.clouds import Cloud, concatenate, spacing, write_cloud
from scenefuse.io.import_cloud import IMPORTED, clouds_in_parts, import_report, survey, write_placed
from scenefuse.io.tiles.parts import columns_in_parts
from scenefuse.io.units import length_unit
from scenefuse.stage import StageError, quantity, read_json, threads, value, write_json
from scenefuse.transforms import Array, Sim3
from scenefuse.workspace import View, posed_images, read_model, read_views, view_of, with_mask

# So many photos have to frame a point for it to count as seen; fewer confirm none (method F4).
LEAST_PHOTOS = 3
# A cloud in other coordinates than the cameras has a smaller share of its points in their pictures than this, or is
# met by a smaller share of the points that the photos' own matches give in its box. Of four right clouds 66 % were met
# or more; with mirrored or swapped axes, half a turn, or 5 % larger, 17 % or fewer.
LEAST_SEEN, LEAST_MET = 0.1, 0.2
# What is met by the cloud: within this share of the distance to the nearest camera, or within a spacing of the cloud.
NEAR = 0.002
# The cloud's box leaves out so much of it on each side; fewer points in it say that the cloud is elsewhere.
STRAY_PERCENT, LEAST_POINTS = 1.0, 10
# Points of the cloud that are projected into all photos, and that are compared with the cameras' own points.
MOST_PROJECTED, MOST_COMPARED = 10_000, 200_000
# A point of an object lies inside the masks in so many of the photos that frame it; masks are grown by this share of
# the photo's width; fewer points give no features to register by.
INSIDE, SLACK, LEAST_INSIDE = 0.9, 0.005, 200


def import_posed_cloud(
    *,
    source: Path,
    sparse: Path,
    sparse_json: Path,
    georeference_json: Path | None = None,
    workspace: Path | None = None,
    masks: Path | None = None,
    cloud: Path,
    report: Path,
) -> None:
    """Take a cloud that lies in the coordinates of given cameras, into the frame that the cameras are in now (M12).

    Args:
        source: PLY, LAS, LAZ, E57, PCD, text, or a mesh (PLY, OBJ, GLB) that points are drawn from.
        sparse: COLMAP model of the given cameras, with the points that the photos' own matches give.
        sparse_json: its JSON; where known lengths scaled the model, they scale the cloud alike.
        georeference_json: JSON of a scene, with the similarity that georeferencing moved the model by; an object's
            model stays where it is.
        workspace: undistorted COLMAP workspace of an object, for the masks.
        masks: folder of an object's masks, {photo}.png; what lies outside them is left out. None keeps all points.
        cloud: output PLY; a scene's tile by tile (`open_cloud`): however large, it is never all in memory.
        report: output JSON: points, spacing, notes, how well cloud and cameras fit, and for an object
            `object_from_file`.

    Raises:
        StageError: the file is missing, damaged, of an unknown ending, has too few different points, or lies in other
            coordinates than the cameras.
    """
    parts = columns_in_parts(source)
    own = survey(source, parts)
    given = _scaled(sparse_json)
    fit = fit_to_cameras(given.apply(own.sample), sparse)
    check_fit(source, fit)
    if georeference_json is None:
        whole = concatenate(list(clouds_in_parts(parts, own))).transformed(given)
        placed = whole if workspace is None or masks is None else _cut_out(whole, source, workspace, masks)
        write_cloud(cloud, placed)
        content = import_report(source, own, spacing(placed.points), placed.diagonal, "object units")
        content |= {"points": quantity(len(placed), "1"), "outside_masks": quantity(len(whole) - len(placed), "1")}
        content |= {"object_from_file": quantity(given.matrix, "object units")}
    else:
        moved = Sim3.from_matrix(np.array(value(read_json(georeference_json), "scene_from_sparse")))
        content = write_placed(cloud, source, parts, own, moved @ given, length_unit(georeference_json))
        content |= {"backend": quantity(IMPORTED, "")}
    write_json(report, content | fit)


def fit_to_cameras(points: Array, sparse: Path) -> dict[str, Any]:
    """How a cloud's points (N, 3) and a sparse model in its frame fit: shares, as quantities.

    `seen_share` of the points lie in the pictures of three photos or more; `met_share` of the model's own points in the
    cloud's box lie on the cloud.
    """
    model = read_model(sparse)
    views = [view_of(model, image) for image in posed_images(model)]
    own = np.array([point.xyz for point in model.points3D.values()]).reshape(-1, 3)
    seen = _seen(points[:: max(1, len(points) // MOST_PROJECTED)], views)
    met = _met(points[:: max(1, len(points) // MOST_COMPARED)], own, np.array([view.centre for view in views]))
    return {"seen_share": quantity(seen, "1"), "met_share": quantity(met, "1")}


def check_fit(source: Path, fit: dict[str, Any]) -> None:
    """StageError where a cloud lies in other coordinates than the cameras; fit: of `fit_to_cameras`."""
    seen, met = value(fit, "seen_share"), value(fit, "met_share")
    if seen < LEAST_SEEN:
        found = f"{100 * seen:.0f} % of its points are in the pictures of {LEAST_PHOTOS} photos"
    elif met < LEAST_MET:
        found = f"{100 * met:.0f} % of the points where the photos' matches meet lie on it"
    else:
        return
    raise StageError(
        f"{source} does not lie in the coordinates of the row's cameras: only {found}; export cloud and cameras in the"
        " same coordinates, with the same axes, or empty the cell cameras or the cell cloud"
    )


def inside_masks(points: Array, views: list[View]) -> NDArray[np.bool_]:
    """(N,) which points lie inside the masks of nearly all photos that frame them; views: with masks as pixels."""
    framed, inside = (np.zeros(len(points), np.int64) for _ in range(2))
    for view in views:
        rows, pixels, _ = view.visible(points)
        framed[rows] += 1
        inside[rows] += view.pixels[pixels[:, 1], pixels[:, 0]]
    return np.asarray((framed >= LEAST_PHOTOS) & (inside >= INSIDE * framed))


def _cut_out(whole: Cloud, source: Path, workspace: Path, masks: Path) -> Cloud:
    """What of an object's cloud lies inside its masks, grown by what these err at outlines."""
    views = []
    for view in read_views(workspace / "sparse"):
        path = masks / f"{Path(view.name).stem}.png"
        if path.is_file():
            side = 2 * int(np.ceil(SLACK * view.width)) + 1
            grown = cv2.dilate(with_mask(view, path).pixels, np.ones((side, side), np.uint8))
            views.append(replace(view, pixels=grown > 127))
    part = whole[inside_masks(whole.points, views)]
    if len(part) < LEAST_INSIDE:
        raise StageError(
            f"only {len(part)} of {len(whole)} points of {source} lie inside the masks in {masks}; look at masks.png"
            " beside them, and correct the clicks"
        )
    return part


def _scaled(sparse_json: Path) -> Sim3:
    """model_from_given: what known lengths did to the given cameras."""
    scale = read_json(sparse_json).get("metres_per_unit", {}).get("value")
    return Sim3(1.0 if scale is None else scale, np.eye(3), np.zeros(3))


def _seen(points: Array, views: list[View]) -> float:
    """Share of points (N, 3) that lie in enough pictures; a lens's distortion is left out."""
    count = np.zeros(len(points), np.int64)
    for view in views:
        count[view.visible(points)[0]] += 1
    return float((count >= LEAST_PHOTOS).mean())


def _met(points: Array, own: Array, centres: Array) -> float:
    """Share of a model's points (M, 3), in the box of a cloud (N, 3), that lie on it; centres (V, 3): of cameras."""
    low, high = np.percentile(points, [STRAY_PERCENT, 100 - STRAY_PERCENT], axis=0)
    own = own[((own >= low) & (own <= high)).all(1)]
    if len(own) < LEAST_POINTS:
        return 0.0
    reach = np.maximum(NEAR * cKDTree(centres).query(own)[0], spacing(points))
    return float((cKDTree(points).query(own, workers=threads())[0] <= reach).mean())

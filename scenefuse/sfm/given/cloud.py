"""The dense cloud of another program's project, in the coordinates of the cameras that it found."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pyproj
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from scenefuse.io.clouds import Cloud, concatenate, spacing, write_cloud
from scenefuse.io.crs import plane
from scenefuse.io.formats import LAS_DIMENSIONS, las_crs
from scenefuse.io.import_cloud import IMPORTED, clouds_in_parts, import_report, survey, write_placed
from scenefuse.io.tiles.parts import columns_in_parts
from scenefuse.io.units import length_unit
from scenefuse.sfm.given.offset import cloud_from_own
from scenefuse.sfm.given.place import read_place
from scenefuse.stage import StageError, quantity, read_json, threads, value, write_json
from scenefuse.transforms import Array, Sim3, fit_sim3, rotation_angle_deg
from scenefuse.workspace import View, posed_images, read_model, read_views, view_of, with_mask

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
    """Take the cloud of given cameras into the frame that these are in now (M12).

    It lies in the coordinates of the cameras, or in a CRS where their project says how they lie on the earth.

    Args:
        source: PLY, LAS, LAZ, E57, PCD, text, or a mesh (PLY, OBJ, GLB) that points are drawn from.
        sparse: COLMAP model of the given cameras, with the points that the photos' own matches give.
        sparse_json: its JSON; where known lengths scaled the model, they scale the cloud alike; it knows where the
            given cameras lie on the earth.
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
    parts = columns_in_parts(source, degrees=True)
    own = survey(source, parts, () if georeference_json is None else LAS_DIMENSIONS)
    way, fit = _way_to_cameras(source, own.sample, sparse, read_json(sparse_json))
    if georeference_json is None:
        whole = way.apply(concatenate(list(clouds_in_parts(parts, own))))
        placed = whole if workspace is None or masks is None else _cut_out(whole, source, workspace, masks)
        write_cloud(cloud, placed)
        content = import_report(source, own, spacing(placed.points), placed.diagonal, "object units")
        content |= {"points": quantity(len(placed), "1"), "outside_masks": quantity(len(whole) - len(placed), "1")}
        similar = None if way.turned_alone else way.nearest.matrix
        content |= {"object_from_file": quantity(similar, "object units")}
    else:
        moved = Sim3.from_matrix(np.array(value(read_json(georeference_json), "scene_from_sparse")))

        def move(part: Cloud) -> Cloud:
            return way.apply(part).transformed(moved)

        content = write_placed(cloud, source, parts, own, move, length_unit(georeference_json))
        content |= {"backend": quantity(IMPORTED, "")}
    write_json(report, content | fit | {"crs": quantity(way.crs, "")})


@dataclass(frozen=True)
class Way:
    """From a cloud's file to the model of its cameras.

    Attributes:
        exact: (N, 3) to (N, 3).
        nearest: the similarity that comes nearest to it over the cloud; normals turn by it.
        crs: of the file; None where it lies in the coordinates of the cameras.
        turned_alone: whether only the turn of `nearest` is one: the file is in degrees.
    """

    exact: Callable[[Array], Array]
    nearest: Sim3
    crs: str | None
    turned_alone: bool = False

    def apply(self, cloud: Cloud) -> Cloud:
        """The cloud among the cameras."""
        return replace(cloud.transformed(self.nearest), points=self.exact(cloud.points))


def _way_to_cameras(source: Path, sample: Array, sparse: Path, content: dict[str, Any]) -> tuple[Way, dict[str, Any]]:
    """How a cloud comes among its cameras, and how well it fits there (`fit_to_cameras`).

    Args:
        source: its file.
        sample: (N, 3) of its points.
        sparse: model of the cameras.
        content: of its JSON.

    Raises:
        StageError: it fits in no way.
    """
    scale = content.get("metres_per_unit", {}).get("value")
    given = Sim3(1.0 if scale is None else scale, np.eye(3), np.zeros(3))
    fit, place = fit_to_cameras(given.apply(sample), sparse), read_place(content)
    if place is None or not misfit(fit):
        check_fit(source, fit)
        return Way(given.apply, given, None), fit
    crs, place = pyproj.CRS.from_user_input(las_crs(source) or place.crs), place.after(given)

    def exact(points: Array) -> Array:
        return place.model_from(points, crs)

    fit = fit_to_cameras(exact(sample), sparse)
    check_fit(source, fit, f" nor, taken as {crs.name}, where these lie on the earth")
    print(f"{source.name} lies in {crs.name}, its cameras where their project placed them there", flush=True)
    in_degrees, name = plane(crs).is_geographic, crs.to_string()
    nearest = _turn_there(exact, np.median(sample, axis=0)) if in_degrees else fit_sim3(sample, exact(sample))
    return Way(exact, nearest, crs.name if len(name) > len(crs.name) + 20 else name, in_degrees), fit


def _turn_there(exact: Callable[[Array], Array], place: Array) -> Sim3:
    """How a change of coordinates turns directions at a place (3,), whatever it does to lengths."""
    steps = np.diag([1e-6, 1e-6, 0.1])
    along = exact(place + steps) - exact(np.stack([place] * 3))
    left, _, right = np.linalg.svd((along / np.linalg.norm(along, axis=1, keepdims=True)).T)
    return Sim3(1.0, left @ np.diag([1, 1, np.linalg.det(left @ right)]) @ right, np.zeros(3))


def fit_to_cameras(points: Array, sparse: Path) -> dict[str, Any]:
    """How a cloud's points (N, 3) and a sparse model in its frame fit: shares, as quantities.

    `seen_share` of the points lie in the pictures of three photos or more; `met_share` of the model's own points in the
    cloud's box lie on the cloud. Where that is little, how much it would be if the cloud were moved, and by what.
    """
    model = read_model(sparse)
    views = [view_of(model, image) for image in posed_images(model)]
    own = np.array([point.xyz for point in model.points3D.values()]).reshape(-1, 3)
    seen, centres = _seen(points[:: max(1, len(points) // MOST_PROJECTED)], views), np.array([v.centre for v in views])
    points = points[:: max(1, len(points) // MOST_COMPARED)]
    own = _in_box_of(points, own)
    met = _met(points, own, centres)
    content = {"seen_share": quantity(seen, "1"), "met_share": quantity(met, "1")}
    if seen < LEAST_SEEN or len(own) < LEAST_POINTS or met > USUALLY_MET:
        return content
    moved = cloud_from_own(points, own)
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

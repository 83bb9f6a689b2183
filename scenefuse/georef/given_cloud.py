"""The dense cloud of another program's project, in the coordinates of the cameras that it found."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pyproj

from scenefuse.cloud.clouds import Cloud, concatenate, spacing, write_cloud
from scenefuse.cloud.crs import plane
from scenefuse.cloud.import_cloud import IMPORTED, MIN_POINTS, ImportedFile
from scenefuse.cloud.readers.las import LAS_DIMENSIONS, las_crs
from scenefuse.core.stage import StageError, quantity, read_json, value, write_json
from scenefuse.core.transforms import Array, Sim3, fit_sim3
from scenefuse.geometry.depth_test import CONFIRMING_PHOTOS
from scenefuse.geometry.visual_hull import MAX_WRONG_SHARE, Outline, count_silhouettes
from scenefuse.georef.on_cloud import FIT, check_fit, cloud_crs, fit_to_cameras, in_local, misfit
from scenefuse.photos.cameras.given import read_place
from scenefuse.photos.geodesy import LocalFrame, length_unit, scene_frame
from scenefuse.photos.workspace import read_model, read_views, with_mask

# Masks are grown by this share of the photo's width.
MASK_MARGIN = 0.005


def import_posed_cloud(
    *,
    source: Path,
    sparse: Path | None = None,
    sparse_json: Path | None = None,
    georeference_json: Path | None = None,
    crs: str | None = None,
    workspace: Path | None = None,
    masks: Path | None = None,
    cloud: Path,
    report: Path,
) -> None:
    """Take the cloud of given cameras into the frame that these are in now (M12), or one that photos lie on (M14).

    It lies in the coordinates of the cameras, or in a CRS where their project or the scene's survey places them on the
    earth.

    Args:
        source: PLY, LAS, LAZ, E57, PCD, text, or a mesh (PLY, OBJ, glTF) that points are drawn from.
        sparse: COLMAP model of the given cameras, with the points that the photos' own matches give; None where the
            scene's photos were laid on this cloud.
        sparse_json: its JSON; where known lengths scaled the model, they scale the cloud alike; it knows where the
            given cameras lie on the earth.
        georeference_json: JSON of a scene, with the similarity that georeferencing moved the model by, or its frame; an
            object's model stays where it is.
        crs: of a cloud on which the model was laid, where its file does not say it.
        workspace: undistorted COLMAP workspace of an object, for the masks.
        masks: folder of an object's masks, {photo}.png; what lies outside them is left out. None keeps all points.
        cloud: output PLY; a scene's tile by tile (`open_cloud`): however large, it is never all in memory.
        report: output JSON: points, spacing, notes, how well cloud and cameras fit, and for an object
            `object_from_file`.

    Raises:
        StageError: the file is missing, damaged, of an unknown ending, has too few different points, or lies in other
            coordinates than the cameras.
    """
    file = ImportedFile.of(source, () if georeference_json is None else LAS_DIMENSIONS, degrees=True)
    sample = file.summary.sample
    if sparse is None or sparse_json is None:
        assert georeference_json is not None
        georeference = read_json(georeference_json)
        way, fit = _way_into_scene(source, sample, georeference, crs), {name: georeference[name] for name in FIT}
    else:
        way, fit = _way_to_cameras(source, sample, sparse, read_json(sparse_json))
    if georeference_json is None:
        whole = way.apply(concatenate(list(file.clouds())))
        placed = whole if workspace is None or masks is None else _cut_out(whole, source, workspace, masks)
        write_cloud(cloud, placed)
        content = file.report(placed.points, spacing(placed.points), placed.diagonal, "object units")
        content |= {"points": quantity(len(placed), "1"), "outside_masks": quantity(len(whole) - len(placed), "1")}
        similar = None if way.turned_alone else way.nearest.matrix
        content |= {"object_from_file": quantity(similar, "object units")}
    else:
        moved = Sim3.identity()
        if sparse is not None:
            moved = Sim3.from_matrix(np.array(value(read_json(georeference_json), "scene_from_sparse")))

        def move(part: Cloud) -> Cloud:
            return way.apply(part).transformed(moved)

        content = file.write(cloud, move, length_unit(georeference_json))
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
    model, place = read_model(sparse), read_place(content)
    fit = fit_to_cameras(given.apply(sample), model)
    if place is None or not misfit(fit):
        check_fit(source, fit)
        return Way(given.apply, given, None), fit
    crs, place = las_crs(source) or place.crs, place.after(given)

    def exact(points: Array) -> Array:
        return place.model_from(points, crs)

    fit = fit_to_cameras(exact(sample), model)
    check_fit(source, fit, f" nor, taken as {crs.name}, where these lie on the earth")
    print(f"{source.name} lies in {crs.name}, its cameras where their project placed them there", flush=True)
    in_degrees = plane(crs).is_geographic
    nearest = _turn_there(exact, np.median(sample, axis=0)) if in_degrees else fit_sim3(sample, exact(sample))
    return Way(exact, nearest, _short_name(crs), in_degrees), fit


def _way_into_scene(source: Path, sample: Array, georeference: dict[str, Any], crs: str | None) -> Way:
    """How a cloud comes into the frame of a scene whose photos were laid on it.

    Args:
        source: its file.
        sample: (N, 3) of its points.
        georeference: of the scene's JSON.
        crs: of the cloud, where its file does not say it.
    """
    known, frame = cloud_crs(source, crs), scene_frame(georeference)
    assert isinstance(frame, LocalFrame)

    def exact(points: Array) -> Array:
        return in_local(points, known, frame, source)

    return Way(exact, fit_sim3(sample, exact(sample)), _short_name(known))


def _short_name(crs: pyproj.CRS) -> str:
    """An EPSG code or the like; of a CRS that only WKT describes, its name."""
    text = crs.to_string()
    return crs.name if len(text) > len(crs.name) + 20 else text


def _turn_there(exact: Callable[[Array], Array], place: Array) -> Sim3:
    """How a change of coordinates turns directions at a place (3,), whatever it does to lengths."""
    steps = np.diag([1e-6, 1e-6, 0.1])
    along = exact(place + steps) - exact(np.stack([place] * 3))
    left, _, right = np.linalg.svd((along / np.linalg.norm(along, axis=1, keepdims=True)).T)
    return Sim3(1.0, left @ np.diag([1, 1, np.linalg.det(left @ right)]) @ right, np.zeros(3))


def _cut_out(whole: Cloud, source: Path, workspace: Path, masks: Path) -> Cloud:
    """What of an object's cloud lies inside its masks, grown by what these err at outlines."""
    views = []
    for view in read_views(workspace / "sparse"):
        path = masks / f"{Path(view.name).stem}.png"
        if path.is_file():
            side = 2 * int(np.ceil(MASK_MARGIN * view.width)) + 1
            grown = cv2.dilate(with_mask(view, path).pixels, np.ones((side, side), np.uint8))
            views.append(replace(view, pixels=grown > 127))
    shown, missed, *_ = count_silhouettes(whole.points, map(Outline, views))
    part = whole[(shown >= CONFIRMING_PHOTOS) & (missed <= MAX_WRONG_SHARE * shown)]
    if len(part) < MIN_POINTS:
        raise StageError(
            f"only {len(part)} of {len(whole)} points of {source} lie inside the masks in {masks}; look at masks.png"
            " beside them, and correct the clicks"
        )
    return part

"""The crop stage: an object's surroundings, cut out of the scene by its masks or cloud, by clicks or by fiducials."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pyproj
from scipy.spatial import cKDTree

from scenefuse.cloud.clouds import Cloud, read_cloud, spacing, write_cloud
from scenefuse.cloud.crs import to_wgs84
from scenefuse.cloud.import_cloud import MIN_POINTS
from scenefuse.cloud.tiled_cloud import TiledCloud, open_cloud
from scenefuse.core.stage import StageError, quantity, read_json, threads, value, write_json
from scenefuse.core.transforms import UP, Array, Sim3
from scenefuse.crop.crop_cloud import Crop, CropSettings, crop_cloud, whole, without_strays
from scenefuse.crop.marked import MAX_GROWTH, SceneClicks, crop_grown, locate_clicks, read_masked_views, vote
from scenefuse.geometry.surface import SAMPLED_POINTS
from scenefuse.marks.clicks import ScenePoints, read_points
from scenefuse.marks.triangulation import triangulate
from scenefuse.photos.geodesy import LocalFrame, length_unit, scene_frame
from scenefuse.photos.workspace import read_model

MIN_FIDUCIALS = 4
# Points of a scene in which an object is searched without any mark.
MAX_WHOLE_POINTS = 10_000_000


@dataclass(frozen=True)
class CropInputs:
    """Files that the crop reads."""

    scene: Path
    """Dense scene cloud (PLY), z up as the georegister stage leaves it."""
    sparse: Path | None = None
    """COLMAP model of the scene in the same frame; clicks are in its photos. None where the scene has no
    photos."""
    georeference_json: Path | None = None
    """JSON of the scene, for the unit of its lengths and the origin of an imported cloud."""
    fiducials: Path | None = None
    """Tab-separated labels (label, photo, x_px, y_px), a few pixels of one scene photo inside and outside the object;
    or clicks (point, photo, x_px, y_px) or scene points (point, x, y, z; of an imported scene in its file's
    coordinates), at least four different points on the object."""
    alignment_json: Path | None = None
    """JSON of the alignment stage, with `found` and `scene_from_object`, for the masks or the cloud."""
    workspace: Path | None = None
    """Undistorted COLMAP workspace of the object, for the masks."""
    masks: Path | None = None
    """Folder of the object's masks."""
    cloud: Path | None = None
    """The object's cloud, which was given with its cameras and has no masks: it marks the object in their place."""


@dataclass(frozen=True)
class Marks:
    """What marks the object.

    Attributes:
        mode: none, masks, cloud, clicks or fiducials.
        fiducials: (F, 3) in the scene frame: the fiducials, or the inside clicks with their depth.
    """

    mode: str
    fiducials: Array


def crop_scene(*, inputs: CropInputs, crop: Path, report: Path, settings: CropSettings) -> None:
    """Cut an object's surroundings out of the scene by its masks, by clicks in a photo or by fiducials (C1 to C5).

    Args:
        inputs: the scene, and what marks the object in it.
        crop: output PLY, the scene's points on the object.
        report: output JSON: what marked it, box, gravity, ground, counts.
        settings: see CropSettings.

    Raises:
        StageError: nothing marks the object, the marks are wrong or contradict each other, or too few points are left.
    """
    scene = open_cloud(inputs.scene)
    near, cut, marks = crop_of(scene, inputs, settings)
    part = near[cut.keep]
    write_cloud(crop, part)
    unit = length_unit(inputs.georeference_json)
    known = {} if inputs.georeference_json is None else read_json(inputs.georeference_json)
    about = {
        "mode": quantity(marks.mode, ""),
        # What says which way is up in the scene; None where that is not known.
        "up_cue": quantity(known.get("up_cue", {}).get("value"), ""),
        "fiducials": quantity(marks.fiducials, unit),
    }
    write_json(report, about | _report(len(scene), part, cut, unit))


def crop_of(scene: TiledCloud, inputs: CropInputs, settings: CropSettings) -> tuple[Cloud, Crop, Marks]:
    """The part of the scene that was read, and the crop of it by what marks the object, in this order: masks (or the
    object's own cloud) where photos are linked, then the user's file."""
    alignment = None if inputs.alignment_json is None else read_json(inputs.alignment_json)
    found = alignment is not None and value(alignment, "found")
    unmarked = inputs.cloud is not None and not found and inputs.fiducials is None
    if settings.whole_scene or unmarked:
        if len(scene) > MAX_WHOLE_POINTS:
            raise StageError(
                f"nothing marks the object, and the scene has {len(scene)} points; without marks it is searched in at"
                f" most {MAX_WHOLE_POINTS}: mark it (column fiducials of the objects table)"
            )
        near = scene.read(np.arange(len(scene.low)))[1]
        cut = whole(near)
        print(cut.notes[0], flush=True)
        return near, cut, Marks("none", np.zeros((0, 3)))
    if settings.mode != "masks" or alignment is None:
        return crop_by_file(scene, inputs, settings)
    if found or inputs.fiducials is None:
        return crop_linked(scene, inputs, settings)
    near, cut, marks = crop_by_file(scene, inputs, settings)
    note = (
        f"marked by {inputs.fiducials}: shared features give no alignment of the object with the scene"
        f" ({value(alignment, 'reason')})"
    )
    print(note, flush=True)
    return near, replace(cut, notes=[note, *cut.notes]), marks


def around_marks(marks: Array, settings: CropSettings, extents: float = 1.0) -> tuple[Array, Array]:
    """Corners (3,) of the part of a scene that a crop around marks (F, 3) depends on, its ground included.

    It is as wide as the marks' box, its margin, and so many of its diagonals on each side, and of any height.
    """
    low, high = marks.min(0), marks.max(0)
    across = (settings.margin + extents) * float(np.linalg.norm(high - low))
    reach = np.array([across, across, np.inf])
    return low - reach, high + reach


def crop_by_file(scene: TiledCloud, inputs: CropInputs, settings: CropSettings) -> tuple[Cloud, Crop, Marks]:
    """The crop by labels in photos of the scene (`crop_grown`) or by fiducials (`crop_marked`), and the part read."""
    names, points, clicks = _located(scene, inputs, settings)
    assert inputs.fiducials is not None
    if clicks is None:
        near = scene.near(*around_marks(points, settings))[1]
        return near, crop_marked(near, names, points, UP, settings, inputs.fiducials), Marks("fiducials", points)
    # The crop grows, and looks for ground around what it has become.
    near = scene.near(*around_marks(points, settings, 2 * MAX_GROWTH))[1]
    cut = crop_grown(near, points, replace(settings, minimal=False), clicks.other(near.points))
    cut = replace(cut, notes=[*clicks.left_out, *cut.notes])
    _announce(cut, str(inputs.fiducials))
    return near, cut, Marks("clicks", points)


def _located(
    scene: TiledCloud, inputs: CropInputs, settings: CropSettings
) -> tuple[list[str], Array, SceneClicks | None]:
    """Names and positions (F, 3) in the scene frame of what the user's file marks; of labels, all that they say."""
    if inputs.fiducials is None:
        raise StageError("cropping by fiducials needs --fiducials; give them, or mode masks and its files")
    if inputs.sparse is None:
        return *points_in(inputs.fiducials, inputs.georeference_json), None
    marked = read_points(inputs.fiducials)
    if isinstance(marked, ScenePoints):
        frame, given = _frame_of_cloud(inputs.georeference_json), marked.positions
        if frame is not None:
            given = frame.apply(to_wgs84(pyproj.CRS.from_user_input(frame.crs), given, str(inputs.fiducials)))
        return marked.points, given, None
    if marked.kind == "labels":
        found = locate_clicks(marked, inputs.sparse, scene)
        return found.names, found.inside, found
    return *triangulate(marked, read_model(inputs.sparse), settings.max_residual_px)[:2], None


def _frame_of_cloud(georeference_json: Path | None) -> LocalFrame | None:
    """The frame of a scene whose photos were laid on its cloud, in whose coordinates a user's points are; else None."""
    content = {} if georeference_json is None else read_json(georeference_json)
    frame = scene_frame(content) if "laid_on_cloud_by" in content else None
    return frame if isinstance(frame, LocalFrame) else None


def points_in(fiducials: Path, georeference_json: Path | None) -> tuple[list[str], Array]:
    """Names and positions (F, 3), in the scene's frame, of fiducials in the coordinates of an imported cloud.

    Raises:
        StageError: the file is missing or not well formed, or holds clicks in photos.
    """
    marked = read_points(fiducials)
    if not isinstance(marked, ScenePoints):
        raise StageError(
            f"{fiducials} holds clicks in photos, and the scene is a cloud without photos; give points as 'point x y z'"
            " in the cloud's coordinates"
        )
    frame = None if georeference_json is None else scene_frame(read_json(georeference_json))
    origin = np.zeros(3) if frame is None else frame.in_crs(np.zeros((1, 3)))[0]
    return marked.points, marked.positions - origin


def crop_linked(scene: TiledCloud, inputs: CropInputs, settings: CropSettings) -> tuple[Cloud, Crop, Marks]:
    """The crop around what the object's photos or its own cloud mark through the alignment, and the part of the scene
    that was read; checked by the fiducials or clicks where there are some.

    Marks are the scene points that the object's masks vote for, and its SfM points (C3); or points of its own cloud.

    Raises:
        StageError: a file is missing, the alignment has no pose, the masks mark nothing, or the fiducials mark
            something else.
    """
    assert inputs.alignment_json is not None
    pose, other, notes = _alignment(inputs.alignment_json), None, tuple[str, ...]()
    if inputs.cloud is not None:
        mode, source, by = "cloud", inputs.cloud, "the object's own cloud"
        own = without_strays(read_cloud(inputs.cloud).points)
        marks = pose.apply(own[:: max(1, len(own) // SAMPLED_POINTS)])
        near = scene.near(*around_marks(marks, settings))[1]
    else:
        assert inputs.workspace is not None and inputs.masks is not None
        mode, source, by = "masks", inputs.masks, f"the votes of {inputs.masks}"
        masked = read_masked_views(inputs.workspace, inputs.masks, settings.min_votes)
        own, sight = pose.apply(masked.own), masked.sight(pose)
        low, high = around_marks(own, settings)
        near = scene.near(np.minimum(low, sight.min(0)), np.maximum(high, sight.max(0)))[1]
        voted, other = vote(near.points, masked, pose, settings.min_votes)
        print(f"{voted.sum()} of {len(scene)} scene points by the votes of the masks", flush=True)
        marks, notes = np.concatenate([near.points[voted], own]), masked.notes
    cut = crop_cloud(near, marks, UP, settings, other)
    points, clicked = _checked(scene, inputs, settings, cut)
    by = f"marked by {by} through the alignment from shared features"
    cut = replace(cut, notes=[by, *notes, *clicked, *cut.notes])
    _announce(cut, str(source))
    return near, cut, Marks(mode, points)


def _checked(scene: TiledCloud, inputs: CropInputs, settings: CropSettings, cut: Crop) -> tuple[Array, list[str]]:
    """The fiducials or clicks (F, 3) that check a crop, none where no file is given, and what they say."""
    if inputs.fiducials is None:
        return np.zeros((0, 3)), []
    names, points, clicks = _located(scene, inputs, settings)
    notes = [] if clicks is None else clicks.left_out
    return points, [*notes, *_check_inside(names, points, cut, inputs.fiducials)]


def _check_inside(names: list[str], points: Array, cut: Crop, path: Path) -> list[str]:
    """Names the fiducials (F, 3) off the box that the object is in; StageError when all are."""
    level = points @ cut.level_from_scene.T
    off = ((level < cut.low) | (level > cut.high)).any(axis=1)
    outside = [names[k] for k in np.flatnonzero(off)]
    if len(outside) == len(names):
        raise StageError(
            f"all {len(names)} marks of {path} lie outside the box that marks the object in the scene: either they are"
            " on something else, or the alignment from shared features is wrong; correct them, or set"
            " registration.crop.mode to fiducials"
        )
    if not outside:
        return []
    return [f"{len(outside)} of {len(names)} marks of {path} lie outside the box: {', '.join(outside)}"]


def _alignment(path: Path) -> Sim3:
    """scene_from_object of an alignment's JSON; StageError where it has none."""
    alignment = read_json(path)
    if not value(alignment, "found"):
        raise StageError(
            "shared features give no alignment of the object with the scene"
            f" ({value(alignment, 'reason')}; see {path}): if one of the scene's photos shows the object, click on it"
            f" there (scenefuse pick --object {path.parent.name}, key t; column fiducials of the objects table), or add"
            " photos of the object that show its surroundings too, from as far away as the scene's"
        )
    return Sim3.from_matrix(np.array(value(alignment, "scene_from_object")))


def crop_marked(
    scene: Cloud, names: list[str], fiducials: Array, up: Array, settings: CropSettings, path: Path
) -> Crop:
    """`crop_cloud` for fiducials that a person marked in the file `path`: checked, and the notes printed.

    Raises:
        StageError: fewer than four fiducials, one far from every scene point, or too few points in the box.
    """
    if (different := len(np.unique(fiducials, axis=0))) < MIN_FIDUCIALS:
        raise StageError(f"{path} gives {different} fiducials; an object needs at least 4 different points on it")
    _check_near(names, fiducials, scene, path)
    cut = crop_cloud(scene, fiducials, up, settings)
    _announce(cut, str(path))
    return cut


def _announce(cut: Crop, source: str) -> None:
    """Print the notes; StageError when too little is left."""
    for note in cut.notes:
        print(note, flush=True)
    if cut.keep.sum() < MIN_POINTS:
        raise StageError(
            f"only {cut.keep.sum()} scene points are left in the box of {source}, {MIN_POINTS} are"
            " needed: the scene may not show the object, or a fiducial or mask may not lie on it; where the scene's"
            " photos show it small, raise scene.depth_maps.max_image_size_px or set scene.dense_cloud.min_photos to 2"
        )


def _check_near(names: list[str], points: Array, cloud: Cloud, path: Path) -> None:
    """StageError for a fiducial far from everything the scene shows: a wrong click."""
    diagonal = float(np.linalg.norm(np.ptp(points, axis=0)))
    distance = cKDTree(cloud.points).query(points, workers=threads())[0]
    worst = int(distance.argmax())
    if distance[worst] > max(0.5 * diagonal, 10 * spacing(cloud.points)):
        raise StageError(
            f"fiducial {names[worst]} of {path} lies {distance[worst]:.3g} from the nearest scene point, and the"
            f" fiducials span {diagonal:.3g}: check its clicks or coordinates"
        )


def _report(scene_points: int, part: Cloud, cut: Crop, unit: str) -> dict[str, object]:
    """The stage JSON of a crop."""
    return {
        "level_from_scene": quantity(cut.level_from_scene, ""),
        "box_low": quantity(cut.low, unit),
        "box_high": quantity(cut.high, unit),
        "scene_points": quantity(scene_points, "1"),
        "crop_points": quantity(len(part), "1"),
        "diagonal": quantity(part.diagonal, unit),
        "spacing": quantity(spacing(part.points), unit),
        "ground_points": quantity(int(cut.on_ground.sum()), "1"),
        "notes": quantity(cut.notes, ""),
    }

"""The crop stage: an object's surroundings, cut out of the scene by its fiducials or by its masks."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from scenefuse.io.clouds import Cloud, read_cloud, spacing, write_cloud
from scenefuse.io.units import length_unit
from scenefuse.registration.crop.crop_cloud import Crop, CropSettings, crop_cloud, whole
from scenefuse.registration.crop.parts import MIN_PART, parts
from scenefuse.registration.crop.vote import Votes, vote
from scenefuse.sfm.fiducials import ScenePoints, locate, read_points
from scenefuse.sfm.geodesy import scene_frame
from scenefuse.stage import StageError, quantity, read_json, threads, value, write_json
from scenefuse.transforms import Array, Sim3

UP = np.array([0.0, 0.0, 1.0])
# Fewer points than this give no features to register by.
MIN_POINTS = 200
MIN_FIDUCIALS = 4


@dataclass(frozen=True)
class CropInputs:
    """Files that the crop reads."""

    scene: Path
    """Dense scene cloud (PLY), z up as the georegister stage leaves it."""
    sparse: Path | None = None
    """COLMAP model of the scene in the same frame; clicked fiducials are triangulated in it. None where the scene was
    given as a cloud."""
    georeference_json: Path | None = None
    """JSON of the scene, for the unit of its lengths and the origin of an imported cloud."""
    fiducials: Path | None = None
    """Tab-separated clicks (point, photo, x_px, y_px) or scene points (point, x, y, z; of an imported scene in its
    file's coordinates), at least four different points on the object; mode fiducials."""
    alignment_json: Path | None = None
    """JSON of the alignment stage, with `scene_from_object`; mode masks."""
    workspace: Path | None = None
    """Undistorted COLMAP workspace of the object; mode masks."""
    masks: Path | None = None
    """Folder of the object's masks; mode masks."""


def crop_scene(*, inputs: CropInputs, crop: Path, report: Path, settings: CropSettings) -> None:
    """Cut an object's surroundings out of the scene by its fiducials or its masks (method C1 to C4).

    Args:
        inputs: the scene, and what marks the object in it.
        crop: output PLY, the scene's points on the object.
        report: output JSON: box, gravity, ground, counts.
        settings: see CropSettings.

    Raises:
        StageError: fewer than four fiducials, one far from every scene point, too few points in the box, or neither
            fiducials nor a pose of the object from the alignment.
    """
    scene, mode = read_cloud(inputs.scene), "none" if settings.whole_scene else settings.mode
    fiducials, voted = np.zeros((0, 3)), 0
    if mode == "none":
        cut = whole(scene)
        print(cut.notes[0], flush=True)
    elif mode == "masks":
        cut, voted = crop_by_masks(scene, inputs, settings)
    else:
        cut, fiducials = crop_by_fiducials(scene, inputs, settings)
    part = scene[cut.keep]
    write_cloud(crop, part)
    unit = length_unit(inputs.georeference_json)
    marks = {"fiducials": quantity(fiducials, unit), "voted_points": quantity(voted, "1")}
    write_json(report, {"mode": quantity(mode, "")} | marks | _report(scene, part, cut, unit))


def crop_by_fiducials(scene: Cloud, inputs: CropInputs, settings: CropSettings) -> tuple[Crop, Array]:
    """`crop_marked` with the fiducials of a file; these, (F, 3) in the scene frame."""
    if inputs.fiducials is None:
        raise StageError("cropping by fiducials needs --fiducials; give them, or mode masks")
    if inputs.sparse is None:
        names, points = points_in(inputs.fiducials, inputs.georeference_json)
    else:
        names, points, _ = locate(inputs.fiducials, inputs.sparse, settings.max_residual_px)
    return crop_marked(scene, names, points, UP, settings, inputs.fiducials), points


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


def crop_by_masks(scene: Cloud, inputs: CropInputs, settings: CropSettings) -> tuple[Crop, int]:
    """`crop_cloud` around the scene points that the object's masks vote for, and its SfM points; and their number (C3).

    Raises:
        StageError: a file is missing, the alignment has no pose, or the masks mark nothing.
    """
    if inputs.alignment_json is None or inputs.workspace is None or inputs.masks is None:
        raise StageError(
            "cropping by masks needs --alignment-json, --workspace and --masks; give them, or mode fiducials"
        )
    votes = votes_of(scene, inputs.alignment_json, inputs.workspace, inputs.masks, settings)
    cut = crop_cloud(scene, np.concatenate([scene.points[votes.object], votes.own]), UP, settings, votes.other)
    note = f"marked by the votes of {inputs.masks} through the alignment from shared features, not by fiducials"
    cut = replace(cut, notes=[note, *cut.notes])
    _announce(cut, str(inputs.masks))
    return cut, int(votes.object.sum())


def votes_of(scene: Cloud, alignment_json: Path, workspace: Path, masks: Path, settings: CropSettings) -> Votes:
    """The masks' votes on the scene's points, without loose parts among those that they vote for.

    Raises:
        StageError: the alignment has no pose, or too few photos have a mask.
    """
    alignment = read_json(alignment_json)
    if not value(alignment, "found"):
        raise StageError(
            "there are no fiducials, and shared features give no alignment of the object with the scene"
            f" ({value(alignment, 'reason')}; see {alignment_json}): click at least four points on it in the scene's"
            " photos and name the file in the column fiducials of the objects table, or add photos of the object that"
            " show its surroundings too, from as far away as the scene's"
        )
    pose = Sim3.from_matrix(np.array(value(alignment, "scene_from_object")))
    votes = vote(scene.points, workspace, masks, pose, settings.min_votes)
    chosen = np.flatnonzero(votes.object)
    if len(chosen) > 1:
        part_of, counts = parts(scene.points[chosen], 3 * spacing(scene.points[chosen]))
        chosen = chosen[(counts >= MIN_PART * len(chosen))[part_of]]
    print(f"{len(chosen)} of {len(scene)} scene points by the votes of the masks", flush=True)
    return replace(votes, object=np.isin(np.arange(len(scene)), chosen))


def crop_marked(
    scene: Cloud, names: list[str], fiducials: Array, up: Array, settings: CropSettings, path: Path
) -> Crop:
    """`crop_cloud` for fiducials that a person marked in the file `path`: checked, and the notes printed.

    Raises:
        StageError: fewer than four fiducials, one far from every scene point, or too few points in the box.
    """
    if len(fiducials) < MIN_FIDUCIALS:
        raise StageError(f"{path} gives {len(fiducials)} fiducials; an object needs at least 4 different points on it")
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
            f"only {cut.keep.sum()} scene points are left in the {cut.shape} of {source}, {MIN_POINTS} are"
            " needed: the scene may not show the object, or a fiducial or mask may not lie on it"
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


def _report(scene: Cloud, part: Cloud, cut: Crop, unit: str) -> dict[str, object]:
    """The stage JSON of a crop."""
    ground = cut.ground
    return {
        "shape": quantity(cut.shape, ""),
        "up_in_scene": quantity(UP, ""),
        "level_from_scene": quantity(cut.level_from_scene, ""),
        "box_low": quantity(cut.low, unit),
        "box_high": quantity(cut.high, unit),
        "scene_points": quantity(len(scene), "1"),
        "box_points": quantity(int(cut.in_box.sum()), "1"),
        "crop_points": quantity(len(part), "1"),
        "diagonal": quantity(part.diagonal, unit),
        "spacing": quantity(spacing(part.points), unit),
        "ground_removed": quantity(bool(cut.on_ground.any()), ""),
        "ground_points": quantity(int(cut.on_ground.sum()), "1"),
        "ground_coefficients": quantity(None if ground is None else ground.coefficients, unit),
        "ground_centre": quantity(None if ground is None else ground.centre, unit),
        "ground_tolerance": quantity(None if ground is None else ground.tolerance, unit),
        "notes": quantity(cut.notes, ""),
    }

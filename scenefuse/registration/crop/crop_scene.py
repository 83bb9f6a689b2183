"""The scene around an object: a box or hull upright to gravity, with the ground and loose parts removed."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import QhullError, cKDTree

from scenefuse.io.clouds import Cloud, read_cloud, spacing, write_cloud
from scenefuse.io.units import length_unit
from scenefuse.registration.crop.shapes import in_wide_hull, least_footprint
from scenefuse.registration.crop.vote import Votes, vote
from scenefuse.sfm.fiducials import locate
from scenefuse.sfm.ground import Ground, fit_ground
from scenefuse.stage import StageError, quantity, read_json, setting, threads, value, write_json
from scenefuse.transforms import Array, Sim3, rotation_between

UP = np.array([0.0, 0.0, 1.0])
# Shares of the diagonal of the fiducials' box.
MARGIN_FRACTION = 0.04  # widening of the box beside `margin`: two pairing distances of the registration
RING_FRACTION = 0.5  # width of the ring around the box in which the ground is looked for
GROUND_FRACTION = 0.015  # points lower than this above the ground are ground
LINK_FRACTION = 0.03  # points closer than this belong to one part
REACH_FRACTION = 0.05  # a part this near to a fiducial belongs to the object
# Parts with a smaller share of the points are left out.
MIN_PART = 0.01
# Fewer points than this give no features to register by.
MIN_POINTS = 200
MIN_FIDUCIALS = 4


@dataclass(frozen=True)
class CropSettings:
    """Settings of the crop."""

    mode: Literal["fiducials", "masks"] = setting("fiducials")
    """What marks the object in the scene: fiducials, or its masks, seen through the alignment from shared features (in
    any case for objects without fiducials)."""
    shape: Literal["box", "oriented", "hull"] = setting("box")
    """The fiducials' box, the same turned about the vertical to their least footprint, or their convex hull."""
    margin: float = setting(0.05, least=0)
    """Widening of the box on every side, as a share of its own extent."""
    remove_ground: bool = setting(True)
    """Whether the ground is fitted around the box and removed inside."""
    max_residual_px: float = setting(5, unit="px", least=0)
    """Clicks of one fiducial may miss each other by this much, RMS, in pixels of the photos."""
    min_votes: float = setting(0.8, above=0, most=1)
    """Share of the object's photos showing a scene point that must have it inside their mask; mode masks only."""
    whole_scene: bool = False
    """Keep the whole scene, whatever the mode: the ablation without cropping."""


@dataclass(frozen=True)
class CropInputs:
    """Files that the crop reads."""

    scene: Path
    """Dense scene cloud (PLY), z up as the georegister stage leaves it."""
    sparse: Path
    """COLMAP model of the scene in the same frame; clicked fiducials are triangulated in it."""
    georeference_json: Path | None = None
    """JSON of the scene, for the unit of its lengths."""
    fiducials: Path | None = None
    """Tab-separated clicks (point, photo, x_px, y_px) or scene points (point, x, y, z), at least four different points
    on the object; mode fiducials."""
    alignment_json: Path | None = None
    """JSON of the alignment stage, with `scene_from_object`; mode masks."""
    workspace: Path | None = None
    """Undistorted COLMAP workspace of the object; mode masks."""
    masks: Path | None = None
    """Folder of the object's masks; mode masks."""


@dataclass(frozen=True)
class Crop:
    """What was cut out and how.

    Attributes:
        keep: (N,) bool over the scene's points, True on the object.
        in_box: (N,) bool, True for all points in the box or hull, ground included.
        shape: box, oriented or hull: what was cut out; None for the whole scene.
        level_from_scene: (3, 3) rotation that turns the scene's up into z, and the box's sides into x and y.
        low: (3,) least corner of the box (around the hull) in the level frame.
        high: (3,) greatest corner.
        ground: the fitted ground, or None.
        notes: what was not done and why.
    """

    keep: NDArray[np.bool_]
    in_box: NDArray[np.bool_]
    shape: str | None
    level_from_scene: Array
    low: Array
    high: Array
    ground: Ground | None
    notes: list[str]


@dataclass(frozen=True)
class Marks:
    """What marks the object.

    Attributes:
        fiducials: (F, 3) in the scene frame; none where masks mark it.
        voted: scene points that the masks vote for.
    """

    fiducials: Array
    voted: int = 0


NO_MARKS = Marks(np.zeros((0, 3)))


def crop_scene(*, inputs: CropInputs, crop: Path, report: Path, settings: CropSettings) -> None:
    """Cut an object's surroundings out of the scene by its fiducials or its masks (method C1 to C3).

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
    if mode == "none":
        cut, marks = whole(scene), NO_MARKS
    elif mode == "masks":
        cut, marks = crop_by_masks(scene, inputs, settings)
    else:
        cut, marks = crop_by_fiducials(scene, inputs, settings)
    part = scene[cut.keep]
    write_cloud(crop, part)
    write_json(report, _report(scene, part, cut, marks, mode, length_unit(inputs.georeference_json)))


def whole(scene: Cloud) -> Crop:
    """The whole scene as a crop."""
    everything = np.ones(len(scene), dtype=bool)
    return Crop(everything, everything, None, np.eye(3), scene.points.min(0), scene.points.max(0), None, [])


def crop_by_fiducials(scene: Cloud, inputs: CropInputs, settings: CropSettings) -> tuple[Crop, Marks]:
    """`crop_marked` with the fiducials of a file."""
    if inputs.fiducials is None:
        raise StageError("cropping by fiducials needs --fiducials; give them, or mode masks")
    names, points, _ = locate(inputs.fiducials, inputs.sparse, settings.max_residual_px)
    return crop_marked(scene, names, points, UP, settings, inputs.fiducials), Marks(points)


def crop_by_masks(scene: Cloud, inputs: CropInputs, settings: CropSettings) -> tuple[Crop, Marks]:
    """`crop_cloud` around the scene points that the object's masks vote for, and its SfM points (C3).

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
    return cut, Marks(NO_MARKS.fiducials, int(votes.object.sum()))


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
        part_of, counts = _parts(scene.points[chosen], 3 * spacing(scene.points[chosen]))
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
    if cut.keep.sum() < MIN_POINTS:
        raise StageError(
            f"only {cut.keep.sum()} scene points are left in the {cut.shape} of {source}, {MIN_POINTS} are"
            " needed: the scene may not show the object, or a fiducial or mask may not lie on it"
        )
    for note in cut.notes:
        print(note, flush=True)


def crop_cloud(
    scene: Cloud, fiducials: Array, up: Array, settings: CropSettings, other: NDArray[np.bool_] | None = None
) -> Crop:
    """The points of a scene that belong to the object marked by fiducials (F, 3), without those known to be `other`."""
    level, shape = rotation_between(up, np.array([0.0, 0.0, 1.0])), settings.shape
    notes: list[str] = []
    if shape == "oriented":
        level = least_footprint(fiducials @ level.T) @ level
    points, marks = scene.points @ level.T, fiducials @ level.T
    extent = np.ptp(marks, axis=0)
    diagonal = float(np.linalg.norm(extent))
    margin = settings.margin * extent + MARGIN_FRACTION * diagonal
    low, high = marks.min(0) - margin, marks.max(0) + margin
    ground = None
    if settings.remove_ground:
        ground = fit_ground(points, low, high, RING_FRACTION * diagonal, GROUND_FRACTION * diagonal)
        if ground is None:
            notes.append("no ground was found around the box: nothing was removed as ground")
        else:
            # Fiducials are clicked where the scene shows the object; what it stands on bounds it below.
            corners = np.array([[x, y] for x in (low[0], high[0]) for y in (low[1], high[1])])
            low[2] = min(low[2], ground.height(corners).min() - GROUND_FRACTION * diagonal)
    in_box = ((points >= low) & (points <= high)).all(1)
    if shape == "hull":
        try:
            in_box[in_box] = in_wide_hull(points[in_box], marks, low[2], margin)
        except QhullError:
            shape = "box"
            notes.append("the fiducials lie in one vertical plane and span no hull: their box was cut out instead")
    above = in_box.copy()
    if ground is not None:
        above &= points[:, 2] > ground.height(points[:, :2]) + ground.tolerance
    if other is not None:
        above &= ~other
    keep = above.copy()
    inside = np.flatnonzero(above)
    if len(inside):
        link = max(LINK_FRACTION * diagonal, 3 * spacing(points[inside]))
        near = _parts_near(points[inside], marks, link, REACH_FRACTION * diagonal)
        if near.any():
            keep[inside] = near
        else:
            notes.append("no part in the box lies near a fiducial: all of them were kept")
    return Crop(keep, in_box, shape, level, low, high, ground, notes)


def _parts(points: Array, link: float) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """The connected part of each point, of points closer than about `link`, and how many points each part has."""
    cells, cell_of = np.unique(np.floor(points / link).astype(np.int64), axis=0, return_inverse=True)
    touching = cKDTree(cells).query_pairs(1.8, output_type="ndarray")
    graph = coo_matrix((np.ones(len(touching)), touching.T), shape=(len(cells), len(cells)))
    part_of = connected_components(graph, directed=False)[1][cell_of.ravel()]
    return part_of, np.bincount(part_of)


def _parts_near(points: Array, marks: Array, link: float, reach: float) -> NDArray[np.bool_]:
    """Which points belong to a large enough part that a fiducial touches or that mostly lies between fiducials.

    The second counts for parts no one clicked, a wall under a roof for instance: half their points in the fiducials'
    own box, seen from above.
    """
    part_of, counts = _parts(points, link)
    touched = np.bincount(part_of, cKDTree(marks).query(points, workers=threads())[0] <= reach) > 0
    low, high = marks.min(0)[:2], marks.max(0)[:2]
    between = np.bincount(part_of, ((points[:, :2] >= low) & (points[:, :2] <= high)).all(1))
    wanted = (counts >= MIN_PART * len(points)) & (touched | (between >= 0.5 * counts))
    return wanted[part_of]


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


def _report(scene: Cloud, part: Cloud, cut: Crop, marks: Marks, mode: str, unit: str) -> dict[str, object]:
    """The stage JSON of a crop."""
    ground = cut.ground
    return {
        "mode": quantity(mode, ""),
        "shape": quantity(cut.shape, ""),
        "up_in_scene": quantity(UP, ""),
        "level_from_scene": quantity(cut.level_from_scene, ""),
        "box_low": quantity(cut.low, unit),
        "box_high": quantity(cut.high, unit),
        "fiducials": quantity(marks.fiducials, unit),
        "voted_points": quantity(marks.voted, "1"),
        "scene_points": quantity(len(scene), "1"),
        "box_points": quantity(int(cut.in_box.sum()), "1"),
        "crop_points": quantity(len(part), "1"),
        "diagonal": quantity(part.diagonal, unit),
        "spacing": quantity(spacing(part.points), unit),
        "ground_removed": quantity(ground is not None, ""),
        "ground_coefficients": quantity(None if ground is None else ground.coefficients, unit),
        "ground_centre": quantity(None if ground is None else ground.centre, unit),
        "ground_tolerance": quantity(None if ground is None else ground.tolerance, unit),
        "notes": quantity(cut.notes, ""),
    }

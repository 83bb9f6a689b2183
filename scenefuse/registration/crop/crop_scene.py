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
from scenefuse.registration.crop.ground import Ground, fit_ground
from scenefuse.registration.crop.shapes import in_wide_hull, least_footprint
from scenefuse.registration.crop.vote import Votes, vote
from scenefuse.sfm.fiducials import locate
from scenefuse.stage import StageError, quantity, read_json, setting, threads, value, write_json
from scenefuse.transforms import Array, Sim3, rotation_between


@dataclass(frozen=True)
class CropSettings:
    """Settings of the crop. Shares are of the diagonal of the fiducials' box."""

    shape: Literal["box", "oriented", "hull"] = setting("box")
    """The fiducials' box, the same turned about the vertical to their least footprint, or their convex hull."""
    margin: float = setting(0.05, least=0)
    """Widening of the box on every side, as a share of its own extent."""
    margin_fraction: float = setting(0.04, unit="of the diagonal", least=0)
    """Further widening on every side, as a share of the diagonal (two voxels of the registration)."""
    remove_ground: bool = setting(True)
    """Whether the ground is fitted around the box and removed inside."""
    ring_fraction: float = setting(0.5, unit="of the diagonal", least=0)
    """Width of the ring around the box in which the ground is looked for, as a share of the diagonal."""
    ground_fraction: float = setting(0.015, unit="of the diagonal", least=0)
    """Points lower than this above the ground are ground, as a share of the diagonal."""
    link_fraction: float = setting(0.03, unit="of the diagonal", least=0)
    """Points closer than this belong to one part, as a share of the diagonal."""
    reach_fraction: float = setting(0.05, unit="of the diagonal", least=0)
    """A part this near to a fiducial belongs to the object, as a share of the diagonal."""
    min_part: float = setting(0.01, least=0)
    """Parts with a smaller share of the points are left out."""
    min_points: int = setting(200, least=0)
    """Fewest points a crop may have."""
    max_residual_px: float = setting(5, unit="px", least=0)
    """Clicks of one fiducial may miss each other by this much, RMS, in pixels of the photos."""
    min_votes: float = setting(0.8, above=0, most=1)
    """Share of the object's photos showing a scene point that must have it inside their mask; mode masks only."""


@dataclass(frozen=True)
class Crop:
    """What was cut out and how.

    Attributes:
        keep: (N,) bool over the scene's points, True on the object.
        in_box: (N,) bool, True for all points in the box or hull, ground included.
        shape: box, oriented or hull: what was cut out.
        level_from_scene: (3, 3) rotation that turns the scene's up into z, and the box's sides into x and y.
        low: (3,) least corner of the box (around the hull) in the level frame.
        high: (3,) greatest corner.
        ground: the fitted ground, or None.
        notes: what was not done and why.
    """

    keep: NDArray[np.bool_]
    in_box: NDArray[np.bool_]
    shape: str
    level_from_scene: Array
    low: Array
    high: Array
    ground: Ground | None
    notes: list[str]


def crop_scene(
    *,
    scene: Path,
    model: Path,
    georeference: Path | None = None,
    fiducials: Path | None = None,
    alignment: Path | None = None,
    cameras: Path | None = None,
    masks: Path | None = None,
    crop: Path,
    report: Path,
    mode: Literal["fiducials", "masks", "none"],
    settings: CropSettings,
) -> None:
    """Cut an object's surroundings out of the scene by its fiducials or its masks (method C1 to C3).

    Args:
        scene: dense scene cloud (PLY), z up as the georegister stage leaves it.
        model: COLMAP model of the scene in the same frame; clicked fiducials are triangulated in it.
        georeference: JSON of the scene, for the unit of its lengths, or nothing.
        fiducials: tab-separated clicks (point, photo, x_px, y_px) or scene points (point, x, y, z), at least four
            different points on the object; mode fiducials.
        alignment: JSON of the alignment stage, with `scene_from_object`; mode masks.
        cameras: undistorted COLMAP workspace of the object; mode masks.
        masks: folder of the object's masks; mode masks.
        crop: output PLY, the scene's points on the object.
        report: output JSON: box, gravity, ground, counts.
        mode: fiducials; masks, by whose votes the scene's points are picked; or none, which keeps the whole scene (the
            ablation without cropping).
        settings: see CropSettings.

    Raises:
        StageError: fewer than four fiducials, one far from every scene point, too few points in the box, or neither
            fiducials nor a pose of the object from the alignment.
    """
    cloud, unit = read_cloud(scene), length_unit(georeference)
    up = np.array([0.0, 0.0, 1.0])
    if mode == "none":
        write_cloud(crop, cloud)
        write_json(report, _report(cloud, cloud, None, None, up, mode, unit))
        return
    voted = 0
    if mode == "masks":
        if alignment is None or cameras is None or masks is None:
            raise StageError("cropping by masks needs --alignment, --cameras and --masks; give them, or mode fiducials")
        votes = votes_of(cloud, alignment, cameras, masks, settings)
        points, voted = np.concatenate([cloud.points[votes.object], votes.own]), int(votes.object.sum())
        cut = crop_cloud(cloud, points, up, settings, votes.other)
        marked = f"marked by the votes of {masks} through the alignment from shared features, not by fiducials"
        cut = replace(cut, notes=[marked, *cut.notes])
        _announce(cut, settings, str(masks))
    else:
        if fiducials is None:
            raise StageError("cropping by fiducials needs --fiducials; give them, or mode masks")
        names, points, _ = locate(fiducials, model, settings.max_residual_px)
        cut = crop_marked(cloud, names, points, up, settings, fiducials)
    part = cloud[cut.keep]
    write_cloud(crop, part)
    write_json(report, _report(cloud, part, points, cut, up, mode, unit, voted))


def votes_of(cloud: Cloud, alignment: Path, cameras: Path, masks: Path, settings: CropSettings) -> Votes:
    """What the object's masks say of the scene's points, loose ones among those they vote for left out (C3).

    Raises:
        StageError: the alignment has no pose, or the masks are of no use.
    """
    said = read_json(alignment)
    if not value(said, "found"):
        raise StageError(
            f"there are no fiducials, and the photos do not tell where the object lies ({value(said, 'reason')}; see"
            f" {alignment}): click at least four points on it in the scene's photos and name the file in the column"
            " fiducials of the objects table, or add photos of the object that show its surroundings too, from as far"
            " away as the scene's"
        )
    pose = Sim3.from_matrix(np.array(value(said, "scene_from_object")))
    votes = vote(cloud.points, cameras, masks, pose, settings.min_votes)
    chosen = np.flatnonzero(votes.object)
    if len(chosen) > 1:
        part_of, counts = _parts(cloud.points[chosen], 3 * spacing(cloud.points[chosen]))
        chosen = chosen[(counts >= settings.min_part * len(chosen))[part_of]]
    print(f"{len(chosen)} of {len(cloud)} scene points by the votes of the masks", flush=True)
    return replace(votes, object=np.isin(np.arange(len(cloud)), chosen))


def crop_marked(
    scene: Cloud, names: list[str], fiducials: Array, up: Array, settings: CropSettings, path: Path
) -> Crop:
    """`crop_cloud` for fiducials that a person marked in the file `path`: checked, and the notes printed.

    Raises:
        StageError: fewer than four fiducials, one far from every scene point, or too few points in the box.
    """
    if len(fiducials) < 4:
        raise StageError(f"{path} gives {len(fiducials)} fiducials; an object needs at least 4 different points on it")
    _check_near(names, fiducials, scene, path)
    cut = crop_cloud(scene, fiducials, up, settings)
    _announce(cut, settings, str(path))
    return cut


def _announce(cut: Crop, settings: CropSettings, source: str) -> None:
    """Print the notes; StageError when too little is left."""
    if cut.keep.sum() < settings.min_points:
        raise StageError(
            f"only {cut.keep.sum()} scene points are left in the {cut.shape} of {source}, {settings.min_points} are"
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
    margin = settings.margin * extent + settings.margin_fraction * diagonal
    low, high = marks.min(0) - margin, marks.max(0) + margin
    ground = None
    if settings.remove_ground:
        ground = fit_ground(points, low, high, settings.ring_fraction * diagonal, settings.ground_fraction * diagonal)
        if ground is None:
            notes.append("no ground was found around the box: nothing was removed as ground")
        else:
            # Fiducials are clicked where the scene shows the object; what it stands on bounds it below.
            corners = np.array([[x, y] for x in (low[0], high[0]) for y in (low[1], high[1])])
            low[2] = min(low[2], ground.height(corners).min() - settings.ground_fraction * diagonal)
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
        link = max(settings.link_fraction * diagonal, 3 * spacing(points[inside]))
        near = _parts_near(points[inside], marks, link, settings.reach_fraction * diagonal, settings.min_part)
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


def _parts_near(points: Array, marks: Array, link: float, reach: float, min_part: float) -> NDArray[np.bool_]:
    """Which points belong to a large enough part that a fiducial touches or that mostly lies between fiducials.

    The second counts for parts no one clicked, a wall under a roof for instance: half their points in the fiducials'
    own box, seen from above.
    """
    part_of, counts = _parts(points, link)
    touched = np.bincount(part_of, cKDTree(marks).query(points, workers=threads())[0] <= reach) > 0
    low, high = marks.min(0)[:2], marks.max(0)[:2]
    between = np.bincount(part_of, ((points[:, :2] >= low) & (points[:, :2] <= high)).all(1))
    wanted = (counts >= min_part * len(points)) & (touched | (between >= 0.5 * counts))
    return wanted[part_of]


def _check_near(names: list[str], points: Array, cloud: Cloud, path: Path) -> None:
    """A fiducial far from everything the scene shows is a wrong click."""
    diagonal = float(np.linalg.norm(np.ptp(points, axis=0)))
    distance = cKDTree(cloud.points).query(points, workers=threads())[0]
    worst = int(distance.argmax())
    if distance[worst] > max(0.5 * diagonal, 10 * spacing(cloud.points)):
        raise StageError(
            f"fiducial {names[worst]} of {path} lies {distance[worst]:.3g} from the nearest scene point, and the"
            f" fiducials span {diagonal:.3g}: check its clicks or coordinates"
        )


def _report(
    scene: Cloud, part: Cloud, marks: Array | None, cut: Crop | None, up: Array, mode: str, unit: str, voted: int = 0
) -> dict[str, object]:
    """The stage JSON of a crop."""
    ground = None if cut is None else cut.ground
    return {
        "mode": quantity(mode, ""),
        "shape": quantity(None if cut is None else cut.shape, ""),
        "up_in_scene": quantity(up, ""),
        "level_from_scene": quantity(np.eye(3) if cut is None else cut.level_from_scene, ""),
        "box_low": quantity(scene.points.min(0) if cut is None else cut.low, unit),
        "box_high": quantity(scene.points.max(0) if cut is None else cut.high, unit),
        "fiducials": quantity(marks if marks is not None and mode == "fiducials" else [], unit),
        "voted_points": quantity(voted, "points"),
        "scene_points": quantity(len(scene), "points"),
        "box_points": quantity(len(scene) if cut is None else int(cut.in_box.sum()), "points"),
        "crop_points": quantity(len(part), "points"),
        "diagonal": quantity(part.diagonal, unit),
        "spacing": quantity(spacing(part.points), unit),
        "ground_removed": quantity(ground is not None, ""),
        "ground_coefficients": quantity(None if ground is None else ground.coefficients, unit),
        "ground_centre": quantity(None if ground is None else ground.centre, unit),
        "ground_tolerance": quantity(None if ground is None else ground.tolerance, unit),
        "notes": quantity([] if cut is None else cut.notes, ""),
    }

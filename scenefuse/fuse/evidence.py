"""Evidence: an object fused into a scene by what the photos of both sides know of their points (method F4)."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from scenefuse.cloud.clouds import Cloud, sampled_rows, spacing
from scenefuse.core.stage import quantity, threads
from scenefuse.core.transforms import Sim3
from scenefuse.fuse.compare import KEPT, REASONS, SAME_PLACE_SPACINGS, compare, gaps
from scenefuse.fuse.measure import (
    MEASURED,
    NERF_ONLY,
    STEREO_ONLY,
    measure,
    measure_again,
    unchecked,
    with_evidence,
)
from scenefuse.fuse.modes import (
    SEAM_SPACINGS,
    Fused,
    FusionSettings,
    feathered,
    thinned,
    with_colors_of,
)
from scenefuse.geometry.icp import COLOR_WEIGHT, ScaleRange, refine_planes
from scenefuse.geometry.photo_check import CONFIRMING_PHOTOS, Photos, moved_photos
from scenefuse.geometry.surface import Surface, with_queries
from scenefuse.register.uncertainty import Uncertainty, half_sampling

# The scene is checked in the object's box, widened by this share of its diagonal.
NEAR = 0.05
# Points of the scene around an object that are checked; of a denser scene a random choice, which the others follow.
MAX_CHECKED = 1_000_000
# Pairs within these shares of the diagonal, one after the other: an object a few per cent off still settles. One that
# would move by more than the first (RMS) is not where the registration put it.
REACHES = (0.04, 0.02, 0.01)
# The scale stays within five per cent of what the registration found.
SCALE_WIDTH = 0.05
# Measured points that each side needs; of each side at most so many, drawn evenly, and of these those that look for a
# partner. They are not averaged, which would round corners off.
MIN_POINTS, MAX_POINTS, MAX_QUERIES = 200, 20000, 5000
# An object that moves by more than this share of its diagonal was put at a wrong place, however certain that seemed: a
# registration's position may be as uncertain as that.
MIN_MISPLACED = 0.005
# Halves of the surfaces that are settled alike, and how far their poses may spread, over the diagonal, for the scale to
# be settled too: a roof alone does not determine how large a house is.
HALVES, MAX_SPREAD = 6, 0.003


@dataclass(frozen=True)
class Checked:
    """What the photos of both sides say of their points.

    Attributes:
        settled: settled_from_placed, by which the object was moved before its points were compared.
        moved: RMS distance of that, over the object's diagonal; None where it could not be settled.
        obj: the object's points, moved, with the fields of evidence.
        added: (N,) of the object's points that come into the scene.
        contradicted: (N,) of the object's points that are not measured, those that photos see through.
        scene: the scene's points around it, with the fields of evidence.
        reason: (M,) uint8 of the scene's points: KEPT, or why it is taken away.
        notes: what a user should know.
    """

    settled: Sim3
    moved: float | None
    obj: Cloud
    added: NDArray[np.bool_]
    contradicted: NDArray[np.bool_]
    scene: Cloud
    reason: NDArray[np.uint8]
    notes: list[str]


def fuse_by_evidence(
    obj: Cloud,
    scene: Cloud,
    obj_photos: Photos,
    scene_photos: Photos,
    settings: FusionSettings,
    uncertainty: Uncertainty | None = None,
) -> tuple[Fused, Checked]:
    """Fuse by what photos know of the points of both sides; see `check`.

    Args:
        obj: the object in the scene's frame, registered.
        scene: the scene around it, or all of it.
        obj_photos: the object's photos in the scene's frame.
        scene_photos: the scene's photos that see the object.
        settings: see FusionSettings.
        uncertainty: of the object's pose on the scene, where it is known.
    """
    certain = None if uncertainty is None else uncertainty.size(obj.diagonal)
    rows = np.flatnonzero(around(scene, obj))
    near = scene[rows]
    checked = check(obj, near, obj_photos, scene_photos, settings.nerf_only, certain)
    step = spacing(near.points)
    moved, gain, bias = with_colors_of(checked.obj, near, SAME_PLACE_SPACINGS * step, settings.match_colors)
    added = thinned(moved[checked.added], settings.density * step)
    added = feathered(added, near[checked.reason == KEPT], SEAM_SPACINGS * step, SAME_PLACE_SPACINGS * step)
    whole = unchecked(scene)
    for name, values in whole.fields.items():
        values[rows] = checked.scene.fields[name]
    return Fused(whole, rows, checked.reason, added, gain, bias, SAME_PLACE_SPACINGS * step), checked


def around(scene: Cloud, obj: Cloud) -> NDArray[np.bool_]:
    """(N,) points of the scene that are checked: in the object's box, widened by NEAR."""
    low, high, margin = obj.points.min(0), obj.points.max(0), NEAR * obj.diagonal
    return ((scene.points >= low - margin) & (scene.points <= high + margin)).all(1)


def check(
    obj: Cloud, scene: Cloud, obj_photos: Photos, scene_photos: Photos, nerf_only: bool, certain: float | None = None
) -> Checked:
    """Measure the points of an object and of the scene around it in the photos of both, settle the object, compare.

    A side without photos is measured by the other's; a scene's point also counts as measured where the object's photos
    confirm it. Of a scene of more than MAX_CHECKED points each of the others shares the fate of the nearest of these.

    Args:
        obj: the object in the scene's frame, registered.
        scene: the scene's points around it.
        obj_photos: of the object, in the scene's frame.
        scene_photos: of the scene.
        nerf_only: whether points of the object that no photo confirms are added where the scene has none.
        certain: how certain the registration was; see `settle`.
    """
    diagonal, chosen = obj.diagonal, np.sort(sampled_rows(len(scene), MAX_CHECKED, seed=0))
    notes = _photo_notes(obj_photos, scene_photos)
    mine = measure(obj, obj_photos if _is_enough(obj_photos) else scene_photos, diagonal)
    theirs = measure(scene[chosen], scene_photos if _is_enough(scene_photos) else obj_photos, diagonal)
    if not mine.surface.any():
        notes.append("no photo confirms any point of the object, so nothing is added")

    found = settle(mine.cloud[mine.surface], theirs.cloud[theirs.surface], diagonal, certain)
    settled, moved = found or (Sim3.identity(), None)
    if moved is None:
        notes.append(
            "the object stays where the registration put it: too little is measured on both sides, or it would move far"
        )
    elif moved == 0:
        notes.append("the object stays where the registration put it: that is more certain than what the surfaces say")
    mine, obj_photos = mine.moved(settled), moved_photos(obj_photos, settled)

    theirs = measure_again(theirs, obj_photos, diagonal)
    decided = compare(mine, theirs, obj_photos.views + scene_photos.views, len(chosen) / max(len(scene), 1))
    added, reason = decided.added, decided.reason
    if nerf_only:
        unconfirmed = ~mine.surface & ~decided.contradicted
        added = added | gaps(mine.cloud.points, unconfirmed, added, theirs.cloud.points[reason == KEPT])
    known = with_evidence(theirs, STEREO_ONLY)
    if len(chosen) < len(scene):
        notes.append(
            f"of {len(scene)} points of the scene near the object {len(chosen)} were checked; the others follow the"
            " nearest"
        )
        nearest = cKDTree(known.points).query(scene.points, workers=threads())[1]
        known = replace(scene, fields={name: values[nearest] for name, values in known.fields.items()})
        reason = reason[nearest]
    return Checked(settled, moved, with_evidence(mine, NERF_ONLY), added, decided.contradicted, known, reason, notes)


def settle(
    obj: Cloud, scene: Cloud, diagonal: float, certain: float | None = None, seed: int = 0
) -> tuple[Sim3, float] | None:
    """The similarity that lays measured points of an object on those of the scene, and how far it moves them.

    The registration worked on whole clouds, with what stereo made up at edges and the NeRF where nothing was seen; here
    both sides are what their photos confirmed, so the same refinement (method R8: planes, points and colours both ways)
    is more exact. The scale stays what it is where the surfaces do not determine it. Where the registration was more
    certain than that, by the photos that both sides share for instance, the object stays as it is, unless it would move
    by more than MIN_MISPLACED: the surfaces of a scene's stereo have errors of their own.

    Args:
        obj: measured points in the scene's frame, with normals, and colours if both have them.
        scene: the scene's around them, likewise.
        diagonal: of the object.
        certain: `size` of the registration's uncertainty on the scene, over the diagonal; None where it is not known.
        seed: of the drawing.

    Returns:
        settled_from_placed and the RMS distance that it moves the object's points, over the diagonal; None where a side
        has too few points, or where they would move by more than the first of REACHES.
    """
    if min(len(obj), len(scene)) < MIN_POINTS:
        return None
    mine, theirs = _surface(obj, seed), _surface(scene, seed)
    pose, scales = _refined(mine, theirs, SCALE_WIDTH, diagonal), ScaleRange(1.0, SCALE_WIDTH)
    spread = half_sampling([(mine, theirs)], pose, scales, REACHES[1] * diagonal, HALVES, seed)
    if spread is None or spread.size(diagonal) > MAX_SPREAD:
        pose = _refined(mine, theirs, 0.0, diagonal)
    moved = float(np.sqrt(((pose.apply(obj.points) - obj.points) ** 2).sum(1).mean())) / diagonal
    if certain is not None and moved <= MIN_MISPLACED and (spread is None or certain < spread.size(diagonal)):
        return Sim3.identity(), 0.0
    return (pose, moved) if moved <= REACHES[0] else None


def _refined(mine: Surface, theirs: Surface, scale_width: float, diagonal: float) -> Sim3:
    """The pose after refinement with pairs that come nearer and nearer."""
    pose = Sim3.identity()
    for reach in REACHES:
        pose = refine_planes(mine, theirs, pose, ScaleRange(1.0, scale_width), reach * diagonal, 10, COLOR_WEIGHT)
    return pose


def _surface(cloud: Cloud, seed: int) -> Surface:
    """A cloud made ready for refinement."""
    rng = np.random.default_rng(seed)
    thin = cloud[np.sort(rng.permutation(len(cloud))[:MAX_POINTS])]
    colors = None if thin.colors is None else thin.colors / 255.0
    assert thin.normals is not None
    normals = thin.normals.astype(np.float64)
    surface = Surface(thin.points, normals, colors, cKDTree(thin.points), np.arange(len(thin)))
    return with_queries(surface, MAX_QUERIES, seed)


def _is_enough(photos: Photos) -> bool:
    return len(photos.views) >= CONFIRMING_PHOTOS


def _photo_notes(obj_photos: Photos, scene_photos: Photos) -> list[str]:
    """What a user should know of sides with too few photos."""
    return [
        f"fewer than {CONFIRMING_PHOTOS} photos of the {name} see it: it is judged by those of the {other}"
        for photos, name, other in ((obj_photos, "object", "scene"), (scene_photos, "scene", "object"))
        if not _is_enough(photos)
    ]


def evidence_report(fused: Fused, checked: Checked | None, unit: str) -> dict[str, Any]:
    """What photos say of both sides' points; without `evidence`, only what was taken away.

    `object_points` are `object_measured` and `object_nerf_only`; the measured ones are added or better in the scene. Of
    the others, photos see through `object_contradicted`; fewer than three could be compared at `object_unasked`.
    `added_photos` is how many photos confirm the measured points that were added.
    """
    removed = {text: int((fused.reason == code).sum()) for code, text in REASONS.items()}
    content = {"scene_removed": quantity(removed, "points")}
    if checked is None:
        return content | {"notes": quantity(["no photo was compared"], "")}
    fields, of_scene = checked.obj.fields, checked.scene.fields["evidence"] == MEASURED
    measured, left = fields["evidence"] == MEASURED, checked.reason == KEPT
    middle = float(np.median(fields["deviation"][measured])) if measured.any() else None
    masks = {
        "object_measured": measured,
        "object_nerf_only": fields["evidence"] == NERF_ONLY,
        "object_contradicted": checked.contradicted,
        "object_better_in_scene": measured & ~checked.added,
        "object_added": checked.added,
        "object_unasked": ~measured & np.isnan(fields["match"]),
        "scene_measured": of_scene,
        "scene_stereo_only": ~of_scene,
        "scene_kept": left,
        "scene_kept_measured": left & of_scene,
    }
    return content | {
        "object_points": quantity(len(measured), "points"),
        "scene_checked": quantity(len(left), "points"),
        **{name: quantity(int(mask.sum()), "points") for name, mask in masks.items()},
        "deviation_median": quantity(middle, unit),
        "object_measured_share": quantity(float(measured.mean()) if len(measured) else None, "1"),
        "added_photos": quantity(_quantiles(fields["photos"][checked.added & measured]), "photos"),
        "settled_by": quantity(checked.moved, "diagonals"),
        "notes": quantity(checked.notes, ""),
    }


def _quantiles(values: NDArray[Any]) -> dict[str, float] | None:
    """Least, median and largest of (N,) values, and the twentieth from below."""
    if not len(values):
        return None
    places = {"least": 0.0, "5 %": 0.05, "median": 0.5, "largest": 1.0}
    return {name: float(np.quantile(values, place, method="lower")) for name, place in places.items()}

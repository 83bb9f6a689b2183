"""How an object comes into a scene: by what photos know of both sides' points (F4), or by distances alone (F1).

By evidence a point goes through four steps: it is measured (`measure`), the object settles (`settle`), both sides are
compared (`compare`), and what changes is written (`write`).
"""

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from scenefuse.cloud.clouds import Cloud, sampled_rows, spacing, within
from scenefuse.cloud.tiled_cloud import Rows
from scenefuse.core.stage import setting, threads
from scenefuse.core.transforms import Array, Sim3, Uncertainty, inside_box
from scenefuse.fuse.compare import SAME_PLACE_SPACINGS, Reason, compare, gaps
from scenefuse.fuse.measure import (
    FIELDS,
    NEAR,
    Evidence,
    deviations_of_pose,
    measure,
    measure_again,
    plain_points,
    unchecked,
    with_evidence,
    with_normals,
)
from scenefuse.fuse.settle import settle
from scenefuse.fuse.write import GAINS, MIN_PAIRS, SEAM_SPACINGS, Changes, feathered, with_colors_of
from scenefuse.geometry.photo_check import CONFIRMING_PHOTOS, Photos, moved_photos

Unconfirmed = Literal["plain", "all", "none"]
# Points of the scene around an object that are checked; of a denser scene a random choice, which the others follow.
MAX_CHECKED = 1_000_000


@dataclass(frozen=True)
class FusionSettings:
    """How the object is added."""

    mode: Literal["evidence", "fill", "append", "replace"] = setting("evidence")
    """`evidence` checks the points of both sides in the photos of both and keeps what these confirm. For comparison,
    `fill` adds the object points that the scene lacks, `append` all of them, and `replace` puts the object in the place
    of the scene's points on it."""
    match_colors: bool = setting(True)
    """Whether the object's colours get a gain and bias per channel from the overlap."""
    unconfirmed: Unconfirmed = setting("plain")
    """Points of the object that no photo confirms, added where nothing else is (`evidence` only): those too plain to
    match that continue what photos confirm; all that photos do not see through; or none."""


@dataclass(frozen=True)
class Fused:
    """A part of a scene with an object in it.

    Attributes:
        scene: its points with the fields of evidence.
        rows: (M,) rising, of these points, those that were checked.
        reason: (M,) uint8, Reason.KEPT or why the point is taken away.
        added: the object's points that come in, with the same fields.
        gain: (3,) colour gain of the object.
        bias: (3,) colour bias, 0..255.
        same_distance: distance within which both show the same place.
        ground: how many of what comes in, the last ones, are not the object's but of the ground beside it.
    """

    scene: Cloud
    rows: Rows
    reason: NDArray[np.uint8]
    added: Cloud
    gain: Array
    bias: Array
    same_distance: float
    ground: int = 0

    @property
    def removed(self) -> Rows:
        """(R,) rows of the points that are taken away."""
        return self.rows[self.reason != Reason.KEPT]

    @property
    def kept(self) -> Cloud:
        """The part of the scene without them."""
        return self.scene[np.delete(np.arange(len(self.scene)), self.removed)]

    def changes(self, rows: Rows) -> Changes:
        """What changes in a scene's cloud that has the part's points in these rows (N,)."""
        fields = {name: self.scene.fields[name][self.rows] for name in FIELDS}
        return Changes(rows[self.rows], self.reason != Reason.KEPT, fields)


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
        reason: (M,) uint8 of the scene's points: Reason.KEPT, or why it is taken away.
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
    on_scene: Uncertainty | None = None,
    on_world: Array | None = None,
) -> tuple[Fused, Checked]:
    """Fuse by what photos know of the points of both sides; see `check`.

    Args:
        obj: the object in the scene's frame, registered.
        scene: the scene around it, or all of it.
        obj_photos: the object's photos in the scene's frame.
        scene_photos: the scene's photos that see the object.
        settings: see FusionSettings.
        on_scene: how uncertain the object's pose on the scene is, where it is known.
        on_world: the same against the world, a covariance (7, 7) about the object's mean, for `world_deviation`.
    """
    certain = None if on_scene is None else on_scene.size(obj.diagonal)
    rows = np.flatnonzero(around(scene, obj))
    near = scene[rows]
    checked = check(obj, near, obj_photos, scene_photos, settings.unconfirmed, certain, on_world)
    step = spacing(near.points)
    fill = SAME_PLACE_SPACINGS * step
    moved, gain, bias = with_colors_of(checked.obj, near, fill, settings.match_colors)
    added = feathered(moved[checked.added], near[checked.reason == Reason.KEPT], SEAM_SPACINGS * step, fill)
    whole = unchecked(scene)
    for name, values in whole.fields.items():
        values[rows] = checked.scene.fields[name]
    return Fused(whole, rows, checked.reason, added, gain, bias, fill), checked


def around(scene: Cloud, obj: Cloud) -> NDArray[np.bool_]:
    """(N,) points of the scene that are checked: in the object's box, widened by NEAR."""
    return inside_box(scene.points, obj.points.min(0), obj.points.max(0), NEAR * obj.diagonal)


def check(
    obj: Cloud,
    scene: Cloud,
    obj_photos: Photos,
    scene_photos: Photos,
    unconfirmed: Unconfirmed,
    certain: float | None = None,
    on_world: Array | None = None,
) -> Checked:
    """Measure the points of an object and of the scene around it in the photos of both, settle the object, compare.

    A side without photos is measured by the other's; a scene's point also counts as measured where the object's photos
    confirm it. Of a scene of more than MAX_CHECKED points each of the others shares the fate of the nearest of these.

    Args:
        obj: the object in the scene's frame, registered.
        scene: the scene's points around it.
        obj_photos: of the object, in the scene's frame.
        scene_photos: of the scene.
        unconfirmed: points of the object that no photo confirms, added where the scene has none.
        certain: how certain the registration was; see `settle`.
        on_world: see `fuse_by_evidence`.
    """
    diagonal, chosen = obj.diagonal, np.sort(sampled_rows(len(scene), MAX_CHECKED, seed=0))
    notes, views = _photo_notes(obj_photos, scene_photos), obj_photos.views + scene_photos.views
    obj, given = with_normals(obj, views), with_normals(scene[chosen], views)
    mine = measure(obj, obj_photos if _is_enough(obj_photos) else scene_photos, diagonal)
    theirs = measure(given, scene_photos if _is_enough(scene_photos) else obj_photos, diagonal)
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

    theirs, disputed = measure_again(theirs, obj_photos, diagonal)
    views = obj_photos.views + scene_photos.views
    added, contradicted, reason = compare(mine, theirs, disputed, views, len(chosen) / max(len(scene), 1))
    plain = plain_points(mine, contradicted)
    if unconfirmed != "none":
        wanted = plain if unconfirmed == "plain" else ~mine.surface & ~contradicted
        added = added | gaps(mine.cloud, wanted, added, theirs.cloud[reason == Reason.KEPT])
    known = with_evidence(theirs, Evidence.STEREO_ONLY)
    if len(chosen) < len(scene):
        notes.append(
            f"of {len(scene)} points of the scene near the object {len(chosen)} were checked; the others follow the"
            " nearest"
        )
        nearest = cKDTree(known.points).query(scene.points, workers=threads())[1]
        known = replace(scene, fields={name: values[nearest] for name, values in known.fields.items()})
        reason = reason[nearest]
    of_pose = 0.0 if on_world is None else deviations_of_pose(mine.cloud, on_world, obj.points.mean(0))
    own = with_evidence(mine, Evidence.NERF_ONLY, of_pose)
    own.fields["evidence"][plain] = Evidence.PLAIN
    return Checked(settled, moved, own, added, contradicted, known, reason, notes)


def _is_enough(photos: Photos) -> bool:
    return len(photos.views) >= CONFIRMING_PHOTOS


def _photo_notes(obj_photos: Photos, scene_photos: Photos) -> list[str]:
    """What a user should know of sides with too few photos."""
    return [
        f"fewer than {CONFIRMING_PHOTOS} photos of the {name} see it: it is judged by those of the {other}"
        for photos, name, other in ((obj_photos, "object", "scene"), (scene_photos, "scene", "object"))
        if not _is_enough(photos)
    ]


def fuse_by_distance(obj: Cloud, scene: Cloud, part: Cloud, pose: Sim3, settings: FusionSettings) -> Fused:
    """Decide what is added and what is taken away by distances alone: `fill`, `append` and `replace` (method F1).

    Args:
        obj: the object in its own frame.
        scene: the scene around it, or all of it.
        part: the scene's points on the object.
        pose: scene_from_object of the registration.
        settings: see FusionSettings.
    """
    moved, step = obj.transformed(pose), spacing(part.points)
    if scene.normals is not None:
        moved = with_normals(moved)
    near = np.flatnonzero(around(scene, moved))
    near = near if len(near) else np.arange(len(scene))
    distance = cKDTree(scene.points[near]).query(moved.points, workers=threads())[0]
    # Where both exist, noise does not add a second layer.
    fill = SAME_PLACE_SPACINGS * step
    overlap = distance <= 3 * fill
    if overlap.sum() > MIN_PAIRS:
        fill = max(fill, SAME_PLACE_SPACINGS * float(np.median(distance[overlap])))
    moved, gain, bias = with_colors_of(moved, scene[near], fill, settings.match_colors)
    removed = near[:0]
    if settings.mode == "fill":
        moved = moved[distance > fill]
    elif settings.mode == "replace":
        removed = near[within(scene.points[near], moved.points, fill)]
    if settings.mode != "append":
        moved = feathered(moved, scene[np.setdiff1d(near, removed)], SEAM_SPACINGS * step, fill)
    reason = np.full(len(removed), Reason.REPLACED, np.uint8)
    return Fused(unchecked(scene), removed, reason, unchecked(moved), gain, bias, fill)


def color_notes(fused: Fused, obj: Cloud, scene: Cloud) -> tuple[Fused, list[str]]:
    """The fusion, added points grey where only the scene has colours, and what a user should know of the colours."""
    notes = []
    if scene.colors is not None and obj.colors is None:
        notes.append("the object has no colours: its points are grey in the scene")
        grey = np.full((len(fused.added), 3), 128, np.uint8)
        fused = replace(fused, added=replace(fused.added, colors=grey))
    if np.isin(fused.gain, GAINS).any():
        notes.append(
            "the scene shows the object much darker or lighter, or with less or more contrast, than its own photos: its"
            f" colours are changed by the most that is done (gain {', '.join(f'{g:.2f}' for g in fused.gain)});"
            " fusion.match_colors: false leaves them as they are"
        )
    return fused, notes

"""The lens of a model's cameras: as much of it is refined as the photos determine (method M9).

Principal point and higher distortion are refined where observations that took no part in the adjustment are predicted
better with them; where they are not, they are held, and the photos say nothing about them.
"""

import copy
from collections import Counter
from collections.abc import Collection
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
import pycolmap

from scenefuse.core.transforms import Array
from scenefuse.sfm.colmap import MAX_REPROJECTION_ERROR_PX, MIN_PHOTOS, ROBUST_PX, Freedom, adjust

# A richer lens has to predict held-out observations better by so many standard errors.
MIN_GAIN = 3.0
# And their median error has to fall by this share. What changes less is no better lens that matters, but tangential
# distortion in the place of a principal point, which turns the cameras.
MIN_MEDIAN_GAIN = 0.005
# A principal point farther from the middle, as a share of the longer side, is no lens but a fit to something else.
MAX_OFF_CENTRE = 0.1
# Models by the number of their distortion parameters, the poorer ones as prefixes of the richer.
POLYNOMIALS = ("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV")

# Models that a second radial term makes richer.
ONE_TERM = ("SIMPLE_PINHOLE", "SIMPLE_RADIAL")

# The lens is chosen on so many points, and the spread of a model is of so many.
MAX_POINTS = 4000

Held = list[tuple[int, int, Array]]


@dataclass(frozen=True)
class Lens:
    """A choice of camera model and of what of it is refined.

    Attributes:
        name: of the choice.
        richest: cameras of poorer models become this; None leaves each as it is.
        freedom: what is refined.
        words: the choice in a few words.
        shared: whether photos with cameras of their own get focal length and distortion in common.
    """

    name: str
    richest: str | None
    freedom: Freedom
    words: str
    shared: bool = False

    def fit(self, model: pycolmap.Reconstruction) -> pycolmap.Reconstruction:
        """A copy of a model, adjusted with this lens."""
        fitted = copy.deepcopy(model)
        for camera in fitted.cameras.values():
            if self.richest is not None:
                enrich(camera, self.richest)
        if self.shared:
            share(fitted)
        adjust(fitted, self.freedom)
        return fitted


KNOWN = Lens("known", None, Freedom(lens=False), "calibration given, held")
HELD = Lens("held", None, Freedom(), "principal point held in the middle")
CENTRED = Lens("centred", None, Freedom(principal_point=True), "principal point refined")
RADIAL = Lens("radial", "RADIAL", CENTRED.freedom, "principal point and two radial terms refined")
BROWN = Lens("brown", "OPENCV", CENTRED.freedom, "principal point and Brown distortion refined")
RATIONAL = Lens("rational", "FULL_OPENCV", CENTRED.freedom, "principal point and rational distortion refined")
DISTORTED = (HELD, CENTRED, RADIAL, BROWN, RATIONAL)
SHARED = tuple(
    replace(
        lens,
        name=f"{lens.name}, shared",
        freedom=Freedom(lens=False, principal_point=True),
        words=f"{lens.words}, all but the principal point in common",
        shared=True,
    )
    for lens in DISTORTED
    if lens.freedom.principal_point
)
LENSES = {lens.name: lens for lens in (KNOWN, *DISTORTED, *SHARED)}


class Choice(NamedTuple):
    """The lens that a model's photos determine, and the one beyond it, which they do not, or None."""

    lens: Lens
    next: Lens | None


def choose_lens(
    model: pycolmap.Reconstruction, lenses: tuple[Lens, ...] = DISTORTED, cropped: Collection[str] = ()
) -> Choice:
    """Go from the poorest lens to richer ones while held-out observations are predicted better (method M9).

    Cross-validation (Stone 1974): one observation of every point that four photos or more see is left out of the
    adjustment; the logarithmic (Cauchy) errors of a richer lens there have to be smaller than those of each poorer one,
    taken or not (but for one whose principal point ran away), pair by pair, by three standard errors of their mean, and
    their median by half a per cent. Cropped photos share all but their principal points, unless their own lenses are
    better by as many standard errors.

    Args:
        model: bundle-adjusted; it is not changed.
        lenses: from poor to rich.
        cropped: names of photos whose principal point may be anywhere.
    """
    kept, held = hold_out(model)
    best, beyond = lenses[0], None
    start = best.fit(kept)
    poorer = [_errors(start, held)]
    for lens in lenses[1:]:
        if lens is RADIAL and any(camera.model_name not in ONE_TERM for camera in model.cameras.values()):
            continue
        fitted = lens.fit(start)
        errors = _errors(fitted, held)
        gain = min(_gain(others, errors) for others in poorer)
        median = min(np.median(others) for others in poorer) if held else 0.0
        better = len(errors) > 0 and np.median(errors) <= (1 - MIN_MEDIAN_GAIN) * median
        is_lens = _in_bounds(fitted, cropped)
        if is_lens:
            poorer.append(errors)
            start = fitted
        taken = better and gain >= MIN_GAIN and is_lens
        if taken:
            best, beyond, of_best = lens, None, (fitted, errors)
        elif beyond in (None, RADIAL):
            beyond = lens
        # A free principal point may help with distortion only, and one term of it with the others: all are tried.
        if not taken and lens.richest not in (None, RADIAL.richest):
            break
    if cropped and best.freedom.principal_point:
        shared = LENSES[f"{best.name}, shared"]
        fitted, errors = of_best
        if _gain(_errors(shared.fit(fitted), held), errors) < MIN_GAIN:
            return Choice(shared, beyond and LENSES[f"{beyond.name}, shared"])
    return Choice(best, beyond)


def hold_out(model: pycolmap.Reconstruction) -> tuple[pycolmap.Reconstruction, Held]:
    """A copy of a model with MAX_POINTS of its points, drawn at random, without one observation of each long track, and
    these: point, photo, (2,) pixels."""
    rng, kept, held = np.random.default_rng(0), copy.deepcopy(model), Held()
    drawn = rng.permutation(sorted(model.point3D_ids()))
    for point in drawn[MAX_POINTS:].tolist():
        kept.delete_point3D(point)
    for point in sorted(drawn[:MAX_POINTS].tolist()):
        track = model.points3D[point].track.elements
        if len(track) > MIN_PHOTOS:
            chosen = track[int(rng.integers(len(track)))]
            pixel = model.images[chosen.image_id].points2D[chosen.point2D_idx].xy
            held.append((point, chosen.image_id, np.array(pixel)))
            kept.delete_observation(chosen.image_id, chosen.point2D_idx)
    return kept, held


def enrich(camera: pycolmap.Camera, name: str) -> None:
    """Turn a camera into a richer polynomial model, in place and the same lens (RADIAL takes the mean of two focal
    lengths); others and richer ones stay."""
    ranks = {model: rank for rank, model in enumerate(POLYNOMIALS)}
    if ranks.get(camera.model_name, len(ranks)) >= ranks[name]:
        return
    focal = [camera.params[i] for i in camera.focal_length_idxs()]
    same = [camera.mean_focal_length()] if name == "RADIAL" else focal * (3 - len(focal))
    centre = _centre(camera)
    distortion = [camera.params[i] for i in camera.extra_params_idxs()]
    camera.model = getattr(pycolmap.CameraModelId, name)
    missing = len(camera.extra_params_idxs()) - len(distortion)
    camera.params = [*map(float, [*same, *centre, *distortion]), *[0.0] * missing]


def share(model: pycolmap.Reconstruction) -> None:
    """Adjust a model in place, with one lens for all cameras of a size and type that have one photo each: principal
    points in turns with all else, until a turn changes next to nothing."""
    photos = Counter(model.images[photo].camera_id for photo in model.reg_image_ids())
    first: dict[Any, int] = {}
    kind = {key: (camera.model, camera.width, camera.height) for key, camera in model.cameras.items()}
    alike = {key: first.setdefault(kind[key], key) if photos[key] == 1 else key for key in sorted(photos)}
    error = np.inf
    while True:
        together = _together(model, alike)
        adjust(together, HELD.freedom)
        for photo in together.reg_image_ids():
            model.frames[model.images[photo].frame_id].rig_from_world = together.images[photo].cam_from_world()
        for key, camera in model.cameras.items():
            if key in alike:
                centre = _centre(camera)
                camera.params = together.cameras[alike[key]].params
                camera.principal_point_x, camera.principal_point_y = centre
        for key, point in together.points3D.items():
            model.points3D[key].xyz = point.xyz
        adjust(model, Freedom(lens=False, principal_point=True))
        model.update_point_3d_errors()
        before, error = error, model.compute_mean_reprojection_error()
        if error > (1 - MIN_MEDIAN_GAIN) * before:
            return


def _together(model: pycolmap.Reconstruction, alike: dict[int, int]) -> pycolmap.Reconstruction:
    """A model whose photos have the cameras that theirs are alike; what they see is moved with the principal point."""
    together = pycolmap.Reconstruction()
    for key in sorted(set(alike.values())):
        medians = np.median([model.cameras[k].params for k, other in alike.items() if other == key], axis=0)
        camera = pycolmap.Camera(model.cameras[key].todict())
        camera.params = [*map(float, medians)]
        together.add_camera_with_trivial_rig(camera)
    for photo in sorted(model.reg_image_ids()):
        image = model.images[photo]
        key = alike[image.camera_id]
        moved = _centre(together.cameras[key]) - _centre(model.cameras[image.camera_id])
        seen = pycolmap.Point2DList([pycolmap.Point2D(point.xy + moved) for point in image.points2D])
        copied = pycolmap.Image(name=image.name, points2D=seen, camera_id=key, image_id=photo)
        together.add_image_with_trivial_frame(copied, image.cam_from_world())
    for key, point in model.points3D.items():
        together.add_point3D_with_id(key, point)
    return together


def _centre(camera: pycolmap.Camera) -> Array:
    """(2,) principal point in pixels."""
    return np.array([camera.principal_point_x, camera.principal_point_y])


def _errors(model: pycolmap.Reconstruction, held: Held) -> Array:
    """(N,) reprojection errors in pixels at held-out observations, at most what COLMAP takes for no
    outlier, so that one wrong match does not decide; that, where there is none."""
    errors = np.full(len(held), MAX_REPROJECTION_ERROR_PX)
    for row, (point, photo, pixel) in enumerate(held):
        if point in model.points3D:
            seen = model.images[photo].project_point(model.points3D[point].xyz)
            if seen is not None:
                errors[row] = min(MAX_REPROJECTION_ERROR_PX, float(np.linalg.norm(seen - pixel)))
    return errors


def _gain(poorer: Array, richer: Array) -> float:
    """By how many standard errors the richer lens has smaller logarithmic errors."""
    if len(poorer) < 2:
        return 0.0
    smaller = np.log1p((poorer / ROBUST_PX) ** 2) - np.log1p((richer / ROBUST_PX) ** 2)
    return float(smaller.mean() / max(smaller.std(ddof=1) / np.sqrt(len(smaller)), 1e-12))


def _in_bounds(model: pycolmap.Reconstruction, cropped: Collection[str]) -> bool:
    """Whether the principal points of most photos are near enough to the middle to be a lens's; that of a cropped photo
    is not, and says nothing about the others'."""
    off = []
    photos = [model.images[photo] for photo in model.reg_image_ids()]
    for camera in (model.cameras[photo.camera_id] for photo in photos if photo.name not in cropped):
        size = np.array([camera.width, camera.height])
        off.append(np.abs(_centre(camera) - size / 2).max() / size.max())
    return not off or bool(np.median(off) <= MAX_OFF_CENTRE)

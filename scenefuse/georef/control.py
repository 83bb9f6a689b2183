"""Surveyed points in a model: where its cameras see them, the similarity that they ask for, and what is left over."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path

import numpy as np
import pycolmap

from scenefuse.cloud.crs import grid_name
from scenefuse.core.stage import StageError
from scenefuse.core.transforms import Array, Sim3
from scenefuse.georef.control_file import ControlFile, SurveyedPoint, read_control, unknown_photo
from scenefuse.marks.clicks import Click, in_photos
from scenefuse.marks.triangulation import MAX_CLICK_MISS, intersect, model_pixel
from scenefuse.photos.photos import Photo

# Fewest control points that fix a model.
MIN_CONTROL_POINTS = 3
# Control points lie along one line if none is farther from it than this share of their extent.
MIN_WIDTH_SHARE = 0.01


@dataclass(frozen=True)
class LocatedPoint:
    """A surveyed point as a model's cameras see it.

    Attributes:
        point: the point, with the clicks that agree, in pixels of the model's photos.
        x_in_model: (3,) its place by these clicks; NaN where they give none.
        off_px: (N,) their distances in pixels from that place in the photos.
        problem: why it takes no part, or "".
    """

    point: SurveyedPoint
    x_in_model: Array
    off_px: Array
    problem: str = ""


@dataclass(frozen=True)
class Control:
    """A file of surveyed points, found in a model.

    Attributes:
        path: of the file, for messages.
        grid: the projected CRS of the coordinates, "" for a geographic one.
        located: of every point in the file.
        notes: a line for every click and point that is left out.
    """

    path: Path
    grid: str
    located: list[LocatedPoint]
    notes: list[str]


def read_control_points(path: Path, model: pycolmap.Reconstruction, photos: list[Photo]) -> Control:
    """Read surveyed points and find them in a model.

    Raises:
        StageError: what `read_control` and `locate_points` say; fewer than three control points that can be used.
    """
    surveyed = read_control(path)
    located, notes = locate_points(surveyed, model, {p.name: (p.width, p.height) for p in photos})
    good = [s for s in located if not (s.problem or s.point.check) and np.isfinite(s.point.position).all()]
    if len(good) < MIN_CONTROL_POINTS:
        reasons = "; ".join(f"{s.point.name}: {s.problem}" for s in located if s.problem and not s.point.check)
        raise StageError(
            f"{path}: {len(good)} control points with a height can be used, {MIN_CONTROL_POINTS} are needed"
            f"{f' ({reasons})' if reasons else ''}; click more points, each in two photos or more"
        )
    return Control(path, grid_name(surveyed.crs), located, notes)


def locate_points(
    control: ControlFile, model: pycolmap.Reconstruction, sizes: Mapping[str, tuple[int, int]]
) -> tuple[list[LocatedPoint], list[str]]:
    """Find each surveyed point by its clicks, and say which clicks are left out and why.

    Clicks that do not agree with most of the others on the point are left out; so are those in photos that are not
    registered. A point with fewer than two clicks, or whose clicks contradict each other, takes no part.

    Args:
        control: points and clicks.
        model: of the photos clicked in.
        sizes: photo name -> (width, height), of every photo listed.

    Raises:
        StageError: a click in a photo that does not exist, or outside its photo.
    """
    images = {model.images[i].name: model.images[i] for i in model.reg_image_ids()}
    located, notes = [], []
    for point in control.points:
        seen, lost = [], []
        for click in in_photos(point.clicks, sizes, control.path):
            photo = click.photo
            if photo not in sizes:
                raise unknown_photo(control.path, point.name, photo, sizes)
            if photo in images:
                x_px, y_px = model_pixel(control.path, click, images[photo], sizes).tolist()
                seen.append(Click(point.name, images[photo].name, x_px, y_px))
            else:
                lost.append(photo)
        notes += [f"{point.name}: {photo} could not be registered, its click is left out" for photo in lost]
        located_point, dropped = _agreed(replace(point, clicks=seen), {image.name: image for image in images.values()})
        located.append(located_point)
        notes += dropped + ([f"{point.name} is left out: {located_point.problem}"] if located_point.problem else [])
    return located, notes


def _agreed(point: SurveyedPoint, images: Mapping[str, pycolmap.Image]) -> tuple[LocatedPoint, list[str]]:
    """A point by the largest set of its clicks that agree, and a line for every other click."""
    nowhere = LocatedPoint(point, np.full(3, np.nan), np.zeros(0))
    if len(point.clicks) < 2:
        where = f"in {point.clicks[0].photo} only" if point.clicks else "in no registered photo"
        return replace(nowhere, problem=f"it is clicked {where}; click it in two or more"), []
    seen, pixels = [images[click.photo] for click in point.clicks], np.array([click.pixel for click in point.clicks])
    limit = np.array([MAX_CLICK_MISS * max(i.camera.width, i.camera.height) for i in seen if i.camera is not None])
    everyone = tuple(range(len(seen)))
    found: dict[tuple[int, ...], Array] = {}
    for chosen in [everyone, *combinations(everyone, 2)]:
        position, _ = intersect([seen[k] for k in chosen], pixels[list(chosen)])
        if position is not None:
            agree = tuple(int(k) for k in np.flatnonzero(off_px(position, seen, pixels) <= limit))
            if set(chosen) <= set(agree):
                found.setdefault(agree, position)
        if everyone in found:
            break
    most = max((len(agree) for agree in found), default=0)
    best = [agree for agree in found if len(agree) == most]
    if len(best) != 1:
        position, _ = intersect(seen, pixels)
        off = [np.inf] * len(seen) if position is None else off_px(position, seen, pixels)
        miss = ", ".join(f"{click.photo} {px:.0f} px" for click, px in zip(point.clicks, off))
        return replace(nowhere, problem=f"its clicks contradict each other ({miss}); correct them"), []
    agree = best[0]
    position, _ = intersect([seen[k] for k in agree], pixels[list(agree)])
    assert position is not None
    off = off_px(position, seen, pixels)
    dropped = [
        f"{point.name}: the click in {click.photo} is {off[k]:.0f} px off where {most} others show the point, and is"
        " left out"
        for k, click in enumerate(point.clicks)
        if k not in agree
    ]
    return LocatedPoint(replace(point, clicks=[point.clicks[k] for k in agree]), position, off[list(agree)]), dropped


def off_px(position: Array, images: list[pycolmap.Image], pixels: Array) -> Array:
    """(N,) distances of a point (3,) in photos from pixels (N, 2); infinite behind a camera."""
    seen = [image.project_point(position) for image in images]
    return np.array([np.inf if at is None else np.linalg.norm(at - pixel) for at, pixel in zip(seen, pixels)])


def check_spread(target: Array, names: list[str], where: str) -> None:
    """StageError where points (N, 3; metres) lie at one place or along one line."""
    centred = target - target.mean(0)
    extent = np.linalg.svd(centred, compute_uv=False)
    if extent[1] <= MIN_WIDTH_SHARE * extent[0] or extent[0] == 0:
        raise StageError(
            f"{where}: the control points {', '.join(names)} lie along one line, which leaves the model free to turn"
            " about it; add one beside the line"
        )


def seen_at(located: list[LocatedPoint], model: pycolmap.Reconstruction) -> tuple[Array, Array]:
    """Places (N, 3) of points in a model by their clicks, and RMS distances (N,) of clicks from these, in pixels.

    NaN where clicks give nothing.
    """
    images = {model.images[i].name: model.images[i] for i in model.reg_image_ids()}
    places, rms_px = np.full((len(located), 3), np.nan), np.full(len(located), np.nan)
    for row, located_point in enumerate(located):
        if not located_point.problem:
            seen = [images[click.photo] for click in located_point.point.clicks]
            position, residual = intersect(seen, np.array([click.pixel for click in located_point.point.clicks]))
            if position is not None:
                places[row], rms_px[row] = position, residual
    return places, rms_px


def describe_misses(located_point: LocatedPoint, local_from_model: Sim3, target: Array) -> str:
    """How far a point (3,) is from its coordinates, and where it was clicked."""
    miss = float(np.sqrt(np.nansum((local_from_model.apply(located_point.x_in_model) - target) ** 2)))
    photos = ", ".join(click.photo for click in located_point.point.clicks)
    return f"by its clicks in {photos} it lies {miss:.2f} m from its coordinates; correct these or the clicks"

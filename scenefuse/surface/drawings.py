"""Drawings of a surface to scale: from above in the CRS, and elevations along the object's own walls (method F9)."""

from dataclasses import dataclass, replace
from datetime import date
from pathlib import Path
from typing import Any

import numpy as np
import pyproj
import rasterio
from matplotlib.backends.backend_pdf import PdfPages
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from numpy.typing import NDArray
from rasterio import Affine
from rasterio.enums import ColorInterp
from scipy.ndimage import map_coordinates
from scipy.spatial import cKDTree

from scenefuse.cloud.crs import crs_name, points_north
from scenefuse.core.stage import StageError, atomic_directory, quantity, read_json, threads, write_json
from scenefuse.core.transforms import UP, Array, along_a_line
from scenefuse.fuse.compare import MARGIN
from scenefuse.fuse.measure import SUPPORT
from scenefuse.photos.geodesy import LocalFrame, length_unit, scene_frame
from scenefuse.photos.sheets import round_below
from scenefuse.surface.gltf import BRIDGED_TINT, NO_COLOR, Painted, metres_per_unit, read_painted
from scenefuse.surface.make_surface import read_surface
from scenefuse.surface.mesh import AT_ONCE, FaceClass, Surface, cast, caster
from scenefuse.surface.texture import MAX_SIDE_PX

# Width and height of a page, A3, and of what is drawn on it at most, metres.
PAGE, DRAWN = np.array([0.42, 0.297]), np.array([0.37, 0.247])
COLORS = (ColorInterp.red, ColorInterp.green, ColorInterp.blue, ColorInterp.alpha)
# Value of the class band where nothing is.
NOTHING = 255
# Axes of drawings, right and up, by the side that they are seen from; a drawing's third axis points at the viewer.
SIDES = {
    "above": ((1, 0, 0), (0, 1, 0)),
    "south": ((1, 0, 0), (0, 0, 1)),
    "east": ((0, 1, 0), (0, 0, 1)),
    "north": ((-1, 0, 0), (0, 0, 1)),
    "west": ((0, -1, 0), (0, 0, 1)),
}


@dataclass(frozen=True)
class Drawing:
    """A parallel projection of a surface's outside; the bands are (H, W), the first row at the top.

    Attributes:
        colors: (H, W, 4) uint8 RGBA, one tint where a gap is bridged.
        heights: float32, distance towards the viewer along the third axis; NaN where nothing is.
        classes: uint8 values of FaceClass, NOTHING where nothing is.
        deviations: float32, NaN where unknown, and where a gap is bridged.
        left, top: of the picture's upper left corner along the drawing's axes.
        pixel: side of a pixel; all lengths are in the surface's unit.
    """

    colors: NDArray[np.uint8]
    heights: NDArray[np.float32]
    classes: NDArray[np.uint8]
    deviations: NDArray[np.float32]
    left: float
    top: float
    pixel: float


def draw(surface: Surface, painted: Painted | None, axes: Array, pixel: float) -> Drawing:
    """Draw a surface along the third of some axes.

    Args:
        surface: what is measured, and how well.
        painted: the same with a picture; None for the colours of its vertices.
        axes: (3, 3) unit rows: right, up, towards the viewer.
        pixel: side of a pixel; larger where a picture would be longer than MAX_SIDE_PX.
    """
    points = surface.vertices.points @ axes.T
    low, high = points.min(0), points.max(0)
    pixel = max(pixel, float((high - low)[:2].max()) / MAX_SIDE_PX)
    left, bottom = (np.floor(low[:2] / pixel) - 1) * pixel
    width, height = np.ceil((high[:2] - [left, bottom]) / pixel).astype(int) + 1
    top = bottom + height * pixel
    scene, count = caster(points, surface.faces), width * height
    pictures = None if painted is None else caster(painted.points @ axes.T, painted.shown)
    heights, deviations = np.full(count, np.nan, np.float32), np.full(count, np.nan, np.float32)
    classes, colors = np.full(count, NOTHING, np.uint8), np.zeros((count, 4), np.uint8)
    for row in np.array_split(np.arange(height), -(-count // AT_ONCE)):
        x, y = np.meshgrid(left + (np.arange(width) + 0.5) * pixel, top - (row + 0.5) * pixel)
        origins = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, high[2] + pixel)])
        down, first = np.tile([0.0, 0, -1], (x.size, 1)), row[0] * width
        hit = cast(scene, origins, down)
        # Nobody measured what the back of a surface hides, a facade's from behind for instance.
        hit["t_hit"][hit["primitive_normals"][:, 2] < 0] = np.inf
        on = np.flatnonzero(np.isfinite(hit["t_hit"]))
        face, at = hit["primitive_ids"][on].astype(np.int64), first + on
        corner = surface.faces[face]
        weights = _weights(hit["primitive_uvs"][on])
        heights[at] = origins[on, 2] - hit["t_hit"][on]
        classes[at] = surface.classes[face]
        deviations[at] = (surface.vertices.fields["deviation"][corner] * weights).sum(1)
        colors[at] = *NO_COLOR, 255
        if surface.vertices.colors is not None:
            colors[at, :3] = (surface.vertices.colors[corner] * weights[..., None]).sum(1)
        if painted is not None:
            found = cast(pictures, origins, down)
            # Where a gap is bridged nothing is painted, and the ray goes on to another part.
            away = np.abs(found["t_hit"] - np.where(np.isfinite(hit["t_hit"]), hit["t_hit"], -np.inf))
            of = np.flatnonzero(away <= MARGIN * surface.vertices.diagonal)
            uv = painted.uv[painted.shown[found["primitive_ids"][of].astype(np.int64)]]
            at = (uv * _weights(found["primitive_uvs"][of])[..., None]).sum(1) * painted.picture.shape[1::-1] - 0.5
            for k in range(3):
                band = painted.picture[..., k]
                colors[first + of, k] = map_coordinates(band, at[:, ::-1].T, order=1, mode="nearest")
    bridged = classes == FaceClass.BRIDGED
    colors[bridged, :3], deviations[bridged] = BRIDGED_TINT, np.nan
    shape = (height, width)
    flat = (heights.reshape(shape), classes.reshape(shape), deviations.reshape(shape))
    return Drawing(colors.reshape(*shape, 4), *flat, float(left), float(top), pixel)


def _weights(uvs: NDArray[Any]) -> Array:
    """(N, 3) of a triangle's corners at places that Embree gives by two of them."""
    return np.column_stack([1 - uvs.sum(1), uvs])


def wall_turn(surface: Surface) -> float:
    """Angle, radians within 45 degrees, from east or north to the object's walls; 0 where most agree on none."""
    corners = surface.vertices.points[surface.faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    # The level part of a normal, weighted by the area that it has seen from the side.
    flat = normals[:, 0] + 1j * normals[:, 1]
    length = np.abs(flat)
    mean = (flat**4 / np.maximum(length, 1e-30) ** 3).sum() / max(float(length.sum()), 1e-30)
    return float(np.angle(mean)) / 4 if abs(mean) >= SUPPORT else 0.0


def facade_axes(surface: Surface, points: Array) -> Array:
    """Axes (3, 3) of a drawing of the plane through three points (3, 3), seen from where the surface faces.

    Raises:
        StageError: the points lie in a line.
    """
    if along_a_line(points):
        raise StageError("the three points of the facade lie in a line; click three of its corners")
    normal = np.cross(points[1] - points[0], points[2] - points[0])
    toward, vertices = normal / np.linalg.norm(normal), surface.vertices
    distance = np.abs((vertices.points - points[0]) @ toward)
    # The other side of a thin wall is beside the plane too, but farther off than most of this one.
    nearest = np.argsort(distance)[: (np.count_nonzero(distance <= MARGIN * vertices.diagonal) + 1) // 2]
    assert vertices.normals is not None
    toward *= -1.0 if (vertices.normals[nearest] @ toward).sum() < 0 else 1.0
    # Up is y where the plane is level.
    upright = UP if abs(toward @ UP) < 1 - MARGIN else np.array([0.0, 1, 0])
    right = np.cross(upright, toward)
    right /= np.linalg.norm(right)
    return np.array([right, np.cross(toward, right), toward])


def draw_surface(
    *,
    name: str,
    surface: Path,
    glb: Path,
    georeference_json: Path | None = None,
    facade: tuple[float, ...] = (),
    folder: Path,
) -> None:
    """Draw an object from above and from four sides, and a facade of it.

    Of each drawing NAME: NAME.png, a sheet with frame and scale bar; NAME.tif, the picture; NAME_height.tif,
    NAME_class.tif, NAME_deviation.tif. `above` is a GeoTIFF in the scene's CRS where it has one.
    Elevations are turned to the object's walls; heights of `facade` are distances from its plane. drawings.pdf has all
    sheets, A3, to the scale that they say.

    Args:
        name: of the object.
        surface: PLY of `make_surface`.
        glb: the same with a picture from photos, or without.
        georeference_json: JSON of the scene.
        facade: x y z of three points of a wall or a roof, in the scene's frame; none for no such drawing.
        folder: output, with drawings.json: pixel and scale of each, and NAME_from_scene, (4, 4): the files' x, y and
            distance towards the viewer of a place in the scene; of `above` where it is in no CRS.
    """
    whole, painted = read_surface(surface), read_painted(glb)
    unit = length_unit(georeference_json)
    metres = metres_per_unit(unit)
    report: dict[str, Any] = {"status": quantity("drawn" if len(whole.faces) else "empty", "")}
    if painted is not None:
        painted = replace(painted, points=painted.points / metres)
    turn = wall_turn(whole) if len(whole.faces) else 0.0
    frame = None if georeference_json is None else scene_frame(read_json(georeference_json))
    # Of the CRS in one of the scene, which counts in metres where its CRS may in feet.
    per_unit = 1.0 if frame is None else float(np.ptp(frame.in_crs(UP * np.arange(2)[:, None])[:, 2]))
    has_north = frame is not None and frame.has_north
    with atomic_directory(folder) as output, PdfPages(output / "drawings.pdf", metadata={"CreationDate": None}) as pdf:
        for side, axes in _axes_of(whole, turn, facade).items() if len(whole.faces) else ():
            drawn, shown, crs, shift, counted, ratio = whole, painted, None, np.zeros(3), unit, 1.0
            if side != "above":
                if side == "facade":
                    shift[2] = -axes[2] @ np.array(facade[:3])
                # Of an inclined plane, up are no heights; of one that leans a little they are, where it was clicked.
                if axes[1] @ UP > 1 - MARGIN:
                    clicked = np.reshape(facade, (3, 3)) if side == "facade" else whole.vertices.points
                    middle = clicked.mean(0)
                    height = middle[2] if frame is None else frame.in_crs(middle[None])[0, 2] / per_unit
                    shift[1] = height - axes[1] @ middle
            elif frame is not None:
                crs, shift, ratio = frame.crs, np.floor(frame.in_crs(np.zeros((1, 3)))[0]), per_unit
                counted = frame.crs_unit if isinstance(frame, LocalFrame) else unit
                vertices = whole.vertices
                fields = vertices.fields | {"deviation": ratio * vertices.fields["deviation"]}
                points = frame.in_crs(vertices.points) - shift
                drawn = replace(whole, vertices=replace(vertices, points=points, fields=fields))
                shown = None if painted is None else replace(painted, points=frame.in_crs(painted.points) - shift)
            drawing = draw(drawn, shown, axes, ratio * pixel_of(whole, painted))
            _write_bands(output / side, drawing, crs, shift, counted)
            towards = f", looking towards {np.degrees(np.arctan2(-axes[2, 0], -axes[2, 1])) % 360:.0f}°"
            towards += "" if has_north else ", y taken for north"
            if abs(axes[2] @ UP) > 1 - MARGIN:
                towards = f", looking {'down' if axes[2] @ UP > 0 else 'up'}"
            scale = _scale(drawing, metres / ratio, unit)
            where = {"above": "plan", "facade": "facade"}.get(side, f"elevation from the {side}")
            title = f"{name}, {where}{'' if side == 'above' else towards}"
            title += f"; 1:{scale} on A3" if unit != "scene units" else ""
            left = drawing.left + shift[0] if side == "above" else 0.0
            corner = (left, drawing.top + shift[1])
            figure = _sheet(drawing, title, counted, metres / ratio / scale, corner, crs)
            figure.savefig(output / f"{side}.png", dpi=200)
            pdf.savefig(figure)
            report[f"{side}_pixel"], report[f"{side}_scale"] = quantity(drawing.pixel, counted), quantity(scale, "1")
            if crs is None:
                report[f"{side}_from_scene"] = quantity(np.vstack([np.column_stack([axes, shift]), [0, 0, 0, 1]]), unit)
        if not len(whole.faces):
            pdf.savefig(Figure(figsize=(1, 1)))
        report |= {"wall_turn": quantity(float(np.degrees(turn)), "deg"), "crs": quantity(frame and frame.crs, "")}
        report["has_north"] = quantity(has_north, "")
        write_json(output / "drawings.json", report)


def _axes_of(surface: Surface, turn: float, facade: tuple[float, ...]) -> dict[str, Array]:
    """Axes (3, 3) of all drawings: right, up, towards the viewer."""
    c, s = np.cos(turn), np.sin(turn)
    turned = np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])
    axes = {side: np.array([right, up, np.cross(right, up)], np.float64) for side, (right, up) in SIDES.items()}
    axes = {side: own if side == "above" else own @ turned for side, own in axes.items()}
    return axes | ({"facade": facade_axes(surface, np.reshape(facade, (3, 3)))} if facade else {})


def pixel_of(surface: Surface, painted: Painted | None) -> float:
    """Side of a drawing's pixel: the picture's, which follows the photos; else the distance between vertices."""
    if painted is None:
        points = surface.vertices.points
        return float(np.median(cKDTree(points).query(points, k=2, workers=threads())[0][:, 1]))
    corners, flat = painted.points[painted.shown], painted.uv[painted.shown] * painted.picture.shape[1::-1]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1).sum()
    a, b = flat[:, 1] - flat[:, 0], flat[:, 2] - flat[:, 0]
    return float(np.sqrt(area / np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum()))


def _write_bands(path: Path, drawing: Drawing, crs: str | None, shift: Array, unit: str) -> None:
    """PATH.tif and its bands, cloud-optimised GeoTIFFs, in the CRS where there is one; each says what it holds."""
    towards = "height" if path.name == "above" else "distance towards the viewer"
    height, width = drawing.classes.shape
    plane = {
        "transform": Affine(drawing.pixel, 0, drawing.left + shift[0], 0, -drawing.pixel, drawing.top + shift[1]),
        "crs": None if crs is None else pyproj.CRS.from_user_input(crs).to_2d().to_wkt(),
        "driver": "COG",
        "compress": "deflate",
        "overview_resampling": "nearest",
    }
    classes = ", ".join(f"{kind} {kind.name.lower()}" for kind in FaceClass)
    for ending, band, nothing, said in (
        ("", np.moveaxis(drawing.colors, 2, 0), None, ""),
        ("_height", (drawing.heights + np.float32(shift[2]))[None], np.nan, f"{towards} ({unit})"),
        ("_class", drawing.classes[None], NOTHING, classes),
        ("_deviation", drawing.deviations[None], np.nan, f"standard deviation ({unit})"),
    ):
        shape = {"count": len(band), "height": height, "width": width, "dtype": band.dtype, "nodata": nothing}
        with rasterio.open(f"{path}{ending}.tif", "w", **shape, **plane) as file:
            file.write(band)
            if len(band) == 4:
                file.colorinterp = COLORS
            else:
                file.set_band_description(1, said)


def _scale(drawing: Drawing, metres: float, unit: str) -> float:
    """N of the largest scale 1:N, N = 1, 2 or 5 times a power of ten, at which a drawing fits on the page; of "scene
    units" less than 1 too."""
    height, width = drawing.classes.shape
    needed = metres * drawing.pixel * max(width / DRAWN[0], height / DRAWN[1])
    scale = 1 / round_below(1 / needed)
    return scale if unit == "scene units" else max(1, round(scale))


def _sheet(
    drawing: Drawing, title: str, unit: str, page_per_unit: float, corner: tuple[float, float], crs: str | None
) -> Figure:
    """A page with a frame and a scale bar.

    Args:
        drawing: what is on it.
        title: above the frame.
        unit: of lengths.
        page_per_unit: metres of the page for a unit.
        corner: what the frame says of its upper left.
        crs: of a plan, whose north is up where y points there; None for another drawing.
    """
    inch = 0.0254
    height, width = (side * drawing.pixel for side in drawing.classes.shape)
    figure = Figure(figsize=(PAGE[0] / inch, PAGE[1] / inch), facecolor="white")
    size = width * page_per_unit / PAGE[0], height * page_per_unit / PAGE[1]
    axes = figure.add_axes(((1 - size[0]) / 2, (1 - size[1]) / 2, *size))
    extent = (corner[0], corner[0] + width, corner[1] - height, corner[1])
    axes.set_facecolor("0.85")  # a wall may be white
    axes.imshow(drawing.colors, extent=extent, interpolation="antialiased")
    axes.ticklabel_format(useOffset=False, style="plain")
    axes.tick_params(labelsize=7)
    axes.set_title(f"{title} ({unit})", fontsize=10)
    bar = round_below(width / 2)
    left, low = (1 - size[0]) / 2, (1 - size[1]) / 2 - 0.05
    ends = [left, left + bar * page_per_unit / PAGE[0]], [low, low]
    figure.add_artist(Line2D(*ends, color="black", linewidth=4, solid_capstyle="butt"))
    figure.text(left, low + 0.01, f"{bar:g} {unit}", fontsize=8)
    figure.text(left, low - 0.02, f"purple: interpolated; grey: not measured; drawn {date.today()}", fontsize=8)
    if crs is not None:
        figure.text(left, low - 0.04, crs_name(crs), fontsize=8)
    if crs is not None and points_north(crs):
        axes.annotate("N", (1.03, 1), (1.03, 0.9), "axes fraction", ha="center", arrowprops={"arrowstyle": "-|>"})
    return figure

"""Sheets of pictures with captions: matplotlib for the layout."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray
from PIL import Image as Picture

from scenefuse.core.stage import atomic_file

Image = NDArray[np.uint8]
# A caption and its picture; None leaves the place empty, without a caption too.
Cell = tuple[str, Image | None]
# Width and height of a picture on a sheet.
TILE_PX = (400, 300)
# Between the pictures of a sheet, and for a line of text: a row's label, a caption.
MARGIN_PX = 26


def draw_sheet(
    title: str,
    note: str,
    rows: Sequence[Sequence[Cell]],
    tile_px: tuple[int, int] = TILE_PX,
    labels: Sequence[str] = (),
) -> Figure:
    """A sheet of pictures in rows, whose axes count in pixels; `save_png` writes it.

    Args:
        title: first line.
        note: lines below it.
        rows: captions and pictures, row by row.
        tile_px: width and height of every picture.
        labels: one a row, written upwards at its left; none where this is empty.
    """
    shape, lines = (len(rows), max(map(len, rows))), 2 + len(note.splitlines())
    # Text grows with the pictures, so that it is read where a page shows the sheet small.
    zoom = max(1.0, tile_px[0] / TILE_PX[0])
    width, height = (MARGIN_PX + count * (side / zoom + MARGIN_PX) for count, side in zip(shape[::-1], tile_px))
    height += (lines - 1) * MARGIN_PX
    figure = Figure(figsize=(width / 100, height / 100), dpi=100 * zoom)
    FigureCanvasAgg(figure)
    left, line = MARGIN_PX / width, MARGIN_PX / height
    cells = figure.subplots(
        *shape, squeeze=False, subplot_kw={"xticks": [], "yticks": []},
        gridspec_kw={"left": left, "right": 1 - left, "bottom": line, "top": 1 - lines * line}
        | dict(zip(("wspace", "hspace"), np.divide(zoom * MARGIN_PX, tile_px))),
    )  # fmt: skip
    figure.text(left, 1 - line / 4, title, fontsize="large", fontweight="bold", va="top")
    figure.text(left, 1 - line, note, color="0.3", va="top")
    for row, pictures in zip(cells, rows):
        for axes, (caption, picture) in zip(row, pictures):
            axes.set_title(caption, fontsize="medium", pad=3)
            axes.spines[:].set_color("0.85")
            axes.set_visible(picture is not None or caption != "")
            if picture is not None:
                size = (0, picture.shape[1], picture.shape[0], 0)
                axes.imshow(picture, interpolation="antialiased", extent=size)
                axes.set(xlim=size[:2], ylim=size[2:])
    for row, label in zip(cells, labels):
        row[0].set_ylabel(label, fontsize="large")
    return figure


def draw_scale(axes: Any, px_per_unit: float, unit: str, has_north: bool, at_right: bool = False) -> None:
    """A scale bar at a lower corner of a map; an arrow above it to the north, where it is known to be up."""
    right, low = axes.get_xlim()[1], axes.get_ylim()[0]
    bar, box = round_below(right / px_per_unit / 4), {"color": "white", "alpha": 0.7, "pad": 1}
    start = 0.96 * right - bar * px_per_unit if at_right else 0.04 * right
    ends = [start, start + bar * px_per_unit], [0.96 * low] * 2
    axes.plot(*ends, color="black", linewidth=3, solid_capstyle="butt", zorder=6)
    axes.text(start, 0.94 * low, f"{bar:g} {unit}", zorder=5, bbox=box)
    if has_north:
        arrow = {"arrowstyle": "-|>", "color": "black"}
        axes.annotate("N", (start, 0.68 * low), (start, 0.82 * low), ha="center", zorder=5, arrowprops=arrow, bbox=box)


def round_below(value: float) -> float:
    """The largest of 1, 2 and 5 times a power of ten that is not above a value."""
    power = 10.0 ** np.floor(np.log10(value))
    return float(power * max((k for k in (2, 5) if k * power <= value), default=1))


def depth_colors(depth: NDArray[np.float32], low: float, high: float) -> Image:
    """(H, W, 3) colours of a depth map, near bright; pixels without a depth are light grey."""
    level = 1.0 - np.clip((depth - low) / max(high - low, 1e-9), 0.0, 1.0)
    picture = (colormaps["viridis"](level)[..., :3] * 255).astype(np.uint8)
    picture[depth <= 0] = 235
    return picture


def save_png(path: Path, image: Image | Figure) -> None:
    """Write a PNG."""
    if isinstance(image, Figure):
        assert isinstance(image.canvas, FigureCanvasAgg)
        image.canvas.draw()
        image = np.asarray(image.canvas.buffer_rgba())[..., :3].copy()
    with atomic_file(path) as temporary:
        Picture.fromarray(image).save(temporary)

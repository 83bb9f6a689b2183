"""Sheets of pictures with labels: matplotlib for the layout, small PNG files."""

import io
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray
from PIL import Image as Picture

from scenefuse.core.stage import atomic_file

Image = NDArray[np.uint8]

_MAX_BYTES = 950_000


@dataclass(frozen=True)
class Sheet:
    """A grid of pictures.

    Attributes:
        title: first line, bold.
        note: second line, small; empty for none.
        rows: the pictures, row by row; None leaves a cell empty.
        row_labels: one per row, written upwards at its left; empty for none.
        column_labels: over the pictures of the first row; empty for none.
        captions: (row, column) -> text over that picture, instead of a column label.
        tile_px: width and height of every cell.
    """

    title: str
    note: str
    rows: list[list[Image | None]]
    row_labels: list[str]
    column_labels: list[str]
    captions: dict[tuple[int, int], str]
    tile_px: tuple[int, int]


def draw_sheet(sheet: Sheet) -> Image:
    """The sheet as (H, W, 3) uint8 RGB."""
    rows, columns = len(sheet.rows), max(len(row) for row in sheet.rows)
    width, height = sheet.tile_px
    left, gap, top = (34 if sheet.row_labels else 8), 6, (54 if sheet.note else 34)
    captioned = {row for row, _ in sheet.captions} | ({0} if sheet.column_labels else set())
    tops, y = [], top
    for row in range(rows):
        y += 22 if row in captioned else 0
        tops.append(y)
        y += height + gap
    full = (left + columns * (width + gap) + 2, y + 2)
    figure = new_figure(full)
    figure.text(left / full[0], 1 - 10 / full[1], sheet.title, fontsize=12, fontweight="bold", va="top")
    if sheet.note:
        figure.text(left / full[0], 1 - 32 / full[1], sheet.note, fontsize=9.5, color="#444444", va="top")
    for row, images in enumerate(sheet.rows):
        if sheet.row_labels:
            x, middle = 0.45 * left / full[0], 1 - (tops[row] + height / 2) / full[1]
            figure.text(x, middle, sheet.row_labels[row], rotation=90, ha="center", va="center", fontsize=11)
        for column, image in enumerate(images):
            x = left + column * (width + gap)
            label = sheet.captions.get((row, column), "")
            if not label and row == 0 and column < len(sheet.column_labels):
                label = sheet.column_labels[column]
            if label:
                figure.text((x + width / 2) / full[0], 1 - (tops[row] - 5) / full[1], label, ha="center", fontsize=10)
            axes = add_axes(figure, (x, tops[row], width, height), full)
            if image is None:
                axes.text(0.5, 0.5, "none", ha="center", va="center", color="#999999", transform=axes.transAxes)
            else:
                axes.imshow(image, interpolation="antialiased", aspect="equal")
    return to_image(figure)


def new_figure(size_px: tuple[int, int]) -> Figure:
    """An empty white figure of that many pixels, with no display behind it."""
    dpi = 100
    figure = Figure(figsize=(size_px[0] / dpi, size_px[1] / dpi), dpi=dpi, facecolor="white")
    FigureCanvasAgg(figure)
    return figure


def add_axes(figure: Figure, box_px: tuple[int, int, int, int], size_px: tuple[int, int]) -> Axes:
    """Bare axes at x, y (from the top), width, height in pixels."""
    x, y, width, height = box_px
    axes = figure.add_axes(
        (x / size_px[0], 1 - (y + height) / size_px[1], width / size_px[0], height / size_px[1]),
        xticks=[],
        yticks=[],
        anchor="C",
    )
    for spine in axes.spines.values():
        spine.set_color("#dddddd")
    return axes


def to_image(figure: Figure) -> Image:
    """The drawn figure as (H, W, 3) uint8 RGB."""
    canvas = figure.canvas
    assert isinstance(canvas, FigureCanvasAgg)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()


def depth_colors(depth: NDArray[np.float32], low: float, high: float) -> Image:
    """(H, W, 3) colours of a depth map, near bright; pixels without a depth are light grey."""
    level = 1.0 - np.clip((depth - low) / max(high - low, 1e-9), 0.0, 1.0)
    picture = (colormaps["viridis"](level)[..., :3] * 255).astype(np.uint8)
    picture[depth <= 0] = 235
    return picture


def save_png(path: Path, image: Image) -> None:
    """Write a PNG below 1 MB: full colour if that fits, else 256 colours, else smaller."""
    picture = Picture.fromarray(image)
    data = _encode(picture)
    if len(data) > _MAX_BYTES:
        data = _encode(picture.quantize(256, dither=Picture.Dither.NONE))
    while len(data) > _MAX_BYTES:
        picture = picture.resize((picture.width * 9 // 10, picture.height * 9 // 10), Picture.Resampling.LANCZOS)
        data = _encode(picture.quantize(256, dither=Picture.Dither.NONE))
    with atomic_file(path) as temporary:
        temporary.write_bytes(data)


def _encode(picture: Picture.Image) -> bytes:
    buffer = io.BytesIO()
    picture.save(buffer, format="PNG", compress_level=6)
    return buffer.getvalue()

"""One picture of all masks over their photos, for a person to check in ten seconds."""

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from scenefuse.geometry.visual_hull import Mask
from scenefuse.photos.workspace import View

WIDTH_PX = 240
"""Of one photo on the sheet."""
COLUMNS = 8
GREEN, RED, WHITE = (0, 255, 0), (255, 0, 0), (255, 255, 255)


def draw_contact_sheet(
    views: list[View], masks: list[Mask], notes: list[str], dropped: list[bool]
) -> NDArray[np.uint8]:
    """(H, W, 3) RGB: all photos, the background dimmed, the mask's outline green, or red where the photo is left out.

    Args:
        views: photos with colours, (H, W, 3) uint8 RGB.
        masks: (H, W) per photo.
        notes: a few characters per photo, written beside its name.
        dropped: whether a photo is left out.
    """
    tiles = []
    for view, mask, note, out in zip(views, masks, notes, dropped):
        height = round(WIDTH_PX * view.height / view.width)
        picture = np.where(mask[..., None], view.pixels, view.pixels // 3).astype(np.uint8)
        edge = mask & ~ndimage.binary_erosion(mask, iterations=max(1, view.width // 640))
        picture[edge] = RED if out else GREEN
        tile = cv2.resize(picture, (WIDTH_PX, height), interpolation=cv2.INTER_AREA)
        if out:
            cv2.rectangle(tile, (0, 0), (WIDTH_PX - 1, height - 1), RED, 3)
        cv2.putText(tile, f"{Path(view.name).stem} {note}", (5, 14), cv2.FONT_HERSHEY_SIMPLEX, 0.42, WHITE, 1)
        tiles.append(tile)
    columns = min(COLUMNS, len(tiles))
    tallest = max(t.shape[0] for t in tiles)
    sheet = np.zeros((-(-len(tiles) // columns) * tallest, columns * WIDTH_PX, 3), dtype=np.uint8)
    for k, tile in enumerate(tiles):
        row, column = divmod(k, columns)
        sheet[row * tallest : row * tallest + tile.shape[0], column * WIDTH_PX : (column + 1) * WIDTH_PX] = tile
    return sheet

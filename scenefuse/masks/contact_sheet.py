"""One picture of all masks over their photos, for a person to check in ten seconds."""

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from scenefuse.mvs.visual_hull import Frame, Mask


def contact_sheet(
    frames: list[Frame], masks: list[Mask], notes: list[str], dropped: list[bool], width_px: int = 240
) -> NDArray[np.uint8]:
    """All photos, the background dimmed and the mask's outline drawn: green, or red where the photo is left out.

    Args:
        frames: the photos.
        masks: (H, W) per photo.
        notes: a few characters per photo, written beside its name.
        dropped: whether a photo is left out.
        width_px: width of one photo on the sheet.
    """
    tiles = []
    for frame, mask, note, out in zip(frames, masks, notes, dropped):
        height = round(width_px * frame.image.shape[0] / frame.image.shape[1])
        picture = np.where(mask[..., None], frame.image, frame.image // 3).astype(np.uint8)
        edge = mask & ~ndimage.binary_erosion(mask, iterations=max(1, frame.image.shape[1] // 640))
        picture[edge] = (0, 0, 255) if out else (0, 255, 0)
        tile = cv2.resize(picture, (width_px, height), interpolation=cv2.INTER_AREA)
        if out:
            cv2.rectangle(tile, (0, 0), (width_px - 1, height - 1), (0, 0, 255), 3)
        text = f"{Path(frame.name).stem} {note}"
        cv2.putText(tile, text, (5, 14), cv2.FONT_HERSHEY_SIMPLEX, 0.42, (255, 255, 255), 1)
        tiles.append(tile)
    columns = min(8, len(tiles))
    tallest = max(t.shape[0] for t in tiles)
    sheet = np.zeros((-(-len(tiles) // columns) * tallest, columns * width_px, 3), dtype=np.uint8)
    for k, tile in enumerate(tiles):
        row, column = divmod(k, columns)
        sheet[row * tallest : row * tallest + tile.shape[0], column * width_px : (column + 1) * width_px] = tile
    return sheet

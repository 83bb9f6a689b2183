"""Masks as transparent pictures to lay over photos."""

import cv2
import numpy as np
from numpy.typing import NDArray

TINT = 70
"""Opacity of a mask's inside, of 255."""
LINE = 1 / 400
"""Width of its outline, as a share of the longer side."""
CLICKED, CARRIED = (0, 200, 83), (255, 145, 0)
"""RGB of a mask from clicks, and of one that the workflow made."""


def overlay(mask: NDArray[np.bool_], colour: tuple[int, int, int]) -> bytes:
    """PNG with alpha, of the mask's size: its inside tinted, its outline opaque."""
    pixels = np.zeros((*mask.shape, 4), dtype=np.uint8)
    pixels[..., :3] = colour[::-1]
    pixels[mask, 3] = TINT
    width = max(2, round(LINE * max(mask.shape)))
    lines, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_CCOMP, cv2.CHAIN_APPROX_SIMPLE)
    cv2.drawContours(pixels, lines, -1, (*colour[::-1], 255), width)
    return cv2.imencode(".png", pixels, [cv2.IMWRITE_PNG_COMPRESSION, 3])[1].tobytes()

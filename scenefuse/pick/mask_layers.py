"""The masks over the photo that is shown: that of its clicks, made at once, and the workflow's."""

import asyncio
import base64
from collections.abc import Callable

import cv2
import numpy as np
from numpy.typing import NDArray

from scenefuse.core.stage import StageError
from scenefuse.pick.edits import Rows
from scenefuse.pick.photo_map import COLOURS, EXPECTED, PhotoMap
from scenefuse.pick.photo_tiles import MASK_PX, Picture
from scenefuse.pick.session import Session

# Opacity of a mask's inside, of 255, and width of its outline where its longer side has MASK_PX.
TINT, OUTLINE_PX = 70, 3


class MaskLayers:
    """Lays masks over a map's photo as its clicks and the workflow's results change.

    Attributes:
        note: what is wrong with the mask of the clicks; "" where nothing is.
    """

    def __init__(self, session: Session, photo_map: PhotoMap, on_note: Callable[[], None]) -> None:
        self._session, self._map, self._on_note = session, photo_map, on_note
        self._clicked: tuple[str, Rows] | None = None
        self._results: tuple[str, tuple[float, ...]] | None = None
        self._segmenting = asyncio.Lock()
        self.note = ""

    def forget(self) -> None:
        """Another photo is shown: no mask lies over it yet."""
        self._clicked = self._results = None

    def update(self, picture: Picture, clicks: Rows, visible: bool) -> None:
        """Lay what is not there yet, in the background, and take away what is no longer so."""
        results = (picture.name, self._session.results_state) if visible and self._session.masks.agreement else None
        if results != self._results:
            self._results = results
            self._map.lay("workflow", None)
            if results is not None:
                asyncio.get_running_loop().create_task(self._lay_workflow(picture, results))
        clicked = (picture.name, clicks) if visible and any(row.label != "outside" for row in clicks) else None
        if clicked != self._clicked:
            self._clicked, self.note = clicked, "Making it ..." if clicked else ""
            if clicked is None:
                self._map.lay("clicked", None)
            else:
                asyncio.get_running_loop().create_task(self._lay_clicked(picture, clicked))

    async def _lay_workflow(self, picture: Picture, results: tuple[str, tuple[float, ...]]) -> None:
        try:
            mask = await asyncio.to_thread(self._session.masks.mask, picture)
        except StageError as error:
            print(error, flush=True)
            return
        if mask is not None and results == self._results:
            self._map.lay("workflow", overlay(mask, EXPECTED))

    async def _lay_clicked(self, picture: Picture, clicked: tuple[str, Rows]) -> None:
        address = None
        try:
            async with self._segmenting:
                if clicked != self._clicked:
                    return
                mask, notes = await asyncio.to_thread(self._session.segmenter.mask, picture, clicked[1])
            note = " ".join(f"{sentence[0].upper()}{sentence[1:]}." for sentence in notes)
            address = overlay(mask, COLOURS["inside"])
        except StageError as error:
            note = str(error)
        if clicked == self._clicked:
            self._map.lay("clicked", address)
            self.note = note
            self._on_note()


def overlay(mask: NDArray[np.bool_], colour: str) -> str:
    """A mask (H, W) as the address of a transparent picture (data:) of a colour #rrggbb: its inside tinted, its outline
    opaque."""
    blue_green_red = tuple(bytes.fromhex(colour[1:]))[::-1]
    pixels = np.zeros((*mask.shape, 4), dtype=np.uint8)
    pixels[..., :3] = blue_green_red
    pixels[mask, 3] = TINT
    width = max(2, round(OUTLINE_PX * max(mask.shape) / MASK_PX))
    lines, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_CCOMP, cv2.CHAIN_APPROX_SIMPLE)
    cv2.drawContours(pixels, lines, -1, (*blue_green_red, 255), width)
    return "data:image/png;base64," + base64.b64encode(cv2.imencode(".png", pixels)[1].tobytes()).decode()

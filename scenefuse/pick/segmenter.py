"""The mask that the workflow makes of a photo from its clicks, at once: features are computed ahead."""

import threading
import time
from collections import OrderedDict
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from numpy.typing import NDArray

from scenefuse.core.stage import StageError, scratch_directory, threads
from scenefuse.core.transforms import Array
from scenefuse.masks.prompts import OUTLINE_BAND_SHARE, pixel_of
from scenefuse.pick.document import Rows
from scenefuse.pick.photo_tiles import MASK_PX, Picture, at_most, read_upright

if TYPE_CHECKING:
    from scenefuse.marks.photo_clicks import PhotoClicks
    from scenefuse.masks.sam2 import Sam2

Mask = NDArray[np.bool_]
# Photos whose features are kept; 17 MB each, and the photo.
KEPT_PHOTOS = 24
# Without a click for so long, photos that are not shown are prepared.
IDLE_S = 4.0


class Segmenter:
    """Masks of single photos from their clicks, as the masks' stage makes those of clicked photos.

    Attributes:
        method: what segments, for a person; "" until it is loaded.
        loading: what is being done until then.
        trouble: why it is not what the settings ask for, or why there is nothing; "" where all is well.
    """

    def __init__(self, settings: Mapping[str, Any], photo_px: int) -> None:
        """Nothing is loaded yet.

        Args:
            settings: `object.masks`.
            photo_px: longest side of an undistorted photo in the workflow.
        """
        self._settings, self._photo_px = settings, photo_px
        self._photos: OrderedDict[str, NDArray[np.uint8]] = OrderedDict()
        self._network: Sam2 | None = None
        self._ask: Callable[..., Any] | None = None
        self._busy = threading.Lock()
        self._waiting, self._asked_at = 0, -IDLE_S
        self.method = self.trouble = ""
        self.loading = "Loading the network ..."
        self._closed = False

    def load(self) -> None:
        """Load the network, or GrabCut where the settings say so or there are no weights; seconds.

        The weights are fetched, as the workflow would, where nothing has tried that yet.
        """
        from scenefuse.masks.grabcut import query_grabcut

        settings = self._settings
        with self._busy:
            if self.method:
                return
            if settings["method"] in ("auto", "sam2"):
                from scenefuse.masks.sam2 import load_network, query_sam2
                from scenefuse.masks.sam2_weights import WEIGHTS, UnavailableError

                try:
                    self._fetch_once(Path(WEIGHTS))
                    network = load_network(threads())
                    self._network, network.kept = network, KEPT_PHOTOS
                    self._ask, self.method = partial(query_sam2, network), "SAM 2"
                    return
                except (StageError, UnavailableError, OSError) as error:
                    self.trouble = f"Masks are shown by GrabCut, not by SAM 2: {error}"
            from scenefuse.masks.segmentation import MaskSettings

            self._ask, self.method = partial(query_grabcut, MaskSettings().grabcut_width_px), "GrabCut"

    def _fetch_once(self, place: Path) -> None:
        """Fetch the weights to their place, unless something has tried it already, or does so meanwhile.

        Raises:
            UnavailableError, OSError: they cannot be fetched or written; nothing is left behind then.
        """
        from scenefuse.masks.sam2_weights import download_weights

        if not place.exists():
            self.loading = "Fetching SAM 2's weights (184 MB, once) ..."
            with scratch_directory(place) as folder:
                download_weights(folder)
                if not place.exists():
                    folder.rename(place)

    def compute_ahead(self, wanted: Callable[[], list[Picture]]) -> None:
        """Compute features until closed, in the order wanted; run in a thread of its own.

        While a person clicks, only those of the first photo are computed.
        """
        self.load()
        while not self._closed:
            photos = wanted()[: None if self.is_idle() else 1] if self._network else []
            missing = [p for p in photos if p.name not in self._photos]
            if self._waiting or not missing:
                time.sleep(0.2)
                continue
            with self._busy:
                try:
                    assert self._network is not None
                    self._network.encode(self._pixels(missing[0]))
                except StageError as error:
                    print(error, flush=True)
                    self._photos[missing[0].name] = np.zeros((1, 1, 3), dtype=np.uint8)

    def is_idle(self) -> bool:
        """Whether nobody has clicked for some seconds, so that work in the background does not make a person wait."""
        return not self._waiting and time.monotonic() - self._asked_at > IDLE_S

    def close(self) -> None:
        """End `compute_ahead`."""
        self._closed = True

    def mask(self, picture: Picture, rows: Rows, shared: Array | None = None) -> tuple[Mask, list[str]]:
        """(H, W) mask of a photo from its own clicks, at most MASK_PX large, and what is wrong with it.

        Args:
            picture: the photo.
            rows: clicks, those in other photos too.
            shared: (N, 2) pixels of its sparse points, once there are any; corners take their place before.

        Raises:
            StageError: the photo cannot be read.
        """
        from scenefuse.masks.prompts import Prompts, agreement
        from scenefuse.masks.propagation import one_photo
        from scenefuse.masks.votes import MIN_AGREEMENT
        from scenefuse.photos.workspace import View

        self.load()
        self._waiting += 1
        self._asked_at = time.monotonic()
        try:
            with self._busy:
                assert self._ask is not None
                pixels = self._pixels(picture)
                height, width = pixels.shape[:2]
                clicks = _clicks_of(picture, rows, width, height)
                # As the workflow has it, in the undistorted photo.
                size = min(self._photo_px, max(picture.width, picture.height))
                tolerance_px = self._settings["max_click_residual_px"] * max(height, width) / size
                view = View(picture.name, np.eye(3), np.eye(4), width, height, pixels)
                mask, _, _, left_out = one_photo(self._ask, view, clicks, tolerance_px)
        finally:
            self._waiting -= 1
        notes = [f"left out: {note}" for note in left_out]
        known = corners(pixels) if shared is None else shared * [width / picture.width, height / picture.height]
        if lies_in_nothing(mask, clicks.on, known):
            notes.append("a click lies where other photos can share nothing, as in the sky: click on the object")
        if self.method == "GrabCut" and clicks.box is None and clicks.inside.all():
            notes.append("GrabCut separates colours: click beside the object too, or drag a box around it")
        if self.method == "SAM 2" and clicks.box is not None and replace(clicks, box=None).enough:
            notes.append("the box is not used, as the clicks suffice: click outside where the mask is too large")
        share = agreement(mask, Prompts(clicks.on, clicks.off), tolerance_px)
        if share < MIN_AGREEMENT:
            notes.append(f"it agrees with {share:.2f} of the clicks, at least {MIN_AGREEMENT} is needed")
        return mask, notes

    def _pixels(self, picture: Picture) -> NDArray[np.uint8]:
        """The photo as the network sees it; always the same array while it is kept."""
        if picture.name not in self._photos:
            pixels = at_most(read_upright(picture.path, MASK_PX), MASK_PX)
            self._photos[picture.name] = np.ascontiguousarray(pixels)
            while len(self._photos) > KEPT_PHOTOS:
                self._photos.popitem(last=False)
        return self._photos[picture.name]


def corners(pixels: NDArray[np.uint8]) -> Array:
    """(N, 2) corners in a photo (H, W, 3), by FAST: the sky has none."""
    found = cv2.FastFeatureDetector.create().detect(cv2.cvtColor(pixels, cv2.COLOR_RGB2GRAY))
    return np.array([corner.pt for corner in found]).reshape(-1, 2)


def lies_in_nothing(mask: Mask, clicks: Array, known: Array) -> bool:
    """Whether one of the clicks (N, 2) lies in a part of a mask (H, W) that holds none of the known pixels (M, 2), but
    near its outline, which is not exact."""
    deep = cv2.distanceTransform(mask.astype(np.uint8), cv2.DIST_L2, 3) > OUTLINE_BAND_SHARE * max(mask.shape)
    _, parts = cv2.connectedComponents(deep.astype(np.uint8))
    (clicked, held) = (parts[rows, columns] for columns, rows in (pixel_of(clicks, mask), pixel_of(known, mask)))
    return not set(clicked) - {0} <= set(held)


def _clicks_of(picture: Picture, rows: Rows, width: int, height: int) -> "PhotoClicks":
    """The clicks of one photo, in pixels of a copy of it of another size."""
    from scenefuse.marks.photo_clicks import of_photo

    scale, edge = np.array([width / picture.width, height / picture.height]), np.array([width, height]) - 1e-3
    own = [(row, np.clip(row.pixel * scale, 0, edge)) for row in rows if row.photo == picture.name]
    return of_photo(Path("the clicks"), picture.name, own)

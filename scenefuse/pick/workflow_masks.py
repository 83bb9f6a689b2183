"""The masks that the workflow made, as overlays of the original photos, and which of them a person has accepted."""

import json
from itertools import chain
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from scenefuse.core.stage import StageError, read_json, write_json
from scenefuse.photos.pictures import read_mask
from scenefuse.photos.workspace import read_cameras
from scenefuse.pick.document import digest
from scenefuse.pick.photo_tiles import Picture

Mask = NDArray[np.bool_]
OVERLAY_PX = 1200
"""Longer side of an overlay."""


class CarriedMasks:
    """What the masks' stage left in an object's results.

    Attributes:
        agreement: IoU with the visual hull's outline, by photo.
        dropped: why a photo was left out, by photo.
        notes: which clicks were left out and why, and what else the stage noted, a sentence each.
    """

    def __init__(self, results: Path, accepted: Path) -> None:
        """Read the report of the masks, which need not be there.

        Args:
            results: folder of the object's results.
            accepted: JSON where accepted masks are noted, by the hash of each.
        """
        self._results, self._accepted = results, accepted
        self._digests: dict[str, str] = {}
        self._known = _read_accepted(accepted)
        self.agreement: dict[str, float] = {}
        self.dropped: dict[str, str] = {}
        self.notes: list[str] = []
        self._cameras: tuple[dict, dict] | None = None
        report = results / "masks.json"
        if report.is_file():
            content = read_json(report)
            self.dropped = content["dropped"]
            said = [content[key]["value"] for key in ("clicks_left_out", "notes") if key in content]
            self.notes = list(chain.from_iterable(said))
            self.agreement = {name: entry["agreement"] for name, entry in content["per_photo"].items()}

    def __bool__(self) -> bool:
        return bool(self.agreement)

    def mask(self, picture: Picture) -> Mask | None:
        """(H, W) mask of a photo at overlay size, bent as its lens bends; None where there is none.

        Raises:
            StageError: a file of the results cannot be read.
        """
        path = self._path(picture.name)
        if not path.is_file():
            return None
        if self._cameras is None:
            self._cameras = read_cameras(self._results / "sparse"), read_cameras(self._results / "undistorted/sparse")
        bent, straight = (cameras.get(picture.name) for cameras in self._cameras)
        if bent is None or straight is None:
            return None
        scale = min(1.0, OVERLAY_PX / max(bent.width, bent.height))
        width, height = round(bent.width * scale), round(bent.height * scale)
        grid = (np.mgrid[0:height, 0:width][::-1].reshape(2, -1).T + 0.5) * [bent.width / width, bent.height / height]
        rays = np.asarray(bent.cam_from_img(grid))
        k = straight.calibration_matrix()
        maps = (rays * [k[0, 0], k[1, 1]] + k[:2, 2] - 0.5).astype(np.float32).reshape(height, width, 2)
        mask = read_mask(path).astype(np.uint8) * 255
        return np.asarray(cv2.remap(mask, maps[..., 0], maps[..., 1], cv2.INTER_LINEAR)) > 127

    def has_mask(self, photo: str) -> bool:
        """Whether there is a mask of a photo to look at."""
        return bool(self._digest(photo))

    def accept(self, photo: str) -> None:
        """Note that a person has looked at a photo's mask, and that it is right; nothing where there is none."""
        if not self.has_mask(photo):
            return
        self._known = _read_accepted(self._accepted) | {photo: self._digest(photo)}
        write_json(self._accepted, self._known)

    def is_accepted(self, photo: str) -> bool:
        """Whether a person has accepted the mask that the photo had when the results were read."""
        return photo in self._known and self._known[photo] == self._digest(photo)

    def _digest(self, photo: str) -> str:
        if photo not in self._digests:
            self._digests[photo] = digest(self._path(photo))
        return self._digests[photo]

    def _path(self, photo: str) -> Path:
        return self._results / "masks" / f"{Path(photo).stem}.png"


def _read_accepted(path: Path) -> dict[str, str]:
    try:
        return json.loads(path.read_text())
    except (OSError, ValueError):
        return {}


def carried_masks(results: Path, accepted: Path) -> tuple[CarriedMasks, str]:
    """The masks of an object's results, and why they cannot be shown; "" where they can."""
    try:
        return CarriedMasks(results, accepted), ""
    except (StageError, KeyError) as error:
        return CarriedMasks(Path("nowhere"), accepted), f"the results' masks cannot be read: {error}"

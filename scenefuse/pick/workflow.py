"""What the workflow makes of an object's tables: its masks over the original photos, and what it will run next."""

import json
import re
import shlex
import subprocess
import sys
from itertools import chain
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from scenefuse.core.settings import ROOT
from scenefuse.core.stage import StageError, read_json, write_json
from scenefuse.photos.pictures import read_mask
from scenefuse.photos.workspace import read_cameras
from scenefuse.pick.document import digest
from scenefuse.pick.photo_tiles import MASK_PX, Picture

Mask = NDArray[np.bool_]
# What `scenefuse run` reads by itself.
OWN_SETTINGS = "config/config.yaml"


class WorkflowMasks:
    """What the masks' stage left in an object's results, and which masks a person has accepted.

    Attributes:
        agreement: IoU with the visual hull's outline, by photo.
        dropped: why a photo was left out, by photo.
        notes: which clicks were left out and why, and what else the stage noted, a sentence each.
    """

    def __init__(self, results: Path, accepted: Path) -> None:
        """Read the report of the masks, which need not be there; a note says where it cannot be read.

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
        if not report.is_file():
            return
        try:
            content = read_json(report)
            said = (content[key]["value"] for key in ("clicks_left_out", "notes") if key in content)
            self.notes = list(chain.from_iterable(said))
            self.dropped = content["dropped"]
            self.agreement = {name: entry["agreement"] for name, entry in content["per_photo"].items()}
        except (StageError, KeyError) as error:
            self.notes = [f"the workflow's masks cannot be read: {error}"]

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
        scale = min(1.0, MASK_PX / max(bent.width, bent.height))
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
        if self.has_mask(photo):
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


def command(configfiles: tuple[Path, ...], target: str) -> list[str]:
    """The command line that makes a target, as a person types it in the working directory."""
    words = ["snakemake"]
    if not Path("Snakefile").is_file():
        words += ["--snakefile", str(ROOT / "Snakefile")]
    if configfiles:
        words += ["--configfile", *map(str, configfiles)]
    return [*words, "--cores", "2", target]


def as_text(words: list[str]) -> str:
    """A command line of `command` to be pasted into a shell, by `scenefuse run` where the page is of `scenefuse
    pick`."""
    if Path(sys.argv[0]).name.startswith("scenefuse"):
        shipped = ["--snakefile", str(ROOT / "Snakefile")]
        own = ["--configfile", OWN_SETTINGS, "--cores"]
        rest = words[3:] if words[1:3] == shipped else words[1:]
        words = ["scenefuse", "run", *(rest[2:] if rest[:3] == own else rest)]
    return shlex.join(words)


def dry_run(words: list[str]) -> str:
    """Which rules a command would run now, or why that cannot be said; nothing is run or locked."""
    done = subprocess.run(
        [sys.executable, "-m", *words, "--dry-run", "--nolock"],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    if done.returncode:
        return " ".join([line for line in done.stdout.splitlines() if line.strip()][-6:])
    table = re.findall(r"^([a-z0-9_]+) +(\d+)$", done.stdout, re.MULTILINE)
    jobs = [rule if count == "1" else f"{rule} ({count})" for rule, count in table if rule != "total"]
    return f"Will run: {', '.join(jobs) or 'nothing'}."

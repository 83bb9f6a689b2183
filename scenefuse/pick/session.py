"""All that open pages of one object share: its tables, photos, the workflow's masks, the work in the background."""

import os
import secrets
import shlex
import sys
import threading
import time
from itertools import chain
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from scenefuse.core.project import read_project
from scenefuse.core.settings import OWN_SETTINGS, read_settings
from scenefuse.core.stage import StageError, read_json
from scenefuse.core.transforms import Array
from scenefuse.photos.pictures import read_mask
from scenefuse.photos.workspace import read_cameras
from scenefuse.pick.photo_tiles import MASK_PX, Picture, Thumbnails, Tiles
from scenefuse.pick.segmenter import Segmenter
from scenefuse.pick.tables import tables_of

Mask = NDArray[np.bool_]


class Session:
    """An object that is clicked.

    Attributes:
        name: of the object.
        configfiles: as given on the command line.
        tables: its tables; the first is of the object itself where it has photos.
        tiles, thumbnails, segmenter: see their classes.
        masks: of the object, as the workflow has them.
        results_state: changes with what the workflow has written.
        wanted: photos that are clicked next, whose features are computed ahead.
        key: that the page's requests for pictures and its websocket carry.
    """

    def __init__(self, name: str | None, configfiles: tuple[Path, ...]) -> None:
        """Read the project, the tables and the photos' headers; without a name, of its only object.

        Raises:
            StageError: settings, tables or photos are wrong.
        """
        project = read_project(read_settings(*configfiles))
        if name is None and len(project.objects) != 1:
            raise StageError(f"say by --object which one of {', '.join(project.objects) or 'none'} you want to click")
        name = name or next(iter(project.objects))
        self.name, self.configfiles = name, configfiles
        self.tables = tables_of(project, name)
        self.tiles, self.thumbnails = Tiles(), Thumbnails(Path("results/pick/thumbnails"))
        own = project.of("object", name)["object"]
        self.segmenter = Segmenter(own["masks"], own["undistort"]["max_size_px"])
        self.results_state: tuple[float, ...] = ()
        self.read_results()
        self.wanted: list[Picture] = []
        self.key = secrets.token_urlsafe()
        self._closed = False
        # A download or a network at work does not keep the page from ending.
        self._network = threading.Thread(target=self.segmenter.compute_ahead, args=(lambda: self.wanted,), daemon=True)
        self._thumbnailer = threading.Thread(target=self.make_thumbnails)

    def read_results(self) -> None:
        """Read what the workflow has written since the last time."""
        results = Path("results/objects") / self.name
        files = [results / "masks.json", *(folder for table in self.tables for folder in table.models)]
        state = tuple(file.stat().st_mtime if file.exists() else 0.0 for file in files)
        if state == self.results_state:
            return
        if self.results_state:
            for table in self.tables:
                table.read_cameras()
        self.masks = WorkflowMasks(results)
        self.results_state = state

    def standing(self, table: int, photo: str) -> tuple[str, bool]:
        """What the workflow makes of a photo of a table, in a word or none, and whether that is bad: clicks in a photo
        without a camera count for nothing."""
        cameras, masks = self.tables[table].cameras, self.masks
        if cameras is not None and photo not in cameras:
            return "no camera", True
        if self.tables[table].column != "prompts":
            return "", False
        if photo in masks.dropped:
            return "left out", True
        score = masks.agreement.get(photo)
        return ("", False) if score is None else (f"{score:.2f}", False)

    def shared_pixels(self, photo: str) -> Array | None:
        """(N, 2) pixels of an object's photo that other photos share; None until the workflow has its camera."""
        cameras = self.tables[0].cameras
        return cameras.seen_pixels(photo) if cameras and photo in cameras else None

    def start(self) -> None:
        """Begin the work in the background: thumbnails, and features of the photos that come next."""
        self._thumbnailer.start()
        if self.tables[0].column == "prompts" and self.tables[0].document.kind == "labels":
            self._network.start()

    def leave(self, status: int) -> None:
        """End the process at once where a network is still at work: it would abort while the interpreter ends."""
        if self._thumbnailer.is_alive():
            self._thumbnailer.join()
        if self._network.is_alive():
            sys.stdout.flush()
            sys.stderr.flush()
            os._exit(status)

    def close(self) -> None:
        """End the work in the background."""
        self._closed = True
        self.segmenter.close()

    def photo(self, table: int, number: int) -> Picture:
        """A photo by its place in the table's photos; IndexError where there is none."""
        if table < 0 or number < 0:
            raise IndexError
        return list(self.tables[table].pictures.values())[number]

    def make_thumbnails(self) -> None:
        """Make all thumbnails, while nobody waits for a mask."""
        for table in self.tables:
            for picture in table.pictures.values():
                while not self._closed and not self.segmenter.is_idle():
                    time.sleep(0.2)
                if self._closed:
                    return
                try:
                    self.thumbnails.get(picture)
                except StageError as error:
                    table.notes.append(str(error))

    def thumbnails_left(self, table: int) -> int:
        """Photos of a table whose sharpness is not known yet."""
        return sum(self.thumbnails.is_missing(picture) for picture in self.tables[table].pictures.values())


class WorkflowMasks:
    """What the masks' stage left in an object's results.

    Attributes:
        agreement: IoU with the visual hull's outline, by photo.
        dropped: why a photo was left out, by photo.
        notes: which clicks were left out and why, and what else the stage noted, a sentence each.
    """

    def __init__(self, results: Path) -> None:
        """Read the report of the masks, which need not be there; a note says where it cannot be read."""
        self._results = results
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
        path = self._results / "masks" / f"{Path(picture.name).stem}.png"
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


def next_command(configfiles: tuple[Path, ...], target: Path) -> str:
    """The command line that makes a file of the results, as a person types it in the working directory."""
    # `scenefuse run` reads the project's own settings by itself.
    given = ["--configfile", *map(str, configfiles)] if configfiles not in ((), (OWN_SETTINGS,)) else []
    return shlex.join(["scenefuse", "run", *given, str(target)])

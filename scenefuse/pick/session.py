"""All that open pages of one object share: its tables, photos, masks and the work in the background."""

import itertools
import os
import secrets
import sys
import threading
import time
from collections import OrderedDict
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from scenefuse.core.settings import read_settings
from scenefuse.core.stage import StageError
from scenefuse.marks.project import read_project
from scenefuse.pick.document import Document
from scenefuse.pick.expected_place import Cameras
from scenefuse.pick.photo_tiles import Picture, Thumbnails, Tiles
from scenefuse.pick.segmenter import Segmenter
from scenefuse.pick.sources import Source, sources_of
from scenefuse.pick.workflow_masks import carried_masks

MASK_SIDE_PX = 1024
"""Longer side of the photos that masks are shown in; SAM 2 sees no more."""
OVERLAYS = 64
"""Overlays kept for the browser."""


class Board:
    """One table with its photos.

    Attributes:
        source: what it is.
        document: the table.
        cameras: of its photos, once the workflow has them; None before.
        notes: what could not be read, a sentence each.
    """

    def __init__(self, source: Source) -> None:
        self.source, self.document = source, Document(source.path, source.kind, source.pictures)
        self.notes: list[str] = [*source.notes, *self.document.notes]
        self.read_cameras()

    def read_cameras(self) -> None:
        """Read the cameras that the workflow has found by now."""
        self.cameras: Cameras | None = None
        model = next((folder for folder in self.source.models if folder.is_dir()), None)
        if model is not None:
            try:
                self.cameras = Cameras(model, self.source.sizes)
            except StageError as error:
                self.notes.append(str(error))


class Session:
    """An object that is clicked.

    Attributes:
        name: of the object.
        configfiles: as given on the command line.
        boards: its tables.
        tiles, thumbnails, segmenter, carried: see their classes.
        results_state: changes with what the workflow has written.
        key: of this session, for addresses of pictures that the browser may keep.
    """

    def __init__(self, name: str, configfiles: tuple[Path, ...]) -> None:
        """Read the project, the tables and the photos' headers.

        Raises:
            StageError: settings, tables or photos are wrong.
        """
        project = read_project(read_settings(*configfiles))
        self.name, self.configfiles = name, configfiles
        self.boards = [Board(source) for source in sources_of(project, name)]
        self.tiles, self.thumbnails = Tiles(), Thumbnails(Path("results/pick/thumbnails"))
        own = project.of("object", name)["object"]
        self.segmenter = Segmenter(own["masks"], MASK_SIDE_PX, own["undistort"]["max_size_px"])
        self._accepted = Path("results/pick") / f"{name}.json"
        self.results_state: tuple[float, ...] = ()
        self.read_results()
        self.wanted: list[Picture] = []
        self._overlays: OrderedDict[int, bytes] = OrderedDict()
        self.key = secrets.token_hex(4)
        self._numbers = itertools.count(1)
        self._closed = False
        # A download or a network at work does not keep the page from ending.
        self._network = threading.Thread(target=self.segmenter.compute_ahead, args=(self._ahead,), daemon=True)
        self._thumbnailer = threading.Thread(target=self._make_thumbnails)

    def read_results(self) -> None:
        """Read what the workflow has written since the last time."""
        report = Path("results/objects") / self.name / "masks.json"
        files = [report, *(folder for board in self.boards for folder in board.source.models)]
        state = tuple(file.stat().st_mtime if file.exists() else 0.0 for file in files)
        if state == self.results_state:
            return
        if self.results_state:
            for board in self.boards:
                board.read_cameras()
        self.carried, note = carried_masks(report.parent, self._accepted)
        self.boards[0].notes += [note] if note else []
        self.results_state = state

    def standing(self, board: int, photo: str) -> tuple[str, bool]:
        """What the workflow makes of a photo of a table, in a word or none, and whether that is bad: clicks in a photo
        without a camera count for nothing."""
        cameras, carried = self.boards[board].cameras, self.carried
        if cameras is not None and photo not in cameras:
            return "no camera", True
        if board == 0 and photo in carried.dropped:
            return "left out", True
        score = carried.agreement.get(photo) if board == 0 else None
        return ("", False) if score is None else (f"{score:.2f}" + " ✓" * carried.is_accepted(photo), False)

    def start(self) -> None:
        """Begin the work in the background: thumbnails, and features of the photos that come first."""
        self._thumbnailer.start()
        if self.boards[0].document.kind == "labels":
            self._network.start()

    def leave(self, status: int) -> None:
        """End the process at once where a network is still at work: it would abort while the interpreter ends."""
        if self._thumbnailer.is_alive():
            self._thumbnailer.join()
        if self._network.is_alive():
            sys.stdout.flush()
            sys.stderr.flush()
            os._exit(status)

    def close(self) -> Iterator[str]:
        """End the background's work and keep what is not saved; a sentence for each table that is not."""
        self._closed = True
        self.segmenter.close()
        for board in self.boards:
            draft = board.document.keep_draft()
            if draft is not None:
                yield f"clicks that were not saved are kept in {draft}; the page takes them up again"

    def keep_drafts(self) -> None:
        """Keep what is not saved, in case that this process does not end by itself."""
        for board in self.boards:
            try:
                board.document.keep_draft()
            except StageError as error:
                if str(error) not in board.notes:
                    board.notes.append(str(error))

    def overlay(self, picture: bytes) -> int:
        """Keep a picture for the browser; the number by which it asks for it."""
        number = next(self._numbers)
        self._overlays[number] = picture
        while len(self._overlays) > OVERLAYS:
            self._overlays.popitem(last=False)
        return number

    def picture_of(self, number: int) -> bytes:
        """A kept overlay; KeyError where it is gone."""
        return self._overlays[number]

    def photo(self, board: int, number: int) -> Picture:
        """A photo by its place in the table's photos; IndexError where there is none."""
        if board < 0 or number < 0:
            raise IndexError
        return list(self.boards[board].source.pictures.values())[number]

    def _ahead(self) -> list[Picture]:
        # Which photos are the sharpest changes until all are known, and features take both cores from looking for them.
        if thumbnails_left(self, 0):
            return self.wanted
        return [*self.wanted, *self.thumbnails.sharpest_first(self.boards[0].source.pictures.values())]

    def _make_thumbnails(self) -> None:
        for board in self.boards:
            for picture in board.source.pictures.values():
                while not self._closed and not self.segmenter.is_idle():
                    time.sleep(0.2)
                if self._closed:
                    return
                try:
                    self.thumbnails.get(picture)
                except (StageError, OSError) as error:
                    self.thumbnails.fail(picture)
                    board.notes.append(str(error))


def thumbnails_left(session: Session, board: int) -> int:
    """Photos whose sharpness is not known yet."""
    pictures: Any = session.boards[board].source.pictures.values()
    return sum(session.thumbnails.sharpness(p) is None and not session.thumbnails.failed(p) for p in pictures)

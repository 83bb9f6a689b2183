"""All that open pages of one object share: its tables, photos, masks and the work in the background."""

import os
import secrets
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

from scenefuse.core.project import read_project
from scenefuse.core.settings import read_settings
from scenefuse.core.stage import StageError
from scenefuse.pick.photo_tiles import Picture, Thumbnails, Tiles
from scenefuse.pick.segmenter import Segmenter
from scenefuse.pick.tables import tables_of
from scenefuse.pick.workflow import WorkflowMasks


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
        key: of this session, for addresses of pictures that the browser may keep.
    """

    def __init__(self, name: str, configfiles: tuple[Path, ...]) -> None:
        """Read the project, the tables and the photos' headers.

        Raises:
            StageError: settings, tables or photos are wrong.
        """
        project = read_project(read_settings(*configfiles))
        self.name, self.configfiles = name, configfiles
        self.tables = tables_of(project, name)
        self.tiles, self.thumbnails = Tiles(), Thumbnails(Path("results/pick/thumbnails"))
        own = project.of("object", name)["object"]
        self.segmenter = Segmenter(own["masks"], own["undistort"]["max_size_px"])
        self.results_state: tuple[float, ...] = ()
        self.read_results()
        self.wanted: list[Picture] = []
        self.key = secrets.token_hex(4)
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
        self.masks = WorkflowMasks(results, Path("results/pick") / f"{self.name}.json")
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
        return ("", False) if score is None else (f"{score:.2f}" + " ✓" * masks.is_accepted(photo), False)

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

    def close(self) -> Iterator[str]:
        """End the background's work and keep what is not saved; a sentence for each table that is not."""
        self._closed = True
        self.segmenter.close()
        for table in self.tables:
            draft = table.document.keep_draft()
            if draft is not None:
                yield f"clicks that were not saved are kept in {draft}; the page takes them up again"

    def keep_drafts(self) -> None:
        """Keep what is not saved, in case that this process does not end by itself."""
        for table in self.tables:
            try:
                table.document.keep_draft()
            except StageError as error:
                if str(error) not in table.notes:
                    table.notes.append(str(error))

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

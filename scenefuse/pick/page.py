"""The page: photos at the left, one of them large, and beside it what is marked and what comes next."""

import asyncio
from collections import Counter
from collections.abc import Callable
from typing import Any

from nicegui import ui

from scenefuse.core.stage import StageError
from scenefuse.marks.clicks import Kind
from scenefuse.pick.clicks import Rows, with_box, with_end, with_label, with_length, with_point, without_nearest
from scenefuse.pick.document import Document, FileChanged
from scenefuse.pick.overlays import CARRIED, CLICKED, overlay
from scenefuse.pick.photo_map import PhotoMap
from scenefuse.pick.photo_strip import PhotoStrip
from scenefuse.pick.photo_tiles import Picture
from scenefuse.pick.session import Board, Session
from scenefuse.pick.side_panel import SidePanel

STYLE = """
body { overflow: hidden; background: #202020; }
.photo { width: 100%; height: 100%; }
.photo.leaflet-container { background: #202020; cursor: crosshair; }
.photo .leaflet-draw { display: none; }
.leaflet-container { font: inherit; }
.strip { width: 168px; overflow-y: auto; background: #2b2c30; }
.thumb { position: relative; margin: 5px 6px; border: 2px solid transparent; border-radius: 4px; cursor: pointer; }
.thumb img { width: 100%; height: 104px; object-fit: contain; display: block; border-radius: 2px; background: #202020; }
.thumb.here { border-color: #ffd600; }
.thumb .name { color: #e8eaed; font-size: 11px; overflow: hidden; text-overflow: ellipsis; white-space: nowrap; }
.thumb .mark { position: absolute; top: 3px; padding: 0 6px; border-radius: 8px; color: #fff; font-size: 11px; }
.thumb .clicks { left: 3px; background: #1565c0; }
.thumb .score { right: 3px; background: #2e7d32; }
.thumb .score.bad { background: #c62828; }
.side { width: 300px; overflow-y: auto; background: #fff; padding: 10px 12px; gap: 8px; }
.side > * { flex-shrink: 0; }
.side .q-btn { text-transform: none; }
.code { font: 11px/1.4 monospace; background: #f1f3f4; padding: 6px; border-radius: 4px; user-select: all;
        overflow-wrap: anywhere; }
kbd { font: 11px monospace; border: 1px solid #bdc1c6; border-radius: 3px; padding: 0 4px; background: #f8f9fa; }
"""
KEYS = {
    "i": "click inside",
    "o": "click outside",
    "b": "drag a box",
    "right click": "remove a click",
    "z": "undo",
    "y": "redo",
    "n, p": "next, previous photo",
    "+ − 0": "zoom in, out, whole photo (or the wheel)",
    "m": "show or hide masks",
    "a": "accept the workflow's mask, next one",
    "t": "next table",
    "s": "save",
}
POLL_S = 0.5
FILE_POLL_S = 2.0


class Page:
    """One open page of a session."""

    def __init__(self, session: Session) -> None:
        """Build the page."""
        self.session, self.board_number = session, 0
        self.tool, self.point, self.shows_masks = "inside", "", True
        self.chosen: tuple[str, ...] = ()
        self.picture: Picture | None = None
        self.seen_version = -1
        self.mask_asked: Any = None
        self.segmenting = asyncio.Lock()
        self.mask_note = self.method = ""
        self.seen_results = session.results_state
        self.carried_shown: Any = None
        self.dialog: Any = None
        ui.add_css(STYLE)
        ui.colors(primary="#1565c0")
        ui.query(".nicegui-content").classes("p-0 gap-0")
        self._build()

    @property
    def board(self) -> Board:
        """The table that is clicked now."""
        return self.session.boards[self.board_number]

    def _build(self) -> None:
        with ui.row().classes("w-full items-center no-wrap gap-3 px-3 bg-white").style("height: 44px"):
            ui.label(self.session.name).classes("text-base font-bold").mark("object")
            if len(self.session.boards) > 1:
                titles = {k: board.source.title for k, board in enumerate(self.session.boards)}
                self.tabs = ui.toggle(titles, value=0, on_change=lambda e: self.open_board(e.value))
                self.tabs.props("no-caps dense unelevated padding='2px 12px'")
            self.title = ui.label().classes("text-sm text-gray-700 ellipsis")
            ui.space()
            self.state = ui.label().classes("text-sm")
            ui.button("Save", icon="save", on_click=self.save).props("dense no-caps padding='2px 12px'")
            ui.button(icon="help_outline", on_click=lambda: self.help.open()).props("dense flat round")
        with ui.row().classes("w-full no-wrap gap-0").style("height: calc(100vh - 44px)"):
            self.strip = PhotoStrip(self.session, self.open_photo)
            with ui.element("div").classes("h-full").style("flex: 1 1 0; min-width: 0"):
                self.map = PhotoMap(self.clicked, self.remove, self.box_drawn)
            self.side = SidePanel(self)
        self._build_help()
        ui.keyboard(on_key=self.key, ignore=["input", "textarea"], repeating=False)
        ui.timer(POLL_S, self.poll)
        ui.timer(FILE_POLL_S, self.watch_file)

    def _build_help(self) -> None:
        with ui.dialog() as self.help, ui.card():
            ui.label("Keys and mouse").classes("text-base font-bold")
            with ui.grid(columns="auto 1fr").classes("gap-x-4 gap-y-1"):
                for key, what in KEYS.items():
                    ui.html(f"<kbd>{key}</kbd>", sanitize=False)
                    ui.label(what).classes("text-sm")

    async def begin(self) -> None:
        """Show the first photo: one with clicks, else the sharpest; once the browser is there."""
        await self.map.widget.initialized()
        self.open_board(0)

    def open_board(self, number: int) -> None:
        """Go over to another table."""
        self.board_number = number
        document = self.board.document
        self.tool, self.chosen = "inside", ()
        self.point = next((r.label for r in document.rows if document.kind != "labels"), "")
        self.strip.open(number)
        clicked = {row.photo for row in document.rows}
        order = self.strip.order
        self.open_photo(next((p for p in order if p.name in clicked), order[0]))

    def open_photo(self, picture: Picture) -> None:
        """Show a photo."""
        self.picture, self.carried_shown, self.mask_asked = picture, None, None
        number = list(self.board.source.pictures).index(picture.name)
        self.map.stop_drawing()
        self.map.show(picture, f"/tile/{self.board_number}/{number}/{{z}}/{{x}}/{{y}}?v={self.session.key}")
        self.strip.mark(picture)
        self.title.set_text(f"{picture.name} · {picture.width} × {picture.height}")
        if self.board_number == 0:
            self.session.wanted = [picture, *self.strip.neighbours(picture)]
        self.refresh()

    # What a person does

    def edit(self, changed: Callable[[], Rows]) -> None:
        """Change the table, or say why it cannot be changed so."""
        try:
            self.board.document.change(changed())
        except StageError as error:
            self.say(str(error))
        self.refresh()

    def clicked(self, x: float, y: float) -> None:
        """A click into the photo: of the tool that is chosen."""
        assert self.picture is not None
        name, document, sizes = self.picture.name, self.board.document, self.board.source.sizes
        tool = "outside" if self.tool == "outside" else "inside"
        if document.kind == "labels":
            self.edit(lambda: with_label(document.rows, tool, name, x, y, sizes))
        elif not self.point:
            what = "Write a length" if document.kind == "lengths" else "Name a point"
            self.say(f"{what} first, at the right; then click it.")
        elif document.kind == "points":
            self.edit(lambda: with_point(document.rows, self.point, name, x, y, sizes))
        else:
            self.edit(lambda: with_end(document.rows, self.point, name, x, y, sizes))
            self._take_other_end(name)

    def remove(self, x: float, y: float) -> None:
        """Remove the click under the pointer."""
        assert self.picture is not None
        name, rows = self.picture.name, self.board.document.rows
        self.edit(lambda: without_nearest(rows, name, x, y, self.map.reach_px()))

    def box_drawn(self, corners: list[tuple[float, float]]) -> None:
        """A box was dragged."""
        assert self.picture is not None
        name, rows, ends = self.picture.name, self.board.document.rows, (corners[0], corners[1])
        self.edit(lambda: with_box(rows, name, ends, self.board.source.sizes))
        self.choose("inside")

    def choose(self, tool: str) -> None:
        """Take another tool."""
        if self.board.document.kind != "labels":
            return
        self.tool = tool
        self.map.stop_drawing()
        if tool == "box":
            self.map.draw_box()
        self.refresh()

    def choose_kind(self, kind: Kind) -> None:
        """Mark by labels or by named points."""
        try:
            self.board.document.choose_kind(kind)
        except StageError as error:
            self.say(str(error))
        self.refresh()

    def choose_point(self, text: str) -> None:
        """Take a point, which may be new, or a length with its metres, by what a person writes."""
        document = self.board.document
        try:
            if document.kind == "lengths":
                rows, self.chosen = with_length(document.rows, text)
                document.change(rows)
            else:
                self.chosen = (text.strip(),) if text.strip() else ()
        except StageError as error:
            self.say(str(error))
        self.take_point(self.chosen[0] if self.chosen else "")

    def take_point(self, label: str) -> None:
        """Take a point or an end that is listed."""
        self.point = label
        self.refresh()

    def _take_other_end(self, photo: str) -> None:
        """After one end of a length comes the other, where the photo does not have it yet."""
        rows, length = self.board.document.rows, self.point.split("\t")[0]
        listed = dict.fromkeys([row.label for row in rows] + list(self.chosen))
        here = {row.label for row in rows if row.photo == photo}
        left = [label for label in listed if label.split("\t")[0] == length and label not in here]
        if left:
            self.take_point(left[0])

    def step(self, by: int) -> None:
        """Go to a photo farther on in the strip."""
        if self.picture is not None:
            self.open_photo(self.strip.at(self.picture, by))

    def undo(self, forward: bool = False) -> None:
        """One change back, or forward again."""
        document = self.board.document
        if not (document.redo() if forward else document.undo()):
            self.say("Nothing to redo." if forward else "Nothing to undo.")
        self.refresh()

    def accept(self) -> None:
        """The workflow's mask of this photo is right; go to the next that nobody has accepted."""
        carried = self.session.carried
        if self.board_number or self.picture is None or not carried.has_mask(self.picture.name):
            return
        carried.accept(self.picture.name)
        self.strip.refresh()
        following = (self.strip.at(self.picture, k) for k in range(1, len(self.strip.order)))
        left = [p for p in following if carried.has_mask(p.name) and not carried.is_accepted(p.name)]
        if left:
            self.open_photo(left[0])
        else:
            self.say("All masks are accepted.", "positive")
            self.refresh()

    def toggle_masks(self) -> None:
        """Show or hide masks."""
        self.shows_masks = not self.shows_masks
        self.refresh()

    def key(self, event: Any) -> None:
        """A key was pressed."""
        if not event.action.keydown or event.modifiers.alt or self.help.value:
            return
        name = str(event.key).lower()
        if event.modifiers.ctrl or event.modifiers.meta:
            name = {"z": "y" if event.modifiers.shift else "z", "y": "y"}.get(name, "")
        steps = {"n": 1, "arrowright": 1, "arrowdown": 1, "p": -1, "arrowleft": -1, "arrowup": -1}
        actions: dict[str, Any] = {"z": self.undo, "y": lambda: self.undo(forward=True), "s": self.save}
        actions |= {"a": self.accept, "m": self.toggle_masks, "0": self.map.fit, "?": self.help.open}
        actions |= {"i": lambda: self.choose("inside"), "o": lambda: self.choose("outside")}
        actions |= {"b": lambda: self.choose("box"), "escape": lambda: self.choose("inside")}
        actions |= {key: lambda: self.map.zoom(1) for key in "+="} | {key: lambda: self.map.zoom(-1) for key in "-_"}
        if name in steps:
            self.step(steps[name])
        elif name == "t" and len(self.session.boards) > 1:
            self.tabs.set_value((self.board_number + 1) % len(self.session.boards))
        elif name in actions:
            actions[name]()

    def save(self) -> None:
        """Save the table that is clicked now, and all others that have unsaved clicks."""
        documents = [board.document for board in self.session.boards]
        for document in documents:
            if document is self.board.document or document.unsaved:
                try:
                    self.attempt(document.save)
                    self.warn_unlisted(document)
                except FileChanged as error:
                    self.ask_about_changes(document, str(error))
        self.refresh()

    def warn_unlisted(self, document: Document) -> None:
        """Say that the workflow does not read what was saved, where the user's table does not name it."""
        source = self.board.source
        if document is self.board.document and document.rows and not source.listed:
            where = f"write {document.path} into the column {source.column} of the table of {source.of}"
            self.say(f"The workflow does not read it yet: {where}", "warning")

    def attempt(self, save: Callable[[], str]) -> None:
        """Save, and say what happened."""
        try:
            self.say(save(), "positive")
        except StageError as error:
            self.say(str(error), "negative")

    def ask_about_changes(self, document: Document, message: str) -> None:
        """The file is not what was read: whose clicks count?"""
        if self.dialog is not None and self.dialog.value:
            return

        def decide(how: str) -> None:
            self.dialog.close()
            if how == "both":
                self.attempt(document.merge)
            elif how == "theirs":
                document.read()
            else:
                self.attempt(document.keep_mine)
            self.refresh()

        with ui.dialog().props("persistent") as self.dialog, ui.card():
            ui.label("The file has changed").classes("text-base font-bold")
            ui.label(message).classes("text-sm")
            choices = {"both": "Take both", "theirs": "Take the file's", "mine": "Keep mine (the file's is set aside)"}
            with ui.row():
                for how, text in choices.items():
                    ui.button(text, on_click=lambda how=how: decide(how)).props("no-caps dense padding='2px 10px'")
        self.dialog.open()

    def say(self, text: str, kind: str = "warning") -> None:
        """A notice at the lower edge."""
        ui.notify(text, type=kind, position="bottom", multi_line=True, timeout=6000)  # type: ignore[arg-type]

    # What is shown

    def poll(self) -> None:
        """Notice what another page changed, and what the background has done."""
        now = self.board.document.version, self.session.segmenter.method
        if self.picture is not None and (self.seen_version, self.method) != now:
            self.refresh()
        self.strip.poll(self.picture)

    def watch_file(self) -> None:
        """Take up what an editor or the workflow wrote. Where there are unsaved clicks, too, saving asks."""
        self.session.keep_drafts()
        self.session.read_results()
        if self.seen_results != self.session.results_state:
            self.seen_results = self.session.results_state
            self.strip.refresh()
            self.refresh()
        document = self.board.document
        if self.picture is None or not document.changed_on_disk() or document.unsaved:
            return
        document.read()
        self.say(f"{document.path} was changed by someone else: it was read again.")
        self.refresh()

    def refresh(self) -> None:
        """Draw everything that depends on the clicks again."""
        document, picture = self.board.document, self.picture
        if picture is None:
            return
        self.seen_version, self.method = document.version, self.session.segmenter.method
        self.map.clear()
        here = [row for row in document.rows if row.photo == picture.name]
        if document.kind == "labels":
            self.map.draw_labels(here)
        else:
            self._draw_points()
        self._show_masks(picture)
        # The two corners of a box are one mark.
        marks = {(row.photo, "box" if row.label == "box" else k) for k, row in enumerate(document.rows)}
        self.strip.count(Counter(photo for photo, _ in marks))
        unsaved = [board.source.title for board in self.session.boards if board.document.unsaved]
        if unsaved:
            text = "● not saved" + (f": {', '.join(unsaved)}" if len(self.session.boards) > 1 else "")
        else:
            text = "saved" if document.path.exists() else "no file yet"
        self.state.set_text(text)
        self.state.classes(replace="text-sm " + ("text-red-700" if unsaved else "text-gray-600"))
        self.side.fill()

    def _draw_points(self) -> None:
        assert self.picture is not None
        rows, cameras = self.board.document.rows, self.board.cameras
        for name in dict.fromkeys(row.label for row in rows):
            own = [row for row in rows if row.label == name]
            here = next((row for row in own if row.photo == self.picture.name), None)
            if here is not None:
                self.map.draw_point(here, name == self.point)
            expected = cameras.expected(own, self.picture.name) if cameras else None
            if expected is not None and (name == self.point or (here is None and expected.from_photos > 1)):
                self.map.draw_expected(expected.pixels, name)

    def _show_masks(self, picture: Picture) -> None:
        """Have the clicks' mask made, and the workflow's laid over the photo where it is not there yet."""
        own = [row for row in self.board.document.rows if row.photo == picture.name]
        shows = self.board_number == 0 and self.board.document.kind == "labels" and self.shows_masks
        wanted = (picture.name, self.session.results_state) if shows and self.session.carried else None
        if wanted != self.carried_shown:
            self.carried_shown = wanted
            self.map.lay("carried", None)
            if wanted is not None:
                asyncio.get_running_loop().create_task(self._lay_carried(picture))
        asked = (picture.name, *own) if shows and any(row.label != "outside" for row in own) else None
        if asked == self.mask_asked:
            return
        self.mask_asked, self.mask_note = asked, "Making it ..." if asked else ""
        if asked:
            asyncio.get_running_loop().create_task(self._segment(picture, asked))
        else:
            self.map.lay("clicked", None)

    async def _lay_carried(self, picture: Picture) -> None:
        """Lay the workflow's mask over its photo, unless another one is shown in the meantime."""
        wanted = self.carried_shown
        try:
            mask = await asyncio.to_thread(self.session.carried.mask, picture)
        except StageError as error:
            mask = None
            print(error, flush=True)
        if mask is not None and wanted == self.carried_shown:
            self.map.lay("carried", self._address(overlay(mask, CARRIED)))

    def _address(self, picture: bytes) -> str:
        """Where the browser gets an overlay; of this session, for it may keep those of another at the same port."""
        return f"/overlay/{self.session.overlay(picture)}?v={self.session.key}"

    async def _segment(self, picture: Picture, asked: Any) -> None:
        """Make the mask of a photo's clicks, unless others have come in the meantime."""
        address, note = None, ""
        try:
            async with self.segmenting:
                if asked != self.mask_asked:
                    return
                mask, notes = await asyncio.to_thread(self.session.segmenter.mask, picture, asked[1:])
            note = " ".join(f"{sentence[0].upper()}{sentence[1:]}." for sentence in notes)
            address = self._address(overlay(mask, CLICKED))
        except StageError as error:
            note = str(error)
        if asked == self.mask_asked:
            self.map.lay("clicked", address)
            self.mask_note = note
            self.side.show_note()

    def go(self, photo: str) -> None:
        """Show a photo by its name."""
        picture = self.board.source.pictures.get(photo)
        if picture is not None:
            self.open_photo(picture)

    def remove_lost(self) -> None:
        """Remove clicks in photos that are no longer there."""
        rows, known = self.board.document.rows, self.board.source.pictures
        self.edit(lambda: tuple(row for row in rows if row.photo in known))

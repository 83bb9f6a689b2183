"""The page: photos at the left, one of them large, and beside it what is marked and what comes next."""

import importlib.resources
from collections.abc import Callable
from typing import Any

from nicegui import app, ui

from scenefuse.core.stage import StageError
from scenefuse.pick.document import Document
from scenefuse.pick.panels import PhotoStrip, SidePanel
from scenefuse.pick.photo_map import MaskLayers, PhotoMap
from scenefuse.pick.photo_tiles import BACKGROUND, Picture
from scenefuse.pick.session import Session
from scenefuse.pick.tables import Editor

ASSETS = importlib.resources.files("scenefuse.pick") / "assets"
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
    "t": "next table",
}
FAREWELL = "The clicks are saved, and this page has ended. What comes next is in the terminal."


class Page:
    """One open page of a session: what is shown, and which keys and buttons do what."""

    _help: ui.dialog
    _map: PhotoMap
    _layers: MaskLayers

    def __init__(self, session: Session) -> None:
        """Build the page."""
        self._session = session
        self._editor: Editor | None = None
        self._shows_masks = True
        self._seen: Any = None
        ui.add_css((ASSETS / "page.css").read_text().replace("GREY", BACKGROUND))
        ui.colors(primary="#1565c0")
        ui.query(".nicegui-content").classes("p-0 gap-0")
        self._build()

    @property
    def _open(self) -> Editor:
        """The editor of the table that is clicked now."""
        assert self._editor is not None
        return self._editor

    def _build(self) -> None:
        session = self._session
        titles = {k: table.title for k, table in enumerate(session.tables)}
        with ui.row().classes("w-full items-center no-wrap gap-3 px-3 bg-white").style("height: 44px"):
            ui.label(session.name).classes("text-base font-bold").mark("object")
            self._tabs = ui.toggle(titles, value=0, on_change=lambda e: self._open_table(e.value))
            self._tabs.props("no-caps dense unelevated padding='2px 12px'").set_visibility(len(titles) > 1)
            self._title = ui.label().classes("text-sm text-gray-700 ellipsis wide")
            ui.space()
            self._state = ui.label().classes("text-sm text-gray-600 wide")
            ui.button(icon="help_outline", on_click=lambda: self._help.open()).props("dense flat round")
        with ui.row().classes("parts w-full no-wrap gap-0").style("height: calc(100dvh - 44px)"):
            self._strip = PhotoStrip(session, self._open_photo)
            with ui.element("div").classes("middle h-full").style("flex: 1 1 0; min-width: 0"):
                self._map = PhotoMap(
                    lambda x, y: self._act(lambda: self._open.click(x, y)),
                    lambda x, y: self._act(lambda: self._open.remove(x, y, self._map.reach_px())),
                    lambda corners: self._act(lambda: self._open.draw_box(corners)),
                )
            self._panel = SidePanel(session, self._act, self._open_photo, self._end)
        self._layers = MaskLayers(session, self._map, lambda: self._panel.show_note(self._layers))
        with ui.dialog() as self._help, ui.card():
            ui.label("Keys and mouse").classes("text-base font-bold")
            with ui.grid(columns="auto 1fr").classes("gap-x-4 gap-y-1"):
                for key, what in KEYS.items():
                    ui.html(f"<kbd>{key}</kbd>", sanitize=False)
                    ui.label(what).classes("text-sm")
        ui.keyboard(on_key=self._key, ignore=["input", "textarea"], repeating=False)
        ui.timer(1.0, self._poll)

    async def begin(self) -> None:
        """Show the first photo: one with clicks, else the sharpest; once the browser is there."""
        await self._map.widget.initialized()
        self._open_table(0)

    def _open_table(self, number: int) -> None:
        """Go over to another table."""
        table = self._session.tables[number]
        if table.document.changed_on_disk():
            table.document.read()
        self._strip.open(number)
        clicked = {row.photo for row in table.document.rows}
        first = next((p for p in self._strip.order if p.name in clicked), self._strip.order[0])
        self._editor = Editor(table, first)
        self._open_photo(first)

    def _open_photo(self, picture: Picture) -> None:
        """Show a photo."""
        table, session = self._open.table, self._session
        self._open.picture = picture
        number = list(table.pictures).index(picture.name)
        tiles = f"/tile/{session.tables.index(table)}/{number}/{{z}}/{{x}}/{{y}}?key={session.key}"
        self._map.show(picture, tiles)
        self._layers.forget()
        self._strip.mark(picture)
        self._title.set_text(f"{picture.name} · {picture.width} × {picture.height}")
        if table.column == "prompts":
            following = self._strip.following(picture)
            session.wanted = [picture, *following[:1], *following[-1:]]
        self._refresh()

    # What a person does

    async def _end(self) -> None:
        """End the page and its server; all clicks are saved already."""
        await ui.run_javascript("document.body.innerText = given; return true;".replace("given", repr(FAREWELL)))
        app.shutdown()

    def _act(self, action: Callable[[], None]) -> None:
        """Do what a person wants, or say why it cannot be done; and show what has changed."""
        try:
            action()
        except StageError as error:
            _notify(str(error))
        self._refresh()

    def _key(self, event: Any) -> None:
        """A key was pressed."""
        if self._editor is None or not event.action.keydown or event.modifiers.alt or self._help.value:
            return
        name = str(event.key).lower()
        if event.modifiers.ctrl or event.modifiers.meta:
            name = {"z": "y" if event.modifiers.shift else "z", "y": "y"}.get(name, "")
        tools = {"i": "inside", "o": "outside", "b": "box", "escape": "inside"}
        steps = {"n": 0, "arrowright": 0, "arrowdown": 0, "p": -1, "arrowleft": -1, "arrowup": -1}
        actions: dict[str, Callable[[], Any]] = {"m": self._toggle_masks, "0": self._map.fit}
        actions |= {"?": self._help.open, "t": self._open_next_table}
        actions |= dict.fromkeys("+=", lambda: self._map.zoom(1)) | dict.fromkeys("-_", lambda: self._map.zoom(-1))
        actions |= {"z": lambda: self._act(self._open.undo), "y": lambda: self._act(lambda: self._open.undo(True))}
        if name in tools:
            self._act(lambda: self._open.choose_tool(tools[name]))
        elif name in steps:
            for picture in self._strip.following(self._open.picture)[steps[name] :][:1]:
                self._open_photo(picture)
        elif name in actions:
            actions[name]()

    def _open_next_table(self) -> None:
        self._tabs.set_value((self._tabs.value + 1) % len(self._session.tables))

    def _toggle_masks(self) -> None:
        self._shows_masks = not self._shows_masks
        self._refresh()

    # What is shown

    def _poll(self) -> None:
        """Take up what another page, an editor, the workflow and the background have done."""
        self._session.read_results()
        if self._editor is None:
            return
        document = self._open.table.document
        if document.changed_on_disk():
            document.read()
            _notify(f"{document.path} was changed by someone else: it was read again.")
        if self._seen != self._state_of(document):
            self._refresh()
        self._strip.poll(self._open.picture)

    def _state_of(self, document: Document) -> tuple:
        """Changes with what the page has to show."""
        return document.version, self._session.segmenter.method, self._session.results_state

    def _refresh(self) -> None:
        """Draw everything that depends on the clicks again."""
        editor, document = self._open, self._open.table.document
        self._seen = self._state_of(document)
        labels = document.kind == "labels"
        self._map.clear()
        self._map.drag_box(labels and editor.tool == "box")
        if labels:
            self._map.draw_labels(editor.here)
        else:
            _draw_points(self._map, editor)
        visible = self._shows_masks and labels and editor.table.column == "prompts"
        self._layers.update(editor.picture, editor.here, visible)
        self._strip.update(document.rows)
        self._state.set_text(f"saved in {document.path}" if document.path.exists() else "no clicks yet")
        self._panel.fill(editor, self._layers)


def _notify(text: str) -> None:
    """A notice at the lower edge."""
    ui.notify(text, type="warning", position="bottom", multi_line=True, timeout=6000)


def _draw_points(photo_map: PhotoMap, editor: Editor) -> None:
    """Draw named points, and where they are to be expected by their clicks in other photos."""
    cameras, rows, photo = editor.table.cameras, editor.table.document.rows, editor.picture.name
    for label in editor.points:
        own = [row for row in rows if row.label == label]
        here = next((row for row in own if row.photo == photo), None)
        if here is not None:
            photo_map.draw_point(here, label == editor.point)
        expected = cameras.expected(own, photo) if cameras else None
        if expected is not None and (label == editor.point or (here is None and len(expected) == 1)):
            photo_map.draw_expected(expected)

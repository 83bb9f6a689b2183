"""The strip of thumbnails: sharpest first, with the number of clicks and the agreement of the workflow's mask."""

from collections import Counter
from collections.abc import Callable

from nicegui import ui

from scenefuse.pick.edits import Rows
from scenefuse.pick.photo_tiles import Picture
from scenefuse.pick.session import Session


class PhotoStrip:
    """Thumbnails of a table's photos.

    Attributes:
        order: the photos as they are shown.
    """

    def __init__(self, session: Session, on_open: Callable[[Picture], None]) -> None:
        """Build the strip inside the current element, without photos."""
        self._session, self._on_open = session, on_open
        self.order: list[Picture] = []
        self._table = self._left = 0
        with ui.column().classes("strip h-full no-wrap gap-0"):
            self._progress = ui.label().classes("text-xs text-gray-400 px-2 pt-1")
            self._list = ui.element("div").classes("w-full")

    def open(self, table: int) -> None:
        """Show the photos of a table."""
        self._table = table
        pictures = self._session.tables[table].pictures
        self._thumbs: dict[str, ui.element] = {}
        self._counts: dict[str, ui.label] = {}
        self._scores: dict[str, ui.label] = {}
        self._list.clear()
        self.order = self._session.thumbnails.sharpest_first(pictures.values())
        numbers = {name: number for number, name in enumerate(pictures)}
        with self._list:
            for picture in self.order:
                self._add(picture, f"/thumbnail/{table}/{numbers[picture.name]}?v={self._session.key}")
        self._left = self._session.thumbnails_left(table)

    def _add(self, picture: Picture, source: str) -> None:
        with ui.element("div").classes("thumb") as thumb:
            image = ui.element("img")
            image.props["src"], image.props["loading"], image.props["alt"] = source, "lazy", picture.name
            self._counts[picture.name] = ui.label().classes("mark clicks")
            self._scores[picture.name] = ui.label().classes("mark score")
            name = ui.label(picture.name).classes("name")
            name.props["title"] = picture.name
        thumb.on("click", lambda: self._on_open(picture), args=[])
        self._thumbs[picture.name] = thumb

    def update(self, rows: Rows) -> None:
        """Show how many clicks each photo has, which have no camera, how masks agree, and which are accepted."""
        # The two corners of a box are one mark.
        marks = {(row.photo, "box" if row.label == "box" else k) for k, row in enumerate(rows)}
        clicks = Counter(photo for photo, _ in marks)
        for name, label in self._counts.items():
            label.set_text(str(clicks[name]))
            label.set_visibility(bool(clicks[name]))
        for name, label in self._scores.items():
            text, bad = self._session.standing(self._table, name)
            label.set_text(text)
            label.set_visibility(bool(text))
            label.classes(add="bad" if bad else "", remove="" if bad else "bad")

    def mark(self, picture: Picture) -> None:
        """Say which photo is shown."""
        for name, thumb in self._thumbs.items():
            if name == picture.name:
                thumb.classes(add="here")
                ui.run_javascript(f"getHtmlElement({thumb.id})?.scrollIntoView({{block: 'center'}});")
            elif "here" in thumb.classes:
                thumb.classes(remove="here")

    def poll(self, shown: Picture) -> None:
        """Sort anew once the sharpness of all photos is known; until then, say how many are left."""
        left = self._session.thumbnails_left(self._table) if self._left else 0
        if left != self._left:
            self._left = left
            self._progress.set_text(f"Looking for the sharpest: {left} left" if left else "")
            if not left:
                self.order = self._session.thumbnails.sharpest_first(self.order)
                places = {self._thumbs[p.name].id: k for k, p in enumerate(self.order)}
                self._list.default_slot.children.sort(key=lambda child: places[child.id])
                self._list.update()
                self.mark(shown)

    def following(self, picture: Picture) -> list[Picture]:
        """The other photos, from the next one on; the strip is a circle."""
        place = next(k for k, p in enumerate(self.order) if p.name == picture.name)
        return self.order[place + 1 :] + self.order[:place]

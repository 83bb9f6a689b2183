"""The strip of thumbnails: sharpest first, with the number of clicks and the agreement of the workflow's mask."""

from collections.abc import Callable, Mapping

from nicegui import ui

from scenefuse.pick.photo_tiles import Picture
from scenefuse.pick.session import Session, thumbnails_left


class PhotoStrip:
    """Thumbnails of a table's photos."""

    def __init__(self, session: Session, on_open: Callable[[Picture], None]) -> None:
        """Build the strip inside the current element, without photos."""
        self._session, self._on_open = session, on_open
        self.order: list[Picture] = []
        self._board, self._left = 0, 0
        with ui.column().classes("strip h-full no-wrap gap-0"):
            self._progress = ui.label().classes("text-xs text-gray-400 px-2 pt-1")
            self._list = ui.element("div").classes("w-full")

    def open(self, board: int) -> None:
        """Show the photos of a table."""
        self._board = board
        pictures = self._session.boards[board].source.pictures
        self._numbers = {name: number for number, name in enumerate(pictures)}
        self._thumbs: dict[str, ui.element] = {}
        self._counts: dict[str, ui.label] = {}
        self._scores: dict[str, ui.label] = {}
        self._list.clear()
        self.order = self._session.thumbnails.sharpest_first(pictures.values())
        with self._list:
            for picture in self.order:
                self._add(picture)
        self._left = thumbnails_left(self._session, board)
        self.refresh()

    def _add(self, picture: Picture) -> None:
        with ui.element("div").classes("thumb") as thumb:
            source = f"/thumbnail/{self._board}/{self._numbers[picture.name]}?v={self._session.key}"
            image = ui.element("img")
            image.props["src"], image.props["loading"], image.props["alt"] = source, "lazy", picture.name
            self._counts[picture.name] = ui.label().classes("mark clicks")
            self._scores[picture.name] = ui.label().classes("mark score")
            name = ui.label(picture.name).classes("name")
            name.props["title"] = picture.name
        thumb.on("click", lambda: self._on_open(picture), args=[])
        self._thumbs[picture.name] = thumb

    def refresh(self) -> None:
        """Show which photos have no camera, how the workflow's masks agree, and which are accepted."""
        for name, label in self._scores.items():
            text, bad = self._session.standing(self._board, name)
            label.set_text(text)
            label.set_visibility(bool(text))
            label.classes(add="bad" if bad else "", remove="" if bad else "bad")

    def count(self, clicks: Mapping[str, int]) -> None:
        """Show how many clicks each photo has."""
        for name, label in self._counts.items():
            label.set_text(str(clicks.get(name, 0)))
            label.set_visibility(bool(clicks.get(name, 0)))

    def mark(self, picture: Picture) -> None:
        """Say which photo is shown."""
        for name, thumb in self._thumbs.items():
            if name == picture.name:
                thumb.classes(add="here")
                ui.run_javascript(f"getHtmlElement({thumb.id})?.scrollIntoView({{block: 'center'}});")
            elif "here" in thumb.classes:
                thumb.classes(remove="here")

    def poll(self, shown: Picture | None) -> None:
        """Sort anew once the sharpness of all photos is known; until then, say how many are left."""
        left = thumbnails_left(self._session, self._board) if self._left else 0
        if left != self._left:
            self._left = left
            self._progress.set_text(f"Looking for the sharpest: {left} left" if left else "")
            if not left:
                self.order = self._session.thumbnails.sharpest_first(self.order)
                places = {self._thumbs[p.name].id: k for k, p in enumerate(self.order)}
                self._list.default_slot.children.sort(key=lambda child: places[child.id])
                self._list.update()
                if shown is not None and shown.name in self._thumbs:
                    self.mark(shown)

    def at(self, picture: Picture, by: int) -> Picture:
        """The photo so many places farther on; the strip is a circle."""
        place = next(k for k, p in enumerate(self.order) if p.name == picture.name)
        return self.order[(place + by) % len(self.order)]

    def neighbours(self, picture: Picture) -> list[Picture]:
        """The next photo and the one before."""
        return [self.at(picture, 1), self.at(picture, -1)]

"""What stands beside the photo: the strip of thumbnails, and the panel of tools, points, masks and what comes next."""

from collections import Counter
from collections.abc import Callable

from nicegui import ui

from scenefuse.marks.clicks import label_name
from scenefuse.pick.document import Rows
from scenefuse.pick.photo_map import MaskLayers
from scenefuse.pick.photo_tiles import Picture
from scenefuse.pick.session import Session, next_command
from scenefuse.pick.tables import Editor

Act = Callable[[Callable[[], None]], None]
TOGGLE = "no-caps dense unelevated spread padding='3px 8px'"


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
                self._add(picture, f"/thumbnail/{table}/{numbers[picture.name]}?key={self._session.key}")
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
        """Show how many clicks each photo has, which have no camera, and how masks agree."""
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


class SidePanel:
    """What is beside the photo; filled anew after every change."""

    def __init__(self, session: Session, act: Act, on_open: Callable[[Picture], None], on_done: Callable) -> None:
        """Build the panel inside the current element, empty.

        Args:
            session: the object.
            act: does what a person wants, and shows what changed or why it cannot be done.
            on_open: shows a photo.
            on_done: ends the page.
        """
        self._session, self._act, self._on_open, self._on_done = session, act, on_open, on_done
        self._column = ui.column().classes("side h-full no-wrap")
        with self._column:
            self._note = ui.label()

    def fill(self, editor: Editor, layers: MaskLayers) -> None:
        """Show what there is now."""
        table, document = editor.table, editor.table.document
        self._column.clear()
        with self._column:
            ui.label(table.advice).classes("text-sm text-gray-700")
            for text in filter(None, (document.trouble, *table.notes[:3])):
                ui.label(text).classes("text-xs text-red-700")
            if table.column == "fiducials" and not document.rows:
                kinds = {"labels": "In one photo", "points": "Named points"}
                self._toggle(kinds, document.kind, editor.choose_kind)
            if document.kind == "labels":
                tools = {"inside": "Inside (i)", "outside": "Outside (o)", "box": "Box (b)"}
                self._toggle(tools, editor.tool, editor.choose_tool)
                self._note = ui.label().classes("text-xs")
                if table.column == "prompts":
                    self._fill_masks(editor.picture.name, layers)
            else:
                self._fill_points(editor)
            ui.separator()
            self._fill_next(editor)

    def show_note(self, layers: MaskLayers) -> None:
        """Say what makes the mask, and what is wrong with it."""
        segmenter = self._session.segmenter
        method = f"The mask (green) is made by {segmenter.method}." if segmenter.method else segmenter.loading
        self._note.set_text(f"{method} {layers.note}")

    def _toggle(self, choices: dict, value: str, choose: Callable) -> None:
        toggle = ui.toggle(choices, value=value, on_change=lambda e: self._act(lambda: choose(e.value)))
        toggle.props(TOGGLE).classes("w-full")

    def _fill_masks(self, photo: str, layers: MaskLayers) -> None:
        masks = self._session.masks
        self.show_note(layers)
        if self._session.segmenter.trouble:
            ui.label(self._session.segmenter.trouble).classes("text-xs text-orange-900")
        for text in masks.notes[:4]:
            ui.label(text).classes("text-xs text-orange-900")
        if photo in masks.dropped:
            ui.label(f"Left out: {masks.dropped[photo]}. Add clicks here.").classes("text-xs text-red-700")
        elif photo in masks.agreement:
            text = f"The workflow's mask (orange) agrees with the others: {masks.agreement[photo]:.2f}"
            ui.label(text).classes("text-xs")

    def _fill_points(self, editor: Editor) -> None:
        table, document = editor.table, editor.table.document
        new = "New length, in m: bar 1.5" if document.kind == "lengths" else "New point: a name, then Enter"
        entry = ui.input(new).props("dense outlined").classes("w-full")
        entry.on("keydown.enter", lambda: self._act(lambda: editor.name_point(entry.value)))
        for label in editor.points:
            rows = [row for row in document.rows if row.label == label]
            off = table.cameras.residuals(rows) if table.cameras else {}
            worst = f" · {max(off.values()):.1f} px" if off else ""
            plural = "photo" if len(rows) == 1 else "photos"
            look = "unelevated color=amber-6 text-color=black" if label == editor.point else "flat color=grey-9"
            button = ui.button(
                f"{label_name(label)} · {len(rows)} {plural}{worst}",
                on_click=lambda label=label: self._act(lambda: editor.choose_point(label)),
            )
            button.props(f"dense {look} align=left padding='1px 8px'").classes("w-full")
            for row in rows if label == editor.point else []:
                text = f"{row.photo}: {off[row.photo]:.1f} px off" if row.photo in off else row.photo
                link = ui.label(text).classes("text-xs text-blue-800 cursor-pointer pl-3")
                if row.photo in table.pictures:
                    link.on("click", lambda row=row: self._on_open(table.pictures[row.photo]))
        if table.cameras is None:
            text = "Cross-hairs come once the workflow knows the cameras of these photos."
            ui.label(text).classes("text-xs text-gray-600")

    def _fill_next(self, editor: Editor) -> None:
        table, document = editor.table, editor.table.document
        ui.label("What comes next").classes("text-sm font-bold")
        problems = table.problems()[:6]
        for problem in problems:
            ui.label(problem).classes("text-xs text-orange-900")
        if any(row.photo not in table.pictures for row in document.rows):
            remove = ui.button("Remove clicks in missing photos", on_click=lambda: self._act(editor.remove_lost))
            remove.props("dense outline")
        if document.rows and not table.listed:
            text = f"Write {document.path} into the column {table.column} of the table of {table.of}."
            ui.label(text).classes("text-xs text-orange-900")
        done = ui.button("Done", on_click=self._on_done).classes("w-full")
        done.props("dense outline" if problems else "dense unelevated")
        ui.label("Then scenefuse complete goes on by itself; by hand, in the project's folder:").classes("text-xs")
        ui.label(next_command(self._session.configfiles, table.result)).classes("code w-full").mark("command")

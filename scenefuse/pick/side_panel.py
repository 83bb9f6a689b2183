"""The side of the page: tools or points, the workflow's masks, and what comes next."""

import asyncio
from typing import TYPE_CHECKING

from nicegui import ui

from scenefuse.marks.clicks import label_name
from scenefuse.pick.clicks import problems
from scenefuse.pick.next_run import as_text, command, planned_rules

if TYPE_CHECKING:
    from scenefuse.pick.page import Page


class SidePanel:
    """What is beside the photo; filled anew after every change."""

    def __init__(self, page: "Page") -> None:
        """Build the panel inside the current element, empty."""
        self._page = page
        self._column = ui.column().classes("side h-full no-wrap")
        with self._column:
            self._note = self._planned = ui.label()

    def fill(self) -> None:
        """Show what there is now."""
        self._column.clear()
        with self._column:
            self._fill()

    def _fill(self) -> None:
        board, document = self._page.board, self._page.board.document
        ui.label(board.source.advice[document.kind]).classes("text-sm text-gray-700")
        for text in filter(None, (document.trouble, document.fixed, *board.notes[:3])):
            ui.label(text).classes("text-xs text-red-700")
        if board.source.column == "fiducials" and not document.rows:
            kinds = {"labels": "In one photo", "points": "Named points"}
            kind = ui.toggle(kinds, value=document.kind, on_change=lambda e: self._page.choose_kind(e.value))
            kind.props("no-caps dense unelevated spread padding='3px 8px'").classes("w-full")
        if document.kind == "labels":
            self._fill_tools()
        else:
            self._fill_points()
        ui.separator()
        self._fill_next()

    def _fill_tools(self) -> None:
        tools = {"inside": "Inside (i)", "outside": "Outside (o)", "box": "Box (b)"}
        toggle = ui.toggle(tools, value=self._page.tool, on_change=lambda e: self._page.choose(e.value))
        toggle.props("no-caps dense unelevated spread padding='3px 8px'").classes("w-full")
        self._note = ui.label().classes("text-xs")
        if self._page.board_number == 0:
            self.show_note()
            if self._page.session.segmenter.trouble:
                ui.label(self._page.session.segmenter.trouble).classes("text-xs text-orange-900")
            self._fill_carried()

    def show_note(self) -> None:
        """Say what makes the mask, and what is wrong with it."""
        segmenter = self._page.session.segmenter
        method = f"Mask by {segmenter.method}." if segmenter.method else segmenter.loading
        self._note.set_text(f"{method} {self._page.mask_note}")

    def _fill_carried(self) -> None:
        carried = self._page.session.carried
        if not carried or self._page.picture is None:
            return
        name = self._page.picture.name
        accepted = sum(carried.is_accepted(photo) for photo in carried.agreement)
        ui.separator()
        ui.label(f"The workflow's masks (orange): {accepted} of {len(carried.agreement)} accepted").classes("text-sm")
        for text in carried.notes[:4]:
            ui.label(text).classes("text-xs text-orange-900")
        if name in carried.dropped:
            ui.label(f"Left out: {carried.dropped[name]}. Add clicks here.").classes("text-xs text-red-700")
        elif name in carried.agreement:
            text = f"Agreement with the others here: {carried.agreement[name]:.2f}"
            ui.label(text + (" · accepted" if carried.is_accepted(name) else "")).classes("text-xs")
        ui.button("Accept, next (a)", icon="check", on_click=self._page.accept).props(
            "dense outline padding='2px 10px'"
        )

    def _fill_points(self) -> None:
        document, cameras = self._page.board.document, self._page.board.cameras
        lengths = document.kind == "lengths"
        asked = "New length, in m: bar 1.5" if lengths else "New point: a name, then Enter"
        entry = ui.input(asked).props("dense outlined").classes("w-full")
        entry.on("keydown.enter", lambda: self._page.choose_point(entry.value))
        names = [row.label for row in document.rows]
        for name in dict.fromkeys([*names, *self._page.chosen]):
            rows = [row for row in document.rows if row.label == name]
            off = cameras.residuals(rows) if cameras else {}
            worst = f" · {max(off.values()):.1f} px" if off else ""
            plural = "photo" if len(rows) == 1 else "photos"
            look = "unelevated color=amber-6 text-color=black" if name == self._page.point else "flat color=grey-9"
            button = ui.button(
                f"{label_name(name)} · {len(rows)} {plural}{worst}",
                on_click=lambda name=name: self._page.take_point(name),
            )
            button.props(f"dense {look} align=left padding='1px 8px'").classes("w-full")
            if name == self._page.point:
                for row in rows:
                    text = f"{row.photo}: {off[row.photo]:.1f} px off" if row.photo in off else row.photo
                    link = ui.label(text).classes("text-xs text-blue-800 cursor-pointer pl-3")
                    link.on("click", lambda row=row: self._page.go(row.photo))
        if cameras is None:
            text = "Cross-hairs come once the workflow knows the cameras of these photos."
            ui.label(text).classes("text-xs text-gray-600")

    def _fill_next(self) -> None:
        board, document = self._page.board, self._page.board.document
        ui.label("What the workflow will make of it").classes("text-sm font-bold")
        found = problems(document.rows, document.kind, board.source.sizes, board.source.least_inside)
        for problem in found[:6]:
            ui.label(problem).classes("text-xs text-orange-900")
        if any(row.photo not in board.source.pictures for row in document.rows):
            ui.button("Remove clicks in missing photos", on_click=self._page.remove_lost).props("dense outline")
        if document.rows and not board.source.listed:
            source = board.source
            text = f"Write {document.path} into the column {source.column} of the table of {source.of}."
            ui.label(text).classes("text-xs text-orange-900")
        words = command(self._page.session.configfiles, str(board.source.result))
        ui.label(as_text(words)).classes("code w-full").mark("command")
        ui.button("What will run?", icon="playlist_play", on_click=self.plan).props("dense outline padding='2px 10px'")
        self._planned = ui.label().classes("text-xs")

    async def plan(self) -> None:
        """Ask the workflow what it will run."""
        self._planned.set_text("Asking the workflow; some seconds ...")
        words = command(self._page.session.configfiles, str(self._page.board.source.result))
        rules, trouble = await asyncio.to_thread(planned_rules, words)
        jobs = ", ".join(f"{rule}{f' ({count})' if count > 1 else ''}" for rule, count in rules.items())
        self._planned.set_text(trouble or f"Will run: {jobs or 'nothing'}.")

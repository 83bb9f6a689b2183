"""What a person does to the open table, apart from how it is shown."""

from collections.abc import Callable

from scenefuse.core.stage import StageError
from scenefuse.marks.clicks import Kind
from scenefuse.pick.edits import (
    Corners,
    Rows,
    point_name,
    with_box,
    with_label,
    with_length,
    with_point,
    without_nearest,
)
from scenefuse.pick.photo_tiles import Picture
from scenefuse.pick.tables import Table


class Editor:
    """A table, the photo that is clicked in, and the tool that is chosen.

    An action that cannot be done raises StageError, with a sentence for the person.

    Attributes:
        table: that is clicked.
        picture: the photo that is clicked in.
        tool: inside, outside or box, for labels.
        point: label of the point or end that a click marks; "" for none.
        points: labels of the points or ends that a person has named, clicked or not.
    """

    def __init__(self, table: Table, picture: Picture) -> None:
        self.table, self.picture = table, picture
        self.tool = "inside"
        self._named: tuple[str, ...] = ()
        self.point = self.points[0] if self.points else ""

    @property
    def points(self) -> list[str]:
        """Labels of all points or ends, in the order in which they came."""
        if self.table.document.kind == "labels":
            return []
        return list(dict.fromkeys([*(row.label for row in self.table.document.rows), *self._named]))

    @property
    def here(self) -> Rows:
        """The clicks in the photo."""
        return tuple(row for row in self.table.document.rows if row.photo == self.picture.name)

    def click(self, x: float, y: float) -> None:
        """Click into the photo by the tool that is chosen."""
        document, where = self.table.document, (self.picture.name, x, y, self.table.sizes)
        if document.kind == "labels":
            document.change(with_label(document.rows, "outside" if self.tool == "outside" else "inside", *where))
        elif not self.point:
            what = "Write a length" if document.kind == "lengths" else "Name a point"
            raise StageError(f"{what} first, at the right; then click it.")
        else:
            document.change(with_point(document.rows, self.point, *where))
            if document.kind == "lengths":
                self._choose_other_end()

    def remove(self, x: float, y: float, within_px: float) -> None:
        """Remove the click that is nearest to a pixel."""
        self._change(lambda rows: without_nearest(rows, self.picture.name, x, y, within_px))

    def draw_box(self, corners: Corners) -> None:
        """Draw a box around the object."""
        self.tool = "inside"
        self._change(lambda rows: with_box(rows, self.picture.name, corners, self.table.sizes))

    def remove_lost(self) -> None:
        """Remove clicks in photos that are no longer there."""
        self._change(lambda rows: tuple(row for row in rows if row.photo in self.table.pictures))

    def undo(self, forward: bool = False) -> None:
        """One change back, or forward again."""
        if not self.table.document.undo(forward):
            raise StageError("Nothing to redo." if forward else "Nothing to undo.")

    def choose_tool(self, tool: str) -> None:
        """Take another tool."""
        self.tool = tool

    def choose_kind(self, kind: Kind) -> None:
        """Mark by labels or by named points."""
        self.table.document.choose_kind(kind)

    def name_point(self, text: str) -> None:
        """Take a point, which may be new, or a length with its metres, as a person writes them."""
        document = self.table.document
        if document.kind == "lengths":
            rows, self._named = with_length(document.rows, text)
            document.change(rows)
        else:
            self._named = (point_name(text),)
        self.point = self._named[0]

    def choose_point(self, label: str) -> None:
        """Take a point or an end that is listed."""
        self.point = label

    def _choose_other_end(self) -> None:
        """After one end of a length comes the other, where the photo does not have it yet; then the first again."""
        here = {row.label for row in self.here}
        ends = [label for label in self.points if label.split("\t")[0] == self.point.split("\t")[0]]
        self.point = next((end for end in ends if end not in here), ends[0])

    def _change(self, edit: Callable[[Rows], Rows]) -> None:
        self.table.document.change(edit(self.table.document.rows))

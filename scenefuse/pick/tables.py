"""The tables of clicks of an object, the photos to click in, and what a person does to the table that is open."""

from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, Literal

from scenefuse.core.project import Project
from scenefuse.core.stage import StageError, read_json
from scenefuse.crop.marked import MIN_INSIDE
from scenefuse.marks.clicks import Kind
from scenefuse.photos.photo_files import distinct_photos, frame_name, thin_out, upright_size
from scenefuse.pick.document import (
    Corners,
    Document,
    Rows,
    Sizes,
    label_in,
    point_name,
    problems,
    with_box,
    with_label,
    with_length,
    with_point,
    without_nearest,
)
from scenefuse.pick.expected_place import Cameras
from scenefuse.pick.photo_tiles import Picture

FEW_FEATURES = "Needed only where the photos of object and scene share too few features. "
LENGTH = "Write the name and metres of a length that you know, and click both ends in two photos or more, far apart."
# What to do, by the column that names the table and its kind.
ADVICE: dict[tuple[str, Kind], str] = {
    ("prompts", "labels"): "Click each part of the object in one photo, about five times. Where the mask holds more,"
    " click there as outside. Once it holds the object, press Done: the other tables are seldom needed.",
    ("prompts", "points"): "Mark at least four points on the object that span it, each in two or more photos.",
    ("fiducials", "labels"): f"{FEW_FEATURES}Click the object's ends, top and foot in one photo, and what it touches as"
    " outside.",
    ("fiducials", "points"): f"{FEW_FEATURES}Mark at least four points that bound the object, each in two or more"
    " photos.",
    ("lengths", "lengths"): f"Needed only for metres where there are neither GPS nor control points. {LENGTH}",
}


class Table:
    """A table that can be clicked, with the photos to click in.

    Attributes:
        of: the user's table that names it in a column: of objects, or of scenes.
        column: that column.
        title: for the page.
        pictures: the photos, by name.
        listed: whether the column names the table; a new one lies beside the user's table.
        result: what the workflow makes of it.
        document: its clicks.
        cameras: of its photos, once the workflow has them; None before.
        notes: what a person should know, a sentence each.
    """

    def __init__(
        self,
        project: Project,
        of: Literal["objects", "scenes"],
        name: str,
        column: str,
        *,
        title: str,
        pictures: dict[str, Picture],
        models: tuple[Path, ...],
        result: Path,
    ) -> None:
        """Read the table, which need not exist.

        Args:
            project: the user's.
            of, column, title, pictures, result: see the class.
            name: of the object or scene.
            models: folders where a COLMAP model of the photos may lie, the best first.
        """
        self.of, self.column, self.title, self.pictures, self.result = of, column, title, pictures, result
        row = (project.objects if of == "objects" else project.scenes)[name]
        self.listed = bool(row.get(column))
        path = Path(row[column] if self.listed else Path(project.settings[of]).parent / f"{name}_{column}.tsv")
        self.document = Document(path, "lengths" if column == "lengths" else "labels", pictures)
        self.notes: list[str] = []
        self.models = models
        self.read_cameras()

    @property
    def sizes(self) -> Sizes:
        """Photo name -> (width, height)."""
        return {name: (p.width, p.height) for name, p in self.pictures.items()}

    @property
    def advice(self) -> str:
        """What to do."""
        return ADVICE[self.column, self.document.kind]

    def problems(self) -> list[str]:
        """What the workflow would refuse or leave out, a sentence each."""
        fewest = MIN_INSIDE if self.column == "fiducials" else 1
        return problems(self.document.rows, self.document.kind, self.sizes, fewest)

    def read_cameras(self) -> None:
        """Read the cameras that the workflow has found by now."""
        self.cameras: Cameras | None = None
        model = next((folder for folder in self.models if folder.is_dir()), None)
        if model is not None:
            try:
                self.cameras = Cameras(model, self.sizes)
            except StageError as error:
                self.notes.append(str(error))


def tables_of(project: Project, name: str) -> list[Table]:
    """The tables of an object: its prompts, and fiducials in the scene's photos where it has any; known lengths in
    these, or in the photos of an object by itself.

    Raises:
        StageError: there is no such object, or no photos.
    """
    if name not in project.objects:
        known = ", ".join(project.objects) or "none"
        raise StageError(f"unknown object '{name}'; {project.settings['objects']} lists: {known}")
    found = [*_in_photos_of_object(project, name), *_in_photos_of_scene(project, name)]
    if not found:
        raise StageError(f"object '{name}' and its scene are clouds: there are no photos to click in")
    return found


def _in_photos_of_object(project: Project, name: str) -> Iterator[Table]:
    row, results = project.objects[name], Path("results/objects") / name
    if not row.get("photos"):
        return
    pictures = _object_pictures(Path(row["photos"]), results, project.of("object", name)["object"]["frames"])
    where: dict[str, Any] = {"pictures": pictures, "models": (results / "sparse",)}
    prompts = Table(project, "objects", name, "prompts", title="The object", result=results / "masks.png", **where)
    if row.get("masks"):
        prompts.listed = True
        prompts.notes.append(f"the column masks is filled ({row['masks']}): these masks count, and no clicks")
    yield prompts
    if row.get("lengths") or not row.get("scene"):
        made = results / "sparse.json"
        yield Table(project, "objects", name, "lengths", title="Lengths on it", result=made, **where)


def _in_photos_of_scene(project: Project, name: str) -> Iterator[Table]:
    scene = project.objects[name].get("scene")
    if not scene or not project.scenes[scene].get("photos"):
        return
    results = Path("results/scenes") / scene
    source = Path(project.scenes[scene]["photos"])
    if source.is_file():
        # Objects can be clicked before the scene's frames are there.
        if project.objects[name].get("photos") and not (results / "photos.json").is_file():
            return
        pictures = _video_pictures(source, results, "photos")
    else:
        # Those that the workflow turned upright are the same to a person.
        pictures = _pictures((photo, source / photo) for photo in distinct_photos(source)[0])
    where: dict[str, Any] = {"pictures": pictures, "models": (results / "georeferenced", results / "sparse")}
    made = Path("results/objects") / name / "fused.ply"
    yield Table(project, "objects", name, "fiducials", title="In the scene", result=made, **where)
    yield Table(project, "scenes", scene, "lengths", title="Known lengths", result=results / "residuals.tsv", **where)


def _object_pictures(source: Path, results: Path, frames: dict[str, Any]) -> dict[str, Picture]:
    """The photos around an object, or the frames of its video, by the names that the workflow gives them.

    Args:
        source: folder of photos, or video.
        results: folder of the object's results.
        frames: settings `object.frames`.

    Raises:
        StageError: there are no photos, one cannot be read, or a video has no frames yet.
    """
    if source.is_file():
        return _video_pictures(source, results, "frames")
    names, _ = distinct_photos(source)
    chosen = [names[k] for k in thin_out(len(names), frames["frame_step"], frames["max_frames"])]
    return _pictures((frame_name(name), source / name) for name in chosen)


def _video_pictures(video: Path, results: Path, folder: str) -> dict[str, Picture]:
    """The frames that were extracted. They may be smaller than the video's, whose pixels clicks are in."""
    listed = results / "photos.json"
    if not listed.is_file():
        raise StageError(f"{video} is a video whose frames are not there yet; run: scenefuse run {listed}")
    found = {}
    for name, origin in read_json(listed)["origin"]["value"].items():
        path = results / folder / name
        scale = upright_size(path)[0] / origin["width"]
        found[name] = Picture(name, path, origin["width"], origin["height"], scale)
    return found


def _pictures(files: Iterable[tuple[str, Path]]) -> dict[str, Picture]:
    def picture(file: tuple[str, Path]) -> Picture:
        return Picture(*file, *upright_size(file[1]))

    with ThreadPoolExecutor() as pool:
        return {found.name: found for found in pool.map(picture, files)}


class Editor:
    """A table, the photo that is clicked in, and the tool that is chosen.

    An action that cannot be done raises StageError, with a sentence for the person.

    Attributes:
        table: that is clicked.
        picture: the photo that is clicked in.
        tool: inside, outside or box, for labels.
        points: labels of the points or ends that a person has named, clicked or not.
    """

    def __init__(self, table: Table, picture: Picture) -> None:
        self.table, self.picture, self.tool = table, picture, "inside"
        self._named: tuple[str, ...] = ()
        self._point = self.points[0] if self.points else ""

    @property
    def point(self) -> str:
        """Label of the point or end that a click marks; "" for none."""
        return label_in(self.table.document.rows, self._point)

    @property
    def points(self) -> list[str]:
        """Labels of all points or ends, in the order in which they came."""
        if self.table.document.kind == "labels":
            return []
        rows = self.table.document.rows
        return list(dict.fromkeys([*(row.label for row in rows), *(label_in(rows, label) for label in self._named)]))

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
        document = self.table.document
        document.change(without_nearest(document.rows, self.picture.name, x, y, within_px))

    def draw_box(self, corners: Corners) -> None:
        """Draw a box around the object."""
        self.tool, document = "inside", self.table.document
        document.change(with_box(document.rows, self.picture.name, corners, self.table.sizes))

    def remove_lost(self) -> None:
        """Remove clicks in photos that are no longer there."""
        document = self.table.document
        document.change(tuple(row for row in document.rows if row.photo in self.table.pictures))

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
        self.choose_point(self._named[0])

    def choose_point(self, label: str) -> None:
        """Take a point or an end that is listed."""
        self._point = label

    def _choose_other_end(self) -> None:
        """After one end of a length comes the other, where the photo does not have it yet; then the first again."""
        here = {row.label for row in self.here}
        ends = [label for label in self.points if label.split("\t")[0] == self.point.split("\t")[0]]
        self.choose_point(next((end for end in ends if end not in here), ends[0]))

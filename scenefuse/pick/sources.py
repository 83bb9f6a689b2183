"""What an object's tables and photos are, by the settings and results of the workflow."""

from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from scenefuse.core.stage import StageError, read_json
from scenefuse.marks.clicks import Kind
from scenefuse.marks.project import Project
from scenefuse.photos.photo_files import frame_name, thin_out, upright_size
from scenefuse.photos.photos import photo_names, without_copies
from scenefuse.pick.clicks import Sizes
from scenefuse.pick.photo_tiles import Picture

OF_OBJECT: dict[Kind, str] = {
    "labels": "Click each part of the object, and beside it where something like it touches it. One photo is enough to"
    " begin with.",
    "points": "Mark at least four points on the object that span it, each in two or more photos.",
}
ONLY_IF = "Needed only where the photos of object and scene share too few features. "
OF_SCENE: dict[Kind, str] = {
    "labels": ONLY_IF + "Click the object's ends, top and foot in one photo, and what it touches as outside.",
    "points": ONLY_IF + "Mark at least four points that bound the object, each in two or more photos.",
}
OF_OWN_LENGTHS: dict[Kind, str] = {
    "lengths": "Needed only if the object shall be in metres. Write the name and the metres of a length that you know,"
    " a scale bar's, and click its two ends, each in two or more photos.",
}
OF_LENGTHS: dict[Kind, str] = {
    "lengths": "Needed only where a scene without GPS and control points shall be in metres. Write the name and the"
    " metres of a length that you know, and click its two ends, each in two or more photos.",
}


@dataclass(frozen=True)
class Source:
    """A table that can be clicked, and the photos to click in.

    Attributes:
        column: of the table of objects, or of scenes.
        title: for the page.
        advice: what to do, by the kind of the table.
        path: of the table, which need not exist.
        kind: what a new table holds.
        pictures: the photos, by name.
        models: folders where a COLMAP model of these photos may lie, the best first.
        listed: whether that table names the path.
        result: what the workflow makes of it.
        of: which table that is.
        least_inside: labels: fewest clicks inside.
    """

    column: str
    title: str
    advice: dict[Kind, str]
    path: Path
    kind: Kind
    pictures: dict[str, Picture]
    models: tuple[Path, ...]
    listed: bool
    result: Path
    of: Literal["scenes", "objects"] = "objects"
    least_inside: int = 1
    notes: tuple[str, ...] = ()

    @property
    def sizes(self) -> Sizes:
        """Photo name -> (width, height)."""
        return {name: (p.width, p.height) for name, p in self.pictures.items()}


def sources_of(project: Project, name: str) -> list[Source]:
    """The tables of an object: its prompts, and fiducials in the scene's photos where it has any; known lengths in
    these, or in the photos of an object by itself.

    Raises:
        StageError: there is no such object, or no photos.
    """
    if name not in project.objects:
        known = ", ".join(project.objects) or "none"
        raise StageError(f"unknown object '{name}'; {project.settings['objects']} lists: {known}")
    found = [*_in_the_object_s_photos(project, name), *_in_the_scene_s_photos(project, name)]
    if not found:
        raise StageError(f"object '{name}' and its scene are clouds: there are no photos to click in")
    return found


def _in_the_object_s_photos(project: Project, name: str) -> Iterator[Source]:
    row, results = project.objects[name], Path("results/objects") / name
    if not row.get("photos"):
        return
    pictures = object_pictures(Path(row["photos"]), results, project.of("object", name)["object"]["frames"])
    models: tuple[Path, ...] = (results / "sparse",)
    path, listed = _table(project, "objects", name, "prompts")
    made = results / "masks.png"
    notes = (f"the column masks is filled ({row['masks']}): these count, and no clicks",) if row.get("masks") else ()
    yield Source(
        "prompts", "The object", OF_OBJECT, path, "labels", pictures, models, listed or bool(notes), made, notes=notes
    )
    if row.get("lengths") or not row.get("scene"):
        path, listed = _table(project, "objects", name, "lengths")
        made = results / "sparse.json"
        yield Source("lengths", "Lengths on it", OF_OWN_LENGTHS, path, "lengths", pictures, models, listed, made)


def _in_the_scene_s_photos(project: Project, name: str) -> Iterator[Source]:
    scene = project.objects[name].get("scene")
    if not scene or not project.scenes[scene].get("photos"):
        return
    results = Path("results/scenes") / scene
    pictures = scene_pictures(Path(project.scenes[scene]["photos"]), results)
    models = (results / "georeferenced", results / "sparse")
    path, listed = _table(project, "objects", name, "fiducials")
    made = Path("results/objects") / name / "fused.ply"
    yield Source("fiducials", "In the scene", OF_SCENE, path, "labels", pictures, models, listed, made, least_inside=3)
    path, listed = _table(project, "scenes", scene, "lengths")
    made = results / "residuals.tsv"
    yield Source("lengths", "Known lengths", OF_LENGTHS, path, "lengths", pictures, models, listed, made, of="scenes")


def object_pictures(source: Path, results: Path, frames: dict[str, Any]) -> dict[str, Picture]:
    """The photos around an object, or the frames of its video, by the names that the workflow gives them.

    Args:
        source: folder of photos, or video.
        results: folder of the object's results.
        frames: settings `object.frames`.

    Raises:
        StageError: there are no photos, one cannot be read, or a video has no frames yet.
    """
    if source.is_file():
        return _video_pictures(source, results)
    names, _ = without_copies(source, photo_names(source))
    chosen = [names[k] for k in thin_out(len(names), frames["frame_step"], frames["max_frames"])]
    return _pictures((frame_name(name), source / name) for name in chosen)


def scene_pictures(source: Path, results: Path) -> dict[str, Picture]:
    """The photos of a scene by name; those that the workflow turned upright are the same to a person."""
    return _pictures((name, source / name) for name in without_copies(source, photo_names(source))[0])


def _video_pictures(video: Path, results: Path) -> dict[str, Picture]:
    """The frames that were extracted. They may be smaller than the video's, whose pixels clicks are in."""
    listed = results / "photos.json"
    if not listed.is_file():
        raise StageError(f"{video} is a video whose frames are not there yet; run: snakemake --cores 2 {listed}")
    found = {}
    for name, origin in read_json(listed)["origin"]["value"].items():
        path = results / "frames" / name
        scale = upright_size(path)[0] / origin["width"]
        found[name] = Picture(name, path, origin["width"], origin["height"], scale)
    return found


def _pictures(files: Iterable[tuple[str, Path]]) -> dict[str, Picture]:
    def picture(file: tuple[str, Path]) -> Picture:
        return Picture(*file, *upright_size(file[1]))

    with ThreadPoolExecutor(4) as pool:
        return {found.name: found for found in pool.map(picture, files)}


def _table(project: Project, kind: Literal["scenes", "objects"], name: str, column: str) -> tuple[Path, bool]:
    """The path of a table, and whether the table of objects or scenes names it; a new one lies beside that."""
    rows = project.scenes if kind == "scenes" else project.objects
    if rows[name].get(column):
        return Path(rows[name][column]), True
    return Path(project.settings[kind]).parent / f"{name}_{column}.tsv", False

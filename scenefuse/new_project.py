"""A folder for a project of one's own: tables, settings and a text that says what comes next."""

import re
import shlex
import unicodedata
from collections.abc import Iterable, Mapping, Sequence
from itertools import permutations
from pathlib import Path
from typing import Literal

import tyro

from scenefuse.cloud.formats import READERS, columns_in_parts
from scenefuse.core.settings import OWN_SETTINGS, PACKAGE, ROOT, schema_of
from scenefuse.core.stage import StageError, atomic_file
from scenefuse.core.tables import Row, is_comment, read_table, read_text
from scenefuse.core.transforms import FIXING_POINTS
from scenefuse.photos.photo_files import MIN_OBJECT_PHOTOS, SUFFIXES, VIDEO_SUFFIXES, in_folders, photo_files

SCENES, OBJECTS = Path("config/scenes.tsv"), Path("config/objects.tsv")
COLUMNS = {
    SCENES: ("scene", "photos", "cameras", "cloud", "crs"),
    OBJECTS: ("object", "scene", "photos", "cameras", "cloud", "prompts", "fiducials"),
}
SETTINGS = """\
# Settings that differ from the shipped ones; `scenefuse run` reads this file. All of them, with their shipped values:
# {root}/config/README.md
"""


def init(
    folder: tyro.conf.Positional[Path],
    *,
    scene: Path | None = None,
    objects: tuple[Path, ...] = (),
    preset: Literal["draft", "normal", "high"] = "normal",
) -> None:
    """Make a folder for a project of your own: config/scenes.tsv, config/objects.tsv, config/config.yaml, README.md.

    Args:
        folder: of the project; it may exist, but not hold a project.
        scene: photos of the scene (a folder or a video), or its cloud, for the first row of scenes.tsv.
        objects: the same of objects in it, for the rows of objects.tsv.
        preset: what config.yaml holds: settings for a first look, the shipped ones, or larger ones for a GPU.

    Raises:
        StageError: the folder is a file or holds a project, a path is neither photos nor a cloud, or two names are the
            same.
    """
    rows = make_project(folder, scene, objects, preset)
    clicks = (f"scenefuse pick --object {row['object']}" for row in rows[OBJECTS] if "photos" in row)
    step = f" && {next(clicks, 'scenefuse run')}" if any(rows.values()) else ", and fill in both tables in config/"
    print(f"next: cd {shlex.quote(str(folder))}{step}    (README.md there says more)", flush=True)


def make_project(folder: Path, scene: Path | None, objects: Sequence[Path], preset: str) -> dict[Path, list[Row]]:
    """Make the project and say what is in it; returns the rows of its tables. Arguments and errors as of `init`."""
    if set("{}") & set(str(folder.resolve())):
        raise StageError(f"{folder.resolve()} has braces, which Snakemake takes for wildcards; give another folder")
    rows = project_rows(folder, scene, objects)
    names = [row["object"] for row in rows[OBJECTS]] or ["NAME"]
    text = (PACKAGE / "assets/project.md").read_text().format(name=folder.resolve().name, object=names[0])
    texts = {
        **{path.as_posix(): _table(COLUMNS[path], rows[path]) for path in rows},
        OWN_SETTINGS.as_posix(): SETTINGS.format(root=ROOT) + (ROOT / f"config/presets/{preset}.yaml").read_text(),
        "README.md": text + _columns("scenes") + _columns("objects"),
    }
    for path in (folder / name for name in texts):
        if path.exists() or (folder.exists() and not folder.is_dir()):
            raise StageError(f"{path if folder.is_dir() else folder} exists already; give a new folder")
    if any(path.suffix.lower() in SUFFIXES for path in folder.glob("*")):
        raise StageError(f"{folder} holds photos, and the project would lie among them; give a folder of its own")
    for name, text in texts.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text, encoding="utf-8")
    for path in [*([] if scene is None else [scene]), *objects]:
        name = default_name(path)
        said = "the scene" if path is scene else "an object"
        said += "" if name == _stem(path) else f", called {name} (names hold only A-Z, a-z, 0-9, _ and -)"
        if path.is_dir():
            names = [file.relative_to(path).as_posix() for file in photo_files(path)]
            # README.md says how to photograph.
            few = ", which is few: every part has to be in three or more"
            few += "" if path is scene else "; an object takes 30 to 100, from all sides"
            said += f", {in_folders(names)}{few if len(names) < 30 else ''}"
        print(f"{path}: {said}", flush=True)
    return rows


def project_rows(folder: Path, scene: Path | None, objects: Sequence[Path]) -> dict[Path, list[Row]]:
    """The rows of a project's tables; its columns are those that are filled. Errors as of `init`."""
    names = [default_name(path) for path in objects]
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        raise StageError(f"two objects would be called '{twice}'; give each once, or rename a folder or file")
    if scene is not None and scene.resolve() in (path.resolve() for path in objects):
        raise StageError(f"{scene} is given as the scene and as an object; give the object's own photos")
    folders = [path.resolve() for path in (scene, *objects) if path is not None and path.is_dir()]
    for inner, outer in permutations(folders, 2):
        if inner.is_relative_to(outer):
            raise StageError(f"{inner} lies in {outer}, whose photos in folders below count too; move it elsewhere")
    scene_name = "" if scene is None else default_name(scene)
    scenes = [] if scene is None else [{"scene": scene_name} | _source(scene, folder)]
    sources = [_source(path, folder, MIN_OBJECT_PHOTOS) for path in objects]
    rows = [{"object": name, "scene": scene_name} | source for name, source in zip(names, sources)]
    for row in rows:
        # Where `pick` saves what is clicked.
        row |= {"prompts": f"config/{row['object']}_prompts.tsv"} if "photos" in row else {}
    return {SCENES: scenes, OBJECTS: rows}


def fill(table: Path, column: str, cells: Mapping[str, str]) -> None:
    """Write the cells of a column of a table of objects, by their names; unknown ones get a row, comments stay."""
    rows, comments = read_table(table, "object"), list(filter(is_comment, read_text(table).splitlines()))
    for name, cell in cells.items():
        rows.setdefault(name, {"object": name})[column] = cell
    columns = tuple(dict.fromkeys([*next(iter(rows.values())), column]))
    with atomic_file(table) as temporary:
        temporary.write_text("\n".join([*comments, _table(columns, rows.values())]), encoding="utf-8")


def default_name(path: Path) -> str:
    """A name for the tables from that of a file or folder: without accents; in other scripts, as Punycode."""
    letters = "".join(a for a in unicodedata.normalize("NFKD", _stem(path)) if not unicodedata.combining(a))
    if not letters.isascii() and not re.search("[A-Za-z]", letters):
        letters = letters.encode("punycode").decode()
    return re.sub(r"[^A-Za-z0-9_-]+", "_", letters).strip("-_") or "_"


def _stem(path: Path) -> str:
    return path.stem if path.is_file() else path.resolve().name


def _source(path: Path, folder: Path, least: int = FIXING_POINTS) -> dict[str, str]:
    """The cell of a row that names photos, so many at least, or a cloud, relative to the project if it lies inside."""
    if not path.exists():
        raise StageError(f"{path} does not exist; give a folder of photos, a video or a cloud")
    suffix = path.suffix.lower()
    if path.is_dir():
        if folder.resolve().is_relative_to(path.resolve()):
            raise StageError(f"the project {folder} would lie among its photos in {path}; give a folder of its own")
        clouds = sorted(file.name for file in path.iterdir() if is_cloud(file))
        if clouds and not any(file.suffix.lower() in SUFFIXES for file in path.rglob("*")):
            raise StageError(f"{path} holds no photos; if its files ({clouds[0]}, ...) are clouds, merge and give one")
        if (count := len(photo_files(path))) < least:
            raise StageError(f"{path} holds {count} {'photo' if count == 1 else 'photos'}; {least} or more are needed")
    elif not (is_cloud(path) or suffix in VIDEO_SUFFIXES):
        raise StageError(f"{path} is not a folder of photos, a video nor a cloud ({', '.join(READERS)})")
    elif path.stat().st_size == 0:
        raise StageError(f"{path} is empty; export it again")
    elif is_cloud(path) and next(columns_in_parts(path, degrees=True)(), None) is None:
        raise StageError(f"{path} holds no points; look at what wrote it")
    return {"cloud" if is_cloud(path) else "photos": cell_of(path, folder)}


def is_cloud(path: Path) -> bool:
    """Whether a path is that of a cloud or mesh."""
    return path.is_file() and path.suffix.lower() in READERS


def cell_of(path: Path, folder: Path) -> str:
    """A path as a table of a project names it: relative to the project if it lies inside."""
    place, project = path.resolve(), folder.resolve()
    return (place.relative_to(project) if place.is_relative_to(project) else place).as_posix()


def _table(columns: tuple[str, ...], rows: Iterable[Row]) -> str:
    """A table with these columns and rows."""
    lines = ["\t".join(columns), *("\t".join(row.get(name, "") for name in columns) for row in rows)]
    return "\n".join(lines) + "\n"


def _columns(kind: str) -> str:
    """What belongs in the columns that a table may have, for the project's README."""
    about = [f"- `{name}`: {column['description']}" for name, column in schema_of(kind)["properties"].items()]
    return "\n".join([f"\n## Columns of {kind}.tsv\n", *about]) + "\n"

"""What a run of the workflow works on: settings, scenes, objects and registration variants, all checked.

The workflow imports this whenever it plans: nothing here takes long to import.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from scenefuse.core.settings import (
    ROOT,
    merge,
    place_of,
    problem,
    problem_at,
    read_differences,
    read_yaml,
    schema_of,
    with_defaults,
)
from scenefuse.core.stage import StageError
from scenefuse.core.tables import Row, read_table

# Columns about a row's photos.
PHOTO_COLUMNS = ("calibration", "cameras", "control", "lengths", "prompts", "masks")
# Sections that the settings file of a row may hold, and settings in them that are the same for the whole run.
OWN_SECTIONS = {"scene": ("scene",), "object": ("object", "registration", "fusion")}
RUN_SETTINGS = ("scene.chunks", "object.recipe", "registration.variants")


@dataclass(frozen=True)
class Project:
    """All that the rules need to know of a project.

    Attributes:
        settings: as shipped, with the user's laid over them.
        scenes: rows of the table of scenes by name.
        objects: rows of the table of objects by name.
        variants: for each registration variant that runs, the settings of `registration` that differ.
        own: settings of the rows that have a settings file of their own, by kind and name.
    """

    settings: dict[str, Any]
    scenes: dict[str, Row]
    objects: dict[str, Row]
    variants: dict[str, dict[str, Any]]
    own: dict[tuple[str, str], dict[str, Any]]

    def of(self, kind: str, name: str) -> dict[str, Any]:
        """The settings of a `scene` or an `object`."""
        return self.own.get((kind, name), self.settings)

    def registration(self, name: str, variant: str) -> dict[str, Any]:
        """The settings of `registration` for a variant of an object."""
        return merge(self.of("object", name)["registration"], self.variants[variant])


def read_project(config: Mapping[str, Any], files: Iterable[Path] = ()) -> Project:
    """The project that a configuration describes; relative paths are the working directory's, then the repository's.

    Args:
        config: settings that differ from the shipped ones.
        files: that they were read from, for messages.

    Raises:
        StageError: the first thing that is wrong, with its file and place.
    """
    files, schema = list(files), schema_of("config")
    for file in (file for file in files if file.suffix != ".json"):
        read_yaml(file)
    keys, wrong = problem_at(config, schema)
    if wrong:
        raise StageError(f"{next(filter(None, (place_of(keys, file) for file in files)), 'config')}, {wrong}")
    settings = with_defaults(config, schema)
    scenes, objects = (_checked_table(settings[f"{kind}s"], kind) for kind in ("scene", "object"))
    if not scenes and not objects:
        raise StageError(
            f"{settings['scenes']} and {settings['objects']} have no rows; add one for each scene and object"
        )
    for kind, rows in (("scene", scenes), ("object", objects)):
        for name, row in rows.items():
            wrong = _cloud_problem(kind, row) or _crs_problem(row)
            if wrong:
                raise StageError(f"{settings[f'{kind}s']}: {kind} '{name}' {wrong}")
    for name, row in objects.items():
        wrong = _scene_problem(row, scenes, settings["scenes"])
        if wrong:
            raise StageError(f"{settings['objects']}: object '{name}' {wrong}")
    own = {
        (kind, name): merge(settings, _differences(kind, name, row["config"], settings[f"{kind}s"]))
        for kind, rows in (("scene", scenes), ("object", objects))
        for name, row in rows.items()
        if row.get("config")
    }
    return Project(settings, scenes, objects, _variants(settings), own)


def _checked_table(name: str, kind: str) -> dict[str, Row]:
    path = Path(name) if Path(name).is_file() else ROOT / name
    if not path.is_file():
        raise StageError(f"{name} does not exist; write it as {ROOT}/config/README.md describes")
    rows = read_table(path, kind)
    for of, row in rows.items():
        wrong = problem(row, schema_of(f"{kind}s"))
        if wrong:
            raise StageError(f"{name}, {kind} '{of}', column {wrong}")
    # A path that begins like an option must not be taken for one.
    return {
        of: {key: f"./{cell}" if cell.startswith("-") else cell for key, cell in row.items()}
        for of, row in rows.items()
    }


def _cloud_problem(kind: str, row: Row) -> str:
    """What is wrong with a row that has a cloud in the place of photos or beside them, or neither; "" where nothing."""
    if not row.get("cloud"):
        return "" if row.get("photos") else "has neither photos nor cloud; fill one of these columns"
    if row.get("photos"):
        # Where a scene's photos lie in its cloud, GPS or control points say.
        if row.get("cameras") or kind == "scene":
            return ""
        return (
            "has both photos and a cloud, but no cameras, in whose coordinates the cloud would lie; fill the column"
            " cameras, or empty photos or cloud"
        )
    for column in PHOTO_COLUMNS:
        if row.get(column):
            return f"is a cloud and has no photos that its {column} could be for; empty that cell, or give photos"
    return ""


def _crs_problem(row: Row) -> str:
    """What is wrong with a row that names a CRS; "" where nothing is."""
    if not row.get("crs"):
        return ""
    if row.get("control") and not row.get("cloud"):
        return "names a crs, and its control points name theirs, in which the results are; empty the cell crs"
    if row.get("cloud") and row.get("cameras"):
        return "names a crs, but its cloud lies where its cameras are; empty the cell crs"
    return ""


def _scene_problem(row: Row, scenes: Mapping[str, Row], table: str) -> str:
    """What is wrong with an object beside its scene, or with one that lies in none; "" where nothing is."""
    scene = row.get("scene")
    if not scene:
        if row.get("cloud"):
            other = "empty the cell cloud" if row.get("photos") else "give photos"
            return f"is a cloud and lies in no scene, so there is nothing to do; name its scene, or {other}"
        unused = "lies in no scene that its fiducials could be of; empty that cell, or name its scene"
        return unused if row.get("fiducials") else ""
    if scene not in scenes:
        return f"lies in scene '{scene}', which {table} does not list"
    return ""


def _differences(kind: str, name: str, path: str, table: str) -> dict[str, Any]:
    """What the settings file of a row changes."""
    where = f"{table}, {kind} '{name}', config {path}"
    try:
        found = read_differences(Path(path) if Path(path).is_file() or not (ROOT / path).is_file() else ROOT / path)
    except StageError as error:
        raise StageError(f"{table}, {kind} '{name}': {error}") from None
    other = next((key for key in found if key not in OWN_SECTIONS[kind]), None)
    if other is not None:
        raise StageError(
            f"{where}: '{other}' does not concern one {kind}; it may hold {', '.join(OWN_SECTIONS[kind])}. Put the rest"
            " into the settings file of the run"
        )
    for key in RUN_SETTINGS:
        part: Any = found
        for step in key.split("."):
            part = part.get(step) if isinstance(part, dict) else None
        if part is not None:
            raise StageError(f"{where}: {key} is the same for the whole run; put it into the settings file of the run")
    return found


def _variants(settings: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """Settings of the variants that run, first `full`, which is fused; with recipe `paper` all by its crop."""
    defined = yaml.safe_load((ROOT / "workflow/variants.yaml").read_text())
    registration = settings["registration"]
    if settings["object"]["recipe"] == "paper":
        defined = {name: merge(defined["paper"], own) for name, own in defined.items()}
    chosen = registration["variants"]
    unknown = next((name for name in chosen if name not in defined), None)
    if unknown is not None:
        raise StageError(
            f"config, registration.variants: unknown variant '{unknown}';"
            f" workflow/variants.yaml defines: {', '.join(defined)}"
        )
    if "full" not in chosen:
        raise StageError("config, registration.variants: 'full' is missing; it is the one that is fused")
    return {name: defined[name] for name in sorted(chosen, key=lambda name: name != "full")}

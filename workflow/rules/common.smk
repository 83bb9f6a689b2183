# Tables, settings and the few functions that the rules share.
import csv
import difflib
import os
import shlex
import sys
from pathlib import Path

import jsonschema
import yaml
from snakemake.exceptions import WorkflowError

from scenefuse.fingerprint import fingerprint

ROOT = Path(workflow.basedir)
SCRIPTS = os.path.relpath(ROOT / "scripts")
# Jobs find the project's package and this environment's Python without an installed package or an activated shell.
os.environ["PYTHONPATH"] = str(ROOT)
if str(Path(sys.executable).parent) not in os.environ["PATH"].split(":"):
    os.environ["PATH"] = f"{Path(sys.executable).parent}:{os.environ['PATH']}"


def check(content, schema, where):
    """Stop with one sentence at the first thing in `content` that the schema does not allow."""
    schema = yaml.safe_load((ROOT / "workflow/schemas" / schema).read_text())
    for error in jsonschema.Draft202012Validator(schema).iter_errors(content):
        key = ".".join(str(part) for part in error.absolute_path)
        message = error.message
        if error.validator == "additionalProperties":
            known = list(error.schema["properties"])
            unknown = next(name for name in error.instance if name not in known)
            close = difflib.get_close_matches(str(unknown), known, 1)
            advice = (
                f"did you mean '{close[0]}'?"
                if close
                else f"known keys are: {', '.join(known)}"
            )
            message = f"unknown key '{unknown}'; {advice}"
        raise WorkflowError(f"{where}{f', {key}' if key else ''}: {message}")


def table(path, schema):
    """Rows of a TSV by their first column; every cell is text, an empty one is ''."""
    source = Path(path) if Path(path).is_file() else ROOT / path
    if not source.is_file():
        raise WorkflowError(
            f"{path} does not exist; write it as config/README.md describes"
        )
    with open(source, newline="") as file:
        rows = list(
            csv.DictReader(
                (line for line in file if not line.startswith("#")), delimiter="\t"
            )
        )
    for number, row in enumerate(rows, 1):
        if None in row or None in row.values():
            raise WorkflowError(
                f"{path}, row {number}: not as many columns as the header; separate them by tabs"
            )
        check(row, schema, f"{path}, row {number}")
    names = [next(iter(row.values())) for row in rows]
    if not names:
        raise WorkflowError(
            f"{path} has no rows; add one for each {Path(path).stem.rstrip('s')}"
        )
    if len(set(names)) < len(names):
        raise WorkflowError(
            f"{path}: '{max(names, key=names.count)}' stands in two rows; names must differ"
        )
    return dict(zip(names, rows))


def merge(base, over):
    """`base` with the keys of `over` laid over it, at every depth."""
    if not (isinstance(base, dict) and isinstance(over, dict)):
        return over
    return base | {key: merge(base.get(key), value) for key, value in over.items()}


check(config, "config.schema.yaml", "config")
SCENES = table(config["scenes"], "scenes.schema.yaml")
OBJECTS = table(config["objects"], "objects.schema.yaml")
ARMS = {
    name: merge(config["registration"], over) for name, over in config["arms"].items()
}
for name, row in OBJECTS.items():
    if row["scene"] not in SCENES:
        raise WorkflowError(
            f"{config['objects']}: object '{name}' lies in scene '{row['scene']}', which {config['scenes']} does not list"
        )


wildcard_constraints:
    scene="[A-Za-z0-9_-]+",
    object="[A-Za-z0-9_-]+",
    arm="[a-z_]+",
    stage="[1-4]",
    chunk="[0-9]+",


def scene_row(name):
    if name not in SCENES:
        raise WorkflowError(
            f"unknown scene '{name}'; {config['scenes']} lists: {', '.join(SCENES)}"
        )
    return SCENES[name]


def object_row(name):
    if name not in OBJECTS:
        raise WorkflowError(
            f"unknown object '{name}'; {config['objects']} lists: {', '.join(OBJECTS)}"
        )
    return OBJECTS[name]


def in_scene(path):
    """Input function: a file of the scene that the object lies in."""
    return (
        lambda wildcards: f"results/scenes/{object_row(wildcards.object)['scene']}/{path}"
    )


def photos_in(path, where):
    """The files that a `photos` cell stands for: a video, or all files of a folder; the demo's folder is an output."""
    path = Path(path)
    if path.parts[:2] == ("results", "demo") or path.is_file():
        return [str(path)]
    if not path.is_dir():
        raise WorkflowError(
            f"{where}: the photos '{path}' do not exist; give a folder or a video, relative to {os.getcwd()}"
        )
    return [str(file) for file in sorted(path.iterdir()) if file.is_file()] or [
        str(path)
    ]


def optional(path):
    """An input that a table may leave empty."""
    return [path] if path else []


def code(script):
    """Fingerprint of everything that a script can reach, for `params:`."""
    return fingerprint(ROOT / "scripts" / script, ROOT)


def flags(settings):
    """Settings as command line flags: {"max_size_px": 2000} -> --max-size-px 2000."""
    words = []
    for key, value in settings.items():
        words.append(f"--{key.replace('_', '-')}")
        words += [
            shlex.quote(str(item))
            for item in (value if isinstance(value, list) else [value])
        ]
    return " ".join(words)

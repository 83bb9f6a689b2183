# Tables, settings and the few functions that the rules share.
import csv
import os
import shlex
import sys
from pathlib import Path

import yaml
from snakemake.exceptions import WorkflowError

from scenefuse.fingerprint import fingerprint
from scenefuse.masks.algebra import mask_folders
from scenefuse.io.settings import merge, problem, with_defaults
from scenefuse.stage import StageError

ROOT = Path(workflow.basedir)
# Jobs find the project's package and this environment's Python without an installed package or an activated shell.
os.environ.update(
    PYTHONPATH=str(ROOT),
    PATH=f"{Path(sys.executable).parent}:{os.environ.get('PATH', '')}",
)


def check(content, schema, where):
    """Stop with one sentence at the first thing in `content` that the schema does not allow."""
    wrong = problem(
        content, yaml.safe_load((ROOT / "workflow/schemas" / schema).read_text())
    )
    if wrong:
        raise WorkflowError(f"{where}, {wrong}")


def table(path, schema):
    """Rows of a TSV by their first column; every cell is text, an empty one is ''."""
    source = Path(path) if Path(path).is_file() else ROOT / path
    if not source.is_file():
        raise WorkflowError(
            f"{path} does not exist; write it as config/README.md describes"
        )
    with open(source, newline="", encoding="utf-8-sig") as file:
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
    if len(set(names)) < len(names):
        raise WorkflowError(
            f"{path}: '{max(names, key=names.count)}' stands in two rows; names must differ"
        )
    return dict(zip(names, rows))


check(config, "config.schema.yaml", "config")
config.update(
    with_defaults(
        config,
        yaml.safe_load((ROOT / "workflow/schemas/config.schema.yaml").read_text()),
    )
)
SCENES = table(config["scenes"], "scenes.schema.yaml")
OBJECTS = table(config["objects"], "objects.schema.yaml")
if not SCENES:
    raise WorkflowError(f"{config['scenes']} has no rows; add one for each scene")
DEFINED = yaml.safe_load((ROOT / "workflow/variants.yaml").read_text())
for name in config["registration"]["variants"]:
    if name not in DEFINED:
        raise WorkflowError(
            f"config, registration.variants: unknown variant '{name}'; workflow/variants.yaml defines: {', '.join(DEFINED)}"
        )
if "full" not in config["registration"]["variants"]:
    raise WorkflowError(
        "config, registration.variants: 'full' is missing; it is the one that is fused"
    )
VARIANTS = {
    name: merge(config["registration"], DEFINED[name])
    for name in config["registration"]["variants"]
}
for name, row in OBJECTS.items():
    if row["scene"] not in SCENES:
        raise WorkflowError(
            f"{config['objects']}: object '{name}' lies in scene '{row['scene']}', which {config['scenes']} does not list"
        )


wildcard_constraints:
    scene="[A-Za-z0-9_-]+",
    object="[A-Za-z0-9_-]+",
    variant="[a-z_]+",
    stage="[1-4]",
    chunk="[0-9]+",


def scene_row(name):
    if name not in SCENES:
        raise WorkflowError(
            f"unknown scene '{name}'; {config['scenes']} lists: {', '.join(SCENES)}"
        )
    return SCENES[name]


def scene_truth(name):
    """The truth of the scene that an object with known truth lies in."""
    truth = scene_row(name).get("truth")
    if not truth:
        raise WorkflowError(
            f"{config['scenes']}: scene '{name}' has no truth, but an object in it has; fill both or neither"
        )
    return truth


def object_row(name):
    if name not in OBJECTS:
        raise WorkflowError(
            f"unknown object '{name}'; {config['objects']} lists: {', '.join(OBJECTS)}"
        )
    return OBJECTS[name]


def in_scene(*paths):
    """Input function: files of the scene that the object lies in."""

    def files(wildcards):
        scene = object_row(wildcards.object)["scene"]
        return [f"results/scenes/{scene}/{path}" for path in paths]

    return files


def photos_in(path, where):
    """The files that a `photos` cell stands for: a video, or all files of a folder; the demo's folder is an output."""
    path = Path(path)
    if path.parts[:2] == ("results", "demo") or path.is_file():
        return [str(path)]
    if not path.is_dir():
        raise WorkflowError(
            f"{where}: '{path}' does not exist; give a folder or a video, relative to {os.getcwd()}"
        )
    return [str(file) for file in sorted(path.rglob("*")) if file.is_file()] or [
        str(path)
    ]


def optional(path):
    """An input that a table may leave empty."""
    return [path] if path else []


def script(name):
    """Path of a stage's script, from the working directory."""
    return os.path.relpath(ROOT / "scripts" / name)


def code(name):
    """Fingerprint of everything that a script can reach."""
    return fingerprint(ROOT / "scripts" / name, ROOT)


def flags(settings):
    """Settings as command line flags: {"max_size_px": 2000} -> --max-size-px 2000."""
    words = []
    for key, value in sorted(settings.items()):
        words.append(f"--{key.replace('_', '-')}")
        words += [
            shlex.quote(str(item))
            for item in (value if isinstance(value, list) else [value])
        ]
    return " ".join(words)


def scene_photos(wildcards):
    """The photos of a scene."""
    return photos_in(
        scene_row(wildcards.scene)["photos"],
        f"{config['scenes']}, scene '{wildcards.scene}'",
    )


def scene_folder(wildcards):
    """Their folder, for a command line."""
    return shlex.quote(scene_row(wildcards.scene)["photos"])


def object_photos(wildcards):
    """The photos, or the video, of an object."""
    return photos_in(
        object_row(wildcards.object)["photos"],
        f"{config['objects']}, object '{wildcards.object}'",
    )


def object_source(wildcards):
    """Their folder, or the video, for a command line."""
    return shlex.quote(object_row(wildcards.object)["photos"])


def kept_masks(name):
    """What an object's masks keep."""
    return config["object"]["masks"]["keep"].replace("{object}", name)


def mask_inputs(wildcards):
    """What the masks of an object are made from: your own masks, or prompts and perhaps weights; masks to combine."""
    row, settings = object_row(wildcards.object), config["object"]["masks"]
    try:
        folders = mask_folders(kept_masks(wildcards.object))
    except StageError as error:
        raise WorkflowError(str(error)) from None
    where = f"object.masks.keep of '{wildcards.object}'"
    files = [file for folder in folders for file in photos_in(folder, where)]
    if row.get("masks"):
        return files + photos_in(
            row["masks"], f"{config['objects']}, masks of '{wildcards.object}'"
        )
    if not row.get("prompts"):
        raise WorkflowError(
            f"{config['objects']}: '{wildcards.object}' has neither prompts nor masks; fill one of these columns"
        )
    if settings["method"] == "sam2" and settings["sam2_checkpoint"]:
        files += photos_in(settings["sam2_checkpoint"], "object.masks.sam2_checkpoint")
    elif settings["method"] == "sam2":
        files += [settings["sam2_encoder"], settings["sam2_decoder"]]
    return files + [row["prompts"]]


def mask_options(wildcards):
    """Settings of the masks; your own masks beat any method."""
    row, settings = object_row(wildcards.object), config["object"]["masks"]
    own = {
        "keep": kept_masks(wildcards.object),
        "supplied": row.get("masks") or None,
        "prompts": None if row.get("masks") else row.get("prompts") or None,
    }
    return flags(
        {k: v for k, v in settings.items() if k != "sam2_package"}
        | own
        | ({"method": "supplied"} if row.get("masks") else {})
    )


def variant_options(part):
    """Params function: the settings of one step of a variant."""
    return lambda wildcards: flags(VARIANTS[wildcards.variant][part])


def crop_mode(wildcards):
    """How a variant crops; without fiducials, the object's masks mark it."""
    marked = object_row(wildcards.object).get("fiducials")
    return VARIANTS[wildcards.variant]["crop"]["mode"] if marked else "masks"


def crop_marks(wildcards):
    """The files that mark an object in its scene: option of the crop -> path."""
    if VARIANTS[wildcards.variant]["crop"].get("whole_scene"):
        return {}
    if crop_mode(wildcards) == "masks":
        folder = f"results/objects/{wildcards.object}"
        return {
            "alignment_json": f"{folder}/alignment.json",
            "workspace": f"{folder}/undistorted",
            "masks": f"{folder}/masks",
        }
    return {"fiducials": object_row(wildcards.object)["fiducials"]}


def crop_inputs(wildcards):
    """The same, and what else says that one of them has changed."""
    marks = crop_marks(wildcards)
    return [*marks.values()] + [
        f"{path}.json" for name, path in marks.items() if name in ("workspace", "masks")
    ]


def crop_options(wildcards):
    """Settings of a variant's crop."""
    own = {"mode": crop_mode(wildcards)} | crop_marks(wildcards)
    return flags(VARIANTS[wildcards.variant]["crop"] | own)


def results_of(wildcards):
    """Everything that the summary reads: what the last stage of each scene and object writes, and the truth where it is known."""
    ends = [
        "metrics.json",
        "fusion.json",
        "frames.json",
        *(f"registration/{variant}/metrics.json" for variant in VARIANTS),
    ]
    scene_ends = ["dense.json", "completed.json"]
    files = [f"results/scenes/{name}/{end}" for name in SCENES for end in scene_ends]
    files += [f"results/objects/{name}/{end}" for name in OBJECTS for end in ends]
    files += [
        f"results/scenes/{name}/truth.json"
        for name, row in SCENES.items()
        if row.get("truth")
    ]
    files += [
        f"results/objects/{name}/truth.json"
        for name, row in OBJECTS.items()
        if row.get("truth")
    ]
    return files


def objects_in(wildcards):
    """The names of the objects of a scene."""
    return [name for name, row in OBJECTS.items() if row["scene"] == wildcards.scene]


def of_objects(path):
    """Input function: a file of every object of the scene."""
    return lambda wildcards: [
        f"results/objects/{name}/{path}" for name in objects_in(wildcards)
    ]


def summary_command(log):
    """The shell line that writes the tables and summary.txt; also run when a job has failed, so that the summary names it."""
    return (
        f"python {script('report/write_summary.py')} --scenes {' '.join(f'results/scenes/{name}' for name in SCENES)}"
        f" --chunks {len(CHUNKS)} --objects {' '.join(f'results/objects/{name}' for name in OBJECTS)}"
        f" --scene-of {' '.join(row['scene'] for row in OBJECTS.values())} --variants {' '.join(VARIANTS)}"
        f" --benchmarks results/benchmarks --logs results/logs --summary results/summary &> {log}"
    )

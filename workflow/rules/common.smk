# What the rules share: the project, its files, and how settings become command lines.
import fcntl
import glob
import os
import platform
import re
import shlex
import shutil
import sys
from functools import cache
from pathlib import Path

from snakemake.output_index import OutputIndex

from scenefuse.core.fingerprint import files_fingerprint, fingerprint
from scenefuse.core.project import read_project
from scenefuse.core.settings import PACKAGE, ROOT as SHIPPED
from scenefuse.core.machine import has_gpu, megapixels, memory_mb
from scenefuse.photos.photo_files import camera_files, geo_file, photo_files, subtitles
from scenefuse.core.stage import DISK_FULL, MIN_FREE_BYTES, StageError
from scenefuse.report.run_summary import is_added

# A file that a run holds until it ends, among Snakemake's locks and removed with them.
RUN_LOCK = Path(".snakemake/locks/run")


def refuse(sentence):
    """End before the first job. An exception, of which Snakemake would print a traceback, would hide the sentence in it."""
    sys.exit(f"error: {sentence}")


# The folder above workflow/; where another workflow has fetched this one from the web, that of the installed library.
if workflow.modifier.path_modifier.replace_prefix("results") != "results":
    refuse(
        "scenefuse names its files in commands and settings too, which `prefix` and `replace_prefix` of a module do not"
        " reach; leave them out"
    )
if set("{}") & set(os.getcwd()):
    refuse(
        f"Snakemake takes the braces in {os.getcwd()} for wildcards; rename the folder, or work in another one"
    )
# Snakemake itself, and its log of an error, would end in tracebacks.
for folder in filter(os.path.exists, (os.getcwd(), ".snakemake", "results")):
    if not os.access(folder, os.W_OK):
        refuse(f"{folder} cannot be written to; check who may write there")
if shutil.disk_usage(os.getcwd()).free < MIN_FREE_BYTES:
    refuse(DISK_FULL.format(f" ({os.getcwd()})"))
ROOT = Path(str(workflow.current_basedir)).parents[1]
if not (ROOT / "scripts").is_dir():
    ROOT = SHIPPED
# Where jobs import the library from: the clone, or where it was installed.
LIBRARY = ROOT if (ROOT / "scenefuse").is_dir() else PACKAGE.parent
if LIBRARY != ROOT and workflow.deployment_settings.deployment_method:
    refuse(
        "the environments of --sdm lack scenefuse where it was installed by pip; leave --sdm out, or run the workflow of"
        " a clone"
    )
# Jobs find the project's scripts, its package and this environment's Python without an activated shell.
os.environ.update(
    SCENEFUSE=str(ROOT),
    PYTHONPATH=str(LIBRARY),
    PATH=f"{Path(sys.executable).parent}:{os.environ.get('PATH', '')}",
)

try:
    PROJECT = read_project(config, map(Path, workflow.overwrite_configfiles))
except StageError as error:
    refuse(str(error))
config.update(PROJECT.settings)
SCENES, OBJECTS, VARIANTS = PROJECT.scenes, PROJECT.objects, PROJECT.variants
# Objects that lie in a scene, and those by themselves: their cloud is the result.
JOINED = {name: row for name, row in OBJECTS.items() if row.get("scene")}
LONE = [name for name in OBJECTS if name not in JOINED]
# Clouds without photos, and clouds in the coordinates of cameras that are given with the photos.
CLOUD_SCENES, CLOUD_OBJECTS, POSED_SCENES, POSED_OBJECTS = (
    [
        name
        for name, row in rows.items()
        if row.get("cloud") and bool(row.get("photos")) == photographed
    ]
    for photographed in (False, True)
    for rows in (SCENES, OBJECTS)
)
# What compares the paper's recipe with the paper (rules/paper.smk); nothing where another recipe runs.
PAPER = (
    ["results/summary/paper.tsv", "results/summary/paper.html"]
    if config["object"]["recipe"] == "paper" and JOINED
    else []
)
# A clone has the demo, the installed library does not.
DEMO = (ROOT / "demo").is_dir()
if config["gpu"] == "auto":
    config["gpu"] = int(has_gpu())
# Jobs on one machine share its memory and take turns on its card, unless `--resources` says otherwise; on a cluster, where
# `jobs` is given instead of `cores`, the scheduler sees to that.
if workflow.is_main_process and workflow.global_resources["_nodes"].value is None:
    for name, limit in {"mem_mb": memory_mb(), "gpu": 1}.items():
        if name not in workflow.global_resources:
            workflow.register_resource(name, limit)
    # A job that needs more cores than are free waits until no smaller one is ready, so every job takes its share only:
    # objects share the cores; a scene, which all of them wait for in the end, has at least half and goes first (priority 1).
    cores = workflow.resource_settings.cores or 8
    OBJECT_THREADS = max(1, min(8, cores // max(1, len(OBJECTS))))
    SCENE_THREADS = min(8, max(OBJECT_THREADS, cores // 2))
else:
    SCENE_THREADS = OBJECT_THREADS = 8


def remove_dead_lock():
    """Remove the locks of a run on this machine that was killed: no process holds its file any more."""
    # Some file systems do not tell machines of each other's locks.
    if RUN_LOCK.exists() and RUN_LOCK.read_text().strip() == platform.node():
        with RUN_LOCK.open() as file:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError:
                print(
                    "another run works in this folder; wait until it ends, or stop it",
                    file=sys.stderr,
                )
                return
        shutil.rmtree(RUN_LOCK.parent)
        print("the run before this one was killed; this one goes on", file=sys.stderr)


if workflow.is_main_process and workflow.global_resources["_nodes"].value is None:
    remove_dead_lock()


wildcard_constraints:
    scene="[A-Za-z0-9_][A-Za-z0-9_-]*",
    object="[A-Za-z0-9_][A-Za-z0-9_-]*",
    variant="[a-z_]+",
    stage="[1-4]",
    chunk="[0-9]+",


def row_of(name, rows, table):
    """A row of SCENES or OBJECTS."""
    if name not in rows:
        kind = table.removesuffix("s")
        refuse(f"unknown {kind} '{name}'; {config[table]} lists: {', '.join(rows)}")
    return rows[name]


def scene_row(name):
    return row_of(name, SCENES, "scenes")


def object_row(name):
    return row_of(name, OBJECTS, "objects")


def own_file(kind, name, column):
    """The file or folder that the user names in a cell, in a list; none where the cell is empty."""
    path = (scene_row if kind == "scene" else object_row)(name).get(column)
    if path and not (made_here(path) or Path(path).exists()):
        click = f"click them with scenefuse pick --object {name} (docs/clicking.md)"
        if column == "fiducials" and object_row(name)["scene"] in CLOUD_SCENES:
            click = "write it with a line `x y z` for each of at least four points around the object"
        advice = {
            "prompts": f"; {click}, or correct the path",
            "fiducials": f"; {click}, or leave the cell empty",
        }
        refuse(
            f"{config[f'{kind}s']}, {kind} '{name}': {path} in the column {column} does not exist (relative paths"
            f" begin at {os.getcwd()}){advice.get(column, '')}"
        )
    return [path] if path else []


def settings_of(wildcards):
    """The settings for what a job works on: its object or, without one, its scene, with those of the row's own file."""
    kind = "object" if "object" in wildcards.keys() else "scene"
    return PROJECT.of(kind, wildcards[kind])


def settings(*sections, without=()):
    """Params function: sections of these settings, `object.nerf` for instance, as command line flags; not those of some names."""

    def words(wildcards):
        found = {}
        for section in sections:
            part = settings_of(wildcards)
            for name in section.split("."):
                part = part[name]
            found |= part if isinstance(part, dict) else {name: part}
        return flags({name: found[name] for name in found if name not in without})

    return words


def scene_of(wildcards):
    """The name of the scene that the object lies in."""
    scene = object_row(wildcards.object).get("scene")
    if not scene:
        refuse(
            f"{config['objects']}: object '{wildcards.object}' lies in no scene, so it has nothing beyond"
            f" results/objects/{wildcards.object}/object.ply and figures/; name its scene in the column scene"
        )
    return scene


def in_scene(*paths):
    """Input function: files of the scene that the object lies in."""

    def files(wildcards):
        return [f"results/scenes/{scene_of(wildcards)}/{path}" for path in paths]

    return files


def in_photographed_scene(*paths):
    """The same; none where the scene is given as a cloud."""

    def files(wildcards):
        photos = scene_row(scene_of(wildcards)).get("photos")
        return in_scene(*paths)(wildcards) if photos else []

    return files


def in_matched_scene(*paths):
    """The same; none where the scene has no depth maps of its own, as its cloud is given."""

    def files(wildcards):
        given = scene_row(scene_of(wildcards)).get("cloud")
        return [] if given else in_scene(*paths)(wildcards)

    return files


def files_if(has, *paths):
    """Input function: files of the object, where `has`, a function of its row, says that there are any."""

    def files(wildcards):
        found = [path.replace("{object}", wildcards.object) for path in paths]
        return found if has(object_row(wildcards.object)) else []

    return files


def if_photographed(*paths):
    """Input function: files that the photos of the object give; none where it is given as a cloud without any."""
    return files_if(lambda row: row.get("photos"), *paths)


def if_trained(*paths):
    """Input function: files of the object's stages 1 to 4; none where its cloud is given."""
    return files_if(lambda row: not row.get("cloud"), *paths)


def has_masks(row):
    """Whether masks of an object are made: where its cloud is given, only if its prompts or masks are given too."""
    own = row.get("prompts") or row.get("masks")
    return row.get("photos") and (own or not row.get("cloud"))


def if_masked(*paths):
    """Input function: files that the masks of the object give."""
    return files_if(has_masks, *paths)


def judging_photos(wildcards):
    """The workspace of the photos that judge an object's points; none where it has no photos."""
    given = object_row(wildcards.object).get("cloud")
    return if_photographed(UNDISTORTED if given else POSED)(wildcards)


def is_linked(wildcards):
    """Whether the object and its scene both have photos."""
    rows = object_row(wildcards.object), scene_row(scene_of(wildcards))
    return all(row.get("photos") for row in rows)


def if_linked(*paths):
    """Input function: files that the photos of both sides give."""
    return lambda wildcards: (
        if_photographed(*paths)(wildcards) if is_linked(wildcards) else []
    )


def options_of(*names):
    """Params function: inputs that a row may lack, as command line options of the same names."""

    def words(wildcards, input):
        found = {name: input.get(name) for name in names}
        return flags(
            {
                name: [files] if isinstance(files, str) else list(files)
                for name, files in found.items()
                if files
            }
        )

    return words


def objects_in(wildcards):
    """The names of the objects of a scene."""
    return [name for name, row in JOINED.items() if row["scene"] == wildcards.scene]


def object_folders(wildcards):
    """The result folders of the objects of a scene."""
    return [f"results/objects/{name}" for name in objects_in(wildcards)]


def of_objects(path):
    """Input function: a file of every object of the scene."""
    return lambda wildcards: [
        f"results/objects/{name}/{path}" for name in objects_in(wildcards)
    ]


def finished_folders(wildcards):
    """The result folders of the objects of a scene that were added to it; those that failed or were refused are left out."""
    return [folder for folder in object_folders(wildcards) if is_added(Path(folder))]


def finished_in(path):
    """Input function: a file of every object that was added to the scene; `undistorted` of those with photos."""
    return lambda wildcards: [
        f"{folder}/{path}"
        for folder in finished_folders(wildcards)
        if path != "undistorted" or OBJECTS[Path(folder).name].get("photos")
    ]


@cache
def outputs():
    """What all rules make, by path: to compare each photo with every output takes a second for 5,000 photos."""
    return OutputIndex(workflow.rules)


@cache
def made_here(path):
    """Whether a rule makes the file or folder."""
    return bool(outputs().match_producers(path))


@cache
def photos_in(path, where):
    """The files that a cell of a table or a setting stands for: the photos of a folder, a file with a video's subtitles, or what a rule makes."""
    path = str(Path(path))
    if made_here(path) or Path(path).is_file():
        beside = subtitles(Path(path))
        return [path, *([str(beside)] if beside else [])]
    if Path.cwd().is_relative_to(Path(path).resolve()):
        refuse(
            f"{where}: the project lies in its folder of photos, {path}, whose files would count as photos; put the"
            " photos, or the project, into a folder of its own"
        )
    try:
        return [str(file) for file in photo_files(Path(path))]
    except StageError as error:
        refuse(f"{where}: {error} (relative paths begin at {os.getcwd()})")


def as_inputs(files):
    """Input function: the files of another one whose names hold neither { nor <, which Snakemake would take for a wildcard or a
    path variable. `state_of` sees the others as well."""
    return lambda wildcards: [
        path for path in files(wildcards) if not set("{<") & set(path)
    ]


def state_of(files):
    """Params function: what an input function's own files of the user hold; Snakemake takes one with an older date for the one it
    knew. (A params function that asks for `input` would not be recorded.)"""
    return lambda wildcards: files_fingerprint(
        tuple(path for path in files(wildcards) if not made_here(path))
    )


def maps(folder):
    """Output: a folder of maps, which goes when no job needs it any more, unless `keep_maps`."""
    return directory(folder) if config["keep_maps"] else temp(directory(folder))


def script(name):
    """A stage's script on a command line. Not by its path: what is in `params` may not depend on where the project lies."""
    return f'"$SCENEFUSE/scripts/{name}"'


def code(name):
    """Fingerprint of everything that a script can reach."""
    return fingerprint(ROOT / "scripts" / name, ROOT)


def flags(settings):
    """Settings as command line flags: {"max_size_px": 2000} -> --max-size-px 2000."""
    words = []
    for key, value in sorted(settings.items()):
        if value is None:
            continue
        values = value if isinstance(value, list) else [value]
        words += [f"--{key.replace('_', '-')}", *(shlex.quote(str(v)) for v in values)]
    return " ".join(words)


def by_size(least, **per_mb):
    """Resources function: so much at least, and so much more for each MB of some inputs, of a folder for each MB in it; more with each
    attempt. `all` is for all inputs. Before an input is made, Snakemake says <TBD>."""

    def amount(wildcards, input, attempt):
        inputs = {
            name: input if name == "all" else input.get(name, []) for name in per_mb
        }
        mb = {name: megabytes(files) for name, files in inputs.items()}
        return attempt * round(least + sum(per_mb[name] * mb[name] for name in per_mb))

    return amount


def by_photos(least, base, bytes_each, folder):
    """Resources function: so many MB at least; some, and so many bytes for each pixel of the pictures in a folder, where this is
    more; more with each attempt. `folder` tells it by wildcards and input, and how wide they are read, or None for as they are.
    """

    def amount(wildcards, input, attempt):
        # Snakemake says <TBD> only where the error names an input, which a folder in it is not.
        for path in input:
            os.stat(path)
        pixels = megapixels(*folder(wildcards, input))
        return attempt * max(least, round(base + bytes_each * pixels))

    return amount


def masked_photos(wildcards, input):
    """An object's masks, which are as large as its photos, and how wide these are in its NeRF."""
    width_px = settings_of(wildcards)["object"]["nerf"]["width_px"]
    return Path(input.masks), width_px


def undistorted_photos(wildcards, input):
    """An object's undistorted photos, as they are."""
    return Path(input.workspace) / "images", None


def megabytes(files):
    """The size of a file, of what is in a folder, or of several."""
    paths = [Path(file) for file in ([files] if isinstance(files, str) else files)]
    inside = [
        file
        for path in paths
        if path.is_dir()
        for file in path.rglob("*")
        if file.is_file()
    ]
    return sum(os.path.getsize(path) for path in [*paths, *inside]) / 1e6

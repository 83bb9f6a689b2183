"""Two files in; a decision, a transform, a picture and, if asked for, the completed scene out."""

import os
import shlex
import sys
from dataclasses import dataclass, replace
from enum import IntEnum
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import tyro

from scenefuse.cloud.cloud_file import CloudFile, normals_fault, without_strays
from scenefuse.cloud.clouds import Cloud, write_cloud
from scenefuse.cloud.import_cloud import MIN_POINTS, unit_and_name
from scenefuse.cloud.readers.las import las_crs, las_dimensions
from scenefuse.cloud.write_las import write_laz
from scenefuse.core.settings import ROOT, problem, schema_of
from scenefuse.core.stage import StageError, atomic_file, quantity, value, write_json
from scenefuse.core.transforms import Array, Sim3
from scenefuse.core.version import VERSION
from scenefuse.geometry.icp import ScaleRange
from scenefuse.register.register_object import draw_alignment
from scenefuse.report.view import REACH
from scenefuse.two_clouds.complete import complete, fusion_settings, write_files
from scenefuse.two_clouds.find import (
    MAX_SIZE_RATIO,
    Known,
    Registration,
    RegistrationSettings,
    cut_scene,
    evidence_of,
    find_in_scene,
    report,
    search_box,
    summary,
)
from scenefuse.two_clouds.page import write_box_page, write_page

NOTHING = Known()
# Points of the part of a scene in which an object is searched: of many more, some are left out.
MAX_SEARCHED_POINTS = 1 << 22
# What a refusal ends in.
BOX_PAGE = "crop_box.html"
OUTPUTS = (
    *("transform.json", "transform.txt", "picture.png", "report.html", "completed.ply", "completed.laz"),
    *(BOX_PAGE, "completed.json", "object_in_scene.ply", "object_in_scene.laz", "object_in_scene.las"),
)
"""All that a run may write; what an earlier one left of it is removed first."""


class ExitStatus(IntEnum):
    """Exit status of the command."""

    REGISTERED = 0
    UNREGISTERED = 3


@dataclass(frozen=True)
class Given:
    """What a registration starts from.

    Attributes:
        object: the object's cloud, in its file's coordinates.
        scene: the scene's file, and of its points those among which the object is looked for.
        searched: what that part is, in words.
        notes: what a user should know of the files.
        ups: unit up directions in the object's and the scene's coordinates; None where one is not known.
    """

    object: Cloud
    scene: CloudFile
    searched: str
    notes: list[str]
    ups: tuple[Array, Array] | None


def register(
    *,
    object: Path,
    scene: Path,
    out: Path = Path("registered"),
    format: Literal["ply", "laz", "las"] = "ply",
    fuse: Annotated[tyro.conf.UseCounterAction[int], tyro.conf.arg(help_behavior_hint="")] = 0,
    known: Known = NOTHING,
    config: Path | None = None,
    seed: int | None = None,
) -> int:
    """Find the place, size and orientation of one point cloud in another, or refuse.

    Reads PLY, LAS, LAZ (COPC too), E57, PCD, XYZ, PTS, TXT, ASC and CSV, and meshes as PLY, OBJ and glTF. Exit status:
    0 registered, 3 unregistered, 1 bad input. docs/register.md says how to read what it writes.

    Args:
        object: cloud of the object, in any frame and unit.
        scene: cloud that shows the object.
        out: folder for transform.json, picture.png and, if registered, transform.txt and object_in_scene; what an
            earlier run wrote there is removed.
        format: of object_in_scene, which has the object's points in the scene's coordinates.
        fuse: also write report.html and, if registered, the scene with the object in it: completed.ply, completed.json
            and, of a scene in LAS or LAZ, completed.laz.
        known: what is known beforehand.
        config: YAML of settings that differ from the shipped ones, with the keys of config/config.yaml.
        seed: of all random choices; the config's if not given.
    """
    settings, shipped_seed = RegistrationSettings.read(config)
    command = _command(object, scene, out, format, bool(fuse), known, config, seed)
    seed = shipped_seed if seed is None else seed
    if wrong := problem({"seed": seed}, schema_of("config")):
        raise StageError(f"--{wrong}; correct it")
    known.check()
    scales = known.scales()
    _clear(out, [object, scene, *(path for path in (known.fiducials, config) if path)])
    given = _read(object, scene, settings, known)
    notes = given.notes
    for note in notes:
        print(f"note       {note}", flush=True)
    known_before = len(notes)
    if scales is not None:
        _check_size(scales, given)
    unit, _ = unit_and_name(las_crs(scene))
    # A box holds the ground and what stands beside the object, too.
    marked, boxed = known.fiducials is not None, known.crop_box is not None
    whole = given.scene.part
    found, part, places = find_in_scene(
        given.object, whole, settings, seed,
        ups=given.ups, up_in_scene=known.ups()[1], scales=scales, unit=unit, marked=marked, progress=_progress,
    )  # fmt: skip
    if found.fitting_scale is not None:
        fit, deviation = found.fitting_scale
        notes.append(
            f"--scale holds the scale at {found.scales.centre:.6g}, and the clouds fit best at {fit:.6g}, standard"
            f" deviation {deviation:.2g}: unless the first is sure, give a --scale-range around both"
        )
    if found.sides_estimated:
        inwards = f"most normals of {object} or {scene} face inwards"
        notes.append(f"{inwards}: it is found with the sides of both estimated from the points")
    for note in notes[known_before:]:
        print(f"note       {note}", flush=True)
    if not marked:
        searched = f"{given.searched}, and the parts of it that look like the object"
        given = replace(given, scene=replace(given.scene, part=part), searched=searched)
    points = {"object_points": len(given.object), "scene_points": given.scene.summary.count}
    content = report(found, given.ups) | {
        "evidence": quantity(evidence_of(found, given.ups), ""),
        "searched": quantity(given.searched, ""),
        "inputs": quantity({"object": object, "scene": scene} | points, ""),
        "seed": quantity(seed, ""),
        "notes": quantity(notes, ""),
        "version": quantity(VERSION, ""),
    }
    if not found.registered:
        advice = f"draw a box around the object in {out / BOX_PAGE}, which gives the next command"
        if len(given.object) > given.scene.summary.count:
            advice = f"{object} has more points than {scene}: if it is the scene, exchange the two; otherwise {advice}"
        content["next"] = quantity(f"{advice}; {ROOT}/docs/register.md lists causes", "")
        content["places"] = quantity([{"score": score, "crop_box": box.ravel()} for score, box in places], unit)
    print("\n".join(summary(found, given.searched, given.ups)), flush=True)
    if not found.registered:
        for score, box in places:
            print(f"place      score {score:.2f}  --crop-box {_corners(box)}", flush=True)
        print(f"next       {value(content, 'next')}", flush=True)
    written = _write(out, format, given, found, scene, seed)
    if not found.registered:
        written.append(out / BOX_PAGE)
        shown = without_strays(CloudFile.of(scene, most=MAX_SEARCHED_POINTS).part if marked or boxed else whole, "")[0]
        write_box_page(written[-1], shown, known.ups()[1], [box for _, box in places], command)
    if fuse:
        written += _fuse(out, given, found, content, known, config)
    # Last, so that it says registered only where all is written.
    written.insert(0, out / "transform.json")
    write_json(written[0], content)
    print(f"written    {', '.join(map(str, written))}", flush=True)
    return ExitStatus.REGISTERED if found.registered else ExitStatus.UNREGISTERED


def _progress(step: str) -> None:
    """One line a step on stderr, for who waits minutes for the result on stdout."""
    print(f"step       {step}", file=sys.stderr, flush=True)


def _command(
    object: Path, scene: Path, out: Path, format: str, fuse: bool, known: Known, config: Path | None, seed: int | None
) -> str:
    """What was typed, without what marked a part of the scene."""
    words = ["scenefuse", "register", "--object", object, "--scene", scene, "--out", out, *["--fuse"] * fuse]
    options: dict[str, Any] = {"format": None if format == "ply" else format, "config": config, "seed": seed}
    options |= {name: getattr(known, name) for name in ("up_object", "up_scene", "scale", "scale_range")}
    for name, given in options.items():
        words += [] if given is None else [f"--{name.replace('_', '-')}", *np.atleast_1d(given)]
    return shlex.join(map(str, words))


def _corners(box: Array) -> str:
    """The least and the greatest corner of a box (2, 3) as numbers to be pasted, to about a thousandth of its size."""
    decimals = max(0, 3 - int(np.floor(np.log10(np.ptp(box, axis=0).max()))))
    return " ".join(f"{x:.{decimals}f}" for x in box.ravel())


def _clear(out: Path, inputs: list[Path]) -> None:
    """Remove what an earlier run left: nobody takes its result for that of this one.

    Raises:
        StageError: the folder is a file, or an input is one of the files that would be removed.
    """
    if out.exists() and not out.is_dir():
        raise StageError(f"--out {out} is a file; give a folder")
    earlier = [out / name for name in OUTPUTS]
    for path in inputs:
        if path.exists() and path.resolve() in [other.resolve() for other in earlier]:
            raise StageError(f"{path} is an input, and a run removes what lies in --out {out}; give another folder")
    for path in earlier:
        path.unlink(missing_ok=True)
    if not os.access(next(place for place in (out, *out.absolute().parents) if place.exists()), os.W_OK):
        raise StageError(f"nothing may be written in --out {out}; give another folder")


def _read(object: Path, scene: Path, settings: RegistrationSettings, known: Known) -> Given:
    up_object, up_scene = known.ups()
    box = None if known.crop_box is None else np.array(known.crop_box)
    cloud = CloudFile.of(object)
    own, strays = without_strays(cloud.part, str(object))
    marked = search_box(settings.crop, known.fiducials, box)
    whole = CloudFile.of(scene, marked, MAX_SEARCHED_POINTS)
    crs = las_crs(scene)
    if crs is not None:
        from scenefuse.cloud.crs import check_place

        check_place(crs, whole.summary.sample, scene)
    notes = [*cloud.notes, *strays, *whole.notes, *_notes(object, scene)]
    if unused := las_dimensions(object):
        notes.append(f"what is written leaves out of {object} the dimensions {', '.join(unused)}")
    if whole.every > 1:
        notes.append(f"the part to look in is large: one in {whole.every} of its points is searched")
    if box is not None and len(whole.part) < MIN_POINTS:
        low, high = (" ".join(f"{x:.10g}" for x in end(whole.summary.sample, axis=0)) for end in (np.min, np.max))
        raise StageError(
            f"{len(whole.part)} scene points lie in the crop box, {MIN_POINTS} are needed; give least x y z, then"
            f" greatest x y z, of what lies from about {low} to {high} in {scene}"
        )
    # Marks around which nothing lies are far from all of the scene, which the crop says.
    near = whole.part if len(whole.part) else Cloud(whole.summary.sample)
    part, searched = cut_scene(near, settings.crop, up_scene, known.fiducials, box is not None, whole.summary.count)
    part, strays = without_strays(part, f"what is searched of {scene}")
    notes += strays
    faults = [(object, normals_fault(own)), (scene, normals_fault(part))]
    notes += [f"the normals of {path} {fault}: they are estimated from the points" for path, fault in faults if fault]
    own = replace(own, normals=None) if faults[0][1] else own
    ups = None if up_object is None or up_scene is None else (up_object, up_scene)
    return Given(own, replace(whole, part=part), searched, notes, ups)


def _notes(object: Path, scene: Path) -> list[str]:
    """What a user should know of the coordinate systems of both files."""
    own, other = las_crs(object), las_crs(scene)
    if own is None and other is None:
        return []
    from scenefuse.cloud.crs import mixed_units

    notes = [
        f"{path} counts its plane and its heights in {units}, as its CRS says: no turned object fits; bring both into"
        " one unit"
        for path, crs in ((object, own), (scene, other))
        if crs is not None and (units := mixed_units(crs))
    ]
    if own is None or own == other:
        return notes
    there = "names no CRS" if other is None else f"is in {other.name}"
    said = f"{object} is in {own.name}, which is not used: its points are laid on those of {scene}, which {there}"
    return [*notes, said]


def _write(out: Path, format: str, given: Given, found: Registration, scene: Path, seed: int) -> list[Path]:
    """The picture of the best pose; of a registered one the matrix as text, and the object in the scene."""
    pose = found.scene_from_object
    if pose is None:
        return []
    written = [out / "picture.png"]
    draw_alignment(written[0], given.object, given.scene.part, pose, seed)
    if found.registered:
        written += [out / "transform.txt", out / f"object_in_scene.{format}"]
        write_matrix(written[1], pose)
        _write_placed(written[2], given.object.transformed(pose), las_crs(scene))
    return written


def write_matrix(path: Path, pose: Sim3) -> None:
    """Write a similarity as four rows of four numbers, as CloudCompare and others read a matrix; no digit is lost."""
    with atomic_file(path) as temporary:
        np.savetxt(temporary, pose.matrix, fmt="%.17g")


def _check_size(scales: ScaleRange, given: Given) -> None:
    """StageError where the object would be much larger than the part of the scene that shows it, or lost between its
    points."""
    most, part, step = scales.centre * float(np.exp(scales.width)), given.scene.part.diagonal, given.scene.spacing
    across = most * given.object.diagonal
    if across > MAX_SIZE_RATIO * part or across < MAX_SIZE_RATIO * step:
        raise StageError(
            f"at a scale of {most:.4g} the object would be {across:.4g} across, and the searched part of the scene is"
            f" {part:.4g}, its points {step:.4g} apart; correct --scale or --scale-range, scene units per object unit"
            " (1000 from metres to millimetres), or mark the part that shows the object (--crop-box)"
        )


def _write_placed(path: Path, cloud: Cloud, crs: Any) -> None:
    if path.suffix == ".ply":
        write_cloud(path, cloud)
        return
    origin = np.floor(cloud.points.min(0))
    write_laz(path, replace(cloud, points=cloud.points - origin), origin, crs)


def _fuse(
    out: Path, given: Given, found: Registration, content: dict[str, Any], known: Known, config: Path | None
) -> list[Path]:
    """The completed scene, if registered, and the page."""
    inputs = content["inputs"]["value"]
    written, done = list[Path](), None
    if found.registered and found.scene_from_object is not None:
        pose = found.scene_from_object
        around = REACH * given.object.transformed(pose).diagonal
        done = complete(given.object, given.scene, pose, fusion_settings(config), around)
        written += write_files(out, done, inputs["object"], given.scene)
    page = out / "report.html"
    write_page(page, content, found.unit, out / "picture.png", done, known.ups()[1])
    return [*written, page]

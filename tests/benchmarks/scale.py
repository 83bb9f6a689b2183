"""What one object costs in scenes of ever more points: crop, registration, fusion, completed scene, and the command
`scenefuse register --fuse`; memory and seconds.

make bench-scale, or a part of it:
PYTHONPATH=tests python tests/benchmarks/scale.py --work results/bench/scale --millions 1 10

A planted house stands in a yard that goes on and on at the same density, so that what is near it is the same in all
scenes. Up to --laz-millions the yard is a LAZ file that is imported as in the workflow, the command registers in it,
and laspy reads the same box of it, and of a COPC file; larger ones are written as the workflow indexes them. Up to
--completed-millions the completed scene is written.
"""

import resource
import shutil
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import pandas as pd
from support.copc_file import write_copc
from support.planted import Trial, errors, plant

from scenefuse.cloud.clouds import Cloud, read_cloud, records_of, write_cloud
from scenefuse.cloud.import_cloud import import_scene_cloud
from scenefuse.cloud.tiled_cloud import BOX, ROW_OF_TILE, TILE, open_cloud, reserved
from scenefuse.cloud.write_las import LasLayout, las_writer
from scenefuse.core.job_records import JobRecords
from scenefuse.core.stage import quantity, read_json, run, value, write_json
from scenefuse.core.transforms import Array, Sim3
from scenefuse.crop.crop_cloud import CropSettings
from scenefuse.crop.crop_scene import CropInputs, around_marks, crop_scene
from scenefuse.fuse.fuse_object import FusionInputs, FusionOutputs, fuse_object
from scenefuse.fuse.modes import FusionSettings
from scenefuse.fuse.write import CompletionInputs, complete_scene
from scenefuse.register.coarse import CoarseSettings
from scenefuse.register.decision import FineSettings
from scenefuse.register.problem import Inputs, ScaleSettings
from scenefuse.register.register_object import register_object
from scenefuse.two_clouds.find import Known
from scenefuse.two_clouds.register import register as register_files

OBJECT_POINTS = 100_000
PART = 1_000_000
"""Points that laspy reads together."""
COPC_MILLIONS = 10
"""Of a larger yard no COPC file is made for laspy: what makes it holds all of it in memory."""
CUT = 1.05
"""The yard begins so many diagonals from the middle of the house, where its own ground ends."""

UTM = np.array([500_000.0, 5_300_000.0, 0.0])
"""Where the yard of a LAZ file lies in its CRS."""


def planted() -> Trial:
    """The house, of which the scene shows 60 %."""
    return plant("house", 0, coverage=0.6, object_points=OBJECT_POINTS, depth_maps=False)


def density(trial: Trial) -> float:
    """Points of the scene's ground for each unit of its area."""
    low, high = (end(trial.scene.points[:, :2], axis=0) for end in (np.min, np.max))
    edge = ((trial.scene.points[:, :2] < low + 0.1 * (high - low)).any(1)).sum()
    return float(edge / (0.19 * np.prod(high - low)))


class Yard:
    """A scene of about so many points in square tiles: the planted one, and terraces in one pattern of points."""

    def __init__(self, count: int):
        self.trial = planted()
        self.across, self.side = max(1, round(np.sqrt(count / TILE))), np.sqrt(TILE / density(self.trial))
        self.middle = self.trial.fiducials.mean(0)[:2]
        rng = np.random.default_rng(1)
        self.pattern = rng.random((TILE, 3)) * [self.side, self.side, 0.01 * self.trial.diagonal]
        self.colors = rng.integers(60, 120, (TILE, 3), dtype=np.uint8)

    def tiles(self) -> Iterator[tuple[Array, Array, int]]:
        """Corners (3,) of each tile and its number; -1 is the planted scene."""
        height, reach = 5 * self.trial.diagonal, np.full(2, CUT * self.trial.diagonal)
        yield np.append(self.middle - reach, -height), np.append(self.middle + reach, height), -1
        for number in range(self.across**2):
            low = self.middle + (np.array(divmod(number, self.across)) - self.across / 2) * self.side
            yield np.append(low, -height), np.append(low + self.side, height), number

    def points(self, low: Array, number: int) -> Cloud:
        """The points of a tile: about TILE."""
        trial = self.trial
        if number < 0:
            own = (np.abs(trial.scene.points[:, :2] - self.middle) <= CUT * trial.diagonal).all(1)
            return replace(trial.scene[own], normals=None)
        away = low[:2] + self.side / 2 - self.middle
        steep = min(1.0, float(np.linalg.norm(away)) / (20 * trial.diagonal)) ** 2 * trial.diagonal
        height = steep * float(np.sin(away / (8 * trial.diagonal)).sum())
        found = Cloud(self.pattern + np.append(low[:2], height), None, self.colors)
        if (np.abs(away) > CUT * trial.diagonal + self.side).any():
            return found
        return found[(np.abs(found.points[:, :2] - self.middle) > CUT * trial.diagonal).any(1)]


@dataclass(frozen=True)
class Cost:
    """Of a function in a process of its own.

    Attributes:
        result: what it gave.
        seconds: by the clock.
        cpu_seconds: of all its threads.
        peak_gb: largest memory of the process with its libraries; no less than that of the one that started it.
    """

    result: Any
    seconds: float
    cpu_seconds: float
    peak_gb: float

    def row(self, name: str) -> dict[str, float]:
        """Its columns of the table."""
        return {f"{name}_s": self.seconds, f"{name}_cpu_s": self.cpu_seconds, f"{name}_gb": self.peak_gb}


def timed(function: Callable[..., Any], *arguments: Any, **options: Any) -> Cost:
    """What a function costs."""
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        return pool.submit(_measured, function, arguments, options).result()


def _measured(function: Callable[..., Any], arguments: tuple[Any, ...], options: dict[str, Any]) -> Cost:
    start, busy = time.perf_counter(), time.process_time()
    found = function(*arguments, **options)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
    return Cost(found, time.perf_counter() - start, time.process_time() - busy, peak)


def make_laz(path: Path, count: int) -> None:
    """The yard as a user has it."""
    yard = Yard(count)
    box = np.full(3, -yard.across * yard.side), np.full(3, yard.across * yard.side)
    none = Cloud(np.zeros((0, 3)), None, np.zeros((0, 3), np.uint8))
    layout = LasLayout.of(path, none, box, UTM, "EPSG:32632", np.inf)
    with las_writer(path, layout.header) as writer:
        for low, _, number in yard.tiles():
            writer.write_points(layout.records(yard.points(low, number)))


def make_copc(path: Path, count: int) -> None:
    """The same with an octree."""
    yard = Yard(count)
    parts = [yard.points(low, number) for low, _, number in yard.tiles()]
    write_copc(path, *(np.concatenate([getattr(part, name) for part in parts]) for name in ("points", "colors")))


def make_tiles(path: Path, count: int) -> None:
    """The yard as the workflow has it once it is imported."""
    yard = Yard(count)
    tiles, own = list(yard.tiles()), CUT * yard.trial.diagonal
    table = np.zeros(len(tiles), ROW_OF_TILE)
    for row, (low, high, number) in zip(table, tiles):
        beside = (low[:2] > yard.middle + own).any() or (high[:2] < yard.middle - own).any()
        row["count"] = TILE if beside else len(yard.points(low, number))
        for name, end in zip(BOX, (*low, *high)):
            row[name] = end
    like = records_of(yard.points(*tiles[0][::2]), path)
    with reserved(path, like.dtype, int(table["count"].sum()), len(table)) as (file, _):
        for low, _, number in tiles:
            file.write(records_of(yard.points(low, number), path).tobytes())
        file.write(table.tobytes())
    write_json(path.with_name("georeference.json"), {"length_unit": quantity("scene units", "")})


def laspy_reads(path: Path, low: Array, high: Array) -> int:
    """Points that plain laspy reads out of a box of a LAZ file."""
    count = 0
    with laspy.open(path) as file:
        for points in file.chunk_iterator(PART):
            xy = np.column_stack([points.x, points.y])
            count += int(((xy >= low[:2]) & (xy <= high[:2])).all(1).sum())
    return count


def copc_reads(path: Path, low: Array, high: Array) -> int:
    """Points that laspy reads out of the same box of a COPC file."""
    with laspy.CopcReader.open(path) as file:
        return len(file.query(laspy.Bounds(mins=low[:2], maxs=high[:2])))


def tiles_read(path: Path, low: Array, high: Array) -> int:
    """Points that a stage reads for the same box."""
    return len(open_cloud(path).near(low, high)[1])


def register(folder: Path) -> None:
    """Scale, coarse and fine registration, as the workflow runs them."""
    inputs = Inputs(object=folder / "object.ply", crop=folder / "crop.ply", crop_json=folder / "crop.json")
    register_object(
        inputs=inputs, scale_report=folder / "scale.json", coarse_report=folder / "coarse.json",
        report=folder / "house/fine.json", seed=0,
        scale=ScaleSettings(), coarse=CoarseSettings(), settings=FineSettings(),
    )  # fmt: skip


def command(folder: Path) -> str:
    """`scenefuse register --fuse`, with the fiducials and the scene's up direction; the status."""
    known = Known(up_scene=(0.0, 0.0, 1.0), fiducials=folder / "points.tsv")
    out = folder / "out"
    register_files(object=folder / "object.ply", scene=folder / "yard.laz", known=known, out=out, fuse=True)
    return str(value(read_json(out / "transform.json"), "status"))


def stages(folder: Path, completed: bool) -> dict[str, Cost]:
    """Every stage of one object in the scene of a folder."""
    scene, georeference, house = folder / "dense.ply", folder / "georeference.json", folder / "house"
    crop = CropInputs(scene=scene, georeference_json=georeference, fiducials=folder / "points.tsv")
    fusion = FusionInputs(
        object=folder / "object.ply", scene=scene, crop=folder / "crop.ply", crop_json=folder / "crop.json",
        fine_json=house / "fine.json", georeference_json=georeference,
    )  # fmt: skip
    outputs = FusionOutputs(*(house / name for name in ("fused.ply", "checked.ply", "evidence.json", "fusion.json")))
    found = {
        "crop": timed(
            crop_scene, inputs=crop, crop=folder / "crop.ply", report=folder / "crop.json", settings=CropSettings()
        ),
        "register": timed(register, folder),
        "fuse": timed(fuse_object, inputs=fusion, outputs=outputs, settings=FusionSettings()),
    }
    if completed:
        records = JobRecords(folder / "logs", folder / "benchmarks")
        inputs = CompletionInputs(scene=scene, objects=[house], jobs=records, georeference_json=georeference)
        files = {"completed": folder / "completed.ply", "completed_copc": folder / "completed.copc.laz"}
        found["completed"] = timed(complete_scene, inputs=inputs, **files, report=folder / "completed.json")
    return found


def one_size(work: Path, millions: float, laz: bool, completed: bool) -> dict[str, Any]:
    """A row of the table."""
    trial, folder, count = planted(), work / f"{millions:g}", round(millions * 1e6)
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    write_cloud(folder / "object.ply", trial.object)
    place = UTM if laz else np.zeros(3)
    marks = enumerate((trial.fiducials + place).tolist())
    rows = [f"p{k}\t{x:.4f}\t{y:.4f}\t{z:.4f}\n" for k, (x, y, z) in marks]
    (folder / "points.tsv").write_text("point\tx\ty\tz\n" + "".join(rows))
    low, high = around_marks(trial.fiducials, CropSettings())
    row: dict[str, Any] = {"millions": millions}
    origin = np.zeros(3)
    if laz:
        row |= timed(make_laz, folder / "yard.laz", count).row("make")
        files = {"cloud": "dense.ply", "report": "dense.json", "georeference_json": "georeference.json"}
        outputs = {name: folder / file for name, file in files.items()}
        row |= timed(import_scene_cloud, source=folder / "yard.laz", **outputs).row("index")
        by_laspy = timed(laspy_reads, folder / "yard.laz", low + place, high + place)
        row |= by_laspy.row("laspy") | {"laspy_points": by_laspy.result}
        alone = timed(command, folder)
        row |= alone.row("command") | {"command_status": alone.result}
        shutil.rmtree(folder / "out")
        (folder / "yard.laz").unlink()
        if millions <= COPC_MILLIONS:
            timed(make_copc, folder / "yard.copc.laz", count)
            by_copc = timed(copc_reads, folder / "yard.copc.laz", low, high)
            row |= by_copc.row("copc") | {"copc_points": by_copc.result}
            (folder / "yard.copc.laz").unlink()
        origin = np.array(value(read_json(folder / "georeference.json"), "origin_in_crs"))
    else:
        row |= timed(make_tiles, folder / "dense.ply", count).row("make")
    row["disk_gb"] = (folder / "dense.ply").stat().st_size / 1e9
    read = timed(tiles_read, folder / "dense.ply", low + place - origin, high + place - origin)
    row |= read.row("near") | {"near_points": read.result}
    found = stages(folder, completed)
    for name, cost in found.items():
        row |= cost.row(name)
    of_object = [found[name] for name in ("crop", "register", "fuse")]
    row |= {"object_s": sum(c.seconds for c in of_object), "object_cpu_s": sum(c.cpu_seconds for c in of_object)}
    row["most_gb"] = max(cost.peak_gb for cost in found.values())
    pose = Sim3.from_matrix(np.array(value(read_json(folder / "house/fine.json"), "scene_from_object")))
    placed = Sim3(pose.scale, pose.rotation, pose.translation + origin - place)
    scale, turn, shift = errors(placed, trial.scene_from_object, trial.object.points.mean(0), trial.diagonal)
    row |= {"status": value(read_json(folder / "house/fusion.json"), "status")}
    row |= {"scale_pct": scale, "turn_deg": turn, "shift": shift}
    row["added"] = len(read_cloud(folder / "house/fused.ply"))
    shutil.rmtree(folder)
    return row


def scale(
    work: Path,
    millions: tuple[float, ...] = (1, 10, 100),
    laz_millions: float = 10,
    completed_millions: float = 100,
    table: Path | None = None,
) -> None:
    """Print a table, a row for each size.

    Args:
        work: folder to work in; 500 million points take 14 GB there, 100 million with the completed scene 9 GB.
        millions: points of the scenes.
        laz_millions: sizes up to this are imported from LAZ.
        completed_millions: sizes up to this are written with the house in them.
        table: output CSV, or nothing.
    """
    rows = []
    for size in millions:
        rows.append(one_size(work, size, size <= laz_millions, size <= completed_millions))
        print(pd.DataFrame(rows).T.to_string(float_format="{:.3g}".format), flush=True)
        if table is not None:
            pd.DataFrame(rows).to_csv(table, index=False)


if __name__ == "__main__":
    run(scale)

"""The demo's flight laid on a laser scan of its scene, with GPS that is ever more metres off: how far its cameras are.

make demo; then
python tests/benchmarks/photos_on_scan.py --results results --work results/bench/photos_on_scan

The scan is drawn from the true surfaces that an airborne scanner sees (no walls), with 2 cm of noise, in UTM, its
heights 47.3 m from those of GPS as above a geoid. With --whole house, the workflow then completes the scan by that
object's photos, and prints the summary of the run.
"""

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pycolmap
import pyproj
import yaml
from plyfile import PlyData

from demo.truth import read_cameras
from demo.world import ORIGIN
from scenefuse.cloud.clouds import Cloud
from scenefuse.cloud.write_las import write_laz
from scenefuse.core.settings import ROOT
from scenefuse.core.stage import read_json, run, value
from scenefuse.core.transforms import Array
from scenefuse.georef.georeference import camera_poses, georegister
from scenefuse.georef.placement import GeoreferenceSettings
from scenefuse.photos.geodesy import LocalFrame, scene_frame
from scenefuse.photos.photos import read_photos, write_photos

SCENE, CRS = "demo", 32632
GEOID_M, NOISE_M, HALF_M = 47.3, 0.02, 45.0
POINTS = {"world": 900_000, "house": 30_000, "balloon": 30_000, "sculpture": 30_000}
CELL_M, DEEPEST_M = 0.2, 0.5
"""What lies so far below the highest point of its cell is hidden from above."""
STEEPEST = 0.25
"""Surfaces whose normals rise by less of their length are walls, which a scanner above does not see."""


def surface_of(mesh: Path, count: int, rng: np.random.Generator) -> Array:
    """(N, 3) points on the faces of a mesh in the middle of the scene that are no walls."""
    content = PlyData.read(mesh)
    vertices = np.stack([content["vertex"][axis] for axis in "xyz"], axis=1).astype(np.float64)
    corners = vertices[np.stack(list(content["face"].data[content["face"].data.dtype.names[0]]))]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(normals, axis=1)
    seen = (normals[:, 2] > STEEPEST * length) & (np.abs(corners.mean(1)[:, :2]) < HALF_M).all(1)
    chosen = rng.choice(len(corners), count, p=length * seen / (length * seen).sum())
    one, two = rng.random((2, count, 1))
    one, two = np.where(one + two > 1, 1 - one, one), np.where(one + two > 1, 1 - two, two)
    a, b, c = corners[chosen].transpose(1, 0, 2)
    return np.asarray(a + one * (b - a) + two * (c - a))


def from_above(points: Array) -> Array:
    """Those of (N, 3) points that nothing hides from above."""
    _, cell = np.unique(np.floor(points[:, :2] / CELL_M).astype(np.int64), axis=0, return_inverse=True)
    highest = np.full(cell.max() + 1, -np.inf)
    np.maximum.at(highest, cell, points[:, 2])
    return points[points[:, 2] > highest[cell] - DEEPEST_M]


def write_scan(path: Path, meshes: Path, seed: int) -> None:
    """A laser scan of the demo's scene."""
    rng = np.random.default_rng(seed)
    local = np.concatenate([surface_of(meshes / f"{name}.ply", count, rng) for name, count in POINTS.items()])
    local = from_above(local)
    latitude, longitude, height = LocalFrame(*ORIGIN).inverse(local + rng.normal(0, NOISE_M, local.shape)).T
    easting, northing = pyproj.Transformer.from_crs(4326, CRS, always_xy=True).transform(longitude, latitude)
    points = np.stack([easting, northing, height - GEOID_M], axis=1)
    origin = np.floor(points.mean(0))
    write_laz(path, Cloud(points - origin), origin, f"EPSG:{CRS}")


def cameras_off(folder: Path, truth: Path) -> Array:
    """(N,) metres that the cameras of a folder are off the truth."""
    names, _, centres = camera_poses(pycolmap.Reconstruction(folder / "georeferenced"))
    known = read_cameras(truth / "cameras.json")
    row_of = {name: row for row, name in enumerate(known.names)}
    there = LocalFrame(*ORIGIN).inverse(known.centres[[row_of[name] for name in names]]) - [0, 0, GEOID_M]
    frame = scene_frame(read_json(folder / "georeference.json"))
    assert isinstance(frame, LocalFrame)
    return np.asarray(np.linalg.norm(centres - frame.apply(there), axis=1))


def laid(flight: Path, scan: Path, folder: Path, beside: Array, seed: int) -> str:
    """Lay the flight on the scan, its GPS moved by `beside` (3,) metres; why it lies where it does."""
    folder.mkdir(parents=True, exist_ok=True)
    photos = read_photos(flight / "photos.json")
    frame = LocalFrame(*ORIGIN)
    known = np.array([[p.latitude_deg, p.longitude_deg, p.altitude_m] for p in photos])
    moved = frame.inverse(frame.apply(known) + beside).tolist()
    photos = [replace(p, latitude_deg=a, longitude_deg=o, altitude_m=h) for p, (a, o, h) in zip(photos, moved)]
    write_photos(folder / "photos.json", photos, flight / "photos", "photos", [])
    georegister(
        sparse=flight / "sparse",
        sparse_json=flight / "sparse.json",
        photos=folder / "photos.json",
        cloud=scan,
        georeferenced=folder / "georeferenced",
        residuals=folder / "residuals.tsv",
        report=folder / "georeference.json",
        settings=GeoreferenceSettings(),
        seed=seed,
    )
    return str(value(read_json(folder / "georeference.json"), "reason"))


def completed(results: Path, work: Path, name: str, cores: int) -> None:
    """Run the workflow over the scan, the flight's photos and an object's, and print its summary."""
    of = results / "demo" / SCENE
    tables = {
        "scenes": {"scene": SCENE, "photos": of / "scene/photos", "cloud": "scan.laz"},
        "objects": {
            "object": name, "scene": SCENE, "photos": of / name / "photos", "prompts": of / name / "prompts.tsv",
        },
    }  # fmt: skip
    for kind, cells in tables.items():
        (work / f"{kind}.tsv").write_text("\t".join(cells) + "\n" + "\t".join(map(str, cells.values())) + "\n")
    demo = yaml.safe_load((ROOT / "config/demo.yaml").read_text())
    own = {"scenes": "scenes.tsv", "objects": "objects.tsv"} | {part: demo[part] for part in ("scene", "object")}
    (work / "mine.yaml").write_text(yaml.safe_dump(own))
    command = [sys.executable, "-m", "snakemake", "--snakefile", ROOT / "Snakefile", "--directory", work]
    command += ["--configfile", work / "mine.yaml", "--cores", cores]
    subprocess.run(list(map(str, command)), cwd=ROOT, check=True)
    print((work / "results/summary/summary.txt").read_text())


def photos_on_scan(
    *,
    results: Path,
    work: Path,
    off_m: tuple[float, ...] = (0, 1, 2, 4, 8),
    whole: str | None = None,
    cores: int = 2,
    seed: int = 0,
) -> None:
    """Print how far cameras are from the truth, in metres, for GPS that is so far off in some direction.

    Args:
        results: folder of a finished demo; nothing in it is changed.
        work: folder to work in.
        off_m: metres that all positions are off.
        whole: an object of the demo that completes the scan; none to lay the flight only.
        cores: of that run.
        seed: of the scan and of the directions.
    """
    results, work, rows = results.resolve(), work.resolve(), []
    truth, rng = results / f"demo/{SCENE}/truth/scene", np.random.default_rng(seed)
    work.mkdir(parents=True, exist_ok=True)
    write_scan(work / "scan.laz", truth / "meshes", seed)
    for off in off_m:
        angle = rng.uniform(0, 2 * np.pi)
        beside = off * np.array([np.cos(angle), np.sin(angle), 0])
        reason = laid(results / f"scenes/{SCENE}", work / "scan.laz", work / f"{off:g}", beside, seed)
        errors = cameras_off(work / f"{off:g}", truth)
        rows.append({"off_m": off, "median_m": np.median(errors), "largest_m": errors.max(), "reason": reason})
    print(pd.DataFrame(rows).to_string(index=False, float_format="{:.3f}".format))
    if whole is not None:
        completed(results, work, whole, cores)


if __name__ == "__main__":
    run(photos_on_scan)

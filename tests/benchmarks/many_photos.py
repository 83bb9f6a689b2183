"""A flight of many small photos over a larger world of the demo's: what each step from features to the cloud takes, and
how exact the cameras are.

PYTHONPATH=. OMP_NUM_THREADS=1 python tests/benchmarks/many_photos.py --work results/bench/many --photos 100 300 1000 \\
    --kinds gps no_gps --table results/bench/many_photos.tsv

Photos are rendered once (half a second each); a step that has run is not repeated. `--mappers` maps the same matches
with COLMAP's global or hierarchical mapping beside the incremental one; `--strange 30` adds photos of another place,
whose GPS says this one; `--kinds planted` takes true points in place of rendered photos.
"""

import json
import math
import os
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pandas as pd
import pycolmap
from PIL import Image

from demo import bodies, textures, world
from demo.capture import _exif, focal_px, height_px, render
from demo.objects import OBJECTS, grid, rotation
from demo.textures import Material, noise_at
from demo.truth import Cameras, cameras_json, fit_cameras, pinhole, read_cameras, read_posed
from scenefuse.core.stage import (
    StageError,
    atomic_directory,
    atomic_file,
    quantity,
    read_json,
    run,
    scratch_directory,
    threads,
    value,
    write_json,
)
from scenefuse.core.transforms import Array, look_at
from scenefuse.photos.photos import Photo, write_photos
from scenefuse.sfm import mapping
from scenefuse.sfm.matches import MatchSettings, spatial_pairs

ROOT = Path(__file__).resolve().parents[2]
Mapper = Literal["incremental", "global", "hierarchical"]
Kind = Literal["gps", "no_gps", "planted"]
WIDTH_PX = 400
# Most features of a photo; grass alone would give three times as many.
FEATURES = 1000
# As the demo's flight: height above the ground and distance of photos, metres; noise of GPS, east, north and up.
ALTITUDE_M, STEP_M, GPS_SD_M = 40.0, 10.4, (0.5, 0.5, 1.0)
# Photos along one side of the whole flight.
SIDE = 32
# Every so many photos one looks so far ahead of straight down: without these a flight bends with its lens.
OBLIQUE_EVERY, OBLIQUE_DEG = 6, 25.0
# Half the size of a tile of clutter, as the demo's mapped area, and tiles to each side of the middle one.
TILE_M, TILES = (45.0, 40.0), 2
# Planted: points a square metre, share of those shown that a photo finds, its error, share of wrong matches.
POINTS_M2, DETECTED, NOISE_PX, WRONG = 0.15, 0.67, 0.5, 0.1
SEED = 0
PLACE = ("latitude_deg", "longitude_deg", "altitude_m")
# Runs a script and writes what it took; the parent's own memory would count in what `wait4` says.
MEASURED = """
import json, re, resource, runpy, sys
kept, sys.argv = sys.argv[1], sys.argv[2:]
try:
    runpy.run_path(sys.argv[0], run_name="__main__")
except SystemExit as stop:
    if stop.code:
        raise
used, peak = resource.getrusage(resource.RUSAGE_SELF), re.search(r"VmHWM:\\s*(\\d+)", open("/proc/self/status").read())
json.dump({"seconds": used.ru_utime + used.ru_stime, "memory_mb": int(peak[1]) / 1024}, open(kept, "w"))
"""


def _shifted(height: world.Height, at: Array, x: Array, y: Array) -> Array:
    """Heights of the ground about another middle."""
    return height(x + at[0], y + at[1])


def large_world() -> world.World:
    """The demo's terrain without the hills around it, its clutter again in every tile, its objects in the middle."""
    models = {name: make() for name, make in OBJECTS.items()}
    centres = np.array([m.place[:2] for m in models.values()])
    radii = np.array([m.radius for m in models.values()])
    size = (2 * TILES + 1) * max(TILE_M)

    def height(x: Array, y: Array) -> Array:
        far = np.clip((np.hypot(x, y) - 75.0) / 200.0, 0, 1)
        hills = 0.75 + 0.6 * noise_at(np.stack([x, y, np.zeros_like(x)], axis=1) / 120.0, 2, 0.5, SEED + 7)
        return world._height(x, y, centres, radii, SEED) - 26.0 * far**1.5 * hills

    axis = np.arange(-size, size + 0.01, 0.5)
    x, y = np.meshgrid(axis, axis, indexing="ij")
    ground = height(x.ravel(), y.ravel()).reshape(x.shape)
    parts = [(grid(np.stack([x, y, ground], axis=-1), Material.TERRAIN), 0)]
    for column in range(-TILES, TILES + 1):
        for row in range(-TILES, TILES + 1):
            at, middle = np.array([2 * TILE_M[0] * column, 2 * TILE_M[1] * row]), column == row == 0
            rng = np.random.default_rng([SEED, column + TILES, row + TILES])
            around = partial(_shifted, height, at)
            clutter = world._clutter(around, centres if middle else centres + 1e4, radii, rng)
            inside = [p for p in clutter if (np.abs(p.vertices[:, :2].mean(0)) < TILE_M).all()]
            parts += [(p.moved((at[0], at[1], 0.0)), 0) for p in inside]
    frames = [(0.0, 0.0, 0.0, 1.0, 0.0)]
    for k, model in enumerate(models.values()):
        east, north, yaw = model.place
        up = float(height(np.array([east]), np.array([north]))[0])
        frames.append((east, north, up, np.cos(np.radians(yaw)), np.sin(np.radians(yaw))))
        parts += [(p.turned(rotation(2, yaw)).moved((east, north, up)), k + 1) for p in model.parts]
    return world._assemble(parts, list(models), np.array(frames))


def strips(side: int) -> Cameras:
    """A square flight to and fro, as the demo's; some photos look ahead."""
    body, rng = bodies.FLIGHT["real"], np.random.default_rng([SEED, 1])
    along = (np.arange(side) - (side - 1) / 2) * STEP_M
    rotations, centres = list[Array](), list[Array]()
    for k, x in enumerate(along):
        forth = 1.0 if k % 2 == 0 else -1.0
        for y in along[:: int(forth)]:
            centre = np.array([x, y, ALTITUDE_M]) + rng.normal(size=3) * [0.7, 0.7, 0.5]
            ahead_deg = OBLIQUE_DEG * forth * (len(centres) % OBLIQUE_EVERY == 0)
            tilt, heading = np.radians(rng.normal(0.0, 2.5, 2) + [0.0, ahead_deg]), np.radians(rng.normal(0.0, 4.0))
            below = centre + [np.tan(tilt[0]), np.tan(tilt[1]), -1.0]
            rotations.append(look_at(centre, below, forth * np.array([np.sin(heading), np.cos(heading), 0.0])))
            centres.append(centre)
    names = [f"flight_{k + 1:04d}.jpg" for k in range(len(centres))]
    k_matrix = pinhole(focal_px(WIDTH_PX), WIDTH_PX, height_px(WIDTH_PX), body.shift)
    size = WIDTH_PX, height_px(WIDTH_PX)
    return Cameras(names, k_matrix, *size, np.array(rotations), np.array(centres), np.array(body.distortion))


def block(photos: int) -> list[int]:
    """The photos of a flight of fewer photos in the middle of the whole one, in their order."""
    side = math.isqrt(photos - 1) + 1
    first = (SIDE - side) // 2
    if first < 0:
        raise StageError(f"the whole flight has {SIDE**2} photos, fewer than {photos}; raise SIDE")
    inside = [k for k in range(SIDE**2) if all(first <= i < first + side for i in divmod(k, SIDE))]
    return inside[:photos]


def render_photos(folder: Path, chosen: list[int]) -> None:
    """Render what is missing of a flight's photos, with GPS, and write its truth beside them."""
    body, cameras = bodies.FLIGHT["real"], strips(SIDE)
    write_json(folder / "cameras.json", cameras_json(cameras))
    missing = [k for k in chosen if not (folder / cameras.names[k]).is_file()]
    if not missing:
        return
    gps = positions(cameras)
    textures.set_threads(threads())
    made, rays = large_world(), cameras.rays(2)
    # Shade of corners and trees far from the middle would cost more than it shows.
    open_sky = np.ones(len(made.vertices), dtype=np.float32)
    for k in missing:
        noise = np.random.default_rng([SEED, 20, k])
        light, _ = render(made, cameras, k, rays, open_sky, body.haze)
        picture = bodies.expose(light, body, bodies.draw_exposure(body, noise), cameras, noise)
        half = folder / f".{cameras.names[k]}"
        Image.fromarray(picture).save(
            half, format="JPEG", quality=body.quality, subsampling=body.subsampling, exif=_exif(cameras, k, gps[k])
        )
        half.rename(folder / cameras.names[k])
        if k % 50 == 0:
            print(f"photo {k}", flush=True)


def positions(cameras: Cameras) -> Array:
    """(N, 3) GPS positions of photos."""
    noise = np.random.default_rng([SEED, 2]).normal(size=cameras.centres.shape) * GPS_SD_M
    return np.asarray(pycolmap.GPSTransform().enu_to_ellipsoid(cameras.centres + noise, *world.ORIGIN))


def plant(folder: Path, photos: int) -> Cameras:
    """The list of photos and the database that a flight would give, from true points in place of rendered photos.

    Every photo finds two thirds of the points that it shows, half a pixel off; a tenth of a pair's matches are wrong.
    """
    cameras = strips(math.isqrt(photos - 1) + 1)
    cameras = replace(
        cameras, names=cameras.names[:photos], centres=cameras.centres[:photos],
        cam_from_world=cameras.cam_from_world[:photos],
    )  # fmt: skip
    rng, reach = np.random.default_rng([SEED, 3]), np.abs(cameras.centres[:, :2]).max() + 30.0
    points = rng.uniform(-1, 1, (int(POINTS_M2 * 4 * reach**2), 3)) * [reach, reach, 0]
    points[:, 2] = 1.9 * noise_at(points / 34.0, 3, 0.5, SEED + 5) + 6.0 * rng.random(len(points)) ** 8
    gps = positions(cameras)
    write_json(folder / "cameras.json", cameras_json(cameras))
    focal = float(cameras.intrinsics[0, 0])
    size = cameras.width, cameras.height
    listed = [
        Photo(name, *size, "", latitude_deg=g[0], longitude_deg=g[1], altitude_m=g[2], focal_px=focal)
        for name, g in zip(cameras.names, gps.tolist())
    ]
    write_photos(folder / "photos.json", listed, folder, "photos", [])
    pairs = spatial_pairs(listed, MatchSettings().neighbours)
    quantities = {"pairs": quantity(len(pairs), "1"), "pairs_choice": quantity("spatial", "")}
    write_json(folder / "matches.json", quantities)
    with atomic_file(folder / "database.db") as temporary:
        with pycolmap.Database.open(temporary) as database:
            camera = pycolmap.Camera(model="SIMPLE_RADIAL", width=size[0], height=size[1])
            camera.params = [focal, size[0] / 2, size[1] / 2, 0.0]
            sensor = pycolmap.sensor_t(pycolmap.SensorType.CAMERA, database.write_camera(camera))
            rig = pycolmap.Rig()
            rig.add_ref_sensor(sensor)
            rig_id, numbers, seen = database.write_rig(rig), {}, {}
            for k, name in enumerate(cameras.names):
                pixels, inside = cameras.project(k, points)
                found = np.flatnonzero(inside & (rng.random(len(points)) < DETECTED))
                numbers[name] = database.write_image(pycolmap.Image(name=name, camera_id=sensor.id))
                frame = pycolmap.Frame()
                frame.rig_id = rig_id
                frame.add_data_id(pycolmap.data_t(sensor, numbers[name]))
                database.write_frame(frame)
                noisy = pixels[found] + rng.normal(0, NOISE_PX, (len(found), 2))
                database.write_keypoints(numbers[name], noisy.astype(np.float32))
                seen[name] = found
            for a, b in pairs:
                _, first, second = np.intersect1d(seen[a], seen[b], assume_unique=True, return_indices=True)
                wrong = rng.random(len(first)) < WRONG
                second[wrong] = rng.permutation(len(seen[b]))[: wrong.sum()]
                if len(first) >= 15:
                    both = np.stack([first, second], axis=1).astype(np.uint32)
                    database.write_matches(numbers[a], numbers[b], both)
        pairs_file = folder / "pairs.txt"
        pairs_file.write_text("".join(f"{a} {b}\n" for a, b in pairs))
        pycolmap.verify_matches(temporary, pairs_file)
    return cameras


def timed(folder: Path, name: str, command: list[Any], checkout: Path) -> dict[str, float]:
    """Run a command once; its processor time in seconds and largest memory in MB, also from an earlier run."""
    kept = folder / f"{name}.spent.json"
    if not kept.is_file():
        environment = os.environ | {"PYTHONPATH": f"{checkout}:{ROOT}", "OMP_NUM_THREADS": "1"}
        with open(folder / f"{name}.log", "w") as log:
            words = [sys.executable, "-c", MEASURED, str(kept), *map(str, command)]
            if subprocess.run(words, cwd=checkout, env=environment, stdout=log, stderr=log).returncode:
                raise StageError(f"{name} failed: {(folder / f'{name}.log').read_text()[-2000:]}")
    return dict(json.loads(kept.read_text()))


def link_photos(work: Path, folder: Path, photos: int, strange: int) -> None:
    """The photos of one flight, and some of the whole flight's first strips, beyond its edge."""
    names = read_cameras(work / "flight/cameras.json").names
    with atomic_directory(folder) as temporary:
        for k in block(photos):
            os.link(work / "flight" / names[k], temporary / names[k])
        for k in range(strange):
            os.link(work / "flight" / names[k], temporary / f"other_{k + 1:04d}.jpg")


def match(folder: Path, gps: bool, checkout: Path) -> dict[str, dict[str, float]]:
    """What the steps from photos to matches take."""
    listed, features = folder / "photos.json", folder / "features.db"
    list_photos = ["scripts/photos/list_photos.py", "--source", folder / "source", "--upright", folder / "photos"]
    spent = {"list": timed(folder, "list_photos", [*list_photos, "--photos", listed], checkout)}
    content = read_json(listed)
    own = [{key: photo[key] for key in PLACE} for photo in content["photos"] if photo["name"].startswith("flight")]
    for k, photo in enumerate(content["photos"]):
        if not gps:
            photo |= dict.fromkeys(PLACE)
        elif photo["name"].startswith("other"):
            photo |= own[3 * k % len(own)]
    write_json(listed, content)
    extract = ["scripts/sfm/extract_features.py", "--folder", folder / "photos", "--photos", listed]
    spent["features"] = timed(
        folder, "extract_features", [*extract, "--features", features, "--max-features", FEATURES], checkout
    )
    files = ["--photos", listed, "--features", features, "--database", folder / "database.db"]
    command = ["scripts/sfm/match_features.py", *files, "--matches", folder / "matches.json", "--seed", 0]
    return spent | {"matches": timed(folder, "match_features", command, checkout)}


def case(
    work: Path, photos: int, kind: Kind, strange: int, mapper: Mapper, last: str, checkout: Path
) -> dict[str, Any]:
    """One row of the table: all steps of so many photos, up to the last."""
    folder = work / f"{photos}_{kind}{f'_{strange}' if strange else ''}"
    cameras, spent = work / "flight/cameras.json", {}
    if kind == "planted":
        cameras = folder / "cameras.json"
        # Photos that are not there have no colours; COLMAP wants their folder.
        (folder / "photos").mkdir(parents=True, exist_ok=True)
        if not (folder / "database.db").is_file():
            plant(folder, photos)
    else:
        if not (folder / "source").is_dir():
            link_photos(work, folder / "source", photos, strange)
        spent = match(folder, kind == "gps", checkout)
    sparse, report = folder / f"sparse_{mapper}", folder / f"sparse_{mapper}.json"
    inputs: list[Any] = ["--folder", folder / "photos", "--photos", folder / "photos.json"]
    model = ["--database", folder / "database.db", "--sparse", sparse, "--report", report, "--seed", 0]
    script = [Path(__file__), "map", mapper] if mapper != "incremental" else ["scripts/sfm/map_photos.py"]
    spent["mapping"] = timed(folder, f"map_photos_{mapper}", [*script, *inputs, *model], checkout)
    if last == "dense":
        spent["dense"] = dense(folder, sparse, report, inputs, checkout)
    truth = read_cameras(cameras)
    posed, found, pairs = read_posed(sparse, truth), read_json(report), read_json(folder / "matches.json")
    fit = fit_cameras(posed, truth)
    row = {
        "photos": photos, "kind": kind, "others": strange, "mapper": mapper,
        "pairs": value(pairs, "pairs"), "choice": value(pairs, "pairs_choice"),
        "registered": len(posed), "others_registered": value(found, "registered") - len(posed),
        "points": value(found, "points"), "error_px": round(value(found, "mean_reprojection_error_px"), 4),
        "lens": value(found, "lens"), "attempts": value(found, "attempts"), "mappings": value(found, "mappings"),
        "camera_median_cm": round(100 * float(np.median(fit.position)), 2),
        "camera_max_cm": round(100 * float(fit.position.max()), 2),
        "rotation_median_deg": round(float(np.median(fit.rotation_deg)), 4),
        "rotation_max_deg": round(float(fit.rotation_deg.max()), 4),
    }  # fmt: skip
    for name, used in spent.items():
        row |= {f"{name}_s": round(used["seconds"], 1), f"{name}_mb": round(used["memory_mb"])}
    return row


def dense(folder: Path, sparse: Path, report: Path, inputs: list[Any], checkout: Path) -> dict[str, float]:
    """Processor time and largest memory from undistorted photos to the cloud."""
    space, maps = folder / "undistorted", folder / "depth"
    used = [
        timed(folder, "undistort_photos", ["scripts/mvs/undistort_photos.py", *inputs, "--sparse", sparse,
            "--workspace", space, "--report", folder / "undistorted.json"], checkout),
        timed(folder, "estimate_depth_maps", ["scripts/mvs/estimate_depth_maps.py", "--workspace", space, "--chunk", 0,
            "--chunks", 1, "--depth", maps, "--report", folder / "depth.json", "--seed", 0], checkout),
        timed(folder, "fuse_depth_maps", ["scripts/mvs/fuse_depth_maps.py", "--workspace", space, "--depth", maps,
            "--depth-json", folder / "depth.json", "--cloud", folder / "dense.ply", "--report", folder / "dense.json"],
            checkout),
    ]  # fmt: skip
    return {"seconds": sum(u["seconds"] for u in used), "memory_mb": max(u["memory_mb"] for u in used)}


def mapped_otherwise(mapper: Mapper) -> Callable[..., list[pycolmap.Reconstruction]]:
    """What stands in for `mapping.mapped_models`: COLMAP's global or hierarchical mapping with the same options."""

    def models(job: mapping.Job, options: Any, database: Path | None = None) -> list[pycolmap.Reconstruction]:
        pycolmap.set_random_seed(options.random_seed)
        with scratch_directory(job.sparse.with_name(f"{job.sparse.name}-models")) as work:
            # Global mapping writes into its database.
            copy = work / "database.db"
            copy.write_bytes((database or job.database).read_bytes())
            if mapper == "hierarchical":
                parts = pycolmap.HierarchicalPipelineOptions()
                parts.incremental_options, parts.num_threads, parts.num_workers = options, threads(), 1
                found = pycolmap.hierarchical_mapping(copy, job.folder, work, parts)
            else:
                found = pycolmap.global_mapping(copy, job.folder, work, global_options(options))
        for model in found.values():
            model.update_point_3d_errors()
        ranked = sorted(found.values(), key=lambda m: (-m.num_reg_images(), -m.num_points3D()))
        print(f"{mapper}: {[m.num_reg_images() for m in ranked]} photos", flush=True)
        return ranked

    return models


def global_options(options: Any) -> pycolmap.GlobalPipelineOptions:
    """Global mapping as incremental mapping with these options would be: matches, seed, threads, what is refined."""
    result, seed = pycolmap.GlobalPipelineOptions(), options.random_seed
    mapper = result.mapper
    result.min_num_matches = options.min_num_matches
    result.num_threads = mapper.num_threads = threads()
    result.random_seed = mapper.random_seed = mapper.rotation_averaging.random_seed = seed
    mapper.global_positioning.random_seed = mapper.retriangulation.random_seed = seed
    mapper.global_positioning.use_gpu = mapper.bundle_adjustment.ceres.use_gpu = False
    mapper.bundle_adjustment.refine_focal_length = options.ba_refine_focal_length
    mapper.bundle_adjustment.refine_extra_params = options.ba_refine_extra_params
    return result


def map_otherwise(
    *, mapper: Mapper, folder: Path, photos: Path, database: Path, sparse: Path, report: Path, seed: int
) -> None:
    """`map_photos` with another mapper."""
    mapping.mapped_models = mapped_otherwise(mapper)
    mapping.map_photos(
        folder=folder, photos=photos, database=database, sparse=sparse, report=report,
        settings=mapping.MappingSettings(), seed=seed,
    )  # fmt: skip


def many_photos(
    *,
    work: Path,
    photos: tuple[int, ...] = (100, 300, 1000),
    kinds: tuple[Kind, ...] = ("gps",),
    mappers: tuple[Mapper, ...] = ("incremental",),
    strange: int = 0,
    last: Literal["mapping", "dense"] = "mapping",
    checkout: Path = ROOT,
    table: Path | None = None,
) -> None:
    """Render flights, run all steps on them, and write a table: a row a flight and mapper.

    Args:
        work: folder of photos and results.
        photos: of each flight.
        kinds: rendered photos with or without their positions, or planted matches.
        mappers: of COLMAP.
        strange: photos of another place among them.
        last: step.
        checkout: whose code runs.
        table: output, tab-separated; rows are added.
    """
    if set(kinds) != {"planted"}:
        (work / "flight").mkdir(parents=True, exist_ok=True)
        render_photos(work / "flight", [*range(strange), *sorted({k for count in photos for k in block(count)})])
    rows = []
    for count in photos:
        for kind in kinds:
            for mapper in mappers:
                rows.append(case(work, count, kind, strange, mapper, last, checkout))
                print(pd.DataFrame(rows).to_string(), flush=True)
                if table is not None:
                    table.parent.mkdir(parents=True, exist_ok=True)
                    pd.DataFrame(rows).to_csv(table, sep="\t", index=False)


if __name__ == "__main__":
    if sys.argv[1:2] == ["map"]:
        sys.argv = [sys.argv[0], "--mapper", sys.argv[2], *sys.argv[3:]]
        run(map_otherwise)
    else:
        run(many_photos)

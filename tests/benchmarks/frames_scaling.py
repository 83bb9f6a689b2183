"""What more photos cost: time and memory of the four stages and the cloud of a demo object with 100, 200, 400 photos.

python tests/benchmarks/frames_scaling.py --work results/bench/frames --frames 100 200 400
"""

import importlib
import os
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from functools import wraps
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pycolmap

from demo.capture import OrbitSettings, render_object
from demo.truth import Cameras, read_cameras, read_mesh, sample_surface, visible
from scenefuse.core.settings import build, read_settings
from scenefuse.core.stage import quantity, run, write_json
from scenefuse.nerf.depth_prior import estimate_depth_prior
from scenefuse.nerf.object_cloud import CloudInputs, CloudSettings, make_object_cloud
from scenefuse.nerf.rendered_maps import refine_depth
from scenefuse.nerf.train_object_nerf import NerfInputs, NerfSettings, train_object_nerf

# A quarter of stage 1's pixels: what counts is how the cost grows with the photos.
SMALL_PX = 72
# Functions of a stage whose share is listed by itself: module, function -> part.
PARTS = {
    ("scenefuse.nerf.depth_prior", "load_views"): "loading",
    ("scenefuse.nerf.depth_prior", "first_depth"): "stereo",
    ("scenefuse.nerf.depth_prior", "confirm"): "refinement",
    ("scenefuse.nerf.rendered_maps", "load_views"): "loading",
    ("scenefuse.nerf.rendered_maps", "confirm"): "refinement",
    ("scenefuse.nerf.train_object_nerf", "load_views"): "loading",
    ("scenefuse.nerf.train_object_nerf", "read_prior"): "prior",
    ("scenefuse.nerf.train_object_nerf", "find_volume"): "visual hull",
    ("scenefuse.nerf.train_object_nerf", "train"): "training",
    ("scenefuse.nerf.rendered_maps", "render_view"): "rendering",
    ("scenefuse.nerf.rendered_maps", "agreement"): "confidence",
    ("scenefuse.nerf.object_cloud", "load_views"): "loading",
    ("scenefuse.nerf.object_cloud", "refine_by_photos"): "refinement",
    ("scenefuse.nerf.object_cloud", "fuse_depths"): "fusion",
}


def workspace(photos: Path, truth: Path, chosen: list[int], folder: Path, seed: int) -> None:
    """An undistorted workspace, its report and masks from the capture's true cameras: only the cost is measured."""
    cameras = read_cameras(truth / "cameras.json")
    for name in ("images", "sparse"):
        (folder / "undistorted" / name).mkdir(parents=True)
    (folder / "masks").mkdir()
    model, k = pycolmap.Reconstruction(), cameras.intrinsics
    pinhole = [k[0, 0], k[1, 1], k[0, 2], k[1, 2]]
    model.add_camera_with_trivial_rig(
        pycolmap.Camera(model="PINHOLE", width=cameras.width, height=cameras.height, params=pinhole, camera_id=1)
    )
    few = Cameras(
        [cameras.names[i] for i in chosen], k, cameras.width, cameras.height,
        cameras.cam_from_world[chosen], cameras.centres[chosen],
    )  # fmt: skip
    mesh = read_mesh(truth / "mesh.ply")
    points = sample_surface(mesh, 4000, seed)
    pixels, seen = visible(mesh.caster(), few, points, 0.02)
    tracks: list[list[pycolmap.TrackElement]] = [[] for _ in points]
    for index, name in enumerate(few.names):
        rows = np.flatnonzero(seen[index])
        image = pycolmap.Image(
            name=name, camera_id=1, image_id=index + 1, points2D=[pycolmap.Point2D(p) for p in pixels[index, rows]]
        )
        turn = few.cam_from_world[index]
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(np.column_stack([turn, -turn @ few.centres[index]])))
        for place, row in enumerate(rows):
            tracks[row].append(pycolmap.TrackElement(index + 1, place))
        (folder / "undistorted/images" / name).symlink_to((photos / name).resolve())
        mask = f"{Path(name).stem}.png"
        (folder / "masks" / mask).symlink_to((truth / "masks" / mask).resolve())
    for point, track in zip(points, tracks):
        if len(track) > 1:
            model.add_point3D(point, pycolmap.Track(track), np.zeros(3, np.uint8))
    model.write_binary(folder / "undistorted/sparse")
    write_json(folder / "undistorted.json", {"up_in_camera_frame": quantity([0.0, 0.0, 1.0], "1")})


def measure(part: str, folder: Path, own: dict[str, Any], seed: int) -> dict[str, float]:
    """Run one stage in this process: processor seconds of it and of its parts, and the process's largest memory."""
    spent: dict[str, float] = {}
    for (module, function), label in PARTS.items():
        home = importlib.import_module(module)
        setattr(home, function, timed(getattr(home, function), label, spent))
    undistorted, masks = folder / "undistorted", folder / "masks"
    common: dict[str, Any] = {
        "checkpoints": folder / "checkpoints", "hold_out_every": own["hold_out_every"], "seed": seed
    }  # fmt: skip

    def nerf(number: int, prior: int, previous: Path | None) -> None:
        train_object_nerf(
            inputs=NerfInputs(undistorted, masks, folder / f"stage{prior}", previous), stage=folder / f"stage{number}",
            report=folder / f"stage{number}.json",
            settings=build(NerfSettings, own["nerf"] | own[f"stage{number}"]), **common,
        )  # fmt: skip

    start, began = time.monotonic(), os.times()
    if part == "stage1":
        estimate_depth_prior(
            workspace=undistorted, masks=masks, stage=folder / part, report=folder / "stage1.json",
            width_px=own["nerf"]["width_px"], hold_out_every=own["hold_out_every"], crop_px=SMALL_PX,
        )  # fmt: skip
    elif part == "stage2":
        nerf(2, 1, None)
    elif part == "stage3":
        refine_depth(
            workspace=undistorted, masks=masks, rendered=folder / "stage2", stage=folder / part,
            report=folder / "stage3.json", width_px=own["nerf"]["width_px"], hold_out_every=own["hold_out_every"],
        )  # fmt: skip
    elif part == "stage4":
        nerf(4, 3, folder / "stage2")
    else:
        make_object_cloud(
            inputs=CloudInputs(
                workspace=undistorted, workspace_json=folder / "undistorted.json", masks=masks,
                stage=folder / "stage4", stage_json=folder / "stage4.json",
            ),
            cloud=folder / "object.ply", report=folder / "object.json",
            settings=build(CloudSettings, own["cloud"]), seed=seed,
        )  # fmt: skip
    now = os.times()
    total = now.user + now.system - began.user - began.system
    # Not getrusage: its maximum comes down from the parent.
    peak = next(line for line in Path("/proc/self/status").read_text().splitlines() if line.startswith("VmHWM"))
    memory = int(peak.split()[1]) / 2**20
    rest = {"rest": total - sum(spent.values())}
    return {"total": total, "wall": time.monotonic() - start, "memory_gib": memory} | spent | rest


def timed(function: Callable[..., Any], label: str, spent: dict[str, float]) -> Callable[..., Any]:
    """The same function, its processor seconds added to `spent`."""

    @wraps(function)
    def measured(*args: Any, **named: Any) -> Any:
        began = os.times()
        try:
            return function(*args, **named)
        finally:
            now = os.times()
            spent[label] = spent.get(label, 0.0) + now.user + now.system - began.user - began.system

    return measured


def frames_scaling(
    *, work: Path, name: str = "sculpture", frames: tuple[int, ...] = (100, 200, 400), settings: Path | None = None
) -> None:
    """Print processor seconds and memory by number of photos; all go to frames_scaling.tsv in the work folder.

    Cameras, sparse points and masks are the capture's true ones, since only the cost is measured. An epoch of a NeRF
    stage is a number of rays, whatever the number of photos. The exponent e says that the cost grows like photos^e,
    from the fewest to the most: up to 1 is no faster than the photos.

    Args:
        work: folder for capture and results; a capture that is there is used again.
        name: object of the demo.
        frames: numbers of photos, each taken evenly from the largest capture.
        settings: laid over the shipped ones, or none.
    """
    shipped = read_settings(settings)
    own, seed, most = shipped["object"], shipped["seed"], max(frames)
    photos, truth = work / f"photos_{name}_{most}", work / f"truth_{name}_{most}"
    if not truth.is_dir():
        orbit = replace(build(OrbitSettings, shipped["demo"]["orbit"]), views=most, supersampling=1)
        # An ideal camera: the photos go into the workspace as they are.
        render_object(name=name, photos=photos, truth=truth, settings=orbit, camera="ideal", seed=seed)
    rows: list[dict[str, Any]] = []
    for count in frames:
        folder = work / f"{name}_{count}_{os.getpid()}"
        workspace(photos, truth, [k * most // count for k in range(count)], folder, seed)
        for part in ("stage1", "stage2", "stage3", "stage4", "cloud"):
            with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
                found = pool.submit(measure, part, folder, own, seed).result()
            rows += [{"stage": part, "photos": count, "what": what, "value": v} for what, v in found.items()]
            pd.DataFrame(rows).to_csv(work / "frames_scaling.tsv", sep="\t", index=False, float_format="%.4g")
    table = pd.DataFrame(rows).pivot_table(index=["stage", "what"], columns="photos", values="value", sort=False)
    print("\n| stage | processor seconds of | " + " | ".join(f"{n} photos" for n in table) + " | e |")
    print("|---|---|" + "---|" * (len(table.columns) + 1))
    for (stage, what), row in table.iterrows():
        first, last = max(row.iloc[0], 1e-3), max(row.iloc[-1], 1e-3)
        exponent = np.log(last / first) / np.log(max(frames) / min(frames)) if len(frames) > 1 else np.nan
        label = {"memory_gib": "(memory, GiB)", "wall": "(seconds of wall time)"}.get(what, what)
        print(f"| {stage} | {label} | " + " | ".join(f"{v:.3g}" for v in row) + f" | {exponent:.2f} |")


if __name__ == "__main__":
    run(frames_scaling)

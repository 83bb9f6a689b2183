"""The demo's objects by dense multi-view stereo alone, on the same photos and masks, beside the four stages.

make demo; then python tests/benchmarks/object_mvs.py --results results --settings config/demo.yaml
"""

import os
import tempfile
import time
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pandas as pd

from demo.evaluate import ObjectTruth, cloud_results, depth_results, read_object_truth
from demo.truth import SAMPLES
from scenefuse.cloud.clouds import Cloud, read_cloud, voxel_downsample, write_cloud
from scenefuse.core.settings import build, read_settings
from scenefuse.core.stage import StageError, read_json, run, value
from scenefuse.geometry.consistency import compare
from scenefuse.mvs.dense_cloud import DenseCloudSettings, fuse_depth_maps
from scenefuse.mvs.depth_maps import estimate_depth_maps
from scenefuse.mvs.plane_sweep import DepthMapSettings
from scenefuse.nerf.object_cloud import CloudSettings, SurfaceMaps, clean, fuse_depths
from scenefuse.photos.pictures import read_depth, read_normals, write_depth
from scenefuse.photos.views import Views, load_views

# Depth maps: the scene's settings, and a smaller window. Of seven variants on the house at half the width (score,
# window, angle, sources, best sources) only the window changed much.
DEPTH: dict[str, dict[str, Any]] = {"window 7": {}, "window 5": {"window_px": 5}}
# Their fusion: as for the scene; stricter, since the photos are near; the same with two photos instead of
# three; and that of the object's cloud.
STRICT = {"max_depth_error": 0.005, "max_reprojection_px": 1}
FUSION: dict[str, dict[str, Any] | None] = {
    "scene": {},
    "strict": STRICT,
    "two photos": STRICT | {"min_photos": 2},
    "object": None,
}
STAGES = ("estimate_depth_prior", "train_object_nerf", "refine_depth", "retrain_object_nerf", "make_object_cloud")


def mask_depths(depth: Path, views: Views) -> None:
    """Depths off the mask are no object's."""
    for name, mask in zip(views.names, views.masks):
        path = depth / "depth_maps" / f"{name}.bin"
        if path.is_file():
            write_depth(path, np.where(mask, read_depth(path), 0).astype(np.float32))


def fused(
    folder: Path, depth: Path, report: Path, views: Views, own: dict[str, Any], over: dict[str, Any] | None
) -> Cloud:
    """The maps as one cloud, in which no point is off more masks than the object's cloud allows."""
    settings = build(CloudSettings, own["cloud"])
    if over is None:
        read = [(f"{name}.bin", np.zeros(mask.shape, np.float32)) for name, mask in zip(views.names, views.masks)]
        depths = np.stack([read_depth(p) if (p := depth / "depth_maps" / n).is_file() else z for n, z in read])
        normals = np.stack(
            [read_normals(p) if (p := depth / "normal_maps" / n).is_file() else np.stack([z] * 3, -1) for n, z in read]
        )
        maps = SurfaceMaps(depths, (depths > 0).astype(np.float32), normals)
        return fuse_depths(views, maps, settings)[0]
    path = depth.with_name("fused.ply")
    fuse_depth_maps(
        workspace=folder / "undistorted", depth=[depth], depth_json=[report], cloud=path,
        report=path.with_suffix(".json"), settings=build(DenseCloudSettings, own["dense_cloud"] | over),
    )  # fmt: skip
    cloud = read_cloud(path)
    grown = np.stack([cv2.dilate(m.astype(np.uint8), np.ones((5, 5), np.uint8)) > 0 for m in views.masks])
    nothing = np.zeros(grown.shape, np.float32)
    found = compare(cloud.points, -1, nothing, grown, views.intrinsics, views.object_from_cam, 0.0)
    return cloud[found.off_mask <= settings.gates.mask_share * len(grown)]


def trials(folder: Path, truth: ObjectTruth, settings: dict[str, Any], pictures: Path) -> list[dict[str, Any]]:
    """Every way to make depth maps with every way to fuse them."""
    own = settings["object"] | {key: settings["scene"][key] for key in ("depth_maps", "dense_cloud")}
    width = own["nerf"]["width_px"]
    views = load_views(folder / "undistorted", folder / "masks", width, 0)
    rows = []
    for maps, over in DEPTH.items():
        with tempfile.TemporaryDirectory() as temporary:
            depth, report = Path(temporary) / maps.replace(" ", "_"), Path(temporary) / "depth.json"
            start, began = time.monotonic(), os.times()
            estimate_depth_maps(
                workspace=folder / "undistorted", chunk=0, chunks=1,
                settings=build(DepthMapSettings, own["depth_maps"] | {"max_image_size_px": width} | over),
                seed=settings["seed"], depth=depth, report=report,
            )  # fmt: skip
            mask_depths(depth, views)
            wall, cpu = time.monotonic() - start, used(began)
            errors = depth_results([depth], truth)
            for fusion, changes in FUSION.items():
                start, began = time.monotonic(), os.times()
                try:
                    cloud = fused(folder, depth, report, views, own, changes)
                except StageError as error:
                    print(f"{maps}, {fusion}: {error}", flush=True)
                    continue
                cloud = cleaned(cloud, folder, own)
                seconds, work = wall + time.monotonic() - start, cpu + used(began)
                write_cloud(pictures / f"{folder.name}_{maps}_{fusion}.ply".replace(" ", "_"), cloud)
                rows.append(
                    {"object": folder.name, "method": "mvs", "maps": maps, "fusion": fusion}
                    | {"depth_pct": 100 * (value(errors, f"{depth.name}_depth_error") or np.nan)}
                    | {"within_1pct": value(errors, f"{depth.name}_depth_within_1pct")}
                    | measured(cloud, truth, SAMPLES, settings["seed"])
                    | {"seconds": seconds, "cpu_seconds": work}
                )
                print(rows[-1], flush=True)
    return rows


def early_stages(folder: Path, truth: ObjectTruth, settings: dict[str, Any]) -> list[dict[str, Any]]:
    """The maps of stages 1 and 3, fused and cleaned as the object's cloud: what the NeRF adds to them."""
    own, rows = settings["object"], []
    for stage in ("stage1", "stage3"):
        depth = folder / stage
        width = read_depth(next(iter(sorted((depth / "depth_maps").glob("*.bin"))))).shape[1]
        views = load_views(folder / "undistorted", folder / "masks", width, 0)
        cloud = cleaned(fused(folder, depth, depth, views, own, None), folder, own)
        errors = depth_results([depth], truth)
        rows.append(
            {"object": folder.name, "method": "stage 1 alone" if stage == "stage1" else "stages 1 to 3"}
            | {"maps": stage, "fusion": "object", "depth_pct": 100 * value(errors, f"{stage}_depth_error")}
            | {"within_1pct": value(errors, f"{stage}_depth_within_1pct")}
            | measured(cloud, truth, SAMPLES, settings["seed"])
        )
    return rows


def cleaned(cloud: Cloud, folder: Path, own: dict[str, Any]) -> Cloud:
    """Thinned and cleaned like the object's cloud."""
    settings = build(CloudSettings, own["cloud"])
    step = settings.spacing * value(read_json(folder / "object.json"), "diagonal")  # the demo's pixels are larger
    return clean(voxel_downsample(cloud, step), settings.gates.min_component, step)


def used(began: os.times_result) -> float:
    """Processor seconds of this process since then."""
    now = os.times()
    return now.user + now.system - began.user - began.system


def measured(cloud: Cloud, truth: ObjectTruth, samples: int, seed: int) -> dict[str, Any]:
    found = cloud_results(truth.fit.truth_from_model.apply(cloud.points), truth, samples, seed)
    return {
        "points": len(cloud),
        "accuracy_pct": value(found, "cloud_accuracy_median"),
        "accuracy_90_pct": value(found, "cloud_accuracy_90"),
        "recall_05": value(found, "cloud_recall_05pct"),
        "recall_1": value(found, "cloud_recall_1pct"),
        "f_05": value(found, "cloud_f_score_05pct"),
        "f_1": value(found, "cloud_f_score_1pct"),
    }


def four_stages(results: Path, name: str, truth: ObjectTruth, settings: dict[str, Any]) -> dict[str, Any]:
    """The workflow's cloud, measured alike, and the time of its stages."""
    folder = results / "objects" / name
    times = [pd.read_csv(results / f"benchmarks/{stage}/{name}.tsv", sep="\t").iloc[-1] for stage in STAGES]
    errors = depth_results([folder / "stage4"], truth)
    return (
        {"object": name, "method": "four stages", "maps": "stage4", "fusion": "object"}
        | {"depth_pct": 100 * value(errors, "stage4_depth_error")}
        | {"within_1pct": value(errors, "stage4_depth_within_1pct")}
        | measured(read_cloud(folder / "object.ply"), truth, SAMPLES, settings["seed"])
        | {"seconds": sum(t["s"] for t in times), "cpu_seconds": sum(t["cpu_time"] for t in times)}
    )


def object_mvs(
    *,
    results: Path = Path("results"),
    objects: tuple[str, ...] = ("house", "balloon", "sculpture"),
    settings: Path | None = None,
) -> None:
    """Print the clouds of multi-view stereo and of the four stages; all trials go to bench/object_mvs.tsv.

    Multi-view stereo is the scene's own (plane sweep and slanted refinement, or COLMAP's patch-match with CUDA;
    its fusion) at the width of the NeRF, on all photos; its depths off the mask are dropped before fusion, its
    points off the masks after, and it is thinned and cleaned like the object's cloud. The best trial by F at 1 % is
    marked. Beside them stand clouds of the maps of stages 1 and 3, made in the same way.

    Args:
        results: folder of a finished demo.
        objects: of the demo.
        settings: laid over the shipped ones, or none.
    """
    chosen, rows = read_settings(settings), []
    out = results / "bench/object_mvs.tsv"
    (out.parent / "object_mvs").mkdir(parents=True, exist_ok=True)
    known = results / "demo/demo/truth"
    for name in objects:
        folder = results / "objects" / name
        truth = read_object_truth(folder / "undistorted", known / "scene", known / name, SAMPLES, chosen["seed"])
        rows += [four_stages(results, name, truth, chosen), *early_stages(folder, truth, chosen)]
        rows += trials(folder, truth, chosen, out.parent / "object_mvs")
        pd.DataFrame(rows).to_csv(out, sep="\t", index=False, float_format="%.5g")
    table = pd.DataFrame(rows)
    best = table[table.method == "mvs"].groupby("object").f_1.idxmax()
    columns = list(table.columns[4:])
    print("\n| object | method | " + " | ".join(columns) + " |\n|---|---|" + "---|" * len(columns))
    for index, row in table.iterrows():
        method = row.method if row.method != "mvs" else f"MVS: {row.maps}, {row.fusion}"
        method += " (its best)" if index in set(best) else ""
        print(f"| {row.object} | {method} | " + " | ".join(f"{row[c]:.3g}" for c in columns) + " |")


if __name__ == "__main__":
    run(object_mvs)

"""A scene's depth maps and cloud, with this code and with another checkout's: accuracy, coverage, fringe, sky, time.

python tests/benchmarks/dense_stereo.py --workspace results/scenes/demo/undistorted \\
    --truth results/demo/demo/truth/scene --before ../before
python tests/benchmarks/dense_stereo.py --workspace results/scenes/statue/undistorted --sky True --before ../before
"""

import os
import resource
import shlex
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy import ndimage

from demo.evaluate import within
from demo.truth import (
    HIDDEN,
    cast_together,
    distances,
    f_score,
    fit_cameras,
    nearest,
    read_cameras,
    read_mesh,
    read_posed,
    sample_surface,
    true_depth,
    visible,
)
from scenefuse.cloud.clouds import Cloud, read_cloud
from scenefuse.core.stage import read_json, run, value
from scenefuse.core.transforms import Array, Sim3
from scenefuse.photos.pictures import read_depth
from scenefuse.photos.workspace import View, Workspace, read_workspace

ROOT = Path(__file__).resolve().parents[2]
SAMPLES = 60000
EVERY = 6
"""Every so many photos, the depth map is compared with the true one."""
EDGE_PX, JUMP = 7, 0.03
"""A pixel lies beside an edge where a surface so much nearer (a share of the depth) is within so many pixels of it."""
SKY_BRIGHTNESS, SKY_CHANGE = 150, 12
"""Sky, in 255ths: brighter than this, connected to the top of the photo without a larger step between two pixels."""
SKY_SPREAD, SKY_PATCH_PX = 15, 60
"""Patches of sky that the statue encloses: at most so much darker than the sky's middle, and at least so large."""
OFF_SHARE = 0.15
"""A point is sky where it lies in the sky of so many of the photos that have it in view: no surface does."""
KEPT = 0.01
"""A point is kept where the other cloud has one so near, a share of the diagonal."""


@dataclass(frozen=True)
class Made:
    """What one checkout made of a workspace."""

    folder: Path
    seconds: float
    fusion_seconds: float


def make(checkout: Path, folder: Path, workspace: Path, stereo: str, fusion: str) -> Made:
    """Depth maps and cloud by a checkout's own scripts, on one thread; processor seconds of both."""
    folder.mkdir(parents=True, exist_ok=True)
    spent = []
    maps, cloud = f"--depth {folder}/depth", f"--cloud {folder}/dense.ply --report {folder}/dense.json"
    stages = {
        "estimate_depth_maps": f"--chunk 0 --chunks 1 --seed 0 {maps} --report {folder}/depth.json {stereo}",
        "fuse_depth_maps": f"{maps} --depth-json {folder}/depth.json {cloud} {fusion}",
    }
    for script, options in stages.items():
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        words = [sys.executable, f"scripts/mvs/{script}.py", "--workspace", str(workspace), *shlex.split(options)]
        environment = os.environ | {"PYTHONPATH": str(checkout), "OMP_NUM_THREADS": "1"}
        with open(folder / f"{script}.log", "w") as log:
            subprocess.run(words, cwd=checkout, env=environment, check=True, stdout=log, stderr=log)
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        spent.append(after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime)
    return Made(folder, *spent)


def sized(view: View, depth: NDArray[np.float32]) -> View:
    """A view at the size of its depth map."""
    return view.resized(depth.shape[1], depth.shape[0])


def maps_of(made: Made, read: Workspace) -> dict[str, tuple[View, NDArray[np.float32]]]:
    """The camera at the map's size, and the map (H, W), of every photo that has one."""
    found = {}
    for view in read.views:
        path = made.folder / "depth/depth_maps" / f"{view.name}.bin"
        if path.is_file():
            depth = read_depth(path)
            found[view.name] = (sized(view, depth), depth)
    return found


def general(made: Made, read: Workspace) -> dict[str, Any]:
    """Time and size."""
    maps = maps_of(made, read)
    pixels = sum(depth.size for _, depth in maps.values())
    return {
        "points": len(read_cloud(made.folder / "dense.ply")),
        "pixels_with_depth_pct": 100 * sum((depth > 0).sum() for _, depth in maps.values()) / pixels,
        "stereo_s_per_mpx": made.seconds / pixels * 1e6,
        "fusion_s_per_mpx": made.fusion_seconds / pixels * 1e6,
    }


class Truth:
    """The demo's true surfaces, and the similarity from a model of its flight to them."""

    def __init__(self, folder: Path, model: Path) -> None:
        cameras, content = read_cameras(folder / "cameras.json"), read_json(folder / "cameras.json")
        self.meshes = {name: read_mesh(folder / "meshes" / f"{name}.ply") for name in ["world", *content["objects"]]}
        self.scene = cast_together(list(self.meshes.values()))
        self.from_model: Sim3 = fit_cameras(read_posed(model, cameras), cameras).truth_from_model
        self.gsd = float(value(content, "ground_sampling_distance"))
        low, high = (np.array(corner) for corner in value(content, "mapped_area"))
        ground = sample_surface(within(self.meshes["world"], low, high), SAMPLES, 0)
        self.ground = ground[visible(self.scene, cameras, ground, HIDDEN)[1].sum(0) >= 3]

    def scores(self, made: Made, read: Workspace) -> dict[str, Any]:
        """Of the cloud and the depth maps, everywhere and around the objects."""
        points = self.from_model.apply(read_cloud(made.folder / "dense.ply").points)
        rows = np.random.default_rng(0).choice(len(points), min(SAMPLES, len(points)), replace=False)
        error = distances(self.scene, points[rows])
        result = {
            "accuracy_cm": 100 * float(np.median(error)),
            "accuracy_90_cm": 100 * float(np.quantile(error, 0.9)),
            "beyond_2_gsd_pct": 100 * float((error > 2 * self.gsd).mean()),
            "terrain_covered_pct": 100 * float((nearest(self.ground, points) <= 3 * self.gsd).mean()),
        }
        for name in list(self.meshes)[1:]:
            result |= self._around(name, points)
        return result | self._beside_edges(made, read)

    def _around(self, name: str, points: Array) -> dict[str, Any]:
        """Precision and F-score around one object, as shares of its diagonal (`evaluate_object`)."""
        mesh = self.meshes[name]
        low, high = mesh.vertices.min(0), mesh.vertices.max(0)
        diagonal = float(np.linalg.norm(high - low))
        margin = 0.05 * diagonal
        points = points[((points >= low - margin) & (points <= high + margin)).all(1)]
        rest = cast_together([other for key, other in self.meshes.items() if key != name])
        own = distances(mesh.caster(), points)
        mine = own < distances(rest, points)
        to_cloud = nearest(sample_surface(mesh, SAMPLES, 0), points[mine])
        result: dict[str, Any] = {}
        for share in (0.5, 1.0, 2.0):
            precision, recall, score = f_score(own[mine], to_cloud, share / 100 * diagonal)
            result |= {f"{name}_p_{share:g}": precision, f"{name}_r_{share:g}": recall, f"{name}_f_{share:g}": score}
        return result

    def _beside_edges(self, made: Made, read: Workspace) -> dict[str, Any]:
        """Share of the pixels behind an edge that got a depth on the near side of the middle, or none."""
        near, missing = [], []
        for view, depth in list(maps_of(made, read).values())[::EVERY]:
            true = true_depth(self.scene, view, self.from_model, (view.width, view.height))[0] / self.from_model.scale
            seen = np.isfinite(true)
            nearer = ndimage.minimum_filter(np.where(seen, true, np.inf), 2 * EDGE_PX + 1)
            beside = seen & (nearer < (1 - JUMP) * true)
            near.append((depth > 0)[beside] & (depth < (true + nearer) / 2)[beside])
            missing.append((depth == 0)[beside])
        return {
            "fattened_pct": 100 * float(np.concatenate(near).mean()),
            "missing_beside_edges_pct": 100 * float(np.concatenate(missing).mean()),
        }


def sky_of(photo: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """(H, W), True in the sky of an RGB photo (H, W, 3): bright, and connected to its upper border in small steps."""
    low = photo.min(-1)
    steps = ndimage.morphological_gradient(cv2.GaussianBlur(low, (0, 0), 1.0), 3)
    smooth = (low > SKY_BRIGHTNESS) & (steps < SKY_CHANGE)
    labels, _ = ndimage.label(smooth)
    sky = np.isin(labels, np.unique(labels[0][labels[0] > 0]))
    # Between arms and legs: as bright as the sky above.
    enclosed = ndimage.label((low > np.median(low[sky]) - SKY_SPREAD) & ~sky)[0] if sky.any() else sky.astype(int)
    large = np.flatnonzero(np.bincount(enclosed.ravel()) >= SKY_PATCH_PX)
    sky |= np.isin(enclosed, large[large > 0]) & (steps < SKY_CHANGE)
    return ndimage.binary_dilation(sky, iterations=2) & (low > SKY_BRIGHTNESS)


def draw(path: Path, read: Workspace, sky: dict[str, NDArray[np.bool_]]) -> None:
    """Every second photo with its sky in magenta, to look at."""
    tiles = []
    for view in read.views[::2]:
        photo = read.rgb(view).pixels[..., ::-1].copy()
        photo[sky[view.name]] = (255, 0, 255)
        tiles.append(cv2.resize(photo, (240, round(240 * view.height / view.width)), interpolation=cv2.INTER_AREA))
    height = min(tile.shape[0] for tile in tiles)
    rows = [np.hstack([tile[:height] for tile in tiles[k : k + 8]]) for k in range(0, len(tiles) - 7, 8)]
    cv2.imwrite(str(path), np.vstack(rows))


def in_box(made: Made, box: Array | None) -> Cloud:
    """The cloud's points between two corners (6,), or all."""
    cloud = read_cloud(made.folder / "dense.ply")
    if box is None:
        return cloud
    return cloud[np.flatnonzero(((cloud.points >= box[:3]) & (cloud.points <= box[3:])).all(1))]


def sky_scores(made: Made, read: Workspace, sky: dict[str, NDArray[np.bool_]], box: Array | None) -> dict[str, Any]:
    """Share of the sky's pixels with a depth, and of the cloud's points (in a box) that lie in the sky."""
    depths = maps_of(made, read)
    inside = [depths[name][1][resized(mask, depths[name][1])] > 0 for name, mask in sky.items() if name in depths]
    cloud = in_box(made, box)
    share = off_share(cloud, read, sky)
    return {
        "sky_pixels_with_depth_pct": 100 * float(np.concatenate(inside).mean()),
        "points_in_box": len(cloud),
        "sky_points_pct": 100 * float((share >= OFF_SHARE).mean()),
    }


def kept(before: Made, now: Made, read: Workspace, sky: dict[str, NDArray[np.bool_]], box: Array | None) -> float:
    """Percentage of the earlier points in no photo's sky that still have a point within KEPT of the diagonal."""
    old = in_box(before, box)
    old = old[np.flatnonzero(off_share(old, read, sky) == 0)]
    return 100 * float((nearest(old.points, in_box(now, box).points) <= KEPT * old.diagonal).mean())


def resized(mask: NDArray[np.bool_], depth: NDArray[np.float32]) -> NDArray[np.bool_]:
    """A mask at the size of a depth map."""
    return cv2.resize(mask.astype(np.uint8), depth.shape[::-1], interpolation=cv2.INTER_NEAREST) > 0


def off_share(cloud: Cloud, read: Workspace, sky: dict[str, NDArray[np.bool_]]) -> Array:
    """(N,) share of the photos with a point in view in whose sky it lies."""
    seen, off = np.zeros(len(cloud)), np.zeros(len(cloud))
    for view in read.views:
        rows, pixels, _ = view.visible(cloud.points)
        seen[rows] += 1
        off[rows] += sky[view.name][pixels[:, 1], pixels[:, 0]]
    return off / np.maximum(seen, 1)


def dense_stereo(
    *,
    workspace: Path,
    before: Path | None = None,
    truth: Path | None = None,
    sky: bool = False,
    box: tuple[float, float, float, float, float, float] | None = None,
    stereo: str = "",
    fusion: str = "",
    out: Path = Path("results/bench"),
) -> None:
    """Print the numbers of this code and, made in the same run, of another checkout; also to dense_stereo.tsv.

    Args:
        workspace: an undistorted COLMAP workspace.
        before: a checkout of another commit.
        truth: the demo's truth folder of the flight.
        sky: find the sky by its brightness (look at sky.png) and say how much of the cloud it makes up.
        box: of the sky's points, lower corner and upper corner in the model's frame; without it all count.
        stereo: options for scripts/mvs/estimate_depth_maps.py.
        fusion: options for scripts/mvs/fuse_depth_maps.py.
        out: folder of the tables, maps and clouds.
    """
    workspace, out = workspace.resolve(), out.resolve()
    out.mkdir(parents=True, exist_ok=True)
    read, corners = read_workspace(workspace), None if box is None else np.array(box)
    masks = {view.name: sky_of(read.rgb(view).pixels) for view in read.views} if sky else {}
    known = Truth(truth, workspace / "sparse") if truth is not None else None
    rows, made = {}, {}
    for name, checkout in {"before": before, "now": ROOT}.items():
        if checkout is None:
            continue
        made[name] = make(checkout.resolve(), out / f"dense_stereo_{name}", workspace, stereo, fusion)
        rows[name] = general(made[name], read) | (known.scores(made[name], read) if known is not None else {})
        if sky:
            rows[name] |= sky_scores(made[name], read, masks, corners)
    if sky:
        draw(out / "sky.png", read, masks)
    if sky and before is not None:
        rows["now"]["kept_pct"] = kept(made["before"], made["now"], read, masks, corners)
    table = pd.DataFrame(rows)
    if "before" in rows:
        table["ratio"] = table["now"] / table["before"]
    table.to_csv(out / "dense_stereo.tsv", sep="\t", float_format="%.5g")
    print(table.to_string(float_format=lambda number: f"{number:.4g}"))


if __name__ == "__main__":
    run(dense_stereo)

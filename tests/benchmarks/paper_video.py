"""Stage 1 of the paper on what it is meant for, a video: a walk around an object of the demo, filmed by a phone.

python tests/benchmarks/paper_video.py --name house --table results/bench/paper_video.tsv

The demo's forty photos in two rings are no video. This renders frames of one smooth turn around the object, trains
depth and pose networks on them as `config/paper.yaml` does, and measures motions, the chained trajectory and depths
against the truth, beside chance: no motion at all, all cameras in their middle, the same depth all over a frame.
Nothing but frames, masks and intrinsics, the latter two the true ones, is given to the networks.
"""

import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import open3d as o3d
import pandas as pd
from scipy.spatial.transform import Rotation

from demo import bodies, textures
from demo.capture import render
from demo.truth import Cameras, pinhole
from demo.world import World, build_world, openness
from scenefuse.core.stage import run, threads, value
from scenefuse.core.transforms import Array, fit_sim3, look_at
from scenefuse.paper.estimate_as_paper import chained, trajectory_error
from scenefuse.paper.monocular import (
    frames_of,
    monocular_losses,
    new_monocular_networks,
    pose_quantities,
)
from scenefuse.paper.network_training import Recipe, optimise, predict, prepare_torch
from scenefuse.photos.views import Views

# As the demo's photos, at the width of the paper's stage 1.
WIDTH, HEIGHT, FOCAL = 192, 144, 168.0
ELEVATION_DEG = 20.0
# Without the lens: photos are undistorted before stage 1.
CAMERA = replace(bodies.PHONE, shift=(0.0, 0.0), distortion=(0.0, 0.0, 0.0, 0.0))
SUPERSAMPLING = 2


def walk(world: World, name: str, count: int) -> Cameras:
    """One turn around an object at an arm's height, the hand swaying slowly by a degree or two."""
    low, high = world.bounds(name)
    middle, size = (low + high) / 2, float(np.linalg.norm(high - low))
    distance = 1.25 * FOCAL * size / HEIGHT
    rotations, centres = [], []
    for turn in 2 * np.pi * np.arange(count) / count:
        up = np.radians(ELEVATION_DEG + 2 * np.sin(3 * turn))
        away = distance * (1 + 0.03 * np.sin(2 * turn))
        centre = middle + away * np.array([np.cos(up) * np.cos(turn), np.cos(up) * np.sin(turn), np.sin(up)])
        target = middle + 0.01 * distance * np.array([np.sin(5 * turn), np.cos(4 * turn), np.sin(7 * turn)])
        rotations.append(look_at(centre, target, np.array([0.0, 0.0, 1.0])))
        centres.append(centre)
    names = [f"{name}_{index:04d}.jpg" for index in range(count)]
    return Cameras(names, pinhole(FOCAL, WIDTH, HEIGHT), WIDTH, HEIGHT, np.array(rotations), np.array(centres))


def filmed(world: World, name: str, cameras: Cameras, hold_out_every: int, seed: int) -> tuple[Views, Array]:
    """The frames with true masks and cameras, and the true depth (V, H, W) of the object in metres, NaN beside it."""
    textures.set_threads(threads())
    open_sky, fine, coarse = openness(world, 24, seed), cameras.rays(SUPERSAMPLING), cameras.rays(1)
    owner, images, mattes, depths = world.owner(name), [], [], []
    for index in range(len(cameras.names)):
        rng = np.random.default_rng([seed, owner, index])
        light, owners = render(world, cameras, index, fine, open_sky, CAMERA.haze)
        images.append(bodies.expose(light, CAMERA, bodies.draw_exposure(CAMERA, rng), cameras, rng))
        mattes.append(np.rint(255 * (owners == owner).mean(-1)).astype(np.uint8))
        depths.append(np.where(mattes[-1] > 127, depth_of(world, cameras, index, coarse), np.nan))
    poses = np.tile(np.eye(4), (len(images), 1, 1))
    poses[:, :3, :3], poses[:, :3, 3] = cameras.cam_from_world.swapaxes(1, 2), cameras.centres
    held_out = np.arange(len(images)) % hold_out_every == hold_out_every - 1
    k = np.repeat(cameras.intrinsics[None], len(images), 0)
    matte, nothing = np.stack(mattes), (np.zeros((0, 3)), [np.zeros(0, np.int64)] * len(images))
    views = Views(cameras.names, np.stack(images), matte, np.zeros(matte.shape, bool), k, poses, held_out, *nothing)
    return views, np.stack(depths)


def depth_of(world: World, cameras: Cameras, index: int, in_cam: Array) -> Array:
    """(H, W) depth along the optical axis of what the middles of the pixels show, metres."""
    rays = np.empty((len(in_cam), 6), dtype=np.float32)
    textures.world_rays(rays, cameras.centres[index], np.ascontiguousarray(cameras.cam_from_world[index].T), in_cam)
    away = world.scene.cast_rays(o3d.core.Tensor.from_numpy(rays))["t_hit"].numpy()
    return (away / np.hypot(1.0, np.linalg.norm(in_cam, axis=1))).reshape(cameras.height, cameras.width)


def learned(views: Views, true: Array, diagonal: float, epochs: int, seed: int) -> dict[str, Any]:
    """Train stage 1, and measure it: degrees, shares of the trajectory's extent, % of the object's diagonal."""
    start = time.monotonic()
    device = prepare_torch(seed)
    frames, networks = frames_of(views, device), new_monocular_networks(device)
    recipe = Recipe(epochs)
    objective = monocular_losses(networks, frames, recipe)
    with tempfile.TemporaryDirectory() as folder:
        optimise(networks.parts(), frames, objective, recipe, Path(folder) / "state.pt", seed)
    own = chained(networks.pose, frames)
    motions = pose_quantities(networks.pose, frames, unit_of(own, views.object_from_cam))
    chain = trajectory_error("chain", own, views.object_from_cam)
    raw = predict(networks.depth, frames)
    depth = raw[:, 0].cpu().numpy().astype(np.float64)
    return {
        "steps": recipe.steps(frames),
        "one_motion_deg": value(motions, "pose_network_rotation_error_deg"),
        "one_motion_null_deg": value(motions, "pose_network_rotation_to_find_deg"),
        "trajectory": value(chain, "trajectory_error_chain_over_extent") if chain else None,
        "trajectory_null": spread(views.object_from_cam[:, :3, 3]),
        "cameras_deg": value(chain, "rotation_error_chain_deg") if chain else None,
        "depth_pct": 100 * depth_error(depth, true) / diagonal,
        "depth_null_pct": 100 * depth_error(np.ones_like(true), true) / diagonal,
        "seconds": round(time.monotonic() - start),
    }


def unit_of(own: Array, true: Array) -> Array:
    """True poses (V, 4, 4) in the unit of the networks, as far as one similarity finds it; in metres otherwise."""
    try:
        scale = fit_sim3(own[:, :3, 3], true[:, :3, 3]).scale
    except ValueError:
        return true
    scaled = true.copy()
    scaled[:, :3, 3] /= scale
    return scaled


def spread(centres: Array) -> float:
    """Root mean square distance of positions (V, 3) from their mean, over their extent."""
    off = np.linalg.norm(centres - centres.mean(0), axis=1)
    return float(np.sqrt(np.mean(off**2)) / np.linalg.norm(np.ptp(centres, axis=0)))


def depth_error(found: Array, true: Array) -> float:
    """Median error of depths (V, H, W), each frame brought to the true scale by the median ratio."""
    errors = []
    for ours, known in zip(found, true):
        on = np.isfinite(known)
        errors.append(np.abs(ours[on] * np.median(known[on] / ours[on]) - known[on]))
    return float(np.median(np.concatenate(errors)))


def paper_video(
    *,
    name: str = "house",
    frames: tuple[int, ...] = (40, 120, 360),
    epochs: tuple[int, ...] = (15,),
    hold_out_every: int = 8,
    table: Path | None = None,
    seed: int = 0,
) -> None:
    """Film an object of the demo all around, train the paper's stage 1 on the video, and print a row a training.

    Args:
        name: house, balloon or sculpture.
        frames: of the videos, each one turn.
        epochs: of the trainings; the paper's 60 in all leave 15 for stage 1.
        hold_out_every: every n-th frame is not trained on, as in the workflow.
        table: TSV that the rows are written to, when all are there.
        seed: of the world, exposures, weights and batches.
    """
    world, rows = build_world(seed), []
    diagonal = float(np.linalg.norm(np.ptp(world.mesh(world.owner(name))[0], axis=0)))
    for count in frames:
        views, true = filmed(world, name, walk(world, name, count), hold_out_every, seed)
        turned = Rotation.from_matrix(views.object_from_cam[:, :3, :3])
        step = float(np.degrees(np.median((turned[:-1].inv() * turned[1:]).magnitude())))
        for length in epochs:
            of = {"object": name, "frames": count, "step_deg": round(step, 2), "epochs": length}
            rows.append(of | learned(views, true, diagonal, length, seed))
            print(pd.DataFrame(rows[-1:]).to_string(index=False, float_format="%.4g"), flush=True)
    if table is not None:
        table.parent.mkdir(parents=True, exist_ok=True)
        pd.DataFrame(rows).to_csv(table, sep="\t", index=False, float_format="%.4g")


if __name__ == "__main__":
    run(paper_video)

"""Stage 1 by the paper: self-supervised depth and pose networks, and poses chained from the latter.

The chain, frame after frame, is brought into the frame that masks and registration use.
"""

import shutil
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from scenefuse.core.checkpoints import key_of
from scenefuse.core.stage import StageError, atomic_directory, quantity, value, write_json
from scenefuse.core.transforms import Array, Sim3, fit_sim3, rotation_angle_deg
from scenefuse.nerf.rendered_maps import DepthPrior, read_stage_maps, write_prior
from scenefuse.nerf.train_object_nerf import MIN_CONFIDENCE
from scenefuse.paper import monocular
from scenefuse.paper.depth_photos import DepthPhotos, align_maps, depth_photos, depths_at
from scenefuse.paper.monocular import Content, MonocularSettings, Networks
from scenefuse.paper.network_training import Recipe, loss_quantities, optimise, predict, prepare_torch
from scenefuse.photos.views import Views, load_views
from scenefuse.photos.workspace import read_workspace, write_model
from scenefuse.sfm.gravity import estimate_up


@torch.no_grad()
def chained(network: monocular.PoseNetwork, frames: DepthPhotos) -> Array:
    """(V, 4, 4) poses in the frame of the first camera: the motions between consecutive frames one after the other."""
    small = monocular.small_photos(frames)
    motions: Tensor = network(small[:-1], small[1:])
    poses = [np.eye(4)]
    for next_from_this in motions.double().cpu().numpy():
        poses.append(poses[-1] @ np.linalg.inv(next_from_this))
    return np.stack(poses)


def place_chain(own: Array, known: Array) -> tuple[Array, Sim3]:
    """Lay a chain (V, 4, 4) on SfM's poses (V, 4, 4) by one similarity: masks and gravity count in their frame.

    Returns:
        (V, 4, 4) object_from_cam, and object_from_first; its scale is object units per unit of the networks.

    Raises:
        StageError: the chain does not move, or along one line only.
    """
    try:
        fit = fit_sim3(own[:, :3, 3], known[:, :3, 3])
    except ValueError as error:
        raise StageError(
            f"the pose network's motions make no trajectory around the object ({error}): either it has learned no "
            "motion from these frames, or the camera moved along one line; walk around the object, or set "
            "object.stage1.pose_source to sfm, which runs the later stages from SfM's poses"
        ) from None
    placed = own.copy()
    placed[:, :3, :3], placed[:, :3, 3] = fit.rotation @ own[:, :3, :3], fit.apply(own[:, :3, 3])
    return placed, fit


def trajectory_error(name: str, poses: Array, reference: Array) -> Content:
    """Errors of (V, 4, 4) poses against others after a similarity fitted to the centres; nothing when they coincide."""
    centres, target = poses[:, :3, 3], reference[:, :3, 3]
    try:
        placed = fit_sim3(centres, target)
    except ValueError:
        return {}
    error = np.linalg.norm(placed.apply(centres) - target, axis=1)
    turned = placed.rotation @ poses[:, :3, :3] @ reference[:, :3, :3].swapaxes(1, 2)
    extent = float(np.linalg.norm(np.ptp(target, axis=0)))
    return {
        f"trajectory_error_{name}_over_extent": quantity(float(np.sqrt(np.mean(error**2))) / extent, "1"),
        f"rotation_error_{name}_deg": quantity(float(np.median([rotation_angle_deg(r) for r in turned])), "deg"),
    }


def write_posed(workspace: Path, posed: Path, views: Views, poses: Array) -> None:
    """Write a copy of an undistorted workspace with these poses (V, 4, 4) object_from_cam, and without points."""
    cameras = {view.name: view for view in read_workspace(workspace).views}
    moved = [replace(cameras[name], cam_from_world=np.linalg.inv(pose)) for name, pose in zip(views.names, poses)]
    with atomic_directory(posed) as folder:
        left_out = shutil.ignore_patterns("sparse", ".snakemake_timestamp")
        shutil.copytree(workspace, folder, ignore=left_out, dirs_exist_ok=True)
        (folder / "sparse").mkdir()
        write_model(folder / "sparse", moved)


def chain_quantities(own: Array, known: Array, used: Array, pose_source: str) -> Content:
    """How far a chain is from SfM's poses, all (V, 4, 4), and what later stages read of those that are used."""
    error = trajectory_error("chain", own, known)
    return {
        "pose_source": quantity(pose_source, ""),
        "up_in_camera_frame": quantity(estimate_up(used[:, :3, :3], used[:, :3, 3])[0], "1"),
        **error,
    }


PoseSource = Literal["chain", "sfm"]


@dataclass(frozen=True)
class StageOutputs:
    """What stages 1 and 3 write."""

    stage: Path
    """Folder: depth_maps/{photo}.bin, confidence_maps/{photo}.bin (1 wherever there is a depth) and networks.pt."""
    report: Path
    """JSON."""
    posed: Path
    """COLMAP workspace with the poses that later stages read."""
    posed_json: Path
    """Its JSON: whose poses these are, how far the chain is from SfM's, `up_in_camera_frame`."""


@dataclass(frozen=True)
class Placed:
    """What the networks say, in the object's frame.

    Attributes:
        chain: (V, 4, 4) first_from_cam of the pose network, in its unit.
        poses: (V, 4, 4) object_from_cam that later stages use: the chain's or SfM's.
        depth: (V, 1, H, W) in object units.
        unit: object units per unit of the networks.
        measured: the photos at these poses, with SfM's points to measure residuals at.
    """

    chain: Array
    poses: Array
    depth: Tensor
    unit: float
    measured: DepthPhotos


def estimate_as_paper(
    *,
    workspace: Path,
    masks: Path,
    outputs: StageOutputs,
    checkpoints: Path,
    settings: MonocularSettings,
    pose_source: PoseSource,
    hold_out_every: int,
    seed: int,
) -> None:
    """Train depth and pose networks on the frames of a monocular video (paper 4.2.2, stage 1).

    Of the workspace only frames and intrinsics are used. SfM's poses serve to bring the chain into the frame of masks
    and gravity by one similarity, and to say how far off it is. With `pose_source` sfm the later stages get SfM's poses
    instead, and each depth map is laid on the SfM points of its frame by a robust scale and shift (method N1).

    Args:
        workspace: undistorted COLMAP workspace of the object.
        masks: folder of masks named like the photos, .png.
        outputs: see StageOutputs.
        checkpoints: folder for training states; a killed run resumes from it.
        settings: of the training.
        pose_source: whose poses the later stages use.
        hold_out_every: every n-th frame is not trained on; 0 holds out none.
        seed: of weights and batches.

    Raises:
        StageError: fewer than three frames, frames without motion, fewer than eight SfM points on the object to measure
            with, a chain that does not move, or a training that diverged.
    """
    device = prepare_torch(seed)
    views = load_views(workspace, masks, settings.width_px, hold_out_every)
    frames, networks = monocular.frames_of(views, device), monocular.new_monocular_networks(device)
    content = few_frames(int(frames.trained.sum()))
    stage = Stage(workspace, outputs, checkpoints, views, frames, pose_source, seed)
    stage.run(networks, settings.epochs, content)


def few_frames(count: int) -> Content:
    """A note where there are fewer frames than the paper's batch holds."""
    notes = []
    if count < Recipe.batch_photos:
        notes = [f"{count} frames are fewer than the paper's batch of {Recipe.batch_photos}: a batch holds all of them"]
        print(notes[0], flush=True)
    return {"notes": quantity(notes, "")}


@dataclass(frozen=True)
class Stage:
    """What stages 1 and 3 have in common: networks are trained on frames, and what they say is written.

    Attributes:
        workspace: undistorted COLMAP workspace of the object.
        outputs: see StageOutputs.
        checkpoints: folder for training states.
        views: the frames with SfM's poses.
        frames: the same without any pose.
        pose_source: whose poses the later stages use.
        seed: of the batches.
    """

    workspace: Path
    outputs: StageOutputs
    checkpoints: Path
    views: Views
    frames: DepthPhotos
    pose_source: PoseSource
    seed: int

    def run(
        self, networks: Networks, epochs: int, content: Content, known: tuple[Tensor, Tensor] | None = None
    ) -> None:
        """Train, write depth maps, networks, poses and the report, with `content`; `known` as of `monocular_losses`."""
        start, recipe = time.monotonic(), Recipe(epochs)
        print(f"{len(self.views.names)} frames, {recipe.steps(self.frames)} steps", flush=True)
        key = key_of("paper", recipe, self.seed, self.frames, known, networks.state())
        checkpoint = self.checkpoints / key / "state.pt"
        objective = monocular.monocular_losses(networks, self.frames, recipe, known)
        losses = optimise(networks.parts(), self.frames, objective, recipe, checkpoint, self.seed)
        raw = predict(networks.depth, self.frames)
        placed = place(raw, networks, self.frames, self.views, self.pose_source)
        depth, poses = placed.depth * placed.measured.masks, self.views.object_from_cam
        maps = depth[:, 0].cpu().numpy()
        with atomic_directory(self.outputs.stage) as folder:
            write_prior(folder, self.views, DepthPrior(maps, (maps > 0).astype(np.float32)))
            monocular.save_networks(folder / "networks.pt", networks, maps.shape[2], placed.unit)
        write_posed(self.workspace, self.outputs.posed, self.views, placed.poses)
        chain = chain_quantities(placed.chain, poses, placed.poses, self.pose_source)
        write_json(self.outputs.posed_json, chain)
        content |= {
            "steps": quantity(recipe.steps(self.frames), "1"),
            **{name: part for name, part in chain.items() if name != "up_in_camera_frame"},
            "unit": quantity(placed.unit, "object units per unit of the networks"),
            **monocular.map_quantities(depth, placed.measured),
            **loss_quantities(losses),
            **monocular.pose_quantities(networks.pose, self.frames, in_unit(poses, placed.unit)),
            "seconds": quantity(round(time.monotonic() - start, 1), "s"),
        }
        write_json(self.outputs.report, content)
        checkpoint.unlink(missing_ok=True)
        print(f"depth maps written: {value(content, 'consistent_share'):.0%} agree with another view", flush=True)


def place(raw: Tensor, networks: Networks, frames: DepthPhotos, views: Views, pose_source: PoseSource) -> Placed:
    """Depths (V, 1, H, W) and poses of the networks in the object's frame; errors as of `estimate_as_paper`."""
    chain = chained(networks.pose, frames)
    if pose_source == "chain":
        poses, object_from_first = place_chain(chain, views.object_from_cam)
        unit = object_from_first.scale
        return Placed(chain, poses, raw * unit, unit, photos_at(poses, views, frames))
    known = photos_at(views.object_from_cam, views, frames)
    unit = median_ratio(raw, known)
    return Placed(chain, views.object_from_cam, align_maps(raw * unit, known), unit, known)


def photos_at(poses: Array, views: Views, frames: DepthPhotos) -> DepthPhotos:
    """The frames at poses (V, 4, 4) object_from_cam, with SfM's points, to measure with."""
    device = frames.images.device
    known = depth_photos(views, frames.sources.shape[1], device)
    at = torch.as_tensor(poses, dtype=torch.float32, device=device)
    return replace(known, object_from_cam=at, sources=frames.sources)


def median_ratio(raw: Tensor, known: DepthPhotos) -> float:
    """Depth of SfM points over that of the maps, the median of all frames."""
    pairs = zip(known.points, depths_at(raw, known.points))
    return float(np.median(np.concatenate([points[:, 2] / found for points, found in pairs])))


def in_unit(poses: Array, unit: float) -> Array:
    """Poses (V, 4, 4) with their centres in units of the networks."""
    scaled = poses.copy()
    scaled[:, :3, 3] /= unit
    return scaled


@dataclass(frozen=True)
class EarlierStages:
    """What stage 3 starts from."""

    previous: Path
    """Stage 1's folder."""
    rendered: Path
    """Stage 2's folder, with depth_maps/ and confidence_maps/."""


def refine_as_paper(
    *,
    workspace: Path,
    masks: Path,
    poses: Path,
    earlier: EarlierStages,
    outputs: StageOutputs,
    checkpoints: Path,
    settings: MonocularSettings,
    pose_source: PoseSource,
    hold_out_every: int,
    seed: int,
) -> None:
    """Refine both networks of stage 1 on rendered and predicted depth, and chain the poses again (4.2.2, stage 3).

    Both depths are blended by inverse variance where views agree (method N12). The blend is the depth network's target,
    and what the pose network's motions are judged by. What is written is the refined networks' depth and poses: nothing
    is chosen by held-out photos.

    Args:
        workspace: undistorted COLMAP workspace of the object.
        masks: folder of masks named like the photos, .png.
        poses: workspace with the poses that stages 1 and 2 used.
        earlier: folders of stages 1 and 2.
        outputs: see StageOutputs.
        checkpoints: folder for training states; a killed run resumes from it.
        settings: of the training.
        pose_source: as in stage 1.
        hold_out_every: as in stage 1.
        seed: of the batches.

    Raises:
        StageError: stage 1's folder holds no networks, stage 2's no depth map of any photo, or as in stage 1.
    """
    device = prepare_torch(seed)
    networks, width_px, unit = monocular.load_networks(earlier.previous / "networks.pt", device)
    views, used = (load_views(folder, masks, width_px, hold_out_every) for folder in (workspace, poses))
    frames = monocular.frames_of(views, device)
    measured = photos_at(used.object_from_cam, views, frames)
    depth, weight, shares = monocular.blend_depths(*_depths(earlier, views, device), measured)
    print(f"accepted {shares['accepted_share']:.0%} of the object's pixels", flush=True)
    content = {name: quantity(share, "1") for name, share in shares.items()}
    stage = Stage(workspace, outputs, checkpoints, views, frames, pose_source, seed)
    stage.run(networks, settings.epochs, content, (depth / unit, weight))


def _depths(earlier: EarlierStages, views: Views, device: torch.device) -> tuple[Tensor, Tensor]:
    """(V, 1, H, W) depths of stage 1, and those of stage 2 that are confident; an error where the latter has none."""
    rendered = read_stage_maps(earlier.rendered / "depth_maps", views)
    if not rendered.any():
        raise StageError(f"{earlier.rendered}/depth_maps holds no depth for any photo of the object; run stage 2 again")
    confident = read_stage_maps(earlier.rendered / "confidence_maps", views) >= MIN_CONFIDENCE
    found = read_stage_maps(earlier.previous / "depth_maps", views), rendered * confident * views.masks
    predicted, kept = (torch.from_numpy(maps.astype(np.float32))[:, None].to(device) for maps in found)
    return predicted, kept

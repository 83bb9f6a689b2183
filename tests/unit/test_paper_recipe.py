"""The paper's stages by its letter: their constants, what the networks learn, poses chained from motions, bad input."""

from dataclasses import replace

import cv2
import numpy as np
import pycolmap
import pytest
import torch
from support.painted_sphere import CENTER, RADIUS, sphere_views
from support.sideways_video import SHIFT_PX, sideways_video
from support.textured_plane import plane_views

from scenefuse.core.settings import ROOT, read_settings
from scenefuse.core.stage import StageError, read_json, value
from scenefuse.core.transforms import Sim3, rotation_between
from scenefuse.nerf.field import FieldSettings
from scenefuse.nerf.rays import LossWeights
from scenefuse.nerf.train_object_nerf import NerfSettings
from scenefuse.nerf.training import NerfRecipe, Schedule
from scenefuse.paper import network_training as training
from scenefuse.paper import train_nerf_as_paper as nerf_stage
from scenefuse.paper.estimate_as_paper import (
    EarlierStages,
    StageOutputs,
    chained,
    estimate_as_paper,
    few_frames,
    place,
    place_chain,
    refine_as_paper,
    trajectory_error,
)
from scenefuse.paper.monocular import (
    MonocularSettings,
    frames_of,
    load_networks,
    monocular_losses,
    neighbours,
    new_monocular_networks,
    small_photos,
)
from scenefuse.paper.network_training import Recipe, optimise, predict
from scenefuse.paper.train_nerf_as_paper import RANK_WEIGHT, as_paper, train_nerf_as_paper
from scenefuse.photos.workspace import View, read_workspace
from scenefuse.sfm import colmap, matches
from scenefuse.sfm.lens import KNOWN

CPU = torch.device("cpu")


def test_the_constants_are_the_papers():
    nerf, depth = nerf_stage.NERF, Recipe(15)
    assert (nerf.learning_rate, nerf.grid_learning_rate, training.LEARNING_RATE) == (1e-3, 1e-3, 1e-3)
    assert (nerf.warmup_epochs, depth.warmup_epochs) == (2, 2)
    assert (nerf.images_per_batch, depth.batch_photos) == (24, 24)
    assert FieldSettings(levels=16, log2_table=19, finest=2048, width=64) == nerf_stage.FIELD
    assert nerf == NerfRecipe(
        images_per_batch=24, rays_per_image=170, warmup_epochs=2, learning_rate=1e-3, grid_learning_rate=1e-3,
        coarse_until=0.0, prior_share=0.0, turned_share=0.0, appearance=False,
    )  # fmt: skip
    assert RANK_WEIGHT > 0 and LossWeights().depth_weight > 0 and training.SMOOTHNESS_WEIGHT == 1e-3
    preset = read_settings(ROOT / "config/paper.yaml")
    assert sum(preset["object"][f"stage{number}"]["epochs"] for number in (1, 2, 3, 4)) == 60
    assert preset["scene"]["depth_maps"] | {"max_image_size_px": 2000, "sources": 8} == preset["scene"]["depth_maps"]
    assert preset["object"]["recipe"] == "paper" and preset["object"]["stage1"]["pose_source"] == "chain"
    crop = preset["registration"]["crop"]
    box = {"mode": "fiducials", "margin": 0, "remove_ground": False}
    assert crop | box == crop and preset["fusion"]["mode"] == "append"
    assert preset["registration"]["variants"] == ["full", "no_scale", "no_crop"]
    assert preset["object"]["masks"]["method"] == "sam2"


def test_the_constants_of_sfm_are_the_papers_but_for_the_gain_that_ends_an_adjustment():
    own = read_settings(ROOT / "config/paper.yaml")["scene"]
    assert (own["matches"]["max_ratio"], matches.MAX_DISTANCE, own["matches"]["guided_matching"]) == (0.7, 0.7, True)
    options = colmap.adjustment_options(KNOWN.freedom).ceres.solver_options
    assert (options.max_num_iterations, options.max_linear_solver_iterations) == (100, 200)
    assert (options.gradient_tolerance, options.parameter_tolerance) == (0, 0)
    assert options.function_tolerance == colmap.ADJUSTMENT_TOLERANCE


def test_the_papers_field_and_rays_are_taken_on_a_gpu_and_those_of_the_settings_on_a_cpu():
    settings = NerfSettings(field=FieldSettings(levels=4))
    on_gpu, on_cpu = (as_paper(settings, 900_000, device) for device in ("cuda", "cpu"))
    assert (on_gpu.field, on_gpu.schedule.rays_per_epoch) == (nerf_stage.FIELD, 900_000)
    assert (on_cpu.field, on_cpu.schedule.rays_per_epoch) == (settings.field, settings.schedule.rays_per_epoch)
    assert as_paper(settings, 500, "cpu").schedule.rays_per_epoch == 500
    assert on_cpu.recipe is nerf_stage.NERF


@pytest.mark.slow
def test_a_batch_holds_24_frames_and_the_last_one_the_rest(tmp_path):
    frames, sizes = frames_of(sideways_video(60), CPU), []

    def losses(chosen, step, generator):
        sizes.append(len(chosen))
        nothing = sum(p.sum() for p in networks.depth.parameters()) * 0
        return {"photometric": nothing, "smoothness": nothing}

    networks = new_monocular_networks(CPU)
    optimise(networks.parts(), frames, losses, Recipe(2), tmp_path / "state.pt", 0)
    assert sizes == [24, 24, 11] * 2  # of 60, one is held out


def test_where_nothing_moves_with_the_camera_nothing_is_learned():
    """The auto-mask: what looks the same in the next frame as it stands is left out, at full size."""
    video = sideways_video()
    stuck = video.images.copy()
    stuck[:, :, :32] = stuck[0, :, :32]  # as a sticker on the lens
    frames = frames_of(replace(video, images=stuck), CPU)
    networks, length = new_monocular_networks(CPU), Recipe(3, 1)
    objective, chosen = monocular_losses(networks, frames, length), torch.arange(3)
    last = length.steps(frames) - 1  # the full size
    masked = objective(chosen, last, torch.Generator())["photometric"]
    beside = replace(frames, masks=frames.masks.clone())
    beside.masks[..., :32] = 0
    alone = monocular_losses(networks, beside, length)(chosen, last, torch.Generator())
    assert float(masked) == pytest.approx(float(alone["photometric"]), rel=0.15)


def _trained(frames, path, epochs=30, known=None):
    """Networks trained on frames, and their losses."""
    torch.manual_seed(0)
    networks, length = new_monocular_networks(CPU), Recipe(epochs, 2)
    objective = monocular_losses(networks, frames, length, known)
    losses = optimise(networks.parts(), frames, objective, length, path, 0)
    return networks, losses


@torch.no_grad()
def _shifts_px(networks, frames):
    """Columns by which depth and motion together move the middle of each frame into the next."""
    small = small_photos(frames)
    motion = networks.pose(small[:-1], small[1:])
    depth = predict(networks.depth, frames)
    middle = torch.zeros(len(small) - 1, 3)
    middle[:, 2] = depth[:-1, 0, depth.shape[2] // 2, depth.shape[3] // 2]
    moved = (motion[:, :3, :3] @ middle[:, :, None])[..., 0] + motion[:, :3, 3]
    return frames.intrinsics[0, 0, 0] * moved[:, 0] / moved[:, 2]


@pytest.mark.slow
def test_depth_and_motion_are_learned_from_a_video_alone(tmp_path):
    frames = frames_of(sideways_video(), CPU)
    networks, losses = _trained(frames, tmp_path / "state.pt")
    assert losses[-1]["photometric"] < 0.2 * losses[0]["photometric"]
    assert float(_shifts_px(networks, frames).median()) == pytest.approx(-SHIFT_PX, abs=0.5)


@pytest.mark.slow
def test_fused_depth_refines_the_depth_network_however_far_off_it_is(tmp_path, wanted=0.7):
    """The video alone leaves it at 1.35, where depth and motion fit each other at any scale."""
    frames = frames_of(sideways_video(), CPU)
    target, weight = torch.full_like(frames.masks, wanted), torch.ones_like(frames.masks)
    networks, losses = _trained(frames, tmp_path / "state.pt", known=(target, weight))
    depth = predict(networks.depth, frames)
    assert torch.median((depth - wanted).abs()) < 0.05 and losses[-1]["target"] < 0.05 * losses[0]["target"]
    assert float(_shifts_px(networks, frames).median()) == pytest.approx(-SHIFT_PX, abs=0.5)


def test_fused_depth_teaches_the_pose_network_what_the_frames_look_like_through_it():
    frames = frames_of(sideways_video(), CPU)
    target, weight = torch.full_like(frames.masks, 1.4), torch.ones_like(frames.masks)
    networks, length = new_monocular_networks(CPU), Recipe(1, 1)
    objective = monocular_losses(networks, frames, length, (target, weight))
    objective(torch.arange(3), 0, torch.Generator())["pose"].backward()
    slope = {
        name: sum(float(p.grad.abs().sum()) for p in getattr(networks, name).parameters() if p.grad is not None)
        for name in ("depth", "pose")
    }
    assert slope["depth"] == 0 and slope["pose"] > 0


def test_every_step_moves_both_networks(tmp_path):
    frames = frames_of(sideways_video(), CPU)
    known = torch.full_like(frames.masks, 1.4), torch.ones_like(frames.masks)
    networks, length = new_monocular_networks(CPU), Recipe(2, 1)
    before = {name: [part.clone() for part in network.parameters()] for name, network in networks.parts().items()}
    objective = monocular_losses(networks, frames, length, known)
    optimise(networks.parts(), frames, objective, length, tmp_path / "state.pt", 0)
    for name, network in networks.parts().items():
        assert any(not torch.equal(a, b) for a, b in zip(before[name], network.parameters()))


class Known(torch.nn.Module):
    """A pose network that says what it is told."""

    def __init__(self, motions):
        super().__init__()
        self.motions = motions

    def forward(self, target, source):
        return self.motions


def _orbit(count=12):
    """(V, 4, 4) world_from_cam of cameras that look at the origin from a circle."""
    poses = np.tile(np.eye(4), (count, 1, 1))
    for index, angle in enumerate(np.linspace(0, 2, count)):
        poses[index, :3, 3] = [np.cos(angle), np.sin(angle), 0.1 * angle]
        poses[index, :3, :3] = rotation_between(np.array([0.0, 0.0, 1.0]), -poses[index, :3, 3])
    return poses


def test_a_chain_of_true_motions_is_the_trajectory_and_a_similarity_places_it():
    poses, fit = _orbit(), Sim3(2.5, rotation_between(np.array([1.0, 0, 0]), np.array([0, 0.6, 0.8])), np.ones(3))
    frames = frames_of(sideways_video(len(poses)), CPU)
    motions = torch.as_tensor(np.linalg.inv(poses[1:]) @ poses[:-1])
    own = chained(Known(motions), frames)
    assert np.allclose(own, np.linalg.inv(poses[0]) @ poses, atol=1e-6)
    known = poses.copy()
    known[:, :3, :3], known[:, :3, 3] = fit.rotation @ poses[:, :3, :3], fit.apply(poses[:, :3, 3])
    placed, object_from_first = place_chain(own, known)
    assert np.allclose(placed, known, atol=1e-6) and object_from_first.scale == pytest.approx(2.5)
    own[:, :3, :3] = own[:, :3, :3] @ rotation_between(np.array([1.0, 0, 0]), np.array([np.cos(0.1), np.sin(0.1), 0]))
    error = trajectory_error("chain", own, known)
    assert value(error, "trajectory_error_chain_over_extent") == pytest.approx(0, abs=1e-9)
    assert value(error, "rotation_error_chain_deg") == pytest.approx(np.degrees(0.1))
    assert trajectory_error("chain", np.tile(np.eye(4), (len(own), 1, 1)), known) == {}


@pytest.mark.parametrize("source", ["chain", "sfm"])
def test_depth_gets_the_unit_of_the_poses_that_go_on(source):
    views, truth = plane_views()
    frames, networks = frames_of(views, CPU), new_monocular_networks(CPU)
    unit = views.object_from_cam.copy()
    unit[:, :3, 3] /= 3.0
    motions = torch.as_tensor(np.linalg.inv(unit[1:]) @ unit[:-1])
    told = replace(networks, pose=Known(motions))
    raw = torch.tensor(np.where(truth > 0, truth, 3.0) / 3.0, dtype=torch.float32)[:, None]
    placed = place(raw, told, frames, views, source)
    assert placed.unit == pytest.approx(3.0, rel=0.02)
    on_object = torch.from_numpy(views.masks)[:, None]
    assert np.allclose(placed.depth[on_object].numpy(), truth[views.masks], rtol=0.02)
    assert np.allclose(placed.poses, views.object_from_cam, atol=1e-5)


def test_frames_are_compared_with_trained_ones_before_and_after_them():
    near = neighbours(np.array([True, True, False, True, True]))
    assert near.tolist() == [[1, 3], [0, 3], [1, 3], [1, 4], [3, 1]]


def test_bad_videos_are_one_sentence():
    with pytest.raises(StageError, match="looks the same in all frames.*walk around"):
        frames_of(sideways_video(step=0.0), CPU)
    views = sideways_video()
    with pytest.raises(StageError, match="only 2 frames .* needs at least 3"):
        frames_of(replace(views, held_out=np.arange(10) > 1), CPU)
    still = np.tile(np.eye(4), (5, 1, 1))
    with pytest.raises(StageError, match="no trajectory .* learned no motion .*pose_source to sfm"):
        place_chain(still, _orbit(5))


def test_fewer_frames_than_a_batch_are_said(capsys):
    assert value(few_frames(24), "notes") == []
    assert "23 frames are fewer than the paper's batch" in value(few_frames(23), "notes")[0]
    assert "23 frames" in capsys.readouterr().out


@pytest.fixture(scope="module")
def ball(tmp_path_factory):
    """A workspace of the painted sphere, with masks and some SfM points."""
    root = tmp_path_factory.mktemp("ball")
    images, masks, k, poses, depths = sphere_views()
    for folder in ("undistorted/images", "undistorted/sparse", "masks"):
        (root / folder).mkdir(parents=True)
    points = CENTER + RADIUS * (lambda x: x / np.linalg.norm(x, axis=1, keepdims=True))(
        np.random.default_rng(0).normal(size=(60, 3))
    )
    model = pycolmap.Reconstruction()
    size = images.shape[1]
    model.add_camera_with_trivial_rig(
        pycolmap.Camera(model="PINHOLE", width=size, height=size, params=[size, size, size / 2, size / 2], camera_id=1)
    )
    tracks: list[list[pycolmap.TrackElement]] = [[] for _ in points]
    for number, (image, mask, pose) in enumerate(zip(images, masks, poses), 1):
        name = f"{number:02d}.png"
        cv2.imwrite(str(root / "undistorted/images" / name), image[..., ::-1])
        cv2.imwrite(str(root / "masks" / name), mask.astype(np.uint8) * 255)
        view = View(name, k[0], np.linalg.inv(pose), size, size)
        seen = np.flatnonzero(((points - CENTER) * (pose[:3, 3] - points)).sum(1) > 0)
        at = [pycolmap.Point2D(pixel) for pixel in view.project(points)[0][seen]]
        taken = pycolmap.Image(name=name, camera_id=1, image_id=number, points2D=pycolmap.Point2DList(at))
        model.add_image_with_trivial_frame(taken, pycolmap.Rigid3d(view.cam_from_world[:3]))
        for place_in_photo, point in enumerate(seen):
            tracks[point].append(pycolmap.TrackElement(number, place_in_photo))
    for point, track in zip(points, tracks):
        model.add_point3D(point, pycolmap.Track(track), np.zeros(3, np.uint8))
    model.write(root / "undistorted/sparse")
    return root


@pytest.mark.slow
def test_stages_run_from_sfm_poses_and_stage_3_goes_on_from_the_networks_of_stage_1(ball, tmp_path, monkeypatch):
    # A hash grid learns too little in a test's few steps at the paper's rate.
    fast = replace(nerf_stage.NERF, learning_rate=1e-2, grid_learning_rate=2e-2, rays_per_image=20, occupancy_cells=32)
    monkeypatch.setattr(nerf_stage, "NERF", fast)
    given = {"masks": ball / "masks", "hold_out_every": 4, "seed": 0}

    def outputs(stage, posed):
        return StageOutputs(tmp_path / stage, tmp_path / f"{stage}.json", tmp_path / posed, tmp_path / f"{posed}.json")

    common = {"workspace": ball / "undistorted", "pose_source": "sfm", "checkpoints": tmp_path / "checkpoints"}
    estimate_as_paper(outputs=outputs("stage1", "poses"), settings=MonocularSettings(1), **common, **given)
    field = FieldSettings(levels=6, log2_table=12, coarsest=8, finest=64, width=16)
    train_nerf_as_paper(
        workspace=tmp_path / "poses", prior=tmp_path / "stage1", stage=tmp_path / "stage2",
        report=tmp_path / "stage2.json", checkpoints=tmp_path / "checkpoints",
        settings=NerfSettings(device="cpu", width_px=48, field=field, schedule=Schedule(4, 6000)), **given,
    )  # fmt: skip
    refine_as_paper(
        poses=tmp_path / "poses", earlier=EarlierStages(tmp_path / "stage1", tmp_path / "stage2"),
        outputs=outputs("stage3", "refined_poses"), settings=MonocularSettings(1), **common, **given,
    )  # fmt: skip
    first, nerf, refined = (read_json(tmp_path / f"{stage}.json") for stage in ("stage1", "stage2", "stage3"))
    assert value(first, "pose_source") == value(refined, "pose_source") == "sfm"
    assert "9 frames are fewer" in value(first, "notes")[0] and value(refined, "rendered_share") > 0
    assert value(refined, "target_loss_first") > 0 and value(refined, "pose_loss_first") > 0
    assert not value(nerf, "started_from_previous") and not value(nerf, "field_is_the_papers")
    assert value(nerf, "rays_per_epoch_paper") >= value(nerf, "rays_per_epoch") == 6000
    before, after = (load_networks(tmp_path / stage / "networks.pt", CPU)[0] for stage in ("stage1", "stage3"))
    for name, network in before.parts().items():
        steps = [float((a - b).abs().max()) for a, b in zip(network.parameters(), after.parts()[name].parameters())]
        assert 0 < max(steps) < 2 * training.LEARNING_RATE  # one step of Adam
    assert [view.name for view in read_workspace(tmp_path / "refined_poses").views][:2] == ["01.png", "02.png"]

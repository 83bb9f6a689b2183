"""The paper's depth network: every equation against values worked out by hand; trainings that are stopped or fail."""

import math
import os
import signal

import numpy as np
import pytest
import torch
from support.sideways_video import sideways_video

from scenefuse.core.stage import StageError
from scenefuse.paper.depth_photos import align_to_points
from scenefuse.paper.monocular import frames_of, monocular_losses, new_monocular_networks, rigid
from scenefuse.paper.monodepth import (
    NEAR,
    DepthNetwork,
    depth_from_disparity,
    minimum_reprojection,
    photometric_error,
    smoothness,
    ssim,
    warp,
)
from scenefuse.paper.network_training import Recipe, optimise

INTRINSICS = torch.tensor([[[40.0, 0.0, 24.0], [0.0, 40.0, 16.0], [0.0, 0.0, 1.0]]])


def test_warp_with_identity_pose_is_identity():
    image = torch.rand(1, 3, 32, 48)
    warped, valid = warp(image, torch.full((1, 1, 32, 48), 2.0), torch.eye(4)[None], INTRINSICS, INTRINSICS)
    assert torch.allclose(warped, image, atol=1e-5)
    assert valid[0, 0, 1:-1, 1:-1].all()


def test_warp_follows_the_homography_of_a_plane():
    # H = K (R + t n^T / d) K^-1 for the plane n^T X = d; z = 2 and a sideways step of 0.1: 40 * 0.1 / 2 = 2 pixels.
    image = torch.arange(48.0).expand(1, 1, 32, 48).contiguous()
    move = torch.eye(4)[None].clone()
    move[0, 0, 3] = 0.1
    warped, valid = warp(image, torch.full((1, 1, 32, 48), 2.0), move, INTRINSICS, INTRINSICS)
    assert torch.allclose(warped[0, 0, :, :44], image[0, 0, :, :44] + 2.0, atol=1e-4)
    assert not valid[0, 0, :, -2:].any() and valid[0, 0, 1:-1, 1:44].all()


def test_warp_with_rotation_matches_the_general_homography():
    move = rigid(torch.tensor([[0.02, -0.03, 0.05]]), torch.tensor([[0.05, 0.02, -0.1]]))
    normal, distance = torch.tensor([0.1, 0.2, 1.0]), 2.0
    homography = INTRINSICS[0] @ (move[0, :3, :3] + torch.outer(move[0, :3, 3], normal) / distance)
    homography = homography @ torch.linalg.inv(INTRINSICS[0])
    v, u = torch.meshgrid(torch.arange(32.0) + 0.5, torch.arange(48.0) + 0.5, indexing="ij")
    pixels = torch.stack([u, v, torch.ones_like(u)]).view(3, -1)
    depth = distance / (normal @ torch.linalg.inv(INTRINSICS[0]) @ pixels)
    expected = homography @ pixels
    expected = (expected[:2] / expected[2]).view(2, 32, 48)
    coordinates = torch.stack([u, v])[None]
    warped, valid = warp(coordinates, depth.view(1, 1, 32, 48), move, INTRINSICS, INTRINSICS)
    inner = valid[0, 0]
    assert inner.sum() > 1000
    assert torch.allclose(warped[0][:, inner], expected[:, inner], atol=1e-3)


def test_ssim_of_equal_images_is_one_and_of_flat_images_is_the_luminance_term():
    image = torch.rand(1, 3, 8, 8)
    assert torch.allclose(ssim(image, image), torch.ones(1, 3, 8, 8), atol=1e-4)
    dark, bright = torch.full((1, 3, 8, 8), 0.2), torch.full((1, 3, 8, 8), 0.4)
    luminance = (2 * 0.2 * 0.4 + 1e-4) / (0.2**2 + 0.4**2 + 1e-4)
    assert torch.allclose(ssim(dark, bright), torch.full((1, 3, 8, 8), luminance), atol=1e-3)
    expected = 0.85 * (1 - luminance) / 2 + 0.15 * 0.2
    assert torch.allclose(photometric_error(dark, bright), torch.full((1, 1, 8, 8), expected), atol=1e-3)


def test_minimum_reprojection_picks_the_smallest_valid_error_and_masks_what_did_not_move():
    errors = torch.tensor([[[[0.3, 0.2, 0.5]], [[0.1, 0.4, 0.5]]]])
    valid = torch.tensor([[[[True, True, False]], [[False, True, False]]]])
    smallest, counts = minimum_reprojection(errors, valid, None)
    assert torch.allclose(smallest[0, 0, 0], torch.tensor([0.3, 0.2, 0.0]))
    assert counts[0, 0, 0].tolist() == [True, True, False]
    unmoved = torch.tensor([[[[0.9, 0.15, 0.9]], [[0.8, 0.9, 0.9]]]])
    _, counts = minimum_reprojection(errors, valid, unmoved)
    assert counts[0, 0, 0].tolist() == [True, False, False]


def test_smoothness_by_hand():
    disparity = torch.tensor([[[[1.0, 3.0]]]]).repeat(1, 1, 2, 1)
    image = torch.tensor([0.0, 0.5]).expand(1, 3, 2, 2)
    # normalised by the mean 2: a step of 1, at an edge of 0.5
    assert smoothness(disparity, image, torch.ones(1, 1, 2, 2)).item() == pytest.approx(math.exp(-0.5), rel=1e-5)
    one_column = torch.tensor([[[[1.0, 0.0], [1.0, 0.0]]]])
    assert smoothness(disparity, image, one_column).item() == 0.0


def test_disparity_spans_the_range_of_depths():
    ends = depth_from_disparity(torch.tensor([0.0, 1.0]))
    assert torch.allclose(ends, torch.tensor([1 / NEAR, NEAR]))


def test_the_network_is_small_and_starts_from_a_depth_of_one():
    network = DepthNetwork()
    assert sum(weights.numel() for weights in network.parameters()) < 1_000_000
    depth = depth_from_disparity(network(torch.rand(2, 3, 33, 50)))
    assert torch.allclose(depth, torch.ones(2, 1, 33, 50), atol=1e-5)


def test_alignment_finds_a_planted_scale_and_shift_among_outliers():
    rng = np.random.default_rng(0)
    predicted = rng.uniform(2, 5, 200)
    measured = 1.7 * predicted - 0.6 + 0.002 * rng.standard_normal(200)
    measured[:60] = rng.uniform(1, 20, 60)
    scale, shift = align_to_points(predicted, measured)
    assert scale == pytest.approx(1.7, abs=0.005) and shift == pytest.approx(-0.6, abs=0.02)


def test_alignment_leaves_a_map_alone_that_is_right_but_for_noise():
    rng = np.random.default_rng(0)
    predicted = rng.uniform(2, 5, 20)
    assert align_to_points(predicted, predicted + 0.02 * rng.standard_normal(20)) == (1.0, 0.0)
    assert align_to_points(predicted[:3], 2 * predicted[:3]) == (1.0, 0.0)


RECIPE = Recipe(epochs=3, warmup_epochs=1, batch_photos=4)


def _train(checkpoint, frames, stop_at=None):
    """Trained networks and their losses; a SIGTERM comes in step `stop_at`."""
    torch.manual_seed(0)
    networks = new_monocular_networks(torch.device("cpu"))
    objective = monocular_losses(networks, frames, RECIPE)
    calls, original = iter(range(1000)), torch.optim.Adam.step

    def step(self, *args):
        if next(calls) == stop_at:
            os.kill(os.getpid(), signal.SIGTERM)
        return original(self, *args)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(torch.optim.Adam, "step", step)
        losses = optimise(networks.parts(), frames, objective, RECIPE, checkpoint, 3)
    return networks, losses


def _frames():
    return frames_of(sideways_video(8), torch.device("cpu"))


@pytest.fixture(scope="module")
def uninterrupted(tmp_path_factory):
    """The frames of a training, its networks and its losses."""
    frames = _frames()
    return frames, *_train(tmp_path_factory.mktemp("whole") / "state.pt", frames)


def test_a_resumed_training_equals_an_uninterrupted_one(tmp_path, uninterrupted, capsys):
    frames, whole, losses = uninterrupted
    with pytest.raises(SystemExit):
        _train(tmp_path / "b.pt", frames, stop_at=3)
    capsys.readouterr()
    resumed, again = _train(tmp_path / "b.pt", frames)
    assert "resuming at step 4" in capsys.readouterr().out
    assert losses == again
    for name, network in whole.parts().items():
        for a, b in zip(network.parameters(), resumed.parts()[name].parameters()):
            assert torch.equal(a, b)


def test_a_truncated_checkpoint_starts_the_training_afresh_and_says_so(tmp_path, uninterrupted, capsys):
    (frames, _, losses), checkpoint = uninterrupted, tmp_path / "state.pt"
    with pytest.raises(SystemExit):
        _train(checkpoint, frames, stop_at=2)
    checkpoint.write_bytes(checkpoint.read_bytes()[:1000])
    assert _train(checkpoint, frames)[1] == losses
    assert "training starts afresh" in capsys.readouterr().out


def test_a_diverged_training_is_one_sentence_and_saves_nothing(tmp_path):
    network, checkpoint = DepthNetwork(), tmp_path / "state.pt"

    def losses(chosen, step, generator):
        loss = network.last.bias.sum()
        return {"photometric": loss * torch.nan if step == 3 else loss}

    with pytest.raises(StageError, match="training diverged"):
        optimise({"depth": network}, _frames(), losses, RECIPE, checkpoint, 0)
    assert not checkpoint.exists()


def test_a_failed_save_does_not_end_the_training(tmp_path, uninterrupted, monkeypatch, capsys):
    frames, _, losses = uninterrupted
    monkeypatch.setattr("scenefuse.core.checkpoints.SAVE_EVERY_SECONDS", 0.0)
    monkeypatch.setattr(torch, "save", _full_disk)
    assert _train(tmp_path / "other/state.pt", frames)[1] == losses
    assert "could not be saved" in capsys.readouterr().out


def _full_disk(*_):
    raise OSError(28, "No space left on device")

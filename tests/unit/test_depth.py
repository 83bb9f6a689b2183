"""Stage 1: every equation against values worked out by hand, and one small training against a planted plane."""

import json
import math
import os
import signal
from dataclasses import replace

import numpy as np
import pytest
import torch
from support.textured_plane import plane_views, speckled

from scenefuse.core.stage import StageError
from scenefuse.nerf import train_depth as stage
from scenefuse.nerf.monodepth import (
    DepthNetwork,
    depth_from_disparity,
    disparity_from_depth,
    minimum_reprojection,
    photometric_error,
    smoothness,
    ssim,
    warp,
)
from scenefuse.nerf.prior_inputs import depth_photos, network_inputs
from scenefuse.nerf.prior_training import Recipe, predict, train_network
from scenefuse.nerf.train_depth import align_to_points
from scenefuse.paper.monocular import rigid
from scenefuse.photos.pictures import read_depth

INTRINSICS = torch.tensor([[[40.0, 0.0, 24.0], [0.0, 40.0, 16.0], [0.0, 0.0, 1.0]]])


# Depths of a plane of so few pixels differ by more than those of photos.
SETTINGS = stage.DepthTrainingSettings(2, crop_px=56, map_agreement=0.02)


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


def test_disparity_and_depth_are_inverse_and_span_the_range():
    ends = depth_from_disparity(torch.tensor([0.0, 1.0]), 2.0, 5.0)
    assert torch.allclose(ends, torch.tensor([5.0, 2.0]))
    depth = torch.tensor([2.0, 3.3, 5.0])
    assert torch.allclose(depth_from_disparity(disparity_from_depth(depth, 2.0, 5.0), 2.0, 5.0), depth, atol=1e-5)


def test_the_network_is_small_and_starts_from_the_first_disparity():
    network = DepthNetwork(9)
    assert sum(weights.numel() for weights in network.parameters()) < 1_000_000
    first = torch.rand(2, 1, 33, 50) * 0.8 + 0.1
    assert torch.allclose(network(torch.randn(2, 9, 33, 50), first), first, atol=1e-5)


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


def test_first_disparity_is_near_the_truth_and_sources_are_never_held_out():
    views, truth = plane_views()
    photos = depth_photos(views, 4, torch.device("cpu"))
    assert not np.isin(np.flatnonzero(views.held_out), photos.sources.numpy()).any()
    first = network_inputs(photos).first
    depth = depth_from_disparity(first, photos.near, photos.far).numpy()[:, 0]
    error = np.abs(depth - truth)[views.masks] / photos.diagonal
    assert np.median(error) < 0.005


def test_stereo_alone_is_near_the_truth():
    views, truth = plane_views(width=160, height=120)
    photos = depth_photos(speckled(views, truth), 4, torch.device("cpu"))
    channels = network_inputs(photos).channels
    depth = depth_from_disparity((channels[:, -2:-1] + 1) / 2, photos.near, photos.far).numpy()[:, 0]
    error = np.abs(depth - truth)[views.masks] / photos.diagonal
    assert np.median(error) < 0.003


RECIPE = Recipe(epochs=3, warmup_epochs=1, batch_photos=4)


def _train(checkpoint, photos, stop_at=None):
    """A trained network and its losses; a SIGTERM comes in step `stop_at`."""
    inputs = network_inputs(photos, None)
    torch.manual_seed(0)
    network = DepthNetwork(inputs.channels.shape[1])
    calls, original = iter(range(1000)), torch.optim.Adam.step

    def step(self, *args):
        if next(calls) == stop_at:
            os.kill(os.getpid(), signal.SIGTERM)
        return original(self, *args)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(torch.optim.Adam, "step", step)
        losses = train_network(network, photos, inputs, RECIPE, checkpoint, 3)
    return network, losses


def _photos():
    return depth_photos(plane_views(6)[0], 3, torch.device("cpu"))


@pytest.fixture(scope="module")
def uninterrupted(tmp_path_factory):
    """The photos of a training, its network and its losses."""
    photos = _photos()
    return photos, *_train(tmp_path_factory.mktemp("whole") / "state.pt", photos)


def test_training_mends_a_wrong_first_depth(tmp_path):
    views, truth = plane_views(6)
    photos = depth_photos(views, 3, torch.device("cpu"))
    inputs = network_inputs(photos, None)
    torch.manual_seed(0)
    network, wrong = DepthNetwork(inputs.channels.shape[1]), replace(inputs, first=inputs.first * 0.7)

    def depth_off():
        depth = predict(network, photos, wrong.channels, wrong.first)[:, 0].numpy()
        return np.median(np.abs(depth[views.masks] / truth[views.masks] - 1.0))

    before = depth_off()
    train_network(network, photos, wrong, Recipe(epochs=25, warmup_epochs=1, batch_photos=6), tmp_path / "state.pt", 0)
    assert depth_off() < 0.5 * before


def test_a_resumed_training_equals_an_uninterrupted_one(tmp_path, uninterrupted, capsys):
    photos, whole, losses = uninterrupted
    with pytest.raises(SystemExit):
        _train(tmp_path / "b.pt", photos, stop_at=3)
    capsys.readouterr()
    resumed, again = _train(tmp_path / "b.pt", photos)
    assert "resuming at step 4" in capsys.readouterr().out
    assert losses == again
    for a, b in zip(whole.parameters(), resumed.parameters()):
        assert torch.equal(a, b)


def test_a_truncated_checkpoint_starts_the_training_afresh_and_says_so(tmp_path, uninterrupted, capsys):
    (photos, _, losses), checkpoint = uninterrupted, tmp_path / "state.pt"
    with pytest.raises(SystemExit):
        _train(checkpoint, photos, stop_at=2)
    checkpoint.write_bytes(checkpoint.read_bytes()[:1000])
    assert _train(checkpoint, photos)[1] == losses
    assert "training starts afresh" in capsys.readouterr().out


def test_a_diverged_training_is_one_sentence_and_saves_nothing(tmp_path):
    photos, checkpoint = _photos(), tmp_path / "state.pt"
    photos.images[0, :, 20:30, 20:30] = torch.nan
    with pytest.raises(StageError, match="training diverged"):
        _train(checkpoint, photos, stop_at=2)
    assert not checkpoint.exists()


def test_a_failed_save_does_not_end_the_training(tmp_path, uninterrupted, monkeypatch, capsys):
    photos, _, losses = uninterrupted
    monkeypatch.setattr("scenefuse.core.checkpoints.SAVE_EVERY_SECONDS", 0.0)
    monkeypatch.setattr(torch, "save", _full_disk)
    assert _train(tmp_path / "other/state.pt", photos)[1] == losses
    assert "could not be saved" in capsys.readouterr().out


def _full_disk(*_):
    raise OSError(28, "No space left on device")


def _stage(tmp_path):
    stage.train_depth(
        workspace=tmp_path,
        masks=tmp_path,
        stage=tmp_path / "stage1",
        report=tmp_path / "stage1.json",
        checkpoints=tmp_path / "checkpoints",
        settings=SETTINGS,
        width_px=64,
        hold_out_every=8,
        seed=0,
    )


@pytest.mark.parametrize("what", ["held out", "poses", "intrinsics", "points", "torch"])
def test_a_checkpoint_of_other_inputs_is_not_resumed(tmp_path, monkeypatch, what):
    views, _ = plane_views()

    def killed(self, *args):
        raise SystemExit(143)

    monkeypatch.setattr(stage, "network_inputs", lambda photos: network_inputs(photos, None))

    def keys(views):
        monkeypatch.setattr(stage, "load_views", lambda *_: views)
        seen = []
        with monkeypatch.context() as patch:
            patch.setattr(stage, "train_network", lambda *given: seen.append(given[-2]) or killed(None))
            with pytest.raises(SystemExit):
                _stage(tmp_path)
        return seen[0]

    first = keys(views)
    assert keys(replace(views)) == first
    if what == "torch":
        monkeypatch.setattr(torch, "__version__", "0.0")
        assert keys(views) != first
        return
    turned = views.intrinsics.copy()
    turned[3, 0, 0] *= 1.0001
    other = {
        "held out": {"held_out": np.roll(views.held_out, 1)},
        "poses": {"object_from_cam": views.object_from_cam + np.eye(4, k=3) * 1e-5},
        "intrinsics": {"intrinsics": turned},
        "points": {"sparse": views.sparse + 1e-4},
    }
    assert keys(replace(views, **other[what])) != first


def test_the_stage_writes_maps_near_the_truth_and_says_how_near(tmp_path, monkeypatch):
    views, truth = plane_views()
    monkeypatch.setattr(stage, "load_views", lambda *_: views)
    _stage(tmp_path)
    report = json.loads((tmp_path / "stage1.json").read_text())
    errors, confident = [], []
    for index, name in enumerate(views.names):
        depth = read_depth(tmp_path / "stage1" / "depth_maps" / f"{name}.bin")
        confidence = read_depth(tmp_path / "stage1" / "confidence_maps" / f"{name}.bin")
        assert (depth[~views.masks[index]] == 0).all() and (confidence[~views.masks[index]] == 0).all()
        errors.append((np.abs(depth - truth[index]) / truth[index].max())[views.masks[index]])
        if not views.held_out[index]:
            confident.append(confidence[views.masks[index]])
    assert not list((tmp_path / "checkpoints").rglob("state.pt"))
    assert np.median(np.concatenate(errors)) < 0.01
    assert report["residual_after_alignment"]["value"] < 0.01
    assert report["confirmed_share"]["value"] > 0.7
    assert np.concatenate(confident).mean() > 0.6


def test_too_few_points_or_photos_is_one_sentence():
    views, _ = plane_views()
    with pytest.raises(StageError, match="SfM points lie on the object"):
        depth_photos(replace(views, tracks=[np.arange(3)] * 8), 4, torch.device("cpu"))
    with pytest.raises(StageError, match="needs at least 3"):
        depth_photos(replace(views, held_out=np.arange(8) > 1), 4, torch.device("cpu"))

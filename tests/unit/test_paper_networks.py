"""The paper's pose network and its fusion of two sets of depth maps, by hand and on a planted plane."""

import math

import numpy as np
import pytest
import torch
from support.textured_plane import plane_views

from scenefuse.core.stage import StageError, value
from scenefuse.paper.depth_photos import depth_photos
from scenefuse.paper.monocular import (
    PoseNetwork,
    fuse_by_inverse_variance,
    load_networks,
    pose_quantities,
    rigid,
    variance_between_views,
)


def test_rigid_turns_about_an_axis():
    quarter = rigid(torch.tensor([[0.0, 0.0, math.pi / 2]]), torch.tensor([[1.0, 2.0, 3.0]]))[0]
    assert torch.allclose(quarter @ torch.tensor([1.0, 0.0, 0.0, 1.0]), torch.tensor([1.0, 3.0, 3.0, 1.0]), atol=1e-6)


def test_motions_are_measured_against_true_ones_and_against_standing_still():
    views = plane_views(6)[0]
    photos = depth_photos(views, 3, torch.device("cpu"))
    network = PoseNetwork()
    with torch.no_grad():
        network.last.weight.zero_()
        network.last.bias.copy_(torch.tensor([0.3, 0.0, 0.0, 0.0, 0.0, 0.0]))
    straight = views.object_from_cam.copy()
    straight[:, :3, :3] = np.eye(3)
    found = pose_quantities(network, photos, straight)
    assert value(found, "pose_network_rotation_error_deg") == pytest.approx(np.degrees(0.3), abs=1e-3)
    assert value(found, "pose_network_rotation_to_find_deg") == pytest.approx(0, abs=1e-3)


def test_inverse_variance_by_hand():
    def pixels(*values: float) -> torch.Tensor:
        return torch.tensor(values).view(1, 1, 1, -1)

    inf = math.inf
    depth, variance = fuse_by_inverse_variance(
        pixels(10.0, 10.0, 10.0, 0.0),
        pixels(11.0, 20.0, 20.0, 5.0),
        pixels(1.0, 0.01, inf, inf),
        pixels(3.0, 1.0, 1.0, inf),
    )
    # (10 / 1 + 11 / 3) / (1 + 1 / 3) = 10.25; far apart: none; alone; without a variance: none
    assert depth.flatten().tolist() == pytest.approx([10.25, 0.0, 20.0, 0.0])
    assert variance.flatten().tolist() == pytest.approx([0.75, inf, 1.0, inf])


def test_true_depth_agrees_between_views_and_wrong_depth_does_not():
    views, truth = plane_views(held_out=0)
    photos = depth_photos(views, 4, torch.device("cpu"))
    depth = torch.tensor(truth, dtype=torch.float32)[:, None]
    right = torch.isfinite(variance_between_views(depth, photos))
    inner = torch.nn.functional.max_pool2d(1 - photos.masks, 5, 1, 2) == 0
    assert right[inner].float().mean() > 0.9
    wrong = depth.clone()
    wrong[2] *= 1.15
    assert torch.isfinite(variance_between_views(wrong, photos))[2][inner[2]].float().mean() < 0.1
    assert not right[photos.masks == 0].any()


def test_networks_that_cannot_be_read_are_one_sentence(tmp_path):
    networks = tmp_path / "networks.pt"
    said = "networks.pt (cannot be read|was saved by another version).* run stage 1 again"
    for spoil in (
        lambda: None,
        lambda: torch.save({"weights": torch.zeros(1)}, networks),
        lambda: networks.write_bytes(networks.read_bytes()[:200]),
    ):
        spoil()
        with pytest.raises(StageError, match=said):
            load_networks(networks, torch.device("cpu"))

"""The code for a GPU keeps its tensors together; where there is no GPU, on one that is pretended."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from support.painted_sphere import photos_of, sphere_views, sphere_volume
from support.pretend_gpu import OnGpu, PretendGpu, to_pretended
from support.sideways_video import sideways_video
from support.textured_plane import plane_views

from scenefuse.mvs.photo_refinement import RefinementSettings, refine_by_photos
from scenefuse.nerf import field
from scenefuse.nerf.field import FieldSettings
from scenefuse.nerf.rays import LossWeights
from scenefuse.nerf.render import render_view
from scenefuse.nerf.training import NerfRecipe, Schedule, Training, new_nerf, train
from scenefuse.paper.monocular import frames_of, monocular_losses, new_monocular_networks
from scenefuse.paper.network_training import Recipe, optimise, predict
from scenefuse.paper.train_nerf_as_paper import NERF, OrderAndEdges


@pytest.fixture
def gpu(monkeypatch):
    """CUDA, or what passes for it; its own kernels are tested elsewhere."""
    if torch.cuda.is_available():
        yield
        return
    monkeypatch.setattr(field, "triton_kernels", None)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.nn.Module, "to", to_pretended)
    with PretendGpu():
        yield


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a real one")
def test_the_pretended_gpu_notices_what_was_left_behind(gpu):
    there, here = torch.ones(3, device="cuda"), torch.ones(3)
    assert (there + 1).device.type == "cuda" and (there + here.to("cuda")).device.type == "cuda"
    assert (there + here.sum()).cpu().device.type == "cpu" and isinstance(there[torch.tensor([0, 2])], OnGpu)
    for mistake in (lambda: there + here, lambda: torch.cat([there, here]), lambda: there.numpy()):
        with pytest.raises(RuntimeError, match="on the (CPU|GPU)"):
            mistake()


@pytest.mark.slow
@pytest.mark.parametrize("of_paper", [False, True])
def test_training_and_rendering_on_a_gpu(gpu, tmp_path, of_paper):
    views = sphere_views(6, 40)
    cube, hull = sphere_volume(views, 32)
    photos = photos_of(views, cube, prior=1.0)
    recipe = replace(NERF if of_paper else NerfRecipe(), images_per_batch=3, rays_per_image=16)
    nerf = new_nerf(FieldSettings(log2_table=12), torch.from_numpy(hull), len(photos), 0, "cuda")
    schedule = Schedule(epochs=1, rays_per_epoch=48 * 20)
    additions = OrderAndEdges(nerf, photos, 3) if of_paper else None
    training = Training(photos, schedule, recipe, LossWeights(), warm=False, seed=0, additions=additions)
    train(nerf, training, checkpoint=tmp_path / "state.pt", report=print)
    assert {nerf.field.table.device.type, nerf.occupancy.alpha.device.type} == {"cuda"}
    assert {tensor.device.type for tensor in nerf.state()["field"].values()} == {"cpu"}
    rendered = render_view(nerf.field, nerf.occupancy, photos.camera(0), photos.masks[0], samples=16, colored=True)
    assert rendered.depth.device.type == "cpu" and bool((rendered.opacity > 0).any())


def test_depths_are_refined_by_photos_on_a_gpu(gpu):
    views, truth = plane_views(count=4)
    refined = refine_by_photos(views, truth.astype(np.float32), RefinementSettings(match_reach_px=4.0))
    assert refined.depths.shape == truth.shape


def test_the_papers_networks_train_on_a_gpu(gpu, tmp_path):
    cuda = torch.device("cuda")
    frames, length = frames_of(sideways_video(6), cuda), Recipe(1, 1)
    target, weight = torch.full_like(frames.masks, 1.4), torch.ones_like(frames.masks)
    networks = new_monocular_networks(cuda)
    for known in (None, (target, weight)):
        losses = optimise(
            networks.parts(),
            frames,
            monocular_losses(networks, frames, length, known),
            length,
            tmp_path / "state.pt",
            0,
        )
        assert np.isfinite(losses[-1]["photometric"])
        assert bool((predict(networks.depth, frames) > 0).all())

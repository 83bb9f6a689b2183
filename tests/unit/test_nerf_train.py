"""A small sphere with a painted surface: geometry, training, resuming, determinism."""

import os
import signal
from dataclasses import replace

import numpy as np
import pytest
import torch
from support.painted_sphere import CENTER, RADIUS, photos_of, sphere_views, sphere_volume

import scenefuse.nerf.training as training_module
from scenefuse.core import checkpoints
from scenefuse.core.machine import use_threads
from scenefuse.core.stage import StageError
from scenefuse.core.transforms import Sim3
from scenefuse.geometry.consistency import back_project, compare, normals_from_depth, others, surface_points
from scenefuse.geometry.depth_test import MAX_PHOTOS
from scenefuse.nerf import field, render
from scenefuse.nerf.field import FieldSettings
from scenefuse.nerf.rays import LossWeights, dilate, draw_batch, pixel_pool
from scenefuse.nerf.render import render_view
from scenefuse.nerf.rendered_maps import psnr, silhouette_iou, ssim
from scenefuse.nerf.training import NerfRecipe, Schedule, Training, new_nerf, train
from scenefuse.nerf.volume import cube_from_cameras, silhouettes, visual_hull


@pytest.fixture(scope="module")
def sphere():
    return sphere_views()


FIELD = FieldSettings(levels=6, log2_table=12, coarsest=8, finest=64, width=16)
WEIGHTS = LossWeights(depth_weight=1.0)


RECIPE = NerfRecipe(
    images_per_batch=8,
    rays_per_image=64,
    warmup_epochs=0.2,
    learning_rate=1e-2,
    grid_learning_rate=2e-2,
    samples=16,
    mask_band_px=1,
)


def _train(sphere, steps=60, checkpoint=None, report=lambda line: None, seed=0, **recipe):
    use_threads(1)
    cube, hull = sphere_volume(sphere)
    photos = photos_of(sphere, cube, prior=1.0)
    nerf = new_nerf(FIELD, torch.from_numpy(hull), len(photos), seed, "cpu")
    schedule = Schedule(epochs=2, rays_per_epoch=steps * 512 // 2)
    recipe = replace(RECIPE, **recipe)
    training = Training(photos, schedule, recipe, WEIGHTS, warm=False, seed=seed)
    return nerf, photos, cube, train(nerf, training, checkpoint=checkpoint, report=report)


def test_hull_holds_the_sphere_and_little_more(sphere):
    cube, hull = sphere_volume(sphere, cells=64)
    cells = cube.inverse().apply((np.argwhere(hull) + 0.5) / 64)
    distance = np.linalg.norm(cells - CENTER, axis=1)
    volume = hull.mean() / cube.scale**3
    ball = 4 / 3 * np.pi * RADIUS**3
    assert ball < volume < 2.0 * ball
    assert np.percentile(distance, 99) < 1.7 * RADIUS


def test_masks_without_a_common_volume_give_an_empty_hull(sphere):
    _, masks, k, poses, _ = sphere
    empty = silhouettes(masks & False, None, k, poses)
    assert not visual_hull(empty, Sim3.identity(), 32, 0.0).any()
    with pytest.raises(StageError, match="1 photos with a mask of the object are trained on, two are needed"):
        cube_from_cameras([outline.view for outline in silhouettes(masks[:1], None, k[:1], poses[:1])])


def test_pixels_that_something_stands_before_do_not_teach_emptiness(sphere):
    cube, _ = sphere_volume(sphere)
    photos = photos_of(sphere, cube)
    hidden = torch.zeros_like(photos.masks)
    hidden[:, : hidden.shape[1] // 2] = True
    free, kept = pixel_pool(photos, band_px=2), pixel_pool(replace(photos, hidden=hidden), band_px=2)
    rows = kept.outside // hidden.shape[2]
    assert rows.min() >= hidden.shape[1] // 2 and 0.3 < len(kept.outside) / len(free.outside) < 0.7
    np.testing.assert_array_equal(kept.inside, free.inside)


def test_batches_repeat_and_keep_off_the_band(sphere):
    cube, _ = sphere_volume(sphere)
    photos = photos_of(sphere, cube)
    pool = pixel_pool(photos, band_px=2)
    batch, again = (draw_batch(photos, pool, 5, 9, 8, 60) for _ in range(2))
    assert torch.equal(batch.uv, again.uv) and torch.equal(batch.view, again.view)
    assert not torch.equal(batch.uv, draw_batch(photos, pool, 5, 10, 8, 60).uv)
    assert int((~batch.inside).sum()) == 8 * 6
    column, row = batch.uv.long().unbind(1)
    inner, outer = dilate(photos.masks, -2), dilate(photos.masks, 2)
    assert torch.equal(inner[batch.view, row, column], batch.inside)
    assert torch.equal(outer[batch.view, row, column], batch.inside)


def test_exact_mattes_draw_their_grey_pixels_as_they_are(sphere):
    cube, _ = sphere_volume(sphere)
    photos = photos_of(sphere, cube)
    rim = dilate(photos.masks, 1) & ~photos.masks
    photos.mattes[rim] = 100
    batch = draw_batch(photos, pixel_pool(photos, band_px=0), 5, 9, 8, 256)
    column, row = batch.uv.long().unbind(1)
    grey = rim[batch.view, row, column]
    assert grey.any() and batch.inside[grey].all()
    assert torch.allclose(batch.matte[grey], torch.tensor(100 / 255))
    whole = photos.masks[batch.view, row, column]
    assert torch.equal(batch.inside, grey | whole) and (batch.matte[whole] == 1).all()
    assert (batch.matte[~batch.inside] == 0).all()


@pytest.mark.slow
def test_training_finds_the_sphere(sphere):
    nerf, photos, cube, result = _train(sphere, steps=400)
    depths, masks = sphere[4], sphere[1]
    view = photos.camera(0), photos.masks[0]
    rendered = render_view(nerf.field, nerf.occupancy, *view, samples=32, colored=True)
    assert float(rendered.color[photos.masks[0]].mean()) > 0.2
    plain = render_view(nerf.field, nerf.occupancy, *view, samples=32, colored=False)
    assert torch.equal(plain.depth, rendered.depth) and not plain.color.any()
    error = np.abs(rendered.depth.numpy() / cube.scale - depths[0])[masks[0]]
    assert np.median(error) < 0.01 * 2 * RADIUS
    picture = photos.images[0].float() / 255
    assert psnr(rendered.color, picture, dilate(photos.masks, -1)[0]) > 22
    assert silhouette_iou(rendered.opacity, photos.masks[0]) > 0.95
    assert result["steps"] == 400


@pytest.mark.slow
def test_same_seed_same_model_and_resuming_changes_nothing(sphere, tmp_path, monkeypatch):
    whole = _train(sphere, steps=24)[0]
    assert torch.equal(whole.field.table, _train(sphere, steps=24)[0].field.table)
    assert not torch.equal(whole.field.table, _train(sphere, steps=24, seed=1)[0].field.table)

    def draw_and_end_at_ten(*arguments):
        if arguments[3] == 10:
            os.kill(os.getpid(), signal.SIGTERM)
        return draw_batch(*arguments)

    monkeypatch.setattr(training_module, "draw_batch", draw_and_end_at_ten)
    checkpoint = tmp_path / "state.pt"
    with pytest.raises(SystemExit):
        _train(sphere, steps=24, checkpoint=checkpoint)
    assert torch.load(checkpoint, weights_only=True)["step"] == 11
    monkeypatch.setattr(training_module, "draw_batch", draw_batch)
    lines = []
    resumed = _train(sphere, steps=24, checkpoint=checkpoint, report=lines.append)[0]
    assert "resumed at step 11 of 24" in lines[0]
    assert torch.equal(whole.field.table, resumed.field.table)
    assert torch.equal(whole.occupancy.density, resumed.occupancy.density)


def test_a_truncated_checkpoint_starts_the_training_afresh(sphere, tmp_path, capsys):
    checkpoint = tmp_path / "state.pt"
    checkpoint.write_bytes(b"PK cut off")
    again = _train(sphere, steps=6, checkpoint=checkpoint)[0]
    assert "cannot be read" in capsys.readouterr().out
    assert torch.equal(again.field.table, _train(sphere, steps=6)[0].field.table)


def test_a_training_that_diverges_is_one_sentence_and_leaves_no_checkpoint(sphere, tmp_path, monkeypatch):
    monkeypatch.setattr(training_module, "mask_loss", lambda opacity, matte: opacity.mean() * torch.nan)
    monkeypatch.setattr(checkpoints, "SAVE_EVERY_SECONDS", 0.0)
    with pytest.raises(StageError, match="the training diverged"):
        _train(sphere, steps=3, checkpoint=tmp_path / "state.pt")
    assert not list(tmp_path.iterdir())


def test_depth_maps_confirm_each_other_and_give_normals(sphere):
    _, masks, k, poses, depths = sphere
    rows, columns = np.nonzero(masks[0])
    points = back_project(depths[0][rows, columns], k[0], poses[0], rows, columns)
    assert np.abs(np.linalg.norm(points - CENTER, axis=1) - RADIUS).max() < 1e-9
    grown = dilate(torch.from_numpy(masks), 1).numpy()
    said = compare(points, 0, depths.astype(np.float32), grown, k, poses, 0.1)
    assert np.median(said.agree) >= 1 and np.median(said.through) == 0 and said.off_mask.sum() == 0
    towards = points + 0.6 * (poses[0][:3, 3] - points) / np.linalg.norm(poses[0][:3, 3] - points, axis=1)[:, None]
    floating = compare(towards, 0, depths.astype(np.float32), grown, k, poses, 0.1)
    assert floating.agree.mean() < 0.2 * said.agree.mean()
    assert np.median(floating.through + floating.off_mask) >= 2
    normals = normals_from_depth(depths[0].astype(np.float32), k[0], 1, 0.05)[rows, columns]
    truth = (points - CENTER) @ poses[0][:3, :3] / RADIUS
    found = normals.any(1)
    assert found.mean() > 0.95
    assert np.median((normals * truth).sum(1)[found]) > 0.99


def test_comparing_depth_maps_is_what_it_says(sphere):
    """Point by point, in plain Python, beside what comes out for all at once."""
    _, masks, k, poses, depths = sphere
    rng = np.random.default_rng(0)
    depths = (depths * rng.normal(1, 0.01, depths.shape)).astype(np.float32)
    covered = rng.uniform(0.5, 1.5, depths.shape).astype(np.float32) * np.median(depths[depths > 0])
    points = CENTER + rng.normal(0, 1, (400, 3)) * RADIUS
    tolerance = 0.1 * RADIUS
    found = compare(points, 1, depths, masks, k, poses, tolerance, covered)
    for n, point in enumerate(points):
        counts, agreeing = dict.fromkeys(("agree", "through", "off_mask"), 0), [point]
        finer = [(k[1][0, 0] / (np.linalg.inv(poses[1])[2] @ [*point, 1])) ** 2]
        for other in (v for v in range(len(depths)) if v != 1):
            in_camera = np.linalg.inv(poses[other])[:3] @ [*point, 1]
            u, v, z = (*(k[other] @ in_camera)[:2] / in_camera[2], in_camera[2])
            if z <= 0 or not (0 <= u < masks.shape[2] and 0 <= v < masks.shape[1]):
                continue
            at = other, int(v), int(u)
            counts["off_mask"] += not masks[at] and z < covered[at]
            if depths[at] > 0:
                counts["through"] += z < depths[at] - tolerance
                if abs(z - depths[at]) <= tolerance:
                    counts["agree"] += 1
                    agreeing.append(poses[other][:3] @ [*in_camera * depths[at] / z, 1])
                    finer.append((k[other][0, 0] / depths[at]) ** 2)
        assert counts == {name: getattr(found, name)[n] for name in counts}
        assert found.mean[n] == pytest.approx(np.average(agreeing, 0, finer), abs=1e-9)
    assert min(getattr(found, name).sum() for name in counts) > 20


def test_quality_measures():
    rng = torch.Generator().manual_seed(0)
    picture, everything = torch.rand(20, 20, 3, generator=rng), torch.ones(20, 20, dtype=torch.bool)
    assert psnr(picture, picture + 0.1, everything) == pytest.approx(20.0, abs=1e-3)
    assert ssim(picture, picture, everything) == pytest.approx(1.0, abs=1e-5)
    assert ssim(picture, 1 - picture, everything) < 0.2
    assert silhouette_iou(torch.tensor([[0.9, 0.9, 0.1]]), torch.tensor([[True, False, True]])) == pytest.approx(1 / 3)


@pytest.mark.slow
def test_plain_pytorch_trains_like_the_kernels(sphere, monkeypatch):
    with_kernels = _train(sphere, steps=6)[3]
    for module in (field, render):
        monkeypatch.setattr(module, "kernel_module", lambda _: (None, torch.Tensor.detach))
    plain = _train(sphere, steps=6)[3]
    for name in ("color", "depth", "mask", "sparsity"):
        assert plain[name] == pytest.approx(with_kernels[name], rel=0.02)


def test_of_many_views_the_near_ones_and_fewer_far_ones_are_compared():
    def ring(count):
        angle = 2 * np.pi * np.arange(count) / count
        poses = np.tile(np.eye(4), (count, 1, 1))
        poses[:, :2, 3] = np.column_stack([np.cos(angle), np.sin(angle)])
        return poses

    assert others(7, ring(40)).tolist() == [k for k in range(40) if k != 7]
    compared = others(7, ring(400))
    assert len(compared) == len(set(compared)) == MAX_PHOTOS
    away = np.abs((compared - 7 + 200) % 400 - 200)
    assert away.min() == 1 and away.max() == 200
    assert (away <= 10).sum() > (away >= 180).sum() > 0


@pytest.mark.slow
def test_from_directions_that_no_photo_has_colours_are_those_that_photos_agree_on():
    few = sphere_views(count=6, arc=np.pi / 3)
    errors = {share: _error_from_anywhere(few, share) for share in (0.0, NerfRecipe().turned_share)}
    assert max(errors.values()) == errors[0.0] > 1.5 * min(errors.values())


def _error_from_anywhere(sphere, share):
    """RMS error of the trained field's colours on the surface that a photo shows, asked for from random directions."""
    nerf, photos, cube, _ = _train(sphere, steps=200, turned_share=share)
    images, _, intrinsics, poses, depths = sphere
    points, rows, columns = surface_points(depths[0], intrinsics[0], poses[0])
    directions = torch.nn.functional.normalize(torch.randn(len(points), 3, generator=torch.manual_seed(1)), dim=1)
    with torch.no_grad():
        features = nerf.field.geometry(torch.from_numpy(cube.apply(points).astype(np.float32)))[1]
        found = nerf.field.color(features, directions)[:, 0].numpy()
    return float(np.sqrt(((found - images[0][rows, columns] / 255.0) ** 2).mean()))

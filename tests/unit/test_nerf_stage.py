"""The NeRF stage on a tiny workspace: what it writes, and the sentences for bad input."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from support.painted_sphere import sphere_views

from scenefuse.cloud.clouds import read_cloud
from scenefuse.core.stage import StageError, quantity, read_json, value, write_json
from scenefuse.mvs.photo_refinement import RefinementSettings
from scenefuse.nerf.field import FieldSettings
from scenefuse.nerf.object_cloud import CloudGates, CloudInputs, CloudSettings, make_object_cloud
from scenefuse.nerf.rays import LossWeights
from scenefuse.nerf.rendered_maps import RenderedMapSettings
from scenefuse.nerf.train_object_nerf import NerfInputs, NerfSettings, train_object_nerf
from scenefuse.nerf.training import NerfRecipe, Schedule
from scenefuse.photos.pictures import read_depth, write_depth

ROOT = Path(__file__).resolve().parents[2]
FIELD = FieldSettings(levels=6, log2_table=12, coarsest=8, finest=64, width=16)
WEIGHTS = LossWeights(depth_weight=1.0)
UNREFINED = RefinementSettings(match_reach_px=0.0)
RECIPE = NerfRecipe(
    images_per_batch=8,
    rays_per_image=64,
    warmup_epochs=0.2,
    learning_rate=1e-2,
    grid_learning_rate=2e-2,
    samples=16,
    mask_band_px=1,
    occupancy_cells=32,
)
SETTINGS = NerfSettings(
    device="cpu",
    width_px=48,
    hull_tolerance=0.0,
    field=FIELD,
    schedule=Schedule(epochs=2, rays_per_epoch=120 * 256),
    recipe=RECIPE,
    losses=WEIGHTS,
    maps=RenderedMapSettings(render_samples=24, map_agreement=0.03),
)


GATES = CloudGates(
    point_agreement=0.05,
    min_confidence=0.0,
    through_share=0.5,
    mask_share=0.3,
    min_component=0.02,
)


@pytest.fixture(scope="module")
def workspace(tmp_path_factory):
    root = tmp_path_factory.mktemp("object")
    images, masks, k, poses, depths = sphere_views()
    for folder in ("undistorted/images", "undistorted/sparse", "masks", "stage1"):
        (root / folder).mkdir(parents=True)
    rows = []
    for i, (image, mask, pose, depth) in enumerate(zip(images, masks, poses, depths)):
        cv2.imwrite(str(root / f"undistorted/images/{i:02d}.png"), image[..., ::-1])
        cv2.imwrite(str(root / f"masks/{i:02d}.png"), mask.astype(np.uint8) * 255)
        write_depth(root / f"stage1/depth_maps/{i:02d}.png.bin", depth.astype(np.float32))
        write_depth(root / f"stage1/confidence_maps/{i:02d}.png.bin", mask.astype(np.float32))
        rotation, move = pose[:3, :3].T, -pose[:3, :3].T @ pose[:3, 3]
        numbers = " ".join(f"{v:.12g}" for v in (*np.roll(Rotation.from_matrix(rotation).as_quat(), 1), *move))
        rows.append(f"{i + 1} {numbers} 1 {i:02d}.png\n\n")
    (root / "undistorted/sparse/images.txt").write_text("".join(rows))
    (root / "undistorted/sparse/cameras.txt").write_text(f"1 PINHOLE 48 48 {k[0, 0, 0]} {k[0, 1, 1]} 24 24\n")
    (root / "undistorted/sparse/points3D.txt").write_text("")
    write_json(root / "undistorted.json", {"up_in_camera_frame": quantity([0.0, 0.0, 1.0], "1")})
    return root


def _run(root, stage, previous=None, masks=None, settings=SETTINGS):
    train_object_nerf(
        inputs=NerfInputs(root / "undistorted", masks or root / "masks", prior=root / "stage1", previous=previous),
        stage=root / stage,
        report=root / f"{stage}.json",
        checkpoints=root / "checkpoints",
        settings=settings,
        hold_out_every=6,
        seed=0,
    )


@pytest.fixture(scope="module")
def stage2(workspace):
    """The folder of stage 2."""
    _run(workspace, "stage2")
    return workspace / "stage2"


def _make_cloud(root, stage, cloud):
    make_object_cloud(
        inputs=CloudInputs(
            workspace=root / "undistorted",
            workspace_json=root / "undistorted.json",
            masks=root / "masks",
            stage=stage,
            stage_json=root / f"{stage.name}.json",
        ),
        cloud=cloud,
        report=cloud.with_suffix(".json"),
        settings=CloudSettings(min_views=2, spacing=0.01, gates=GATES, refinement=UNREFINED),
        seed=0,
    )


@pytest.mark.slow
def test_two_stages_and_the_cloud(workspace, stage2):
    _run(workspace, "stage4", previous=stage2)
    report = read_json(workspace / "stage4.json")
    assert value(report, "started_from_previous") is True
    assert value(report, "psnr_held_out") > 15 and value(report, "silhouette_iou") > 0.8
    assert value(report, "photos_measured") == 2
    depth = read_depth(workspace / "stage4/depth_maps/00.png.bin")
    truth = sphere_views()[4][0]
    both = (depth > 0) & (truth > 0)
    assert np.median(np.abs(depth - truth)[both]) < 0.1
    assert sorted(p.name for p in (workspace / "stage4/renders").iterdir()) == ["03.png", "09.png"]
    saved = torch.load(workspace / "stage4/model.pt", weights_only=True)
    assert len(saved["names"]) == 12 and saved["nerf_from_object"].shape == (4, 4)
    assert not list((workspace / "checkpoints").rglob("*.pt"))
    _make_cloud(workspace, workspace / "stage4", workspace / "object.ply")
    cloud = read_json(workspace / "object.json")
    assert value(cloud, "points") > 200 and value(cloud, "up_in_camera_frame") == [0.0, 0.0, 1.0]
    assert np.shape(value(cloud, "nerf_from_object")) == (4, 4)


def test_the_report_names_gains_and_both_qualities_of_the_right_half(workspace, stage2):
    report = read_json(workspace / "stage2.json")
    gains = value(report, "photo_gains")
    assert sorted(gains) == [f"{i:02d}.png" for i in range(12) if i not in (3, 9)]
    assert all(0.5 < gain < 2 for rows in gains.values() for gain in rows)
    assert value(report, "blurred_photos") == {}
    assert value(report, "vignetting_at_corner") == pytest.approx(1.0, abs=0.3)
    for name in ("psnr_right_half", "psnr_right_half_fitted_on_left"):
        assert np.isfinite(value(report, name))


def test_gains_are_taken_out_of_the_cloud_s_colours(workspace, stage2, tmp_path):
    saved = torch.load(stage2 / "model.pt", weights_only=True)
    (tmp_path / "stage2").mkdir()
    for maps in ("depth_maps", "confidence_maps", "normal_maps"):
        (tmp_path / "stage2" / maps).symlink_to(stage2 / maps)
    clouds = []
    for number, factor in enumerate((1.0, 2.0)):
        gains = torch.full_like(saved["log_gain"], float(np.log(factor)))
        torch.save(saved | {"log_gain": gains, "falloff": torch.tensor(0.0)}, tmp_path / "stage2/model.pt")
        _make_cloud(workspace, tmp_path / "stage2", tmp_path / f"{number}.ply")
        clouds.append(read_cloud(tmp_path / f"{number}.ply"))
    assert np.array_equal(clouds[0].points, clouds[1].points)
    assert np.abs(clouds[0].colors / 2.0 - clouds[1].colors).max() <= 1


def test_a_model_of_another_version_is_named(workspace, stage2, tmp_path):
    saved = torch.load(stage2 / "model.pt", weights_only=True)
    del saved["names"]
    torch.save(saved, tmp_path / "model.pt")
    with pytest.raises(StageError, match="saved by another version; delete .* run the NeRF stage again"):
        _run(workspace, "other", previous=tmp_path)


def test_a_missing_earlier_stage_is_named(workspace):
    with pytest.raises(StageError, match="model.pt does not exist; run the NeRF stage first"):
        _run(workspace, "other", previous=workspace / "nowhere")
    assert not (workspace / "other").exists()


def test_a_damaged_earlier_stage_is_named(workspace, tmp_path):
    (tmp_path / "model.pt").write_bytes(b"PK cut off")
    with pytest.raises(StageError, match="model.pt cannot be read .*; delete"):
        _run(workspace, "other", previous=tmp_path)
    assert not (workspace / "other").exists()


def test_empty_masks_are_named(workspace, tmp_path):
    for path in (workspace / "masks").iterdir():
        cv2.imwrite(str(tmp_path / path.name), np.zeros((48, 48), np.uint8))
    with pytest.raises(StageError, match="no photo in .* has a mask in .* that is not black"):
        _run(workspace, "other", masks=tmp_path)


@pytest.mark.skipif(torch.cuda.is_available(), reason="only where there is no CUDA")
def test_missing_cuda_is_named(workspace):
    with pytest.raises(StageError, match="no CUDA device; set it to auto or cpu"):
        _run(workspace, "other", settings=replace(SETTINGS, device="cuda"))

"""Stage 3: fusing and gating on planted depth maps."""

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
import torch
from support.textured_plane import plane_views

from scenefuse.core.stage import StageError
from scenefuse.nerf.prior import refine_depth as feedback
from scenefuse.nerf.prior import train_depth as depth
from scenefuse.nerf.prior.candidates import best_candidate, score_candidates
from scenefuse.nerf.prior.inputs import depth_photos
from scenefuse.photos.maps import read_depth, write_depth
from scenefuse.photos.views import chosen_by

SETTINGS = feedback.FeedbackSettings(epochs=1, batch_photos=4, warmup_epochs=1)
DEPTH_SETTINGS = depth.DepthTrainingSettings(
    width_px=64, crop_px=56, sources=4, sweep_planes=16, epochs=1, batch_photos=4, warmup_epochs=1
)


def _refine(tmp_path):
    feedback.refine_depth(
        workspace=tmp_path,
        masks=tmp_path,
        earlier=feedback.EarlierStages(previous=tmp_path / "stage1", rendered=tmp_path / "stage2"),
        stage=tmp_path / "stage3",
        report=tmp_path / "stage3.json",
        checkpoints=tmp_path / "checkpoints",
        settings=SETTINGS,
        hold_out_every=8,
        seed=0,
    )
    return json.loads((tmp_path / "stage3.json").read_text())


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """Stage 1 of a plane: the folder it wrote to, views, true depths."""
    folder = tmp_path_factory.mktemp("trained")
    views, truth = plane_views()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(depth, "load_views", lambda *_: views)
        depth.train_depth(
            workspace=folder,
            masks=folder,
            stage=folder / "stage1",
            report=folder / "stage1.json",
            checkpoints=folder / "checkpoints",
            settings=DEPTH_SETTINGS,
            hold_out_every=8,
            seed=0,
        )
    return folder, views, truth


@pytest.fixture
def stage1(tmp_path, monkeypatch, trained):
    """A copy of stage 1 in the test's own folder; returns views and true depths."""
    folder, views, truth = trained
    shutil.copytree(folder / "stage1", tmp_path / "stage1")
    monkeypatch.setattr(depth, "load_views", lambda *_: views)
    return views, truth


def _write_rendered(folder, views, maps):
    for name, z in zip(views.names, maps):
        write_depth(folder / "depth_maps" / f"{name}.bin", z.astype(np.float32))
        write_depth(folder / "confidence_maps" / f"{name}.bin", (z > 0).astype(np.float32))


def _error(folder, views, truth):
    maps = [read_depth(folder / "depth_maps" / f"{name}.bin") for name in views.names]
    return np.median(np.abs(np.stack(maps) - truth)[views.masks])


def test_good_rendered_depth_is_accepted_and_the_result_is_no_worse(tmp_path, stage1):
    views, truth = stage1
    _write_rendered(tmp_path / "stage2", views, truth)
    report = _refine(tmp_path)
    assert report["kept"]["value"] in ("rendered", "refined")
    assert report["accepted_share"]["value"] > 0.9
    assert _error(tmp_path / "stage3", views, truth) <= _error(tmp_path / "stage1", views, truth)


def test_every_other_held_out_photo_chooses_and_the_others_have_no_say():
    views, truth = plane_views()
    held_out = np.arange(len(views.names)) % 3 == 0
    assert np.flatnonzero(chosen_by(held_out)).tolist() == np.flatnonzero(held_out)[::2].tolist()
    candidates = {"rendered": torch.as_tensor(truth, dtype=torch.float32)[:, None]}

    def error(spoilt):
        images = views.images.copy()
        images[spoilt] = 0
        photos = depth_photos(replace(views, held_out=held_out, images=images), 4, torch.device("cpu"))
        return score_candidates(candidates, photos)["rendered"]["photometric"]

    right = error(np.zeros(len(views.names), bool))
    assert error(held_out & ~chosen_by(held_out)) == right
    assert error(chosen_by(held_out)) > 2 * right


def test_bad_rendered_depth_is_not_kept(tmp_path, stage1):
    views, truth = stage1
    rng = np.random.default_rng(0)
    _write_rendered(tmp_path / "stage2", views, truth * rng.uniform(0.8, 1.2, truth.shape))
    report = _refine(tmp_path)
    assert report["kept"]["value"] != "rendered"
    assert report["photometric_rendered"]["value"] > report["photometric_stage1"]["value"]
    assert _error(tmp_path / "stage3", views, truth) < 0.03


def test_the_lowest_rank_sum_wins_and_a_tie_goes_to_the_first():
    scores = {
        "rendered": {"photometric": 0.2, "inconsistency": 0.1, "residual": None},
        "refined": {"photometric": 0.1, "inconsistency": 0.1, "residual": 0.0},
    }
    assert best_candidate(scores) == "refined"
    scores["refined"]["inconsistency"] = 0.2
    assert best_candidate(scores) == "rendered"


def test_missing_rendered_depth_or_networks_is_one_sentence(tmp_path, stage1):
    with pytest.raises(StageError, match="holds no depth for any photo"):
        _refine(tmp_path)
    torch.save({"weights": torch.zeros(1)}, tmp_path / "stage1" / "networks.pt")
    with pytest.raises(StageError, match="holds no networks of stage 1"):
        _refine(tmp_path)
    networks = tmp_path / "stage1" / "networks.pt"
    networks.write_bytes(networks.read_bytes()[:200])
    with pytest.raises(StageError, match="networks.pt cannot be read .* run stage 1 again"):
        _refine(tmp_path)
    networks.unlink()
    with pytest.raises(StageError, match="run stage 1 first"):
        _refine(tmp_path)

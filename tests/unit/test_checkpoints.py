"""Training states: saved whole or not at all, resumed where they can be read, never with NaN or infinity."""

import math
import os
import resource
import signal

import pytest
import torch

from scenefuse.core import checkpoints
from scenefuse.core.checkpoints import checkpointed, key_of, learning_rate_factor, load_checkpoint, save_checkpoint
from scenefuse.core.stage import StageError


def state_of(value: float = 1.0, rows: int = 4) -> dict:
    """The state of a network with one layer, three steps into its training."""
    return {"model": {"weight": torch.full((rows, 2), value)}, "losses": [{"color": 0.5}], "step": 3}


def test_a_state_comes_back_as_it_was_saved(tmp_path):
    save_checkpoint(tmp_path / "deep/state.pt", state_of(7.0))
    back = load_checkpoint(tmp_path / "deep/state.pt", like=state_of())
    assert back is not None and torch.equal(back["model"]["weight"], torch.full((4, 2), 7.0)) and back["step"] == 3
    assert [path.name for path in (tmp_path / "deep").iterdir()] == ["state.pt"]


def test_no_checkpoint_starts_afresh(tmp_path):
    assert load_checkpoint(None, like=state_of()) is None
    assert load_checkpoint(tmp_path / "state.pt", like=state_of()) is None


@pytest.mark.parametrize("share", [0.0, 0.3, 0.9])
def test_a_truncated_checkpoint_starts_afresh_and_says_so(tmp_path, capsys, share):
    path = tmp_path / "state.pt"
    save_checkpoint(path, state_of(rows=500))
    whole = path.read_bytes()
    path.write_bytes(whole[: int(share * len(whole))])
    assert load_checkpoint(path, like=state_of(rows=500)) is None
    assert f"note: {path} cannot be read" in capsys.readouterr().out


def test_a_checkpoint_of_another_network_starts_afresh_and_says_so(tmp_path, capsys):
    path = tmp_path / "state.pt"
    save_checkpoint(path, state_of(rows=5))
    assert load_checkpoint(path, like=state_of(rows=4)) is None
    assert load_checkpoint(path, like={**state_of(rows=5), "optimizer": {}}) is None
    assert capsys.readouterr().out.count("saved by another version; training starts afresh") == 2


def test_a_full_disk_is_a_note_and_keeps_the_earlier_state(tmp_path, capsys):
    path = tmp_path / "state.pt"
    save_checkpoint(path, state_of(1.0))
    limit = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (2048, limit[1]))
    try:
        save_checkpoint(path, state_of(2.0, rows=5000))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limit)
    assert f"note: {path} could not be saved" in capsys.readouterr().out
    kept = load_checkpoint(path, like=state_of())
    assert kept is not None and float(kept["model"]["weight"].max()) == 1.0
    assert [file.name for file in tmp_path.iterdir()] == ["state.pt"]


@pytest.mark.parametrize("broken", [{"weight": torch.tensor([1.0, math.nan])}, {"losses": [{"color": math.inf}]}])
def test_numbers_that_are_not_finite_are_never_saved(tmp_path, broken):
    with pytest.raises(StageError, match="the training diverged"):
        save_checkpoint(tmp_path / "state.pt", broken)
    assert not list(tmp_path.iterdir())


def test_a_training_that_ends_with_nan_weights_is_an_error_without_a_checkpoint_too():
    with pytest.raises(StageError, match="the training diverged"), checkpointed(None, lambda: state_of(math.nan)):
        pass


def test_a_signal_waits_until_the_step_is_whole(tmp_path):
    path, done = tmp_path / "state.pt", []
    before = signal.getsignal(signal.SIGTERM)
    with pytest.raises(SystemExit) as end, checkpointed(path, lambda: {"step": len(done)}) as step_done:
        for step in range(5):
            if step == 2:
                os.kill(os.getpid(), signal.SIGTERM)
            done.append(step)
            step_done(step + 1)
    assert end.value.code == 128 + signal.SIGTERM and done == [0, 1, 2]
    assert load_checkpoint(path, like={"step": 0}) == {"step": 3}
    assert signal.getsignal(signal.SIGTERM) is before


def test_states_are_saved_now_and_then(tmp_path, monkeypatch):
    path = tmp_path / "state.pt"
    with checkpointed(path, lambda: {"step": 1}) as step_done:
        step_done(1)
        assert not path.exists()
        monkeypatch.setattr(checkpoints, "SAVE_EVERY_SECONDS", -1.0)
        step_done(2)
        assert path.exists()


def test_the_learning_rate_rises_in_a_line_and_falls_in_half_a_cosine():
    factors = [learning_rate_factor(step, steps=100, warmup=10) for step in range(101)]
    assert factors[:10] == pytest.approx([0.1 * (step + 1) for step in range(10)])
    assert factors[10] == 1.0 and factors[55] == pytest.approx(0.5) and factors[100] == pytest.approx(0)
    assert learning_rate_factor(0, steps=1, warmup=0.0) == 1.0


def test_keys_change_with_any_setting_and_with_the_content_of_arrays():
    weights = torch.arange(6.0)
    keys = [
        key_of("settings", weights),
        key_of("settings ", weights),
        key_of("settings", weights + 1),
        key_of("settings", weights.reshape(2, 3)),
        key_of("settings", weights.double()),
    ]
    assert len(set(keys)) == len(keys) and keys[0] == key_of("settings", weights.clone())

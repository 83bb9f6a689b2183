import errno
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from types import SimpleNamespace

import numpy as np
import pytest

from scenefuse.core.stage import (
    StageError,
    atomic_directory,
    atomic_file,
    quantity,
    read_json,
    remove_leftovers,
    run,
    write_json,
)

SCRIPT = """
import time
from pathlib import Path
from scenefuse.core.stage import StageError, atomic_directory, run
from scenefuse.photos.workspace import write_model

def stage(*, out: Path, fail: bool) -> None:
    '''Write a folder.

    Args:
        out: the folder.
        fail: whether the input is bad.
    '''
    with atomic_directory(out) as temporary:
        (temporary / "a.txt").write_text("a")
        if fail:
            raise StageError("the folder x is empty; give one with photos")
        write_model(temporary, [])  # it imports pycolmap, which takes SIGTERM
        print("ready", flush=True)
        time.sleep(30)

if __name__ == "__main__":
    run(stage)
"""


def test_atomic_file_leaves_nothing_behind_when_it_fails(tmp_path):
    with pytest.raises(RuntimeError), atomic_file(tmp_path / "a.txt") as temporary:
        temporary.write_text("half")
        raise RuntimeError
    assert list(tmp_path.iterdir()) == []


def test_atomic_directory_keeps_the_old_result_when_it_fails(tmp_path):
    with atomic_directory(tmp_path / "d") as temporary:
        (temporary / "a").write_text("old")
    with pytest.raises(RuntimeError), atomic_directory(tmp_path / "d") as temporary:
        (temporary / "a").write_text("new")
        raise RuntimeError
    assert (tmp_path / "d" / "a").read_text() == "old"
    assert [p.name for p in tmp_path.iterdir()] == ["d"]


@pytest.mark.process
def test_what_a_killed_job_left_is_removed_by_the_next_run_and_a_living_one_keeps_its_own(tmp_path):
    dead = subprocess.Popen([sys.executable, "-c", ""])
    dead.wait()
    (tmp_path / f".model.tmp-{dead.pid}").mkdir()
    (tmp_path / f".model.tmp-{dead.pid}" / "half").write_text("x")
    for ending in (".db", ".db-wal", ".db-shm"):
        (tmp_path / f".model.tmp-{dead.pid}{ending}").write_text("x")
    kept = [f".model.tmp-{os.getppid()}.db", f".other.tmp-{dead.pid}.db", f".model.tmp-{dead.pid}.json"]
    for name in kept:
        (tmp_path / name).write_text("x")
    with atomic_file(tmp_path / "model.db") as temporary:
        temporary.write_text("new")
        temporary.with_name(f"{temporary.name}-wal").write_text("journal")
    with atomic_directory(tmp_path / "model"):
        pass
    assert sorted(p.name for p in tmp_path.iterdir()) == sorted([*kept, "model", "model.db"])


def test_a_full_disk_is_one_sentence(tmp_path, monkeypatch, capsys):
    def stage() -> None:
        """Write more than fits."""
        with atomic_file(tmp_path / "a.txt") as temporary:
            temporary.write_text("half")
            raise OSError(errno.ENOSPC, "No space left on device", "a.txt")

    monkeypatch.setattr(sys, "argv", ["stage"])
    monkeypatch.setattr(signal, "signal", lambda *_: None)
    with pytest.raises(SystemExit, match="1"):
        run(stage)
    assert capsys.readouterr().err == "error: the disk is full (a.txt); free some space and run this again\n"
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("made", [atomic_file, atomic_directory])
def test_a_full_disk_and_a_folder_that_is_read_only_are_named_where_a_library_says_something_else(
    tmp_path, monkeypatch, capsys, made
):
    def stage() -> None:
        """Fail as SQLite does."""
        with made(tmp_path / "a.db"):
            raise RuntimeError("No registered database factory succeeded.")

    monkeypatch.setattr(sys, "argv", ["stage"])
    monkeypatch.setattr(signal, "signal", lambda *_: None)
    with pytest.raises(RuntimeError, match="factory"):
        run(stage)
    monkeypatch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(free=10_000))
    with pytest.raises(SystemExit):
        run(stage)
    monkeypatch.setattr(os, "access", lambda *_: False)
    with pytest.raises(SystemExit):
        run(stage)
    full, frozen = capsys.readouterr().err.splitlines()
    assert full == f"error: the disk is full ({tmp_path}); free some space and run this again"
    assert frozen == f"error: {tmp_path}: read-only file system; check the folder and who may write there"


def test_what_cannot_be_written_is_named_without_its_temporary_name(monkeypatch, capsys):
    def stage() -> None:
        """Write where nobody may."""
        raise OSError(errno.EROFS, "Read-only file system", "results/objects/house/.stage1.tmp-12/a.bin")

    monkeypatch.setattr(sys, "argv", ["stage"])
    with pytest.raises(SystemExit, match="1"):
        run(stage)
    assert capsys.readouterr().err.startswith("error: results/objects/house: read-only file system; check the folder")


def test_an_option_that_is_given_twice_loses_no_value(monkeypatch, capsys):
    def stage(*, objects: tuple[str, ...] = ()) -> None:
        """Take all that are named."""
        print(objects)

    monkeypatch.setattr(signal, "signal", lambda *_: None)
    monkeypatch.setattr(sys, "argv", ["stage", "--objects", "house", "--objects=shed"])
    with pytest.raises(SystemExit, match="1"):
        run(stage)
    assert capsys.readouterr().err == "error: --objects is given twice; give it once, with all its values\n"
    monkeypatch.setattr(sys, "argv", ["stage", "--objects", "house", "shed"])
    run(stage)
    assert capsys.readouterr().out == "('house', 'shed')\n"


def test_too_little_memory_is_one_sentence(monkeypatch, capsys):
    def stage() -> None:
        """Take more than there is."""
        np.zeros(2**60, np.float32)

    monkeypatch.setattr(sys, "argv", ["stage"])
    monkeypatch.setattr(signal, "signal", lambda *_: None)
    with pytest.raises(SystemExit, match="1"):
        run(stage)
    said = capsys.readouterr().err
    assert said.startswith("error: the memory, or a limit on it (ulimit -v") and said.count("\n") == 1


def test_what_is_published_was_synced_before_its_name_is_there(tmp_path, monkeypatch):
    synced = []
    real = os.fsync
    monkeypatch.setattr(os, "fsync", lambda f: (synced.append(os.readlink(f"/proc/self/fd/{f}")), real(f)))
    with atomic_directory(tmp_path / "d") as temporary:
        (temporary / "maps").mkdir()
        (temporary / "maps/a.bin").write_bytes(b"a")
    inside = f"{tmp_path}/{temporary.name}"
    assert synced[:-1] and set(synced[:-1]) == {inside, f"{inside}/maps", f"{inside}/maps/a.bin"}
    assert synced[-1] == str(tmp_path)


def test_json_holds_values_with_units_and_refuses_nan(tmp_path):
    write_json(tmp_path / "a.json", {"length": quantity(np.float64(1.5), "m"), "point": quantity(np.zeros(3), "m")})
    assert json.loads((tmp_path / "a.json").read_text())["length"] == {"value": 1.5, "unit": "m"}
    with pytest.raises(ValueError):
        write_json(tmp_path / "b.json", {"length": quantity(float("nan"), "m")})
    assert not (tmp_path / "b.json").exists()


def test_damaged_json_is_named(tmp_path):
    (tmp_path / "a.json").write_text("{")
    with pytest.raises(StageError, match=r"a\.json is not valid JSON"):
        read_json(tmp_path / "a.json")
    with pytest.raises(StageError, match=r"b\.json does not exist"):
        read_json(tmp_path / "b.json")


@pytest.mark.process
def test_an_error_is_one_sentence_a_log_begins_with_the_command_and_a_signal_leaves_nothing(tmp_path):
    script = tmp_path / "stage.py"
    script.write_text(SCRIPT)
    out = tmp_path / "out"
    command = [sys.executable, str(script), "--out", str(out), "--fail"]
    failed = subprocess.run([*command, "True"], capture_output=True, text=True)
    assert failed.returncode == 1
    assert failed.stderr == "error: the folder x is empty; give one with photos\n"
    workflow = os.environ | {"SCENEFUSE": str(tmp_path)}
    process = subprocess.Popen(
        [*command, "False"], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=workflow
    )
    assert process.stdout is not None and process.stderr is not None
    assert process.stdout.readline() == f"python {script} --out {out} --fail False\n"
    assert process.stdout.readline() == "ready\n"
    time.sleep(0.1)
    process.send_signal(signal.SIGTERM)
    assert process.wait(10) == 128 + signal.SIGTERM
    assert "error: stopped by SIGTERM from outside" in process.stderr.read()
    assert [p.name for p in tmp_path.iterdir()] == ["stage.py"]


@pytest.mark.parametrize("said", ["libtorch_cpu.so: failed to map segment from shared object", "std::bad_alloc"])
def test_a_lack_of_memory_is_one_sentence_however_a_library_says_it(monkeypatch, capsys, said):
    def stage():
        try:
            raise ImportError(said)
        except ImportError as error:
            raise RuntimeError("Cannot import the C++ backend") from error

    monkeypatch.setattr(sys, "argv", ["stage"])
    with pytest.raises(SystemExit, match="1"):
        run(stage)
    assert "is too small; raise the limit, end other programs, or use fewer pixels" in capsys.readouterr().err


def test_what_killed_processes_left_beside_an_output_is_removed_and_nothing_else(tmp_path):
    no_process = 2**30
    for name in (f".a.tmp-{no_process}.db", f".a.tmp-{no_process}.db-wal", ".a.tmp-1.db", f".ab.tmp-{no_process}.db"):
        (tmp_path / name).touch()
    (tmp_path / f".maps.tmp-{no_process}").mkdir()
    for output in ("a.db", "maps", "gone/b.json"):
        remove_leftovers(tmp_path / output)
    assert {path.name for path in tmp_path.iterdir()} == {".a.tmp-1.db", f".ab.tmp-{no_process}.db"}

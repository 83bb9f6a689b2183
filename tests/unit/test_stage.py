import json
import os
import signal
import subprocess
import sys
import time

import numpy as np
import pytest

from scenefuse.stage import StageError, atomic_directory, atomic_file, manifest, quantity, read_json, write_json

SCRIPT = """
import time
from pathlib import Path
from scenefuse.stage import StageError, atomic_directory, run

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


def test_manifest_names_contents_and_ignores_snakemake(tmp_path):
    (tmp_path / "d").mkdir()
    (tmp_path / "d" / "a").write_text("a")
    (tmp_path / ".snakemake_timestamp").write_text("")
    assert list(manifest(tmp_path)) == ["d/a"]


def test_an_error_is_one_sentence_a_log_begins_with_the_command_and_a_signal_leaves_nothing(tmp_path):
    script = tmp_path / "stage.py"
    script.write_text(SCRIPT)
    out = tmp_path / "out"
    command = [sys.executable, str(script), "--out", str(out), "--fail"]
    failed = subprocess.run([*command, "True"], capture_output=True, text=True)
    assert failed.returncode == 1
    assert failed.stderr == "error: the folder x is empty; give one with photos\n"
    workflow = os.environ | {"SCENEFUSE": str(tmp_path)}
    process = subprocess.Popen([*command, "False"], stdout=subprocess.PIPE, text=True, env=workflow)
    assert process.stdout is not None
    assert process.stdout.readline() == f"python {script} --out {out} --fail False\n"
    assert process.stdout.readline() == "ready\n"
    time.sleep(0.1)
    process.send_signal(signal.SIGTERM)
    assert process.wait(10) == 128 + signal.SIGTERM
    assert [p.name for p in tmp_path.iterdir()] == ["stage.py"]

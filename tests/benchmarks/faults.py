"""Faults of each stage and of the workflow, and what follows: a table, a row a stage and fault.

make test-faults
PYTHONPATH=.:tests python tests/benchmarks/faults.py workflow --table T.tsv [--only masks crop]
PYTHONPATH=.:tests python tests/benchmarks/faults.py stages --finished FOLDER --table T.tsv
"""

import contextlib
import csv
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import tyro
from snakemake.persistence.file import FilePersistence
from support.snakemake_runs import ROOT
from support.stub_stages import StubRun, results_in, stub_workflow

from scenefuse.core.job_records import KILLED, last_error

COLUMNS = ("stage", "fault", "stages are", "end", "a plain rerun")
# The rule and job of each stage, its script, and an input that is cut to half.
STAGES = {
    "import": ("list_photos-yard", "photos/list_photos.py", ""),
    "features": ("extract_object_features-shed0", "sfm/extract_features.py", "photos.json"),
    "matching": ("match_object_features-shed0", "sfm/match_features.py", "features.db"),
    "mapping": ("map_object_photos-shed0", "sfm/map_photos.py", "database.db"),
    "undistortion": ("undistort_object_photos-shed0", "mvs/undistort_photos.py", "sparse/cameras.bin"),
    "stereo": ("estimate_depth_maps-yard-0", "mvs/estimate_depth_maps.py", "undistorted/sparse/points3D.bin"),
    "masks": ("make_masks-shed0", "masks/make_masks.py", "undistorted.json"),
    "stage-1": ("estimate_depth_prior-shed0", "nerf/estimate_depth_prior.py", "undistorted/sparse/images.bin"),
    "stage-2": ("train_object_nerf-shed0", "nerf/train_object_nerf.py", "stage1/depth_maps/*"),
    "stage-3": ("refine_depth-shed0", "nerf/refine_depth.py", "stage2/depth_maps/*"),
    "stage-4": ("retrain_object_nerf-shed0", "nerf/train_object_nerf.py", "stage3/depth_maps/*"),
    "object-cloud": ("make_object_cloud-shed0", "nerf/make_object_cloud.py", "stage4/depth_maps/*"),
    "crop": ("crop_scene-shed0-full", "crop/crop_scene.py", "dense.ply"),
    "registration": ("register_object-shed0-full", "register/register_object.py", "object.ply"),
    "fusion": ("fuse_object-shed0", "fuse/fuse_object.py", "crop.json"),
    "completed-scene": ("complete_scene-yard", "fuse/complete_scene.py", "fused.ply"),
    "report": ("write_report-all", "report/write_report.py", "view.ply"),
}
MEMORY_LIMIT_KB = 700_000
ENOUGH = {"no memory": "the limit is enough", "full disk": "the room is enough"}
# Room on a full disk: of a stage, for its log; of a run, for what it needs to begin.
STAGE_ROOM_KB, RUN_ROOM_KB = 16, 40_000


def table_of(path: Path, rows: list[dict[str, str]]) -> None:
    """Add rows to a table, in the place of those of the same stage and fault, by stubs or real."""
    known = list(csv.DictReader(path.open(), delimiter="\t")) if path.is_file() else []
    new = [tuple(row[name] for name in COLUMNS[:3]) for row in rows]
    kept = [row for row in known if tuple(row[name] for name in COLUMNS[:3]) not in new] + rows
    kept.sort(key=lambda row: list(STAGES).index(row["stage"]))
    with path.open("w") as file:
        writer = csv.DictWriter(file, COLUMNS, delimiter="\t", lineterminator="\n")
        writer.writeheader()
        writer.writerows(kept)


def workflow(*, table: Path, only: tuple[str, ...] = tuple(STAGES), faults: tuple[str, ...] = ()) -> int:
    """Faults of the workflow: stages are stubs. Every one is the same run, in which the code of a stage was changed.

    Args:
        table: output; rows of other stages stay.
        only: stages that are tried.
        faults: faults that are tried; all without any.
    """
    failed = 0
    with tempfile.TemporaryDirectory(prefix="faults-") as place:
        base = StubRun(Path(place) / "finished", stub_workflow(Path(place) / "code"))
        done = base.run()
        assert done.returncode == 0, done.stdout[-3000:]
        for stage in only:
            job, script, _ = STAGES[stage]
            changed = shutil.copytree(Path(place) / "code", Path(place) / stage, symlinks=True)
            with (changed / "scripts" / script).open("a") as file:
                file.write(f"\nCHANGED = {stage!r}\n")

            def start(name: str, changed: Path = changed) -> StubRun:
                run = base.copy(Path(place) / "runs" / name)
                run.snakefile = changed / "Snakefile"
                return run

            undisturbed = start("undisturbed")
            assert undisturbed.run().returncode == 0
            happenings = {"SIGKILL of the job": _killed, "power cut": _power_cut, "full disk": _full_disk}
            happenings |= {"read-only results": _no_writing} | EXTRA.get(stage, {})
            for fault, happen in happenings.items():
                if not _wanted(fault, faults):
                    continue
                run = start("disturbed")
                end = happen(run, job)
                again = run.run()
                same = again.returncode == 0 and run.results() == undisturbed.results()
                failed += not same
                row = (stage, fault, "stubs", end, "the same as undisturbed" if same else "DIFFERS")
                print(*row, sep=" | ", flush=True)
                table_of(table, [dict(zip(COLUMNS, row))])
                shutil.rmtree(run.path)
            shutil.rmtree(undisturbed.path)
    return failed


def _wanted(fault: str, faults: tuple[str, ...]) -> bool:
    """Whether a fault is asked for, and can be made: only root can mount a disk."""
    can = os.geteuid() == 0 or not fault.startswith(("full disk", "read-only"))
    return can and (not faults or fault in faults)


def _said(output: str) -> str:
    """The first sentence of a run that says what failed."""
    for pattern in (
        r"^(another run .*)$",
        r"^failed: (.*)$",
        r"^(the run before .*)$",
        r"^Error: (.*)$",
        r"^\w*(?:Exception|Error)[^\n]*:\n(.*(?:\n .*)*)$",
    ):
        found = re.search(pattern, output, re.MULTILINE)
        if found:
            return _short(" ".join(found[1].split()))
    return "resumed"


def _short(sentence: str) -> str:
    """A sentence without folders of the run and of this machine, and not too long for a table."""
    sentence = re.sub(r"/\S*/runs?/|results/(objects|scenes|logs)/", "", sentence)
    return re.sub(r"(?<![\w.-])/\S*/", "", sentence).strip()[:200]


def _killed(run: StubRun, job: str) -> str:
    run.plant(job, "SIGKILL")
    said = _said(run.run().stdout)
    run.plant(job, "")
    return said


def _power_cut(run: StubRun, job: str) -> str:
    """Snakemake and the job are gone at once, and half of the job's outputs are written."""
    run.plant(job, "parent SIGKILL")
    run.run()
    run.plant(job, "")
    return _said(run.run().stdout)


@contextlib.contextmanager
def _no_room(path: Path, room_kb: int) -> Iterator[None]:
    """A folder on a disk of its own, in memory, with so much free; its content stays afterwards. Only root may."""
    aside = path.with_name(f"{path.name}.aside")
    shutil.copytree(path, aside, symlinks=True)
    with _mounted(path, "-t", "tmpfs", "tmpfs"):
        shutil.copytree(aside, path, symlinks=True, dirs_exist_ok=True)
        shutil.rmtree(aside)
        used_kb = shutil.disk_usage(path).used // 1024
        subprocess.run(["mount", "-o", f"remount,size={used_kb + room_kb}k", str(path)], check=True)
        yield
        shutil.copytree(path, aside, symlinks=True)
    shutil.rmtree(path)
    aside.rename(path)


@contextlib.contextmanager
def _read_only(folders: set[Path]) -> Iterator[None]:
    """Folders that nobody can write to, root neither."""
    with contextlib.ExitStack() as mounts:
        for folder in folders:
            mounts.enter_context(_mounted(folder, "--bind", str(folder)))
            subprocess.run(["mount", "-o", "remount,bind,ro", str(folder)], check=True)
        yield


@contextlib.contextmanager
def _mounted(path: Path, *what: str) -> Iterator[None]:
    subprocess.run(["mount", *what, str(path)], check=True)
    try:
        yield
    finally:
        subprocess.run(["umount", "-l", str(path)], check=True)


def _full_disk(run: StubRun, job: str) -> str:
    """Another program takes all that is free while the stage works; afterwards it gives it back."""
    filler = run.path / "filler"
    run.plant(job, f"run cat /dev/zero 2> /dev/null > {filler}")
    with _no_room(run.path, RUN_ROOM_KB):
        said = _said(run.run().stdout)
        filler.unlink(missing_ok=True)
    run.plant(job, "")
    return said


def _no_writing(run: StubRun, job: str) -> str:
    """The folders that a stage writes to are read-only."""
    run.plant(job, "run true")
    with _read_only({(run.path / path).parent for path in run.outputs_of(job)}):
        said = _said(run.run().stdout)
    run.plant(job, "")
    return said


def _folder_of_another(run: StubRun, job: str) -> str:
    """The folder is read-only, and empty."""
    for folder in {(run.path / path).parent for path in run.outputs_of(job)}:
        shutil.rmtree(folder)
        folder.mkdir()
    return _no_writing(run, job)


def _stopped(run: StubRun, job: str) -> str:
    run.plant(job, "parent SIGTERM")
    said = run.run().stdout
    run.plant(job, "")
    return _said(said)


def _interrupted(run: StubRun, job: str) -> str:
    """Ctrl-C, which the terminal sends to the whole group of processes."""
    run.plant(job, "sleep 20")
    process = run.start()
    _wait_for_log(run, job)
    os.killpg(process.pid, signal.SIGINT)
    said = process.communicate()[0]
    run.plant(job, "")
    return _said(said)


def _wait_for_log(run: StubRun, job: str) -> None:
    rule, name = job.split("-", 1)
    mark = run.path / f"results/logs/{rule}/{name}.started"
    for _ in range(1200):
        if mark.exists():
            mark.unlink()
            return
        time.sleep(0.1)


def _two_runs(run: StubRun, job: str) -> str:
    """A second run begins while the first one works."""
    run.plant(job, "sleep 12")
    process = run.start()
    _wait_for_log(run, job)
    said = _said(run.run().stdout)
    process.communicate()
    run.plant(job, "")
    return said


def _node_without_folder(run: StubRun, job: str) -> str:
    """A cluster whose node cannot go to the folder: its job leaves nothing, and its scheduler says that it failed."""
    for name, said in (("submit.sh", "7"), ("status.sh", "failed")):
        (run.path / name).write_text(f"echo {said}\n")
    cluster = ["--cluster-generic-submit-cmd", "sh submit.sh", "--cluster-generic-status-cmd", "sh status.sh"]
    words = ["--executor", "cluster-generic", *cluster, "--jobs", "2", "--seconds-between-status-checks", "1"]
    return _said(run.run(*words).stdout)


def _deleted_output(run: StubRun, job: str) -> str:
    """A run, and then one of the files of the stage is gone."""
    assert run.run().returncode == 0
    outputs = [Path(path) for path in run.outputs_of(job)]
    next(run.path / path for path in outputs if path.suffix == ".json").unlink()
    return "resumed"


def _clock_set_back(run: StubRun, job: str) -> str:
    """All that was made before lies in the future; then the clock is put right."""
    files = [file for file in (run.path / "results").rglob("*") if file.is_file()]
    times = {file: file.stat().st_mtime for file in files}
    for file in files:
        os.utime(file, (times[file] + 86400, times[file] + 86400))
    output = run.run().stdout
    for file in files:
        if file.exists() and file.stat().st_mtime == times[file] + 86400:
            os.utime(file, (times[file], times[file]))
    found = re.search(r"Output \S+ has older modification time[^\n]*", output)
    return _short(found[0]) if found else _said(output)


def _other_umask(run: StubRun, job: str) -> str:
    before = os.umask(0o077)
    try:
        run.plant(job, "error")
        said = _said(run.run().stdout)
    finally:
        os.umask(before)
    run.plant(job, "")
    return said


def _photo_changed(run: StubRun, job: str) -> str:
    """A photo is replaced while the stage works, and put back before the next run."""
    photo = run.path / "close/1.jpg"
    before, times = photo.read_bytes(), (photo.stat().st_atime, photo.stat().st_mtime)
    run.plant(job, "write close/1.jpg")
    run.run()
    run.plant(job, "")
    said = _said(run.run().stdout)
    photo.write_bytes(before)
    os.utime(photo, times)
    return said


EXTRA: dict[str, dict[str, Callable[[StubRun, str], str]]] = {
    "import": {"photo changed while it runs": _photo_changed},
    "features": {"photo changed while it runs": _photo_changed, "node without the folder": _node_without_folder},
    "matching": {"output deleted": _deleted_output},
    "mapping": {"another umask": _other_umask, "output deleted": _deleted_output},
    "undistortion": {"two runs in one folder": _two_runs},
    "stereo": {"SIGTERM of Snakemake": _stopped, "Ctrl-C": _interrupted},
    "stage-4": {"Ctrl-C": _interrupted, "SIGTERM of Snakemake": _stopped, "output deleted": _deleted_output},
    "masks": {"Ctrl-C": _interrupted, "two runs in one folder": _two_runs},
    "registration": {"clock set back": _clock_set_back, "output deleted": _deleted_output},
    "fusion": {
        "clock set back": _clock_set_back,
        "another umask": _other_umask,
        "read-only empty folder": _folder_of_another,
    },
    "completed-scene": {"node without the folder": _node_without_folder},
    "report": {"SIGTERM of Snakemake": _stopped},
}


def stages(*, finished: Path, table: Path, only: tuple[str, ...] = tuple(STAGES), faults: tuple[str, ...] = ()) -> int:
    """Faults of the stages themselves: the commands of a finished run of the tiny workflow.

    Each must end in one sentence, change no output and leave nothing hidden.

    Args:
        finished: folder of the run.
        table: output; rows of other stages stay.
        only: stages that are tried.
        faults: faults that are tried; all without any.
    """
    failed = 0
    with tempfile.TemporaryDirectory(prefix="faults-") as place:
        work = Path(place) / "run"
        subprocess.run(["cp", "-a", "--reflink=auto", str(finished), str(work)], check=True)
        for stage in only:
            job, _, cut = STAGES[stage]
            record, outputs = _recorded(work, job.split("-")[0])
            before = {name: text for name, text in results_in(work).items() if _within(name, outputs)}
            happenings: dict[str, contextlib.AbstractContextManager[None]] = {"no memory": contextlib.nullcontext()}
            spoiled = _input([str(work / name) for name in record.input], cut)
            if spoiled:
                happenings |= {
                    "input cut to half": _spoiled(spoiled, _cut),
                    "input garbled": _spoiled(spoiled, _garbled),
                }
            happenings |= {
                "full disk": _no_room(work, STAGE_ROOM_KB),
                "read-only results": _read_only({(work / path).parent for path in outputs}),
            }
            for fault in filter(lambda fault: _wanted(fault, faults), happenings):
                limit = f"ulimit -v {MEMORY_LIMIT_KB}; " if fault == "no memory" else ""
                with happenings[fault]:
                    status, said = _run_stage(record.shellcmd, work, limit)
                after = results_in(work)
                # What a library's abort leaves goes when the stage runs again.
                hidden = [name for name in after if ".tmp-" in name]
                for name in hidden:
                    (work / "results" / name).unlink()
                same = {name: text for name, text in after.items() if _within(name, outputs)} == before
                enough = status == 0 and fault in ("no memory", "full disk")
                well = enough or (bool(said) and same)
                failed += not well
                end = said or (ENOUGH[fault] if enough else "SILENT" if status == 0 else "NO SENTENCE")
                row = (stage, fault, "real", _short(end), "outputs as before" if same else "made anew")
                print(*row, *hidden, sep=" | ", flush=True)
                table_of(table, [dict(zip(COLUMNS, row))])
    return failed


def _recorded(work: Path, rule: str):
    """Snakemake's record of a job of a rule, and its outputs."""
    records = FilePersistence(path=work / ".snakemake")
    outputs, found = list[str](), None
    for file in sorted((work / ".snakemake/metadata").rglob("*")):
        if file.is_file():
            name = _decoded(file, work / ".snakemake/metadata")
            record = records._read_record(name)
            if record and record.rule == rule and (found is None or record.log == found.log):
                found = record
                outputs.append(name)
    assert found is not None, rule
    return found, outputs


def _decoded(file: Path, folder: Path) -> str:
    from base64 import urlsafe_b64decode

    return urlsafe_b64decode("".join(part.removeprefix("@") for part in file.relative_to(folder).parts)).decode()


def _within(name: str, outputs: list[str]) -> bool:
    return any(f"results/{name}" == output or f"results/{name}".startswith(f"{output}/") for output in outputs)


def _input(inputs: list[str], cut: str) -> Path | None:
    """The file to spoil among the inputs of a job."""
    if not cut:
        return next((Path(name) for name in inputs if Path(name).suffix.lower() in (".jpg", ".png")), None)
    for name in inputs:
        path = Path(name)
        for depth in range(len(Path(cut).parts)):
            tail = "/".join(Path(cut).parts[depth:])
            if path.is_dir() and name.endswith("/".join(Path(cut).parts[:depth])) and depth:
                found = sorted(path.glob(tail))
                if found:
                    return found[0]
        if path.is_file() and name.endswith(cut):
            return path
    return None


@contextlib.contextmanager
def _spoiled(file: Path, change: Callable[[bytes], bytes]) -> Iterator[None]:
    content = file.read_bytes()
    file.write_bytes(change(content))
    yield
    file.write_bytes(content)


def _cut(content: bytes) -> bytes:
    return content[: len(content) // 2]


def _garbled(content: bytes) -> bytes:
    """Every other byte of the first hundred is another one."""
    return bytes(255 - byte if index % 2 and index < 100 else byte for index, byte in enumerate(content))


def _run_stage(command: str, work: Path, limit: str) -> tuple[int, str]:
    """Exit status of a stage, and the sentence that its log ends in; "" where that is none."""
    log = work / re.search(r"&> (\S+)", command)[1]  # type: ignore[index]
    env = os.environ | {"SCENEFUSE": str(ROOT), "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    times = log.stat()
    done = subprocess.run(["bash", "-c", limit + command.strip()], cwd=work, env=env)
    text, said = log.read_text(errors="replace"), last_error(log)
    os.utime(log, (times.st_atime, times.st_mtime))
    if "Traceback" in text and "memory" not in said:
        print(text[-600:], flush=True)
        return done.returncode, ""
    # What the summary says of a job that a signal ended.
    return done.returncode, said or (KILLED if done.returncode > 128 else "")


PARTS: dict[str, Callable[..., int]] = {"workflow": workflow, "stages": stages}

if __name__ == "__main__":
    part = PARTS[sys.argv.pop(1)]
    sys.exit(bool(tyro.cli(part, config=(tyro.conf.OmitArgPrefixes,))))

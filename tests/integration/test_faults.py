"""A job that fails or is killed in a rerun: the next run makes all that follows from it, and nothing of before stays.

The stages are stubs. `make test-faults` tries many more faults, and those of the stages themselves.
"""

import json

import pytest
from support.stub_stages import StubRun, stub_workflow


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """A finished run with stubs in the place of stages."""
    folder = tmp_path_factory.mktemp("stubs")
    run = StubRun(folder / "finished", stub_workflow(folder / "code"))
    done = run.run()
    assert done.returncode == 0, done.stdout[-3000:]
    return run


@pytest.fixture(scope="module")
def undisturbed(finished, tmp_path_factory):
    """The results of a run after the setting was changed."""
    run = finished.copy(tmp_path_factory.mktemp("undisturbed") / "run")
    run.set(stage4={"epochs": 9})
    assert run.run().returncode == 0
    return run.results()


@pytest.fixture
def changed(finished, tmp_path):
    """A finished run whose setting of stage 4 was changed since."""
    run = finished.copy(tmp_path / "run")
    run.set(stage4={"epochs": 9})
    return run


STAGE4 = "retrain_object_nerf-shed0"


def test_a_training_that_is_killed_in_a_rerun_is_not_forgotten(changed, undisturbed):
    changed.plant(STAGE4, "SIGKILL")
    for _ in range(2):
        assert changed.run().returncode != 0
    changed.plant(STAGE4, "")
    assert changed.run().returncode == 0
    assert changed.results() == undisturbed


def test_a_failure_on_the_way_to_another_target_is_not_forgotten(changed, undisturbed):
    changed.plant(STAGE4, "error")
    assert changed.run("results/objects/shed0/stage4.json").returncode != 0
    changed.plant(STAGE4, "")
    assert changed.run().returncode == 0
    assert changed.results() == undisturbed


def test_a_run_whose_snakemake_is_killed_goes_on(changed, undisturbed):
    changed.plant(STAGE4, "parent SIGKILL")
    assert changed.run().returncode == -9
    changed.plant(STAGE4, "")
    again = changed.run()
    assert again.returncode == 0 and "the run before this one was killed; this one goes on" in again.stdout
    assert changed.results() == undisturbed


def test_a_setting_that_is_changed_back_after_a_failure_elsewhere_reruns_nothing_for_it(finished, tmp_path):
    run = finished.copy(tmp_path / "run")
    run.set(stage4={"epochs": 9}, undistort={"max_size_px": 900})
    run.plant("undistort_object_photos-shed0", "error")
    assert run.run().returncode != 0
    run.settings = dict(finished.settings)
    run.set()
    run.plant("undistort_object_photos-shed0", "")
    assert run.run().returncode == 0 and run.results() == finished.results()


@pytest.mark.parametrize("names", [("registration/full/fine.json", "matches.json", "object.ply")])
def test_results_that_were_deleted_are_made_again(finished, tmp_path, names):
    run = finished.copy(tmp_path / "run")
    for name in names:
        (run.path / "results/objects/shed0" / name).unlink()
    assert run.run().returncode == 0
    assert run.results() == finished.results()


def test_a_scene_that_fails_is_not_shown_as_it_was_and_what_failed_is_printed(finished, tmp_path):
    run = finished.copy(tmp_path / "run")
    run.project.config["scene"]["dense_cloud"] = {"min_photos": 4}
    run.plant("fuse_depth_maps-yard", "error")
    run.set()
    done = run.run()
    assert done.returncode != 0
    assert "failed: fuse_depth_maps: planted [results/logs/fuse_depth_maps/yard.log]" in done.stdout
    scene = run.path / "results/scenes/yard"
    assert not any((scene / name).exists() for name in ("dense.ply", "scene.png", "view.json"))
    logs = json.loads((run.path / "jobs.json").read_text())
    later = [log for log in logs if "yard" in log and log.split("/")[2] == "view_scene"]
    assert not any("error" in (run.path / log).read_text() for log in later)

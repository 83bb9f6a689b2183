"""config/paper.yaml: which rules run with it, and none of them without it."""

import re
from pathlib import Path

import yaml
from support.user_project import planned

ROOT = Path(__file__).resolve().parents[2]
OF_PAPER = {"estimate_as_paper", "train_nerf_as_paper", "refine_as_paper", "retrain_nerf_as_paper"}
OF_PAPER |= {"make_cloud_as_paper", "register_variant_as_paper", "compare_with_paper"}
SHIPPED = {"estimate_depth_prior", "train_object_nerf", "refine_depth", "retrain_object_nerf", "make_object_cloud"}
SHIPPED |= {"register_object"}


def test_the_papers_stages_run_in_the_place_of_the_shipped_ones_and_only_when_asked_for(project, snakemake):
    project.photos("flight")
    project.photos("close")
    for name in ("clicks.tsv", "prompts.tsv"):
        (project.path / name).write_text("label\tphoto\tx_px\ty_px\ninside\t0.jpg\t3\t3\n")
    plain = snakemake(project.path, "-n", config=project.write())
    assert plain.returncode == 0, plain.stdout[-3000:]
    assert not OF_PAPER & planned(plain.stdout) and planned(plain.stdout) >= SHIPPED
    for key, part in yaml.safe_load((ROOT / "config/paper.yaml").read_text()).items():
        project.config[key] = project.config.get(key, {}) | part
    for source in ("chain", "sfm"):
        project.config["object"]["stage1"]["pose_source"] = source
        by_paper = snakemake(project.path, "-n", "-p", config=project.write())
        assert by_paper.returncode == 0, by_paper.stdout[-3000:]
        assert planned(by_paper.stdout) >= OF_PAPER and not SHIPPED & planned(by_paper.stdout)
        # What each job is given, by its command line.
        jobs = re.findall(r"exec python \S*/scripts/(\S+)\.py\b(.*)", by_paper.stdout)
        stages = [words for script, words in jobs if script == "paper/train_nerf_as_paper"]
        given = {re.search(r"--stage \S+/(stage\d)", words)[1]: words for words in stages}
        for stage, prior, poses in (("stage2", "stage1", "poses"), ("stage4", "stage3", "refined_poses")):
            assert re.search(rf"--workspace \S+/{poses} .*--prior \S+/{prior} ", given[stage])
            assert "--previous" not in given[stage]
        assert all("--match-reach-px 0" in words for script, words in jobs if script == "nerf/make_object_cloud")
        assert all("--minimal True" in words for script, words in jobs if script == "crop/crop_scene")
        scales = [
            re.search(r"--scale (\w+)", words)[1] for script, words in jobs if script.endswith("register_as_paper")
        ]
        assert sorted(scales) == ["none", "rms", "rms"]

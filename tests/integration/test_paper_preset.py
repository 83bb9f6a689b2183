"""config/paper.yaml: which rules run with it, and none of them without it."""

from pathlib import Path

import yaml
from support.user_project import planned

ROOT = Path(__file__).resolve().parents[2]
OF_PAPER = {"estimate_as_paper", "train_nerf_as_paper", "refine_as_paper", "retrain_nerf_as_paper"}
OF_PAPER |= {"make_cloud_as_paper", "register_variant_as_paper", "compare_with_paper"}
SHIPPED = {"train_depth", "train_object_nerf", "refine_depth", "retrain_object_nerf", "make_object_cloud"}
SHIPPED |= {"register_coarsely", "register_finely", "find_poses"}


def test_the_papers_stages_run_in_the_place_of_the_shipped_ones_and_only_when_asked_for(project, snakemake):
    project.photos("flight")
    project.photos("close")
    for name in ("clicks.tsv", "prompts.tsv"):
        (project.path / name).write_text("label\tphoto\tx_px\ty_px\ninside\t0.jpg\t3\t3\n")
    plain = snakemake(project.path, "-n", config=project.write())
    assert plain.returncode == 0, plain.stdout[-3000:]
    assert not OF_PAPER & planned(plain.stdout) and SHIPPED - {"find_poses"} <= planned(plain.stdout)
    for files in (["paper.yaml"], ["paper.yaml", "paper_from_sfm.yaml"]):
        for file in files:
            for key, part in yaml.safe_load((ROOT / "config" / file).read_text()).items():
                project.config[key] = project.config.get(key, {}) | part
        by_paper = snakemake(project.path, "-n", config=project.write())
        assert by_paper.returncode == 0, by_paper.stdout[-3000:]
        assert planned(by_paper.stdout) >= OF_PAPER and not SHIPPED & planned(by_paper.stdout)

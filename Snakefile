# Completes objects in a drone reconstruction with evidence from close-up photos: scene -> objects -> join -> summary.
#   snakemake --cores 2                                        everything
#   snakemake --cores 2 results/objects/house/fused.ply        one object
#   snakemake -n                                               what would run
from snakemake.utils import min_version

min_version("9.20")


configfile: workflow.source_path("config/config.yaml")


report: "workflow/report/workflow.rst"


resource_scopes:
    gpu="local",


include: "workflow/rules/common.smk"
include: "workflow/rules/demo.smk"
include: "workflow/rules/sfm.smk"
include: "workflow/rules/mvs.smk"
include: "workflow/rules/masks.smk"
include: "workflow/rules/poses.smk"
include: "workflow/rules/depth.smk"
include: "workflow/rules/nerf.smk"
include: "workflow/rules/clouds.smk"
include: "workflow/rules/registration.smk"
include: "workflow/rules/fusion.smk"
include: "workflow/rules/metrics.smk"
include: "workflow/rules/report.smk"


if config["object"]["recipe"] == "paper":

    include: "workflow/rules/paper.smk"


rule all:
    default_target: True
    input:
        expand("results/scenes/{scene}/completed.ply", scene=SCENES),
        expand("results/scenes/{scene}/completed.laz", scene=SCENES),
        "results/summary/summary.txt",
        "results/summary/report.html",

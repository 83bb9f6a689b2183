# The paper's own recipe, where object.recipe is paper: stages 1 to 4, the cloud and the registration by its letter (docs/paper.md).
# Its rules make the files of the rules that they go before.
#
# INPUTS    results/objects/{object}/undistorted/, masks/; config: object.stage1 to stage4, object.nerf, object.cloud
# OUTPUTS   results/objects/{object}/stage1/ to stage4/, their JSON, object.ply, registration/{variant}/
#           results/objects/{object}/poses/, poses.json                     poses after stage 1: the pose network's chain, or SfM's
#           results/objects/{object}/refined_poses/, refined_poses.json     the same after stage 3
#           results/summary/paper.tsv, paper.html    the paper's Tables 2 to 4: its own numbers, this run's, and chance


ruleorder: estimate_as_paper > estimate_depth_prior
ruleorder: refine_as_paper > refine_depth
ruleorder: train_nerf_as_paper > train_object_nerf
ruleorder: retrain_nerf_as_paper > retrain_object_nerf
ruleorder: import_object_cloud > import_posed_object_cloud > make_cloud_as_paper
ruleorder: make_cloud_as_paper > make_object_cloud
ruleorder: register_as_paper > register_variant_as_paper > register_object


def of_paper(stage):
    """Params function: epochs of a stage, and what stages 1 and 3 of the paper share."""
    return settings(
        f"object.{stage}.epochs", "object.stage1.pose_source", "object.hold_out_every"
    )


rule estimate_as_paper:
    """Self-supervised depth and pose networks, and poses chained from the latter (paper 4.2.2, stage 1)."""
    input:
        workspace="results/objects/{object}/undistorted",
        workspace_json="results/objects/{object}/undistorted.json",
        masks="results/objects/{object}/masks",
        masks_json="results/objects/{object}/masks.json",
    output:
        stage=maps("results/objects/{object}/stage1"),
        report="results/objects/{object}/stage1.json",
        posed=directory("results/objects/{object}/poses"),
        posed_json="results/objects/{object}/poses.json",
    log:
        "results/logs/estimate_as_paper/{object}.log",
    benchmark:
        "results/benchmarks/estimate_as_paper/{object}.tsv"
    conda:
        "../../envs/training.yaml"
    threads: OBJECT_THREADS
    resources:
        mem_mb=lambda wildcards, attempt: 6000 * attempt,
        runtime=lambda wildcards, attempt: 240 * attempt,
        gpu=config["gpu"],
    params:
        options=of_paper("stage1"),
        checkpoints="results/checkpoints/{object}/paper1",
        seed=config["seed"],
        script=script("paper/estimate_as_paper.py"),
        code=code("paper/estimate_as_paper.py"),
    message:
        "{wildcards.object}: the paper's stage 1, depth and pose networks"
    shell:
        "exec python {params.script} --workspace {input.workspace} --masks {input.masks}"
        " --stage {output.stage} --report {output.report} --posed {output.posed} --posed-json {output.posed_json}"
        " --checkpoints {params.checkpoints}/{params.code} --seed {params.seed} {params.options} &> {log}"


rule train_nerf_as_paper:
    """Depth-guided NeRF (paper 4.2.2, stage 2)."""
    input:
        workspace="results/objects/{object}/poses",
        workspace_json="results/objects/{object}/poses.json",
        masks="results/objects/{object}/masks",
        masks_json="results/objects/{object}/masks.json",
        prior="results/objects/{object}/stage1",
        prior_json="results/objects/{object}/stage1.json",
    output:
        stage=maps("results/objects/{object}/stage2"),
        report="results/objects/{object}/stage2.json",
    log:
        "results/logs/train_nerf_as_paper/{object}.log",
    benchmark:
        "results/benchmarks/train_nerf_as_paper/{object}.tsv"
    conda:
        "../../envs/training.yaml"
    threads: 1
    resources:
        mem_mb=lambda wildcards, attempt: 8000 * attempt,
        runtime=lambda wildcards, attempt: 480 * attempt,
        gpu=config["gpu"],
    params:
        options=settings("object.nerf", "object.stage2", "object.hold_out_every"),
        checkpoints="results/checkpoints/{object}/paper2",
        seed=config["seed"],
        script=script("paper/train_nerf_as_paper.py"),
        code=code("paper/train_nerf_as_paper.py"),
    message:
        "{wildcards.object}: the paper's stage 2, depth-guided NeRF"
    shell:
        "exec python {params.script} --workspace {input.workspace} --masks {input.masks} --prior {input.prior}"
        " --stage {output.stage} --report {output.report} --checkpoints {params.checkpoints}/{params.code}"
        " --seed {params.seed} {params.options} &> {log}"


rule refine_as_paper:
    """Rendered depth refines both networks, and the poses are chained again (paper 4.2.2, stage 3)."""
    input:
        workspace="results/objects/{object}/undistorted",
        workspace_json="results/objects/{object}/undistorted.json",
        masks="results/objects/{object}/masks",
        masks_json="results/objects/{object}/masks.json",
        poses="results/objects/{object}/poses",
        poses_json="results/objects/{object}/poses.json",
        previous="results/objects/{object}/stage1",
        previous_json="results/objects/{object}/stage1.json",
        rendered="results/objects/{object}/stage2",
        rendered_json="results/objects/{object}/stage2.json",
    output:
        stage=maps("results/objects/{object}/stage3"),
        report="results/objects/{object}/stage3.json",
        posed=directory("results/objects/{object}/refined_poses"),
        posed_json="results/objects/{object}/refined_poses.json",
    log:
        "results/logs/refine_as_paper/{object}.log",
    benchmark:
        "results/benchmarks/refine_as_paper/{object}.tsv"
    conda:
        "../../envs/training.yaml"
    threads: OBJECT_THREADS
    resources:
        mem_mb=lambda wildcards, attempt: 6000 * attempt,
        runtime=lambda wildcards, attempt: 240 * attempt,
        gpu=config["gpu"],
    params:
        options=of_paper("stage3"),
        checkpoints="results/checkpoints/{object}/paper3",
        seed=config["seed"],
        script=script("paper/refine_as_paper.py"),
        code=code("paper/refine_as_paper.py"),
    message:
        "{wildcards.object}: the paper's stage 3, feedback"
    shell:
        "exec python {params.script} --workspace {input.workspace} --masks {input.masks} --poses {input.poses}"
        " --previous {input.previous} --rendered {input.rendered}"
        " --stage {output.stage} --report {output.report} --posed {output.posed} --posed-json {output.posed_json}"
        " --checkpoints {params.checkpoints}/{params.code} --seed {params.seed} {params.options} &> {log}"


use rule train_nerf_as_paper as retrain_nerf_as_paper with:
    # The NeRF again, from fresh weights, on the refined depth and poses (paper 4.2.2, stage 4).
    input:
        workspace=POSED,
        workspace_json=f"{POSED}.json",
        masks="results/objects/{object}/masks",
        masks_json="results/objects/{object}/masks.json",
        prior="results/objects/{object}/stage3",
        prior_json="results/objects/{object}/stage3.json",
    output:
        stage=maps("results/objects/{object}/stage4"),
        report="results/objects/{object}/stage4.json",
    log:
        "results/logs/retrain_nerf_as_paper/{object}.log",
    benchmark:
        "results/benchmarks/retrain_nerf_as_paper/{object}.tsv"
    params:
        options=settings("object.nerf", "object.stage4", "object.hold_out_every"),
        checkpoints="results/checkpoints/{object}/paper4",
        seed=config["seed"],
        script=script("paper/train_nerf_as_paper.py"),
        code=code("paper/train_nerf_as_paper.py"),
    message:
        "{wildcards.object}: the paper's stage 4, final NeRF"


use rule make_object_cloud as make_cloud_as_paper with:
    # Rendered depths as they are: photos move none of them.
    log:
        "results/logs/make_cloud_as_paper/{object}.log",
    benchmark:
        "results/benchmarks/make_cloud_as_paper/{object}.tsv"
    params:
        options=lambda wildcards: settings("object.cloud", without=["match_reach_px"])(
            wildcards
        )
        + " --match-reach-px 0",
        seed=config["seed"],
        script=script("nerf/make_object_cloud.py"),
        code=code("nerf/make_object_cloud.py"),
    message:
        "{wildcards.object}: cloud, as rendered"


def scale_of_paper(wildcards):
    """How large a variant takes the object: by the paper's formula, or as it is in the ablation (R2)."""
    without = "scale" in registration_of(wildcards)
    return f"--scale {'none' if without else 'rms'}"


use rule register_as_paper as register_variant_as_paper with:
    # The paper's registration is the one that is fused, and that of its ablation.
    input:
        cloud="results/objects/{object}/object.ply",
        cloud_json="results/objects/{object}/object.json",
        crop="results/objects/{object}/registration/{variant}/crop.ply",
        crop_json="results/objects/{object}/registration/{variant}/crop.json",
        workspace_json=if_photographed("results/objects/{object}/undistorted.json"),
    output:
        scale="results/objects/{object}/registration/{variant}/scale.json",
        coarse="results/objects/{object}/registration/{variant}/coarse.json",
        fine="results/objects/{object}/registration/{variant}/fine.json",
        picture="results/objects/{object}/registration/{variant}/fine.png",
    log:
        "results/logs/register_variant_as_paper/{object}-{variant}.log",
    benchmark:
        "results/benchmarks/register_variant_as_paper/{object}-{variant}.tsv"
    params:
        options=scale_of_paper,
        gravity=options_of("workspace_json"),
        seed=config["seed"],
        script=script("paper/register_as_paper.py"),
        code=code("paper/register_as_paper.py"),
    message:
        "{wildcards.object}, variant {wildcards.variant}: registration by the paper's recipe"


rule compare_with_paper:
    """Tables 2, 3 and 4 of the paper: its own numbers, those of this run, and chance."""
    input:
        "results/summary/summary.txt",
    output:
        table=report(
            "results/summary/paper.tsv",
            category="Tables",
            caption="../report/paper.rst",
        ),
        section="results/summary/paper.html",
    log:
        "results/logs/compare_with_paper/all.log",
    benchmark:
        "results/benchmarks/compare_with_paper/all.tsv"
    conda:
        "../../envs/report.yaml"
    resources:
        mem_mb=lambda wildcards, attempt: 4000 * attempt,
        runtime=lambda wildcards, attempt: 30 * attempt,
    params:
        run=run_options,
        seed=config["seed"],
        script=script("paper/compare_with_paper.py"),
        code=code("paper/compare_with_paper.py"),
    message:
        "Summary: the paper's tables"
    shell:
        "exec python {params.script} {params.run} --table {output.table} --section {output.section}"
        " --seed {params.seed} &> {log}"

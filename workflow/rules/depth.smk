# Depth and pose networks of an object: stage 1 trains them, stage 3 refines them by what the NeRF renders.
#
# INPUTS    results/objects/{object}/undistorted/, masks/; config: object.stage1, object.stage3
# OUTPUTS   results/objects/{object}/stage1/, stage1.json, stage3/, stage3.json


# The workspace that the cloud and what follows it read; in recipe paper with the poses of stage 3, in the same frame.
UNDISTORTED = "results/objects/{object}/undistorted"
POSED = (
    "results/objects/{object}/refined_poses"
    if config["object"]["recipe"] == "paper"
    else UNDISTORTED
)


rule train_depth:
    """Self-supervised depth and pose networks (paper 3.2 and 4.2.2, stage 1)."""
    input:
        workspace=POSED,
        workspace_json=f"{POSED}.json",
        masks="results/objects/{object}/masks",
        masks_json="results/objects/{object}/masks.json",
    output:
        stage=maps("results/objects/{object}/stage1"),
        report="results/objects/{object}/stage1.json",
    log:
        "results/logs/train_depth/{object}.log",
    benchmark:
        "results/benchmarks/train_depth/{object}.tsv"
    conda:
        "../../envs/training.yaml"
    threads: OBJECT_THREADS
    resources:
        mem_mb=by_photos(6000, 2000, 10, masked_photos),
        runtime=lambda wildcards, attempt: 240 * attempt,
        gpu=config["gpu"],
    params:
        options=settings(
            "object.stage1", "object.hold_out_every", without=["pose_source"]
        ),
        checkpoints="results/checkpoints/{object}/stage1",
        seed=config["seed"],
        script=script("nerf/train_depth.py"),
        code=code("nerf/train_depth.py"),
    message:
        "{wildcards.object}: stage 1, depth and pose networks"
    shell:
        "exec python {params.script} --workspace {input.workspace} --masks {input.masks} --stage {output.stage} --report {output.report}"
        " --checkpoints {params.checkpoints}/{params.code} --seed {params.seed} {params.options} &> {log}"


rule refine_depth:
    """Feedback: depth rendered by the NeRF refines the networks (stage 3)."""
    input:
        workspace=POSED,
        workspace_json=f"{POSED}.json",
        masks="results/objects/{object}/masks",
        masks_json="results/objects/{object}/masks.json",
        previous="results/objects/{object}/stage1",
        previous_json="results/objects/{object}/stage1.json",
        rendered="results/objects/{object}/stage2",
        rendered_json="results/objects/{object}/stage2.json",
    output:
        stage=maps("results/objects/{object}/stage3"),
        report="results/objects/{object}/stage3.json",
    log:
        "results/logs/refine_depth/{object}.log",
    benchmark:
        "results/benchmarks/refine_depth/{object}.tsv"
    conda:
        "../../envs/training.yaml"
    threads: OBJECT_THREADS
    resources:
        mem_mb=by_photos(6000, 2000, 10, masked_photos),
        runtime=lambda wildcards, attempt: 240 * attempt,
        gpu=config["gpu"],
    params:
        options=settings("object.stage3", "object.hold_out_every"),
        checkpoints="results/checkpoints/{object}/stage3",
        seed=config["seed"],
        script=script("nerf/refine_depth.py"),
        code=code("nerf/refine_depth.py"),
    message:
        "{wildcards.object}: stage 3, feedback"
    shell:
        "exec python {params.script} --workspace {input.workspace} --masks {input.masks} --previous {input.previous}"
        " --rendered {input.rendered} --stage {output.stage} --report {output.report}"
        " --checkpoints {params.checkpoints}/{params.code} --seed {params.seed} {params.options} &> {log}"

# The NeRF of an object, stages 2 and 4, and its cloud.
#
# INPUTS    results/objects/{object}/undistorted/, masks/, stage1/, stage3/; config: object.nerf, object.cloud
# OUTPUTS   results/objects/{object}/stage2/, stage2.json, stage4/, stage4.json
#           results/objects/{object}/object.ply, object.json                the cloud


rule train_object_nerf:
    """Depth-guided NeRF (stage 2)."""
    input:
        workspace=POSED,
        workspace_json=f"{POSED}.json",
        masks="results/objects/{object}/masks",
        masks_json="results/objects/{object}/masks.json",
        prior="results/objects/{object}/stage1",
        prior_json="results/objects/{object}/stage1.json",
    output:
        stage=maps("results/objects/{object}/stage2"),
        report="results/objects/{object}/stage2.json",
    log:
        "results/logs/train_object_nerf/{object}.log",
    benchmark:
        "results/benchmarks/train_object_nerf/{object}.tsv"
    conda:
        "../../envs/training.yaml"
    threads: OBJECT_THREADS
    resources:
        mem_mb=by_photos(8000, 1000, 100, masked_photos),
        runtime=lambda wildcards, attempt: 480 * attempt,
        gpu=config["gpu"],
    params:
        options=settings("object.nerf", "object.stage2", "object.hold_out_every"),
        previous="",
        checkpoints="results/checkpoints/{object}/stage2",
        seed=config["seed"],
        script=script("nerf/train_object_nerf.py"),
        code=code("nerf/train_object_nerf.py"),
    message:
        "{wildcards.object}: stage 2, depth-guided NeRF"
    shell:
        "exec python {params.script} --workspace {input.workspace} --masks {input.masks} --prior {input.prior} {params.previous}"
        " --stage {output.stage} --report {output.report} --checkpoints {params.checkpoints}/{params.code}"
        " --seed {params.seed} {params.options} &> {log}"


use rule train_object_nerf as retrain_object_nerf with:
    """The NeRF again, guided by the refined depth (stage 4)."""
    input:
        workspace=POSED,
        workspace_json=f"{POSED}.json",
        masks="results/objects/{object}/masks",
        masks_json="results/objects/{object}/masks.json",
        prior="results/objects/{object}/stage3",
        prior_json="results/objects/{object}/stage3.json",
        previous="results/objects/{object}/stage2",
        previous_json="results/objects/{object}/stage2.json",
    output:
        stage=maps("results/objects/{object}/stage4"),
        report="results/objects/{object}/stage4.json",
    log:
        "results/logs/retrain_object_nerf/{object}.log",
    benchmark:
        "results/benchmarks/retrain_object_nerf/{object}.tsv"
    params:
        options=settings("object.nerf", "object.stage4", "object.hold_out_every"),
        previous="--previous results/objects/{object}/stage2",
        checkpoints="results/checkpoints/{object}/stage4",
        seed=config["seed"],
        script=script("nerf/train_object_nerf.py"),
        code=code("nerf/train_object_nerf.py"),
    message:
        "{wildcards.object}: stage 4, final NeRF"


rule make_object_cloud:
    """Fuse the NeRF's depth maps into the object's cloud."""
    input:
        workspace=POSED,
        workspace_json=f"{POSED}.json",
        masks="results/objects/{object}/masks",
        masks_json="results/objects/{object}/masks.json",
        stage="results/objects/{object}/stage4",
        stage_json="results/objects/{object}/stage4.json",
    output:
        cloud="results/objects/{object}/object.ply",
        report="results/objects/{object}/object.json",
    log:
        "results/logs/make_object_cloud/{object}.log",
    benchmark:
        "results/benchmarks/make_object_cloud/{object}.tsv"
    conda:
        "../../envs/training.yaml"
    threads: OBJECT_THREADS
    resources:
        mem_mb=by_photos(4000, 1000, 80, masked_photos),
        runtime=lambda wildcards, attempt: 60 * attempt,
    params:
        options=settings("object.cloud"),
        seed=config["seed"],
        script=script("nerf/make_object_cloud.py"),
        code=code("nerf/make_object_cloud.py"),
    message:
        "{wildcards.object}: cloud"
    shell:
        "exec python {params.script} --workspace {input.workspace} --workspace-json {input.workspace_json} --masks {input.masks}"
        " --stage {input.stage} --stage-json {input.stage_json} --cloud {output.cloud} --report {output.report}"
        " --seed {params.seed} {params.options} &> {log}"

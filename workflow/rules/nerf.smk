# The NeRF of an object, stages 2 and 4, and its cloud.
#
# INPUTS    results/objects/{object}/undistorted/ (or poses/), masks/, stage1/, stage3/; config: object.nerf, object.cloud
# OUTPUTS   results/objects/{object}/stage2/, stage2.json, stage4/, stage4.json
#           results/objects/{object}/object.ply, object.json                the cloud


NERF = config["object"]["nerf"]


rule train_object_nerf:
    """Depth-guided NeRF (stage 2)."""
    input:
        cameras=POSED,
        cameras_json=f"{POSED}.json",
        masks="results/objects/{object}/masks",
        masks_json="results/objects/{object}/masks.json",
        depth="results/objects/{object}/stage1",
        depth_json="results/objects/{object}/stage1.json",
    output:
        stage=directory("results/objects/{object}/stage2"),
        report="results/objects/{object}/stage2.json",
    log:
        "results/logs/train_object_nerf/{object}.log",
    benchmark:
        "results/benchmarks/train_object_nerf/{object}.tsv"
    conda:
        "../../envs/training.yaml"
    threads: 1
    resources:
        mem_mb=lambda wildcards, attempt: 8000 * attempt,
        runtime=lambda wildcards, attempt: 480 * attempt,
        gpu=config["gpu"],
    params:
        options=flags(NERF | config["object"]["stage2"] | HELD_OUT),
        checkpoints="results/checkpoints/{object}/stage2",
        seed=config["seed"],
        script=script("nerf/train_object_nerf.py"),
        code=code("nerf/train_object_nerf.py"),
    message:
        "{wildcards.object}: stage 2, depth-guided NeRF"
    shell:
        "exec python {params.script} --cameras {input.cameras} --masks {input.masks} --prior {input.depth} --previous None"
        " --stage {output.stage} --report {output.report} --checkpoints {params.checkpoints}/{params.code}"
        " --seed {params.seed} {params.options} &> {log}"


rule retrain_object_nerf:
    """The NeRF again, guided by the refined depth (stage 4)."""
    input:
        cameras=POSED,
        cameras_json=f"{POSED}.json",
        masks="results/objects/{object}/masks",
        masks_json="results/objects/{object}/masks.json",
        depth="results/objects/{object}/stage3",
        depth_json="results/objects/{object}/stage3.json",
        nerf="results/objects/{object}/stage2",
        nerf_json="results/objects/{object}/stage2.json",
    output:
        stage=directory("results/objects/{object}/stage4"),
        report="results/objects/{object}/stage4.json",
    log:
        "results/logs/retrain_object_nerf/{object}.log",
    benchmark:
        "results/benchmarks/retrain_object_nerf/{object}.tsv"
    conda:
        "../../envs/training.yaml"
    threads: 1
    resources:
        mem_mb=lambda wildcards, attempt: 8000 * attempt,
        runtime=lambda wildcards, attempt: 480 * attempt,
        gpu=config["gpu"],
    params:
        options=flags(NERF | config["object"]["stage4"] | HELD_OUT),
        checkpoints="results/checkpoints/{object}/stage4",
        seed=config["seed"],
        script=script("nerf/train_object_nerf.py"),
        code=code("nerf/train_object_nerf.py"),
    message:
        "{wildcards.object}: stage 4, final NeRF"
    shell:
        "exec python {params.script} --cameras {input.cameras} --masks {input.masks} --prior {input.depth} --previous {input.nerf}"
        " --stage {output.stage} --report {output.report} --checkpoints {params.checkpoints}/{params.code}"
        " --seed {params.seed} {params.options} &> {log}"


rule make_object_cloud:
    """Fuse the NeRF's depth maps into the object's cloud."""
    input:
        cameras=POSED,
        cameras_json=f"{POSED}.json",
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
    threads: 1
    resources:
        mem_mb=lambda wildcards, attempt: 4000 * attempt,
        runtime=lambda wildcards, attempt: 60 * attempt,
    params:
        options=flags(config["object"]["cloud"]),
        seed=config["seed"],
        script=script("nerf/make_object_cloud.py"),
        code=code("nerf/make_object_cloud.py"),
    message:
        "{wildcards.object}: cloud"
    shell:
        "exec python {params.script} --cameras {input.cameras} --cameras-report {input.cameras_json} --masks {input.masks}"
        " --stage {input.stage} --stage-report {input.stage_json} --cloud {output.cloud} --report {output.report}"
        " --seed {params.seed} {params.options} &> {log}"

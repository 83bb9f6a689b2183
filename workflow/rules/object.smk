# The object: from close-up photos or a video to a cloud in its own frame.
#
# INPUTS    config/objects.tsv: photos, prompts or masks; config: object, seed, gpu
# OUTPUTS   results/objects/{object}/frames/, photos.json              the photos, checked and at most a given width
#           results/objects/{object}/features.db, database.db          COLMAP databases
#           results/objects/{object}/sfm/, sfm.json                    cameras and sparse points
#           results/objects/{object}/cameras/, cameras.json            undistorted photos with pinhole cameras
#           results/weights/                                           SAM 2's, for masks by it
#           results/objects/{object}/masks/, masks.json, masks.png     where the object is in each photo
#           results/objects/{object}/poses/, poses.json                the same with poses found without SfM, for pose_source network
#           results/objects/{object}/stage1/ .. stage4/, stage1.json   depth and pose networks; NeRF; feedback; NeRF
#           results/objects/{object}/object.ply, object.json           the cloud


STAGE1 = dict(config["object"]["stage1"])
# The workspace that the training stages read; both have the same photos, and poses in the same frame.
POSED = {
    "sfm": "results/objects/{object}/cameras",
    "network": "results/objects/{object}/poses",
}[STAGE1.pop("pose_source")]
NERF = config["object"]["nerf"] | config["object"]["matching"]
HELD_OUT = {"hold_out_every": config["object"]["hold_out_every"]}


rule frames:
    """Frames from a folder of photos or a video."""
    input:
        object_photos,
    output:
        frames=directory("results/objects/{object}/frames"),
        photos="results/objects/{object}/photos.json",
    log:
        "results/logs/frames/{object}.log",
    benchmark:
        "results/benchmarks/frames/{object}.tsv"
    conda:
        "../../envs/reconstruction.yaml"
    resources:
        mem_mb=lambda wildcards, attempt: 2000 * attempt,
        runtime=lambda wildcards, attempt: 60 * attempt,
    params:
        source=object_source,
        options=flags(config["object"]["frames"]),
        script=script("frames.py"),
        code=code("frames.py"),
    message:
        "{wildcards.object}: frames"
    shell:
        "exec python {params.script} --source {params.source} --frames {output.frames} --photos {output.photos} {params.options} &> {log}"


rule object_features:
    """SIFT features."""
    input:
        frames="results/objects/{object}/frames",
        photos="results/objects/{object}/photos.json",
    output:
        "results/objects/{object}/features.db",
    log:
        "results/logs/object_features/{object}.log",
    benchmark:
        "results/benchmarks/object_features/{object}.tsv"
    conda:
        "../../envs/reconstruction.yaml"
    threads: 8
    resources:
        mem_mb=lambda wildcards, attempt: 4000 * attempt,
        runtime=lambda wildcards, attempt: 60 * attempt,
    params:
        options=flags(config["object"]["features"]),
        script=script("features.py"),
        code=code("features.py"),
    message:
        "{wildcards.object}: features"
    shell:
        "exec python {params.script} --folder {input.frames} --photos {input.photos} --features {output} {params.options} &> {log}"


rule object_matches:
    """Match pairs of frames."""
    input:
        photos="results/objects/{object}/photos.json",
        features="results/objects/{object}/features.db",
    output:
        database="results/objects/{object}/database.db",
        report="results/objects/{object}/matches.json",
    log:
        "results/logs/object_matches/{object}.log",
    benchmark:
        "results/benchmarks/object_matches/{object}.tsv"
    conda:
        "../../envs/reconstruction.yaml"
    threads: 8
    resources:
        mem_mb=lambda wildcards, attempt: 4000 * attempt,
        runtime=lambda wildcards, attempt: 120 * attempt,
    params:
        options=flags(config["object"]["matches"]),
        seed=config["seed"],
        script=script("matches.py"),
        code=code("matches.py"),
    message:
        "{wildcards.object}: matching"
    shell:
        "exec python {params.script} --photos {input.photos} --features {input.features} --database {output.database}"
        " --matches {output.report} --seed {params.seed} {params.options} &> {log}"


rule object_sfm:
    """Cameras and sparse points by incremental mapping."""
    input:
        frames="results/objects/{object}/frames",
        photos="results/objects/{object}/photos.json",
        database="results/objects/{object}/database.db",
    output:
        model=directory("results/objects/{object}/sfm"),
        report="results/objects/{object}/sfm.json",
    log:
        "results/logs/object_sfm/{object}.log",
    benchmark:
        "results/benchmarks/object_sfm/{object}.tsv"
    conda:
        "../../envs/reconstruction.yaml"
    threads: 8
    resources:
        mem_mb=lambda wildcards, attempt: 4000 * attempt,
        runtime=lambda wildcards, attempt: 120 * attempt,
    params:
        options=flags(config["object"]["sparse"]),
        seed=config["seed"],
        script=script("sparse.py"),
        code=code("sparse.py"),
    message:
        "{wildcards.object}: cameras and sparse points"
    shell:
        "exec python {params.script} --folder {input.frames} --photos {input.photos} --database {input.database}"
        " --sparse {output.model} --report {output.report} --seed {params.seed} {params.options} &> {log}"


rule cameras:
    """Undistort the frames, and find which way is up."""
    input:
        frames="results/objects/{object}/frames",
        photos="results/objects/{object}/photos.json",
        model="results/objects/{object}/sfm",
        report="results/objects/{object}/sfm.json",
    output:
        cameras=directory("results/objects/{object}/cameras"),
        report="results/objects/{object}/cameras.json",
    log:
        "results/logs/cameras/{object}.log",
    benchmark:
        "results/benchmarks/cameras/{object}.tsv"
    conda:
        "../../envs/reconstruction.yaml"
    resources:
        mem_mb=lambda wildcards, attempt: 2000 * attempt,
        runtime=lambda wildcards, attempt: 30 * attempt,
    params:
        options=flags(config["object"]["cameras"]),
        script=script("cameras.py"),
        code=code("cameras.py"),
    message:
        "{wildcards.object}: undistorting"
    shell:
        "exec python {params.script} --folder {input.frames} --photos {input.photos} --sparse {input.model}"
        " --cameras {output.cameras} --report {output.report} {params.options} &> {log}"


rule sam2_weights:
    """SAM 2's weights for ONNX Runtime; not asked for where the config names others."""
    output:
        encoder="results/weights/sam2_encoder.ort",
        decoder="results/weights/sam2_decoder.onnx",
    log:
        "results/logs/sam2_weights.log",
    localrule: True
    conda:
        "../../envs/reconstruction.yaml"
    params:
        options=flags(
            {
                "package": config["object"]["masks"]["sam2_package"],
                "sam2_encoder_sha256": config["object"]["masks"][
                    "sam2_encoder_sha256"
                ],
                "sam2_decoder_sha256": config["object"]["masks"][
                    "sam2_decoder_sha256"
                ],
            }
        ),
        script=script("sam2_weights.py"),
        code=code("sam2_weights.py"),
    message:
        "SAM 2's weights"
    shell:
        "exec python {params.script} --sam2-encoder {output.encoder} --sam2-decoder {output.decoder} {params.options} &> {log}"


rule masks:
    """Where the object is in each frame: SAM 2, GrabCut, or your own masks (paper 3.2)."""
    input:
        mask_inputs,
        photos="results/objects/{object}/photos.json",
        sfm="results/objects/{object}/sfm",
        cameras="results/objects/{object}/cameras",
        cameras_json="results/objects/{object}/cameras.json",
    output:
        masks=directory("results/objects/{object}/masks"),
        report="results/objects/{object}/masks.json",
        sheet=report(
            "results/objects/{object}/masks.png",
            category="Objects",
            subcategory="{object}",
            caption="../report/masks.rst",
        ),
    log:
        "results/logs/masks/{object}.log",
    benchmark:
        "results/benchmarks/masks/{object}.tsv"
    conda:
        "../../envs/reconstruction.yaml"
    resources:
        mem_mb=lambda wildcards, attempt: 4000 * attempt,
        runtime=lambda wildcards, attempt: 120 * attempt,
    params:
        options=mask_options,
        seed=config["seed"],
        script=script("masks.py"),
        code=code("masks.py"),
    message:
        "{wildcards.object}: masks"
    shell:
        "exec python {params.script} --cameras {input.cameras} --cameras-json {input.cameras_json} --sfm {input.sfm} --photos {input.photos}"
        " --masks {output.masks} --report {output.report} --contact-sheet {output.sheet} --seed {params.seed} {params.options} &> {log}"


rule poses:
    """Camera poses without SfM, for pose_source network (paper 3.2; N11)."""
    input:
        cameras="results/objects/{object}/cameras",
        cameras_json="results/objects/{object}/cameras.json",
    output:
        posed=directory("results/objects/{object}/poses"),
        report="results/objects/{object}/poses.json",
    log:
        "results/logs/poses/{object}.log",
    benchmark:
        "results/benchmarks/poses/{object}.tsv"
    conda:
        "../../envs/training.yaml"
    threads: 8
    resources:
        mem_mb=lambda wildcards, attempt: 4000 * attempt,
        runtime=lambda wildcards, attempt: 120 * attempt,
        gpu=config["gpu"],
    params:
        options=flags(config["object"]["poses"]),
        seed=config["seed"],
        script=script("poses.py"),
        code=code("poses.py"),
    message:
        "{wildcards.object}: poses without SfM"
    shell:
        "exec python {params.script} --cameras {input.cameras} --posed {output.posed} --report {output.report}"
        " --seed {params.seed} {params.options} &> {log}"


rule stage1:
    """Self-supervised depth and pose networks (paper 3.2 and 4.2.2, stage 1)."""
    input:
        cameras=POSED,
        cameras_json=f"{POSED}.json",
        masks="results/objects/{object}/masks",
        masks_json="results/objects/{object}/masks.json",
    output:
        stage=directory("results/objects/{object}/stage1"),
        report="results/objects/{object}/stage1.json",
    log:
        "results/logs/stage1/{object}.log",
    benchmark:
        "results/benchmarks/stage1/{object}.tsv"
    conda:
        "../../envs/training.yaml"
    threads: 8
    resources:
        mem_mb=lambda wildcards, attempt: 6000 * attempt,
        runtime=lambda wildcards, attempt: 240 * attempt,
        gpu=config["gpu"],
    params:
        options=flags(STAGE1 | HELD_OUT),
        checkpoints="results/checkpoints/{object}/stage1",
        seed=config["seed"],
        script=script("depth.py"),
        code=code("depth.py"),
    message:
        "{wildcards.object}: stage 1, depth and pose networks"
    shell:
        "exec python {params.script} --cameras {input.cameras} --masks {input.masks} --stage {output.stage} --report {output.report}"
        " --checkpoints {params.checkpoints}/{params.code} --seed {params.seed} {params.options} &> {log}"


rule stage2:
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
        "results/logs/stage2/{object}.log",
    benchmark:
        "results/benchmarks/stage2/{object}.tsv"
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
        script=script("nerf_stage.py"),
        code=code("nerf_stage.py"),
    message:
        "{wildcards.object}: stage 2, depth-guided NeRF"
    shell:
        "exec python {params.script} --cameras {input.cameras} --masks {input.masks} --prior {input.depth} --previous None"
        " --stage {output.stage} --report {output.report} --checkpoints {params.checkpoints}/{params.code}"
        " --seed {params.seed} {params.options} &> {log}"


rule stage3:
    """Feedback: depth rendered by the NeRF refines the networks (stage 3)."""
    input:
        cameras=POSED,
        cameras_json=f"{POSED}.json",
        masks="results/objects/{object}/masks",
        masks_json="results/objects/{object}/masks.json",
        previous="results/objects/{object}/stage1",
        previous_json="results/objects/{object}/stage1.json",
        rendered="results/objects/{object}/stage2",
        rendered_json="results/objects/{object}/stage2.json",
    output:
        stage=directory("results/objects/{object}/stage3"),
        report="results/objects/{object}/stage3.json",
    log:
        "results/logs/stage3/{object}.log",
    benchmark:
        "results/benchmarks/stage3/{object}.tsv"
    conda:
        "../../envs/training.yaml"
    threads: 8
    resources:
        mem_mb=lambda wildcards, attempt: 6000 * attempt,
        runtime=lambda wildcards, attempt: 240 * attempt,
        gpu=config["gpu"],
    params:
        options=flags(config["object"]["stage3"] | HELD_OUT),
        checkpoints="results/checkpoints/{object}/stage3",
        seed=config["seed"],
        script=script("feedback.py"),
        code=code("feedback.py"),
    message:
        "{wildcards.object}: stage 3, feedback"
    shell:
        "exec python {params.script} --cameras {input.cameras} --masks {input.masks} --previous {input.previous}"
        " --rendered {input.rendered} --stage {output.stage} --report {output.report}"
        " --checkpoints {params.checkpoints}/{params.code} --seed {params.seed} {params.options} &> {log}"


rule stage4:
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
        "results/logs/stage4/{object}.log",
    benchmark:
        "results/benchmarks/stage4/{object}.tsv"
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
        script=script("nerf_stage.py"),
        code=code("nerf_stage.py"),
    message:
        "{wildcards.object}: stage 4, final NeRF"
    shell:
        "exec python {params.script} --cameras {input.cameras} --masks {input.masks} --prior {input.depth} --previous {input.nerf}"
        " --stage {output.stage} --report {output.report} --checkpoints {params.checkpoints}/{params.code}"
        " --seed {params.seed} {params.options} &> {log}"


rule object_cloud:
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
        "results/logs/object_cloud/{object}.log",
    benchmark:
        "results/benchmarks/object_cloud/{object}.tsv"
    conda:
        "../../envs/training.yaml"
    threads: 1
    resources:
        mem_mb=lambda wildcards, attempt: 4000 * attempt,
        runtime=lambda wildcards, attempt: 60 * attempt,
    params:
        options=flags(config["object"]["cloud"] | config["object"]["matching"]),
        seed=config["seed"],
        script=script("object_cloud.py"),
        code=code("object_cloud.py"),
    message:
        "{wildcards.object}: cloud"
    shell:
        "exec python {params.script} --cameras {input.cameras} --cameras-report {input.cameras_json} --masks {input.masks}"
        " --stage {input.stage} --stage-report {input.stage_json} --cloud {output.cloud} --report {output.report}"
        " --seed {params.seed} {params.options} &> {log}"

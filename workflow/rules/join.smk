# The join: witness, crop, scale, coarse and fine registration, fusion, metrics; and each scene with all its objects.
#
# INPUTS    config/objects.tsv: fiducials, where there are any; the scene's cloud and model; the object's cloud; config: registration, arms, fusion, metrics
# OUTPUTS   results/objects/{object}/witness.json                where photographs alone put the object
#           results/objects/{object}/registration/{arm}/crop.ply, crop.json, scale.json, coarse.json, fine.json, fine.png, metrics.json
#           results/objects/{object}/fused.ply, fused_scene.ply, fused_scene.laz, fusion.json     of the `full` arm
#           results/objects/{object}/frames.json, metrics.json
#           results/scenes/{scene}/completed.ply, completed.laz, completed.json
#
# An arm is a registration recipe: `full` is the one that is fused, the others (`paper`, `no_witness`, `no_scale`, `no_crop`) are run beside it
# by the same scripts, with the settings that config `arms` lays over config `registration`, and measured at the same thresholds.


rule witness:
    """Find the object in the scene by features that their photos share (R14)."""
    input:
        object_model="results/objects/{object}/sfm",
        object_json="results/objects/{object}/sfm.json",
        object_features="results/objects/{object}/features.db",
        scene_model=in_scene("georeferenced"),
        scene_json=in_scene("georeference.json"),
        scene_features=in_scene("features.db"),
    output:
        "results/objects/{object}/witness.json",
    log:
        "results/logs/witness/{object}.log",
    benchmark:
        "results/benchmarks/witness/{object}.tsv"
    conda:
        "../../envs/registration.yaml"
    threads: 8
    resources:
        mem_mb=lambda wildcards, attempt: 4000 * attempt,
        runtime=lambda wildcards, attempt: 30 * attempt,
    params:
        options=flags(config["registration"]["witness"]),
        seed=config["seed"],
        script=script("witness.py"),
        code=code("witness.py"),
    message:
        "{wildcards.object}: second witness"
    shell:
        "exec python {params.script} --object-model {input.object_model} --object-features {input.object_features}"
        " --scene-model {input.scene_model} --scene-features {input.scene_features} --witness {output}"
        " --seed {params.seed} {params.options} &> {log}"


rule crop:
    """Cut the object's surroundings out of the scene by its fiducials, or by its masks' votes (paper 3.3; C1 to C3)."""
    input:
        crop_inputs,
        scene=in_scene("dense.ply"),
        model=in_scene("georeferenced"),
        model_json=in_scene("georeference.json"),
    output:
        crop="results/objects/{object}/registration/{arm}/crop.ply",
        report="results/objects/{object}/registration/{arm}/crop.json",
    log:
        "results/logs/crop/{object}-{arm}.log",
    benchmark:
        "results/benchmarks/crop/{object}-{arm}.tsv"
    conda:
        "../../envs/registration.yaml"
    resources:
        mem_mb=lambda wildcards, attempt: 4000 * attempt,
        runtime=lambda wildcards, attempt: 30 * attempt,
    params:
        options=crop_options,
        script=script("crop.py"),
        code=code("crop.py"),
    message:
        "{wildcards.object}, arm {wildcards.arm}: crop"
    shell:
        "exec python {params.script} --scene {input.scene} --model {input.model} --georeference {input.model_json}"
        " --crop {output.crop} --report {output.report} {params.options} &> {log}"


rule scale:
    """How large the object's unit is in the scene (paper 3.3; R1 to R4)."""
    input:
        cloud="results/objects/{object}/object.ply",
        cloud_json="results/objects/{object}/object.json",
        crop="results/objects/{object}/registration/{arm}/crop.ply",
        crop_json="results/objects/{object}/registration/{arm}/crop.json",
        cameras="results/objects/{object}/cameras.json",
    output:
        "results/objects/{object}/registration/{arm}/scale.json",
    log:
        "results/logs/scale/{object}-{arm}.log",
    benchmark:
        "results/benchmarks/scale/{object}-{arm}.tsv"
    conda:
        "../../envs/registration.yaml"
    resources:
        mem_mb=lambda wildcards, attempt: 2000 * attempt,
        runtime=lambda wildcards, attempt: 30 * attempt,
    params:
        options=arm_options("scale"),
        script=script("scale.py"),
        code=code("scale.py"),
    message:
        "{wildcards.object}, arm {wildcards.arm}: scale"
    shell:
        "exec python {params.script} --object {input.cloud} --crop {input.crop} --crop-report {input.crop_json} --cameras {input.cameras}"
        " --report {output} {params.options} &> {log}"


rule coarse:
    """Hypotheses of the object's pose in the scene (R3, R6)."""
    input:
        cloud="results/objects/{object}/object.ply",
        cloud_json="results/objects/{object}/object.json",
        crop="results/objects/{object}/registration/{arm}/crop.ply",
        crop_json="results/objects/{object}/registration/{arm}/crop.json",
        cameras="results/objects/{object}/cameras.json",
        scale="results/objects/{object}/registration/{arm}/scale.json",
    output:
        "results/objects/{object}/registration/{arm}/coarse.json",
    log:
        "results/logs/coarse/{object}-{arm}.log",
    benchmark:
        "results/benchmarks/coarse/{object}-{arm}.tsv"
    conda:
        "../../envs/registration.yaml"
    threads: 2
    resources:
        mem_mb=lambda wildcards, attempt: 4000 * attempt,
        runtime=lambda wildcards, attempt: 60 * attempt,
    params:
        options=arm_options("coarse"),
        seed=config["seed"],
        script=script("coarse.py"),
        code=code("coarse.py"),
    message:
        "{wildcards.object}, arm {wildcards.arm}: coarse registration"
    shell:
        "exec python {params.script} --object {input.cloud} --crop {input.crop} --crop-report {input.crop_json} --cameras {input.cameras}"
        " --scale {input.scale} --report {output} --seed {params.seed} {params.options} &> {log}"


rule fine:
    """Refine the hypotheses, judge them, and register or refuse (R8, R9, R12)."""
    input:
        cloud="results/objects/{object}/object.ply",
        cloud_json="results/objects/{object}/object.json",
        crop="results/objects/{object}/registration/{arm}/crop.ply",
        crop_json="results/objects/{object}/registration/{arm}/crop.json",
        cameras="results/objects/{object}/cameras.json",
        scale="results/objects/{object}/registration/{arm}/scale.json",
        coarse="results/objects/{object}/registration/{arm}/coarse.json",
        witness="results/objects/{object}/witness.json",
        workspace=in_scene("dense"),
        depth=in_scene(*(f"depth/{chunk}" for chunk in CHUNKS)),
        depth_json=in_scene(*(f"depth/{chunk}.json" for chunk in CHUNKS)),
    output:
        fine="results/objects/{object}/registration/{arm}/fine.json",
        picture=report(
            "results/objects/{object}/registration/{arm}/fine.png",
            category="Objects",
            subcategory="{object}",
            caption="../report/fine.rst",
        ),
    log:
        "results/logs/fine/{object}-{arm}.log",
    benchmark:
        "results/benchmarks/fine/{object}-{arm}.tsv"
    conda:
        "../../envs/registration.yaml"
    threads: 2
    resources:
        mem_mb=lambda wildcards, attempt: 4000 * attempt,
        runtime=lambda wildcards, attempt: 60 * attempt,
    params:
        options=arm_options("fine"),
        seed=config["seed"],
        script=script("fine.py"),
        code=code("fine.py"),
    message:
        "{wildcards.object}, arm {wildcards.arm}: fine registration"
    shell:
        "exec python {params.script} --object {input.cloud} --crop {input.crop} --crop-report {input.crop_json} --cameras {input.cameras}"
        " --scale {input.scale} --coarse {input.coarse} --witness {input.witness} --workspace {input.workspace} --depth {input.depth} --fine {output.fine} --picture {output.picture}"
        " --seed {params.seed} {params.options} &> {log}"


rule fuse:
    """Add the registered object to the scene; an unregistered one leaves the scene as it is (F1, F2)."""
    input:
        cloud="results/objects/{object}/object.ply",
        cloud_json="results/objects/{object}/object.json",
        crop="results/objects/{object}/registration/full/crop.ply",
        crop_json="results/objects/{object}/registration/full/crop.json",
        fine="results/objects/{object}/registration/full/fine.json",
        scene=in_scene("dense.ply"),
        georeference=in_scene("georeference.json"),
    output:
        fused="results/objects/{object}/fused.ply",
        scene="results/objects/{object}/fused_scene.ply",
        laz="results/objects/{object}/fused_scene.laz",
        report="results/objects/{object}/fusion.json",
    log:
        "results/logs/fuse/{object}.log",
    benchmark:
        "results/benchmarks/fuse/{object}.tsv"
    conda:
        "../../envs/registration.yaml"
    resources:
        mem_mb=lambda wildcards, attempt: 6000 * attempt,
        runtime=lambda wildcards, attempt: 60 * attempt,
    params:
        options=flags(config["fusion"]),
        script=script("fuse.py"),
        code=code("fuse.py"),
    message:
        "{wildcards.object}: fusion"
    shell:
        "exec python {params.script} --object {input.cloud} --scene {input.scene} --crop {input.crop} --crop-report {input.crop_json}"
        " --fine {input.fine} --georeference {input.georeference} --fused {output.fused} --fused-scene {output.scene}"
        " --fused-laz {output.laz} --report {output.report} {params.options} &> {log}"


rule complete_scene:
    """The scene with all its registered objects in it; `source` says where each point is from (F3)."""
    input:
        scene="results/scenes/{scene}/dense.ply",
        georeference="results/scenes/{scene}/georeference.json",
        objects=of_objects("object.ply"),
        crops=of_objects("registration/full/crop.ply"),
        fines=of_objects("registration/full/fine.json"),
    output:
        cloud="results/scenes/{scene}/completed.ply",
        laz="results/scenes/{scene}/completed.laz",
        report="results/scenes/{scene}/completed.json",
    log:
        "results/logs/complete_scene/{scene}.log",
    benchmark:
        "results/benchmarks/complete_scene/{scene}.tsv"
    conda:
        "../../envs/registration.yaml"
    resources:
        mem_mb=lambda wildcards, attempt: 6000 * attempt,
        runtime=lambda wildcards, attempt: 60 * attempt,
    params:
        options=flags(config["fusion"]),
        names=objects_in,
        script=script("complete_scene.py"),
        code=code("complete_scene.py"),
    message:
        "Scene {wildcards.scene}: all objects in it"
    shell:
        "exec python {params.script} --scene {input.scene} --names {params.names} --objects {input.objects}"
        " --crops {input.crops} --fines {input.fines} --georeference {input.georeference} --completed {output.cloud}"
        " --completed-laz {output.laz} --report {output.report} {params.options} &> {log}"


rule frame_ledger:
    """Every transform between the object's frames, in one file."""
    input:
        cloud="results/objects/{object}/object.json",
        fine="results/objects/{object}/registration/full/fine.json",
        georeference=in_scene("georeference.json"),
    output:
        "results/objects/{object}/frames.json",
    log:
        "results/logs/frame_ledger/{object}.log",
    benchmark:
        "results/benchmarks/frame_ledger/{object}.tsv"
    conda:
        "../../envs/registration.yaml"
    resources:
        mem_mb=lambda wildcards, attempt: 500 * attempt,
        runtime=lambda wildcards, attempt: 10 * attempt,
    params:
        script=script("frame_ledger.py"),
        code=code("frame_ledger.py"),
    message:
        "{wildcards.object}: frame ledger"
    shell:
        "exec python {params.script} --object-report {input.cloud} --fine {input.fine} --georeference {input.georeference}"
        " --frames {output} &> {log}"


rule metrics:
    """Registration and completion metrics, each with its null value (paper 3.3.1 and 3.3.2; G1 to G5)."""
    input:
        cloud="results/objects/{object}/object.ply",
        cloud_json="results/objects/{object}/object.json",
        crop="results/objects/{object}/registration/full/crop.ply",
        crop_json="results/objects/{object}/registration/full/crop.json",
        fine="results/objects/{object}/registration/full/fine.json",
        fused="results/objects/{object}/fused.ply",
    output:
        "results/objects/{object}/metrics.json",
    log:
        "results/logs/metrics/{object}.log",
    benchmark:
        "results/benchmarks/metrics/{object}.tsv"
    conda:
        "../../envs/registration.yaml"
    resources:
        mem_mb=lambda wildcards, attempt: 4000 * attempt,
        runtime=lambda wildcards, attempt: 60 * attempt,
    params:
        options=flags(config["metrics"]),
        seed=config["seed"],
        script=script("metrics.py"),
        code=code("metrics.py"),
    message:
        "{wildcards.object}: metrics"
    shell:
        "exec python {params.script} --object {input.cloud} --crop {input.crop} --reference {input.crop_json} --fine {input.fine}"
        " --fused {input.fused} --metrics {output} --seed {params.seed} {params.options} &> {log}"


rule arm_metrics:
    """Registration metrics of one arm, at the full arm's thresholds and on its crop."""
    input:
        cloud="results/objects/{object}/object.ply",
        cloud_json="results/objects/{object}/object.json",
        crop="results/objects/{object}/registration/full/crop.ply",
        crop_json="results/objects/{object}/registration/full/crop.json",
        fine="results/objects/{object}/registration/{arm}/fine.json",
    output:
        "results/objects/{object}/registration/{arm}/metrics.json",
    log:
        "results/logs/arm_metrics/{object}-{arm}.log",
    benchmark:
        "results/benchmarks/arm_metrics/{object}-{arm}.tsv"
    conda:
        "../../envs/registration.yaml"
    resources:
        mem_mb=lambda wildcards, attempt: 4000 * attempt,
        runtime=lambda wildcards, attempt: 30 * attempt,
    params:
        options=flags(config["metrics"]),
        seed=config["seed"],
        script=script("metrics.py"),
        code=code("metrics.py"),
    message:
        "{wildcards.object}, arm {wildcards.arm}: metrics"
    shell:
        "exec python {params.script} --object {input.cloud} --crop {input.crop} --reference {input.crop_json} --fine {input.fine}"
        " --fused None --metrics {output} --seed {params.seed} {params.options} &> {log}"

# Registration and completion metrics, and errors against truth where it is known.
#
# INPUTS    everything before; config/scenes.tsv, config/objects.tsv: truth
# OUTPUTS   results/objects/{object}/metrics.json, registration/{variant}/metrics.json
#           results/scenes/{scene}/truth.json, results/objects/{object}/truth.json      only with truth


include: "../functions/metrics.smk"


rule compute_metrics:
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
        "results/logs/compute_metrics/{object}.log",
    benchmark:
        "results/benchmarks/compute_metrics/{object}.tsv"
    conda:
        "../../envs/registration.yaml"
    resources:
        mem_mb=lambda wildcards, attempt: 4000 * attempt,
        runtime=lambda wildcards, attempt: 60 * attempt,
    params:
        fused=options_of("fused"),
        seed=config["seed"],
        script=script("metrics/compute_metrics.py"),
        code=code("metrics/compute_metrics.py"),
    message:
        "{wildcards.object}: metrics"
    shell:
        "exec python {params.script} --object {input.cloud} --crop {input.crop} --crop-json {input.crop_json} --fine-json {input.fine}"
        " {params.fused} --report {output} --seed {params.seed} &> {log}"


use rule compute_metrics as compute_variant_metrics with:
    # Registration metrics of a variant that is not fused, at the full variant's thresholds and on its crop.
    input:
        cloud="results/objects/{object}/object.ply",
        cloud_json="results/objects/{object}/object.json",
        crop="results/objects/{object}/registration/full/crop.ply",
        crop_json="results/objects/{object}/registration/full/crop.json",
        fine="results/objects/{object}/registration/{variant}/fine.json",
    output:
        "results/objects/{object}/registration/{variant}/metrics.json",
    log:
        "results/logs/compute_variant_metrics/{object}-{variant}.log",
    benchmark:
        "results/benchmarks/compute_variant_metrics/{object}-{variant}.tsv"
    message:
        "{wildcards.object}, variant {wildcards.variant}: metrics"


rule evaluate_scene:
    """Compare a scene with its truth, where it is known: cameras, georeferencing, dense cloud (G8)."""
    input:
        model="results/scenes/{scene}/georeferenced",
        georeference="results/scenes/{scene}/georeference.json",
        cloud="results/scenes/{scene}/dense.ply",
        truth=scene_truth,
    output:
        "results/scenes/{scene}/truth.json",
    log:
        "results/logs/evaluate_scene/{scene}.log",
    benchmark:
        "results/benchmarks/evaluate_scene/{scene}.tsv"
    conda:
        "../../envs/report.yaml"
    resources:
        mem_mb=lambda wildcards, attempt: 4000 * attempt,
        runtime=lambda wildcards, attempt: 30 * attempt,
    params:
        seed=config["seed"],
        script=script("metrics/evaluate_scene.py"),
        files=state_of(scene_truth),
        code=code("metrics/evaluate_scene.py"),
    message:
        "Scene {wildcards.scene}: comparing with the truth"
    shell:
        "exec python {params.script} --model {input.model} --georeference-json {input.georeference} --cloud {input.cloud}"
        " --truth-scene {input.truth:q} --report {output} --seed {params.seed} &> {log}"


rule evaluate_object:
    """Compare an object with its truth, where it is known: masks, cameras, depth after each stage, cloud, registration, fusion (G8)."""
    input:
        workspace=judging_photos,
        sparse="results/objects/{object}/sparse",
        undistorted="results/objects/{object}/undistorted",
        masks=if_masked("results/objects/{object}/masks"),
        stages=if_trained(
            *expand(
                "results/objects/{object}/stage{stage}",
                stage=[1, 2, 3, 4],
                allow_missing=True,
            )
        ),
        cloud="results/objects/{object}/object.ply",
        variants=expand(
            "results/objects/{object}/registration/{variant}/fine.json",
            variant=VARIANTS,
            allow_missing=True,
        ),
        scene=in_scene("dense.ply"),
        fused="results/objects/{object}/fused.ply",
        checked="results/objects/{object}/checked.ply",
        scene_json=in_scene("truth.json"),
        truth=object_truth,
    output:
        "results/objects/{object}/truth.json",
    log:
        "results/logs/evaluate_object/{object}.log",
    benchmark:
        "results/benchmarks/evaluate_object/{object}.tsv"
    conda:
        "../../envs/report.yaml"
    resources:
        mem_mb=lambda wildcards, attempt: 4000 * attempt,
        runtime=lambda wildcards, attempt: 30 * attempt,
    params:
        made=options_of("masks", "stages"),
        seed=config["seed"],
        script=script("metrics/evaluate_object.py"),
        files=state_of(object_truth),
        code=code("metrics/evaluate_object.py"),
    message:
        "{wildcards.object}: comparing with the truth"
    shell:
        "exec python {params.script} --workspace {input.workspace} --sparse {input.sparse} --undistorted {input.undistorted}"
        " {params.made} --cloud {input.cloud} --variants {input.variants} --scene {input.scene} --fused {input.fused}"
        " --checked {input.checked} --scene-json {input.scene_json} --truth-scene {input.truth[0]:q} --truth-object {input.truth[1]:q}"
        " --report {output} --seed {params.seed} &> {log}"

# Registration and completion metrics.
#
# INPUTS    everything before
# OUTPUTS   results/objects/{object}/metrics.json, registration/{variant}/metrics.json


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

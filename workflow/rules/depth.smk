# Depth of an object: by stereo and from SfM points in stage 1, what the NeRF renders in stage 3, both corrected by the photos.
#
# INPUTS    results/objects/{object}/undistorted/, masks/, stage2/; config: object.nerf.width_px
# OUTPUTS   results/objects/{object}/stage1/, stage1.json, stage3/, stage3.json


# The workspace that the cloud and what follows it read; in recipe paper with the poses of stage 3, in the same frame.
UNDISTORTED = "results/objects/{object}/undistorted"
POSED = (
    "results/objects/{object}/refined_poses"
    if config["object"]["recipe"] == "paper"
    else UNDISTORTED
)


rule estimate_depth_prior:
    """Depth by stereo and from SfM points, corrected by the photos (stage 1; paper 3.2 and 4.2.2 in recipe paper)."""
    input:
        workspace=POSED,
        workspace_json=f"{POSED}.json",
        masks="results/objects/{object}/masks",
        masks_json="results/objects/{object}/masks.json",
    output:
        stage=maps("results/objects/{object}/stage1"),
        report="results/objects/{object}/stage1.json",
    log:
        "results/logs/estimate_depth_prior/{object}.log",
    benchmark:
        "results/benchmarks/estimate_depth_prior/{object}.tsv"
    conda:
        "../../envs/training.yaml"
    threads: OBJECT_THREADS
    resources:
        mem_mb=by_photos(4000, 1000, 80, masked_photos),
        runtime=lambda wildcards, attempt: 60 * attempt,
        gpu=config["gpu"],
    params:
        options=settings("object.nerf.width_px", "object.hold_out_every"),
        script=script("nerf/estimate_depth_prior.py"),
        code=code("nerf/estimate_depth_prior.py"),
    message:
        "{wildcards.object}: stage 1, depth prior"
    shell:
        "exec python {params.script} --workspace {input.workspace} --masks {input.masks} --stage {output.stage} --report {output.report}"
        " {params.options} &> {log}"


rule refine_depth:
    """Feedback: photos correct the depth that the NeRF rendered (stage 3)."""
    input:
        workspace=POSED,
        workspace_json=f"{POSED}.json",
        masks="results/objects/{object}/masks",
        masks_json="results/objects/{object}/masks.json",
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
        mem_mb=by_photos(4000, 1000, 80, masked_photos),
        runtime=lambda wildcards, attempt: 60 * attempt,
    params:
        options=settings("object.nerf.width_px", "object.hold_out_every"),
        script=script("nerf/refine_depth.py"),
        code=code("nerf/refine_depth.py"),
    message:
        "{wildcards.object}: stage 3, feedback"
    shell:
        "exec python {params.script} --workspace {input.workspace} --masks {input.masks} --rendered {input.rendered}"
        " --stage {output.stage} --report {output.report} {params.options} &> {log}"

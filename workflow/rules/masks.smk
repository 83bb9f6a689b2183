# Where an object is in each of its photos.
#
# INPUTS    config/objects.tsv: prompts or masks; results/objects/{object}/undistorted/; config: object.masks
# OUTPUTS   results/objects/{object}/masks/, masks.json, masks.png
#           results/weights/sam2/                                           SAM 2's, for masks by it


include: "../functions/masks.smk"


rule fetch_sam2_weights:
    """SAM 2's weights for ONNX Runtime, or why they cannot be had; needed only by masks that use them."""
    output:
        directory("results/weights/sam2"),
    log:
        "results/logs/fetch_sam2_weights.log",
    localrule: True
    conda:
        "../../envs/reconstruction.yaml"
    params:
        script=script("masks/fetch_sam2_weights.py"),  # without `code`: the weights are known by their hashes
    message:
        "SAM 2's weights"
    shell:
        "exec python {params.script} --weights {output} &> {log}"


rule make_masks:
    """Where the object is in each frame: SAM 2, GrabCut, or your own masks (paper 3.2)."""
    input:
        as_inputs(mask_inputs),
        photos_json="results/objects/{object}/photos.json",
        sparse="results/objects/{object}/sparse",
        workspace="results/objects/{object}/undistorted",
        workspace_json="results/objects/{object}/undistorted.json",
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
        "results/logs/make_masks/{object}.log",
    benchmark:
        "results/benchmarks/make_masks/{object}.tsv"
    conda:
        "../../envs/reconstruction.yaml"
    threads: OBJECT_THREADS
    resources:
        mem_mb=by_photos(5000, 3200, 12, undistorted_photos),
        runtime=lambda wildcards, attempt: 120 * attempt,
    params:
        options=mask_options,
        seed=config["seed"],
        script=script("masks/make_masks.py"),
        files=state_of(mask_inputs),
        code=code("masks/make_masks.py"),
    message:
        "{wildcards.object}: masks"
    shell:
        "exec python {params.script} --workspace {input.workspace} --workspace-json {input.workspace_json}"
        " --sparse {input.sparse} --photos-json {input.photos_json}"
        " --masks {output.masks} --report {output.report} --contact-sheet {output.sheet} --seed {params.seed} {params.options} &> {log}"

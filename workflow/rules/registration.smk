# Where the object lies in the scene.
#
# INPUTS    config/objects.tsv: fiducials, where there are any; the scene's cloud and model; the object's cloud; config: registration
# OUTPUTS   results/objects/{object}/alignment.json                          the pose that shared features of the photos give
#           results/objects/{object}/registration/{variant}/crop.ply, crop.json, scale.json, coarse.json, fine.json, fine.png
#
# `full` is the variant that is fused; the others run beside it by the same scripts, with other options, and are measured at the same
# thresholds. `paper` has a crop by fiducials, and the paper's recipe is a stage of its own.
ruleorder: register_as_paper > register_object


include: "../functions/registration.smk"


rule align_models:
    """Find the object in the scene by features that their photos share (R14)."""
    input:
        object_sparse="results/objects/{object}/sparse",
        object_json="results/objects/{object}/sparse.json",
        object_features="results/objects/{object}/features.db",
        object_photos="results/objects/{object}/photos.json",
        scene_sparse=in_scene("georeferenced"),
        scene_json=in_scene("georeference.json"),
        scene_photos=in_scene("photos.json"),
        scene_features=in_scene("features.db"),
    output:
        "results/objects/{object}/alignment.json",
    log:
        "results/logs/align_models/{object}.log",
    benchmark:
        "results/benchmarks/align_models/{object}.tsv"
    conda:
        "../../envs/registration.yaml"
    threads: OBJECT_THREADS
    resources:
        mem_mb=lambda wildcards, attempt: 4000 * attempt,
        runtime=lambda wildcards, attempt: 30 * attempt,
    params:
        seed=config["seed"],
        script=script("georef/align_models.py"),
        code=code("georef/align_models.py"),
    message:
        "{wildcards.object}: alignment from shared features"
    shell:
        "exec python {params.script} --object-sparse {input.object_sparse} --object-features {input.object_features}"
        " --object-photos {input.object_photos} --scene-sparse {input.scene_sparse} --scene-features {input.scene_features}"
        " --scene-photos {input.scene_photos} --scene-json {input.scene_json} --report {output}"
        " --seed {params.seed} &> {log}"


rule crop_scene:
    """Cut the object's surroundings out of the scene by its masks' votes, or by clicks or fiducials (paper 3.3; C1 to C5)."""
    input:
        as_inputs(crop_inputs),
        scene=in_scene("dense.ply"),
        sparse=in_photographed_scene("georeferenced"),
        georeference_json=in_scene("georeference.json"),
    output:
        crop="results/objects/{object}/registration/{variant}/crop.ply",
        report="results/objects/{object}/registration/{variant}/crop.json",
    log:
        "results/logs/crop_scene/{object}-{variant}.log",
    benchmark:
        "results/benchmarks/crop_scene/{object}-{variant}.tsv"
    conda:
        "../../envs/registration.yaml"
    resources:
        mem_mb=lambda wildcards, attempt: 4000 * attempt,
        runtime=lambda wildcards, attempt: 30 * attempt,
    params:
        options=crop_options,
        model=options_of("sparse"),
        script=script("crop/crop_scene.py"),
        files=state_of(crop_inputs),
        code=code("crop/crop_scene.py"),
    message:
        "{wildcards.object}, variant {wildcards.variant}: crop"
    shell:
        "exec python {params.script} --scene {input.scene} {params.model} --georeference-json {input.georeference_json}"
        " --crop {output.crop} --report {output.report} {params.options} &> {log}"


rule register_object:
    """Find the object's size and pose in its scene, and register or reject it (paper 3.3; R1 to R4, R6, R8, R9, R12)."""
    input:
        cloud="results/objects/{object}/object.ply",
        cloud_json="results/objects/{object}/object.json",
        crop="results/objects/{object}/registration/{variant}/crop.ply",
        crop_json="results/objects/{object}/registration/{variant}/crop.json",
        workspace_json=if_photographed("results/objects/{object}/undistorted.json"),
        alignment_json=if_linked("results/objects/{object}/alignment.json"),
        object_spread=if_photographed("results/objects/{object}/spread.npz"),
        scene_spread=in_photographed_scene("spread.npz"),
        workspace=in_matched_scene("undistorted"),
        depth=in_matched_scene(*(f"depth/{chunk}" for chunk in CHUNKS)),
        depth_json=in_matched_scene(*(f"depth/{chunk}.json" for chunk in CHUNKS)),
    output:
        scale="results/objects/{object}/registration/{variant}/scale.json",
        coarse="results/objects/{object}/registration/{variant}/coarse.json",
        fine="results/objects/{object}/registration/{variant}/fine.json",
        picture=report(
            "results/objects/{object}/registration/{variant}/fine.png",
            category="Objects",
            subcategory="{object}",
            caption="../report/fine.rst",
        ),
    log:
        "results/logs/register_object/{object}-{variant}.log",
    benchmark:
        "results/benchmarks/register_object/{object}-{variant}.tsv"
    conda:
        "../../envs/registration.yaml"
    threads: min(2, OBJECT_THREADS)
    resources:
        mem_mb=by_size(4000, cloud=4, crop=4),
        runtime=lambda wildcards, attempt: 120 * attempt,
    params:
        options=variant_options("scale", "coarse", "fine"),
        gravity=options_of("workspace_json"),
        evidence=options_of(
            "alignment_json", "object_spread", "scene_spread", "workspace", "depth"
        ),
        seed=config["seed"],
        script=script("register/register_object.py"),
        code=code("register/register_object.py"),
    message:
        "{wildcards.object}, variant {wildcards.variant}: registration"
    shell:
        "exec python {params.script} --object {input.cloud} --crop {input.crop} --crop-json {input.crop_json}"
        " {params.gravity} {params.evidence} --scale-report {output.scale} --coarse-report {output.coarse}"
        " --report {output.fine} --picture {output.picture} --seed {params.seed} {params.options} &> {log}"


rule register_as_paper:
    """The paper's recipe: RMS-ratio scale, rigid FPFH RANSAC, point-to-point ICP; nothing is rejected (paper 3.3; R1, R5 to R8)."""
    input:
        cloud="results/objects/{object}/object.ply",
        cloud_json="results/objects/{object}/object.json",
        crop="results/objects/{object}/registration/paper/crop.ply",
        crop_json="results/objects/{object}/registration/paper/crop.json",
        workspace_json=if_photographed("results/objects/{object}/undistorted.json"),
    output:
        scale="results/objects/{object}/registration/paper/scale.json",
        coarse="results/objects/{object}/registration/paper/coarse.json",
        fine="results/objects/{object}/registration/paper/fine.json",
        picture=report(
            "results/objects/{object}/registration/paper/fine.png",
            category="Objects",
            subcategory="{object}",
            caption="../report/fine.rst",
        ),
    log:
        "results/logs/register_as_paper/{object}.log",
    benchmark:
        "results/benchmarks/register_as_paper/{object}.tsv"
    conda:
        "../../envs/registration.yaml"
    threads: min(2, OBJECT_THREADS)
    resources:
        mem_mb=by_size(4000, cloud=4, crop=4),
        runtime=lambda wildcards, attempt: 120 * attempt,
    params:
        options="--scale rms",
        gravity=options_of("workspace_json"),
        seed=config["seed"],
        script=script("paper/register_as_paper.py"),
        code=code("paper/register_as_paper.py"),
    message:
        "{wildcards.object}: registration by the paper's recipe"
    shell:
        "exec python {params.script} --object {input.cloud} --crop {input.crop} --crop-json {input.crop_json}"
        " {params.gravity} --scale-report {output.scale} --coarse-report {output.coarse} --report {output.fine}"
        " --picture {output.picture} --seed {params.seed} {params.options} &> {log}"

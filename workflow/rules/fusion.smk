# Registered objects added to their scene.
#
# INPUTS    results/objects/{object}/object.ply, registration/full/; results/scenes/{scene}/dense.ply; config: fusion
# OUTPUTS   results/objects/{object}/fused.ply, fused_scene.ply, fused_scene.laz, fusion.json
#           results/scenes/{scene}/completed.ply, completed.laz, completed.json


def object_folders(wildcards):
    """The result folders of the objects of a scene."""
    return [f"results/objects/{name}" for name in objects_in(wildcards)]


rule fuse_object:
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
        "results/logs/fuse_object/{object}.log",
    benchmark:
        "results/benchmarks/fuse_object/{object}.tsv"
    conda:
        "../../envs/registration.yaml"
    resources:
        mem_mb=lambda wildcards, attempt: 6000 * attempt,
        runtime=lambda wildcards, attempt: 60 * attempt,
    params:
        options=flags(config["fusion"]),
        script=script("fusion/fuse_object.py"),
        code=code("fusion/fuse_object.py"),
    message:
        "{wildcards.object}: fusion"
    shell:
        "exec python {params.script} --object {input.cloud} --scene {input.scene} --crop {input.crop} --crop-json {input.crop_json}"
        " --fine-json {input.fine} --georeference-json {input.georeference} --fused {output.fused} --fused-scene {output.scene}"
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
        objects=object_folders,
        script=script("fusion/complete_scene.py"),
        code=code("fusion/complete_scene.py"),
    message:
        "Scene {wildcards.scene}: all objects in it"
    shell:
        "exec python {params.script} --scene {input.scene} --objects {params.objects} --georeference-json {input.georeference}"
        " --logs results/logs --benchmarks results/benchmarks --completed {output.cloud} --completed-laz {output.laz}"
        " --report {output.report} {params.options} &> {log}"

# Registered objects added to their scene.
#
# INPUTS    results/objects/{object}/object.ply, undistorted/, registration/full/; results/scenes/{scene}/dense.ply, undistorted/;
#           config: fusion
# OUTPUTS   results/objects/{object}/fused.ply, checked.ply, evidence.json, fusion.json, frames.json
#           results/objects/{object}/missing.ply, missing.json, next_photos.csv, next_photos.geojson
#           results/scenes/{scene}/completed.ply, completed.copc.laz, completed.json
#           results/objects/{object}/fused_scene.ply, fused_scene.copc.laz, fused_scene.json      where they are asked for


rule fuse_object:
    """Add the registered object to the scene, checked in the photos of both (F1, F2, F4); an unregistered one leaves it as it is."""
    input:
        cloud="results/objects/{object}/object.ply",
        cloud_json="results/objects/{object}/object.json",
        crop="results/objects/{object}/registration/full/crop.ply",
        crop_json="results/objects/{object}/registration/full/crop.json",
        fine="results/objects/{object}/registration/full/fine.json",
        scene=in_scene("dense.ply"),
        object_workspace=judging_photos,
        scene_workspace=in_photographed_scene("undistorted"),
        georeference=in_scene("georeference.json"),
    output:
        fused="results/objects/{object}/fused.ply",
        checked="results/objects/{object}/checked.ply",
        evidence="results/objects/{object}/evidence.json",
        report="results/objects/{object}/fusion.json",
        frames="results/objects/{object}/frames.json",
    log:
        "results/logs/fuse_object/{object}.log",
    benchmark:
        "results/benchmarks/fuse_object/{object}.tsv"
    conda:
        "../../envs/registration.yaml"
    threads: OBJECT_THREADS
    resources:
        mem_mb=by_size(4000, cloud=10, crop=10),
        runtime=lambda wildcards, attempt: 60 * attempt,
    params:
        options=settings("fusion"),
        photos=options_of("object_workspace", "scene_workspace"),
        script=script("fuse/fuse_object.py"),
        code=code("fuse/fuse_object.py"),
    message:
        "{wildcards.object}: fusion"
    shell:
        "exec python {params.script} --object {input.cloud} --object-json {input.cloud_json} --scene {input.scene} --crop {input.crop}"
        " --crop-json {input.crop_json} --fine-json {input.fine} {params.photos}"
        " --georeference-json {input.georeference} --fused {output.fused} --checked {output.checked} --evidence {output.evidence}"
        " --report {output.report} --frames {output.frames} {params.options} &> {log}"


rule find_missing:
    """Surface of the fused object that no photo confirms, and where to stand next (F5, F6)."""
    input:
        cloud="results/objects/{object}/object.ply",
        scene=in_scene("dense.ply"),
        fused="results/objects/{object}/fused.ply",
        checked="results/objects/{object}/checked.ply",
        fusion="results/objects/{object}/fusion.json",
        object_workspace=judging_photos,
        scene_workspace=in_photographed_scene("undistorted"),
        masks=if_masked("results/objects/{object}/masks"),
        georeference=in_scene("georeference.json"),
    output:
        missing="results/objects/{object}/missing.ply",
        photos="results/objects/{object}/next_photos.csv",
        geojson="results/objects/{object}/next_photos.geojson",
        report="results/objects/{object}/missing.json",
    log:
        "results/logs/find_missing/{object}.log",
    benchmark:
        "results/benchmarks/find_missing/{object}.tsv"
    conda:
        "../../envs/registration.yaml"
    threads: OBJECT_THREADS
    resources:
        mem_mb=by_size(4000, cloud=10),
        runtime=lambda wildcards, attempt: 60 * attempt,
    params:
        photos=options_of("object_workspace", "scene_workspace", "masks"),
        script=script("fuse/find_missing.py"),
        code=code("fuse/find_missing.py"),
    message:
        "{wildcards.object}: what is still missing"
    shell:
        "exec python {params.script} --object {input.cloud} --scene {input.scene} --fused {input.fused} --checked {input.checked}"
        " --fusion-json {input.fusion} {params.photos} --georeference-json {input.georeference}"
        " --missing {output.missing} --next-photos {output.photos} --geojson {output.geojson} --report {output.report} &> {log}"


rule complete_scene:
    """The scene with all its registered objects in it; `source` says where each point is from (F3)."""
    input:
        scene="results/scenes/{scene}/dense.ply",
        georeference="results/scenes/{scene}/georeference.json",
        objects=of_objects("fused.ply"),
        checked=of_objects("checked.ply"),
        fusions=of_objects("fusion.json"),
    output:
        cloud="results/scenes/{scene}/completed.ply",
        copc="results/scenes/{scene}/completed.copc.laz",
        report="results/scenes/{scene}/completed.json",
    log:
        "results/logs/complete_scene/{scene}.log",
    benchmark:
        "results/benchmarks/complete_scene/{scene}.tsv"
    conda:
        "../../envs/registration.yaml"
    resources:
        mem_mb=by_size(3000, objects=4, checked=4),
        runtime=by_size(60, scene=0.05),
    params:
        objects=object_folders,
        script=script("fuse/complete_scene.py"),
        code=code("fuse/complete_scene.py"),
    message:
        "{wildcards.scene}: all objects in it"
    shell:
        "exec python {params.script} --scene {input.scene} --objects {params.objects} --georeference-json {input.georeference}"
        " --logs results/logs --benchmarks results/benchmarks --completed {output.cloud} --completed-copc {output.copc}"
        " --report {output.report} &> {log}"


use rule complete_scene as complete_scene_with_object with:
    # The scene with one of its objects alone; nothing needs it.
    input:
        scene=in_scene("dense.ply"),
        georeference=in_scene("georeference.json"),
        objects="results/objects/{object}/fused.ply",
        checked="results/objects/{object}/checked.ply",
        fusions="results/objects/{object}/fusion.json",
    output:
        cloud="results/objects/{object}/fused_scene.ply",
        copc="results/objects/{object}/fused_scene.copc.laz",
        report="results/objects/{object}/fused_scene.json",
    log:
        "results/logs/complete_scene_with_object/{object}.log",
    benchmark:
        "results/benchmarks/complete_scene_with_object/{object}.tsv"
    params:
        objects=lambda wildcards: f"results/objects/{wildcards.object}",
        script=script("fuse/complete_scene.py"),
        code=code("fuse/complete_scene.py"),
    message:
        "{wildcards.object}: the scene with it"

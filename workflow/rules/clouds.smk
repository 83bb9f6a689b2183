# Clouds and meshes of the tables, in the place of what is made from photos.
#
# INPUTS    config/scenes.tsv, config/objects.tsv: cloud
# OUTPUTS   results/scenes/{scene}/dense.ply, dense.json, georeference.json      of scenes with a cloud
#           results/objects/{object}/object.ply, object.json                     of objects with a cloud
ruleorder: import_scene_cloud > fuse_depth_maps
ruleorder: import_scene_cloud > georegister
ruleorder: import_object_cloud > make_object_cloud


include: "../functions/clouds.smk"


rule import_scene_cloud:
    """Take a cloud or mesh for a scene."""
    input:
        as_inputs(cloud_of("scene")),
    output:
        cloud="results/scenes/{scene}/dense.ply",
        report="results/scenes/{scene}/dense.json",
        georeference="results/scenes/{scene}/georeference.json",
    log:
        "results/logs/import_scene_cloud/{scene}.log",
    benchmark:
        "results/benchmarks/import_scene_cloud/{scene}.tsv"
    wildcard_constraints:
        scene=one_of(CLOUD_SCENES),
    conda:
        "../../envs/registration.yaml"
    resources:
        mem_mb=lambda wildcards, attempt: 4000 * attempt,
        runtime=by_size(30, all=0.1),
    params:
        source=cloud_path("scene"),
        files=state_of(cloud_of("scene")),
        script=script("io/import_scene_cloud.py"),
        code=code("io/import_scene_cloud.py"),
    message:
        "Scene {wildcards.scene}: cloud of the table"
    shell:
        "exec python {params.script} --source {params.source} --cloud {output.cloud} --report {output.report}"
        " --georeference-json {output.georeference} &> {log}"


rule import_object_cloud:
    """Take a cloud or mesh for an object."""
    input:
        as_inputs(cloud_of("object")),
    output:
        cloud="results/objects/{object}/object.ply",
        report="results/objects/{object}/object.json",
    log:
        "results/logs/import_object_cloud/{object}.log",
    benchmark:
        "results/benchmarks/import_object_cloud/{object}.tsv"
    wildcard_constraints:
        object=one_of(CLOUD_OBJECTS),
    conda:
        "../../envs/registration.yaml"
    resources:
        mem_mb=by_size(4000, all=50),
        runtime=lambda wildcards, attempt: 30 * attempt,
    params:
        source=cloud_path("object"),
        files=state_of(cloud_of("object")),
        script=script("io/import_object_cloud.py"),
        code=code("io/import_object_cloud.py"),
    message:
        "{wildcards.object}: cloud of the table"
    shell:
        "exec python {params.script} --source {params.source} --cloud {output.cloud} --report {output.report}"
        " &> {log}"

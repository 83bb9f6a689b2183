# Clouds and meshes of the tables, in the place of what is made from photos.
#
# INPUTS    config/scenes.tsv, config/objects.tsv: cloud; where there are photos and cameras too, sparse/, sparse.json
# OUTPUTS   results/scenes/{scene}/dense.ply, dense.json      of scenes with a cloud
#           results/scenes/{scene}/georeference.json          of those without photos
#           results/objects/{object}/object.ply, object.json  of objects with a cloud
ruleorder: import_scene_cloud > fuse_depth_maps
ruleorder: import_scene_cloud > georegister
ruleorder: import_posed_scene_cloud > fuse_depth_maps
ruleorder: import_object_cloud > import_posed_object_cloud > make_object_cloud


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
        crs=crs_flag,
        files=state_of(cloud_files("scene")),
        script=script("cloud/import_scene_cloud.py"),
        code=code("cloud/import_scene_cloud.py"),
    message:
        "{wildcards.scene}: cloud of the table"
    shell:
        "exec python {params.script} --source {params.source} {params.crs} --cloud {output.cloud} --report {output.report}"
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
        files=state_of(cloud_files("object")),
        script=script("cloud/import_object_cloud.py"),
        code=code("cloud/import_object_cloud.py"),
    message:
        "{wildcards.object}: cloud of the table"
    shell:
        "exec python {params.script} --source {params.source} --cloud {output.cloud} --report {output.report}"
        " &> {log}"


rule import_posed_scene_cloud:
    """Take a cloud in the coordinates of a scene's given cameras, and move it as georeferencing moved these (M12), or
    one on which its photos were laid (M14)."""
    input:
        as_inputs(cloud_of("scene")),
        sparse=with_cameras("results/scenes/{scene}/sparse"),
        sparse_json=with_cameras("results/scenes/{scene}/sparse.json"),
        georeference_json="results/scenes/{scene}/georeference.json",
    output:
        cloud="results/scenes/{scene}/dense.ply",
        report="results/scenes/{scene}/dense.json",
    log:
        "results/logs/import_posed_scene_cloud/{scene}.log",
    benchmark:
        "results/benchmarks/import_posed_scene_cloud/{scene}.tsv"
    wildcard_constraints:
        scene=one_of(POSED_SCENES),
    conda:
        "../../envs/registration.yaml"
    resources:
        mem_mb=lambda wildcards, attempt: 4000 * attempt,
        runtime=by_size(30, all=0.1),
    params:
        source=cloud_path("scene"),
        place=options_of("sparse", "sparse_json", "georeference_json"),
        crs=lambda wildcards: crs_flag(wildcards) if lies_on_cloud(wildcards) else "",
        files=state_of(cloud_files("scene")),
        script=script("georef/import_posed_cloud.py"),
        code=code("georef/import_posed_cloud.py"),
    message:
        "{wildcards.scene}: cloud of the table, with its photos"
    shell:
        "exec python {params.script} --source {params.source} {params.place} {params.crs}"
        " --cloud {output.cloud} --report {output.report} &> {log}"


use rule import_posed_scene_cloud as import_posed_object_cloud with:
    # Take a cloud in the coordinates of an object's given cameras, without what lies outside its masks, if it has some.
    input:
        as_inputs(cloud_of("object")),
        sparse="results/objects/{object}/sparse",
        sparse_json="results/objects/{object}/sparse.json",
        workspace=if_masked("results/objects/{object}/undistorted"),
        masks=if_masked("results/objects/{object}/masks"),
    output:
        cloud="results/objects/{object}/object.ply",
        report="results/objects/{object}/object.json",
    log:
        "results/logs/import_posed_object_cloud/{object}.log",
    benchmark:
        "results/benchmarks/import_posed_object_cloud/{object}.tsv"
    wildcard_constraints:
        object=one_of(POSED_OBJECTS),
    resources:
        mem_mb=by_size(4000, all=50),
        runtime=lambda wildcards, attempt: 30 * attempt,
    params:
        source=cloud_path("object"),
        place=options_of("sparse", "sparse_json", "workspace", "masks"),
        crs="",
        files=state_of(cloud_files("object")),
        script=script("georef/import_posed_cloud.py"),
        code=code("georef/import_posed_cloud.py"),
    message:
        "{wildcards.object}: cloud of the table, among its cameras"

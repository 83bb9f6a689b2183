# What is handed over of the completed objects. `scenefuse export` asks for it; `all` does not.
#
# INPUTS    results/objects/{object}/fused.ply, fusion.json, undistorted/; results/scenes/{scene}/undistorted/, georeference.json
# OUTPUTS   results/objects/{object}/surface.ply, surface.glb, surface.json, drawings/
#           results/scenes/{scene}/cameras/, tiles/


rule make_surface:
    """The surface of a completed object: measured, bridged and open parts told apart (F7)."""
    input:
        fused="results/objects/{object}/fused.ply",
        fusion="results/objects/{object}/fusion.json",
        object_workspace=judging_photos,
        scene_workspace=in_photographed_scene("undistorted"),
        georeference=in_scene("georeference.json"),
    output:
        surface="results/objects/{object}/surface.ply",
        glb="results/objects/{object}/surface.glb",
        report="results/objects/{object}/surface.json",
    log:
        "results/logs/make_surface/{object}.log",
    benchmark:
        "results/benchmarks/make_surface/{object}.tsv"
    conda:
        "../../envs/registration.yaml"
    threads: OBJECT_THREADS
    resources:
        mem_mb=by_size(3000, fused=50),
        runtime=lambda wildcards, attempt: 60 * attempt,
    params:
        photos=options_of("object_workspace", "scene_workspace"),
        script=script("surface/make_surface.py"),
        code=code("surface/make_surface.py"),
    message:
        "{wildcards.object}: surface"
    shell:
        "exec python {params.script} --fused {input.fused} --fusion-json {input.fusion} {params.photos}"
        " --georeference-json {input.georeference} --surface {output.surface} --glb {output.glb} --report {output.report} &> {log}"


rule draw_surface:
    """A completed object to scale, from above and from four sides, with bands of class and standard deviation (F9)."""
    input:
        surface="results/objects/{object}/surface.ply",
        glb="results/objects/{object}/surface.glb",
        georeference=in_scene("georeference.json"),
    output:
        directory("results/objects/{object}/drawings"),
    log:
        "results/logs/draw_surface/{object}.log",
    benchmark:
        "results/benchmarks/draw_surface/{object}.tsv"
    conda:
        "../../envs/registration.yaml"
    threads: OBJECT_THREADS
    resources:
        mem_mb=by_size(3000, surface=20),
        runtime=lambda wildcards, attempt: 30 * attempt,
    params:
        facade=lambda wildcards: facade_of(wildcards.object),
        script=script("surface/draw_surface.py"),
        code=code("surface/draw_surface.py"),
    message:
        "{wildcards.object}: drawings"
    shell:
        "exec python {params.script} --name {wildcards.object} --surface {input.surface} --glb {input.glb}"
        " --georeference-json {input.georeference} {params.facade} --folder {output} &> {log}"


rule export_cameras:
    """The cameras of a scene and of its objects in one frame, for COLMAP, nerfstudio and Metashape."""
    input:
        scene_workspace=lambda wildcards: (
            [f"results/scenes/{wildcards.scene}/undistorted"]
            if scene_row(wildcards.scene).get("photos")
            else []
        ),
        fusions=finished_in("fusion.json"),
        workspaces=finished_in("undistorted"),
        georeference="results/scenes/{scene}/georeference.json",
    output:
        directory("results/scenes/{scene}/cameras"),
    log:
        "results/logs/export_cameras/{scene}.log",
    benchmark:
        "results/benchmarks/export_cameras/{scene}.tsv"
    conda:
        "../../envs/registration.yaml"
    resources:
        mem_mb=2000,
        runtime=lambda wildcards, attempt: 10 * attempt,
    params:
        objects=finished_folders,
        photos=options_of("scene_workspace"),
        script=script("surface/export_cameras.py"),
        code=code("surface/export_cameras.py"),
    message:
        "{wildcards.scene}: cameras of both sides"
    shell:
        "exec python {params.script} {params.photos} --objects {params.objects}"
        " --georeference-json {input.georeference} --folder {output} &> {log}"


rule make_tiles:
    """3D Tiles for web viewers: the completed scene's points, and the surfaces of its objects."""
    input:
        cloud="results/scenes/{scene}/completed.ply",
        report="results/scenes/{scene}/completed.json",
        surfaces=finished_in("surface.ply"),
        glbs=finished_in("surface.glb"),
        georeference="results/scenes/{scene}/georeference.json",
    output:
        directory("results/scenes/{scene}/tiles"),
    log:
        "results/logs/make_tiles/{scene}.log",
    benchmark:
        "results/benchmarks/make_tiles/{scene}.tsv"
    conda:
        "../../envs/registration.yaml"
    resources:
        mem_mb=by_size(2000, cloud=10),
        runtime=lambda wildcards, attempt: 30 * attempt,
    params:
        objects=finished_folders,
        script=script("surface/make_tiles.py"),
        code=code("surface/make_tiles.py"),
    message:
        "{wildcards.scene}: 3D Tiles"
    shell:
        "exec python {params.script} --cloud {input.cloud} --report {input.report} --objects {params.objects}"
        " --georeference-json {input.georeference} --folder {output} &> {log}"

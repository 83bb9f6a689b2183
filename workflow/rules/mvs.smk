# Multi-view stereo: photos with pinhole cameras of a scene and of an object; the scene's depth maps and dense cloud.
#
# INPUTS    results/scenes/{scene}/georeferenced/, results/objects/{object}/sparse/, and their photos; config: scene, object
# OUTPUTS   .../undistorted/, undistorted.json                              photos with pinhole cameras: a COLMAP workspace
#           results/scenes/{scene}/depth/{chunk}/, depth/{chunk}.json       depth and normal maps
#           results/scenes/{scene}/dense.ply, dense.json                    the cloud


CHUNKS = range(config["scene"]["chunks"])


rule undistort_scene_photos:
    """Undistort the photos into a COLMAP workspace."""
    input:
        folder="results/scenes/{scene}/photos",
        photos="results/scenes/{scene}/photos.json",
        model="results/scenes/{scene}/georeferenced",
        report="results/scenes/{scene}/georeference.json",
    output:
        workspace=directory("results/scenes/{scene}/undistorted"),
        report="results/scenes/{scene}/undistorted.json",
    log:
        "results/logs/undistort_scene_photos/{scene}.log",
    benchmark:
        "results/benchmarks/undistort_scene_photos/{scene}.tsv"
    priority: 1
    conda:
        "../../envs/reconstruction.yaml"
    threads: SCENE_THREADS
    resources:
        mem_mb=lambda wildcards, attempt: 4000 * attempt,
        runtime=lambda wildcards, attempt: 60 * attempt,
    params:
        upright=lambda wildcards, input: f"--georeference {input.report}",
        options=settings("scene.undistort"),
        script=script("mvs/undistort_photos.py"),
        code=code("mvs/undistort_photos.py"),
    message:
        "{wildcards.scene}: undistorting"
    shell:
        "exec python {params.script} --folder {input.folder} --photos {input.photos} --sparse {input.model} {params.upright}"
        " --workspace {output.workspace} --report {output.report} {params.options} &> {log}"


use rule undistort_scene_photos as undistort_object_photos with:
    input:
        folder="results/objects/{object}/frames",
        photos="results/objects/{object}/photos.json",
        model="results/objects/{object}/sparse",
        report="results/objects/{object}/sparse.json",
    output:
        workspace=directory("results/objects/{object}/undistorted"),
        report="results/objects/{object}/undistorted.json",
    log:
        "results/logs/undistort_object_photos/{object}.log",
    benchmark:
        "results/benchmarks/undistort_object_photos/{object}.tsv"
    priority: 0
    threads: 1
    resources:
        mem_mb=lambda wildcards, attempt: 2000 * attempt,
        runtime=lambda wildcards, attempt: 30 * attempt,
    params:
        upright="",
        options=settings("object.undistort"),
        script=script("mvs/undistort_photos.py"),
        code=code("mvs/undistort_photos.py"),
    message:
        "{wildcards.object}: undistorting"


rule estimate_depth_maps:
    """Depth maps of one chunk of the photos: COLMAP's patch-match on CUDA, else our plane sweep."""
    input:
        workspace="results/scenes/{scene}/undistorted",
        report="results/scenes/{scene}/undistorted.json",
    output:
        depth=maps("results/scenes/{scene}/depth/{chunk}"),
        report="results/scenes/{scene}/depth/{chunk}.json",
    log:
        "results/logs/estimate_depth_maps/{scene}-{chunk}.log",
    benchmark:
        "results/benchmarks/estimate_depth_maps/{scene}-{chunk}.tsv"
    priority: 1
    conda:
        "../../envs/reconstruction.yaml"
    threads: 1
    resources:
        mem_mb=lambda wildcards, attempt: 6000 * attempt,
        runtime=lambda wildcards, attempt: 240 * attempt,
        gpu=config["gpu"],
    params:
        options=settings("scene.depth_maps"),
        chunks=len(CHUNKS),
        seed=config["seed"],
        script=script("mvs/estimate_depth_maps.py"),
        code=code("mvs/estimate_depth_maps.py"),
    message:
        "{wildcards.scene}: depth maps, chunk {wildcards.chunk}"
    shell:
        "exec python {params.script} --workspace {input.workspace} --chunk {wildcards.chunk} --chunks {params.chunks}"
        " --depth {output.depth} --report {output.report} --seed {params.seed} {params.options} &> {log}"


rule fuse_depth_maps:
    """Fuse the depth maps into one cloud."""
    input:
        workspace="results/scenes/{scene}/undistorted",
        georeference_json="results/scenes/{scene}/georeference.json",
        depth=expand(
            "results/scenes/{scene}/depth/{chunk}", chunk=CHUNKS, allow_missing=True
        ),
        depth_json=expand(
            "results/scenes/{scene}/depth/{chunk}.json",
            chunk=CHUNKS,
            allow_missing=True,
        ),
    output:
        cloud="results/scenes/{scene}/dense.ply",
        report="results/scenes/{scene}/dense.json",
    log:
        "results/logs/fuse_depth_maps/{scene}.log",
    benchmark:
        "results/benchmarks/fuse_depth_maps/{scene}.tsv"
    priority: 1
    conda:
        "../../envs/reconstruction.yaml"
    threads: SCENE_THREADS
    resources:
        mem_mb=by_size(8000, depth=0.5),
        runtime=by_size(120, depth=0.05),
    params:
        options=settings("scene.dense_cloud"),
        script=script("mvs/fuse_depth_maps.py"),
        code=code("mvs/fuse_depth_maps.py"),
    message:
        "{wildcards.scene}: dense cloud"
    shell:
        "exec python {params.script} --workspace {input.workspace} --depth {input.depth} --depth-json {input.depth_json}"
        " --georeference-json {input.georeference_json} --cloud {output.cloud} --report {output.report} {params.options} &> {log}"

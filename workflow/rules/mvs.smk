# Multi-view stereo: the scene's depth maps and dense cloud.
#
# INPUTS    results/scenes/{scene}/undistorted/; config: scene
# OUTPUTS   results/scenes/{scene}/depth/{chunk}/, depth/{chunk}.json       depth and normal maps
#           results/scenes/{scene}/dense.ply, dense.json                    the cloud


CHUNKS = range(config["scene"]["chunks"])


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
        "Scene {wildcards.scene}: depth maps, chunk {wildcards.chunk}"
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
        "Scene {wildcards.scene}: dense cloud"
    shell:
        "exec python {params.script} --workspace {input.workspace} --depth {input.depth} --depth-json {input.depth_json}"
        " --georeference-json {input.georeference_json} --cloud {output.cloud} --report {output.report} {params.options} &> {log}"

# The scene: from a drone's photos to a dense cloud in metres.
#
# INPUTS    config/scenes.tsv: photos; config: scene, seed
# OUTPUTS   results/scenes/{scene}/photos.json                           the photos, checked, with GPS
#           results/scenes/{scene}/features.db, database.db              COLMAP databases
#           results/scenes/{scene}/sparse/, sparse.json                  cameras and sparse points as SfM found them
#           results/scenes/{scene}/georeferenced/, georeference.json     the same in metres, z up
#           results/scenes/{scene}/dense/, depth/{chunk}/                undistorted photos, depth maps
#           results/scenes/{scene}/dense.ply, dense_cloud.json           the cloud


CHUNKS = range(config["scene"]["chunks"])


rule scene_photos:
    """List the flight's photos, and stop at one that cannot be read."""
    input:
        scene_photos,
    output:
        "results/scenes/{scene}/photos.json",
    log:
        "results/logs/scene_photos/{scene}.log",
    benchmark:
        "results/benchmarks/scene_photos/{scene}.tsv"
    conda:
        "../../envs/reconstruction.yaml"
    resources:
        mem_mb=lambda wildcards, attempt: 1000 * attempt,
        runtime=lambda wildcards, attempt: 30 * attempt,
    params:
        folder=scene_folder,
        script=script("photos.py"),
        code=code("photos.py"),
    message:
        "Scene {wildcards.scene}: checking the photos"
    shell:
        "exec python {params.script} --folder {params.folder} --photos {output} &> {log}"


rule scene_features:
    """SIFT features and GPS priors (paper 3.1)."""
    input:
        scene_photos,
        photos="results/scenes/{scene}/photos.json",
    output:
        "results/scenes/{scene}/features.db",
    log:
        "results/logs/scene_features/{scene}.log",
    benchmark:
        "results/benchmarks/scene_features/{scene}.tsv"
    conda:
        "../../envs/reconstruction.yaml"
    threads: 8
    resources:
        mem_mb=lambda wildcards, attempt: 6000 * attempt,
        runtime=lambda wildcards, attempt: 120 * attempt,
    params:
        folder=scene_folder,
        options=flags(config["scene"]["features"]),
        script=script("features.py"),
        code=code("features.py"),
    message:
        "Scene {wildcards.scene}: features"
    shell:
        "exec python {params.script} --folder {params.folder} --photos {input.photos} --features {output} {params.options} &> {log}"


rule scene_matches:
    """Match pairs of photos that GPS says are near each other (paper 3.1)."""
    input:
        photos="results/scenes/{scene}/photos.json",
        features="results/scenes/{scene}/features.db",
    output:
        database="results/scenes/{scene}/database.db",
        report="results/scenes/{scene}/matches.json",
    log:
        "results/logs/scene_matches/{scene}.log",
    benchmark:
        "results/benchmarks/scene_matches/{scene}.tsv"
    conda:
        "../../envs/reconstruction.yaml"
    threads: 8
    resources:
        mem_mb=lambda wildcards, attempt: 6000 * attempt,
        runtime=lambda wildcards, attempt: 240 * attempt,
    params:
        options=flags(config["scene"]["matches"]),
        seed=config["seed"],
        script=script("matches.py"),
        code=code("matches.py"),
    message:
        "Scene {wildcards.scene}: matching"
    shell:
        "exec python {params.script} --photos {input.photos} --features {input.features} --database {output.database}"
        " --matches {output.report} --seed {params.seed} {params.options} &> {log}"


rule scene_sparse:
    """Incremental mapping and bundle adjustment (paper 3.1)."""
    input:
        scene_photos,
        photos="results/scenes/{scene}/photos.json",
        database="results/scenes/{scene}/database.db",
    output:
        model=directory("results/scenes/{scene}/sparse"),
        report="results/scenes/{scene}/sparse.json",
    log:
        "results/logs/scene_sparse/{scene}.log",
    benchmark:
        "results/benchmarks/scene_sparse/{scene}.tsv"
    conda:
        "../../envs/reconstruction.yaml"
    threads: 8
    resources:
        mem_mb=lambda wildcards, attempt: 8000 * attempt,
        runtime=lambda wildcards, attempt: 480 * attempt,
    params:
        folder=scene_folder,
        options=flags(config["scene"]["sparse"]),
        seed=config["seed"],
        script=script("sparse.py"),
        code=code("sparse.py"),
    message:
        "Scene {wildcards.scene}: cameras and sparse points"
    shell:
        "exec python {params.script} --folder {params.folder} --photos {input.photos} --database {input.database}"
        " --sparse {output.model} --report {output.report} --seed {params.seed} {params.options} &> {log}"


rule georegister:
    """Turn and scale the model into metres, east, north and up, by the photos' GPS."""
    input:
        photos="results/scenes/{scene}/photos.json",
        model="results/scenes/{scene}/sparse",
        report="results/scenes/{scene}/sparse.json",
    output:
        model=directory("results/scenes/{scene}/georeferenced"),
        report="results/scenes/{scene}/georeference.json",
    log:
        "results/logs/georegister/{scene}.log",
    benchmark:
        "results/benchmarks/georegister/{scene}.tsv"
    conda:
        "../../envs/reconstruction.yaml"
    resources:
        mem_mb=lambda wildcards, attempt: 2000 * attempt,
        runtime=lambda wildcards, attempt: 30 * attempt,
    params:
        options=flags(config["scene"]["georegister"]),
        seed=config["seed"],
        script=script("georegister.py"),
        code=code("georegister.py"),
    message:
        "Scene {wildcards.scene}: georeferencing"
    shell:
        "exec python {params.script} --sparse {input.model} --photos {input.photos} --georeferenced {output.model}"
        " --report {output.report} --seed {params.seed} {params.options} &> {log}"


rule undistort:
    """Undistort the photos into a COLMAP workspace."""
    input:
        scene_photos,
        model="results/scenes/{scene}/georeferenced",
        report="results/scenes/{scene}/georeference.json",
    output:
        workspace=directory("results/scenes/{scene}/dense"),
        report="results/scenes/{scene}/dense.json",
    log:
        "results/logs/undistort/{scene}.log",
    benchmark:
        "results/benchmarks/undistort/{scene}.tsv"
    conda:
        "../../envs/reconstruction.yaml"
    threads: 8
    resources:
        mem_mb=lambda wildcards, attempt: 4000 * attempt,
        runtime=lambda wildcards, attempt: 60 * attempt,
    params:
        folder=scene_folder,
        options=flags(config["scene"]["undistort"]),
        script=script("undistort.py"),
        code=code("undistort.py"),
    message:
        "Scene {wildcards.scene}: undistorting"
    shell:
        "exec python {params.script} --folder {params.folder} --sparse {input.model} --dense {output.workspace}"
        " --report {output.report} {params.options} &> {log}"


rule depth_maps:
    """Depth maps of one chunk of the photos: COLMAP's patch-match on CUDA, else our plane sweep."""
    input:
        workspace="results/scenes/{scene}/dense",
        report="results/scenes/{scene}/dense.json",
    output:
        depth=directory("results/scenes/{scene}/depth/{chunk}"),
        report="results/scenes/{scene}/depth/{chunk}.json",
    log:
        "results/logs/depth_maps/{scene}-{chunk}.log",
    benchmark:
        "results/benchmarks/depth_maps/{scene}-{chunk}.tsv"
    conda:
        "../../envs/reconstruction.yaml"
    threads: 1
    resources:
        mem_mb=lambda wildcards, attempt: 6000 * attempt,
        runtime=lambda wildcards, attempt: 240 * attempt,
        gpu=config["gpu"],
    params:
        options=flags(config["scene"]["depth_maps"]),
        chunks=len(CHUNKS),
        seed=config["seed"],
        script=script("depth_maps.py"),
        code=code("depth_maps.py"),
    message:
        "Scene {wildcards.scene}: depth maps, chunk {wildcards.chunk}"
    shell:
        "exec python {params.script} --workspace {input.workspace} --chunk {wildcards.chunk} --chunks {params.chunks}"
        " --depth {output.depth} --report {output.report} --seed {params.seed} {params.options} &> {log}"


rule dense_cloud:
    """Fuse the depth maps into one cloud by COLMAP's stereo fusion."""
    input:
        workspace="results/scenes/{scene}/dense",
        georeference="results/scenes/{scene}/georeference.json",
        depth=expand(
            "results/scenes/{scene}/depth/{chunk}", chunk=CHUNKS, allow_missing=True
        ),
        reports=expand(
            "results/scenes/{scene}/depth/{chunk}.json",
            chunk=CHUNKS,
            allow_missing=True,
        ),
    output:
        cloud="results/scenes/{scene}/dense.ply",
        report="results/scenes/{scene}/dense_cloud.json",
    log:
        "results/logs/dense_cloud/{scene}.log",
    benchmark:
        "results/benchmarks/dense_cloud/{scene}.tsv"
    conda:
        "../../envs/reconstruction.yaml"
    threads: 8
    resources:
        mem_mb=lambda wildcards, attempt: 8000 * attempt,
        runtime=lambda wildcards, attempt: 120 * attempt,
    params:
        options=flags(config["scene"]["dense_cloud"]),
        script=script("dense_cloud.py"),
        code=code("dense_cloud.py"),
    message:
        "Scene {wildcards.scene}: dense cloud"
    shell:
        "exec python {params.script} --workspace {input.workspace} --depth {input.depth} --depth-reports {input.reports}"
        " --georeference {input.georeference} --cloud {output.cloud} --report {output.report} {params.options} &> {log}"

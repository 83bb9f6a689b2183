# Structure from motion: from photos to cameras, the same steps for a scene and for an object.
#
# INPUTS    config/scenes.tsv, config/objects.tsv: photos, calibration, cameras, control, lengths; config: scene, object, seed
# OUTPUTS   results/scenes/{scene}/photos/, photos.json                     the photos, checked and upright, with GPS
#           results/objects/{object}/frames/, photos.json                   the same, at most a given width
#           .../features.db, database.db, matches.json                      COLMAP databases
#           .../sparse/, sparse.json                                        cameras and sparse points
#           results/scenes/{scene}/georeferenced/, georeference.json        the same in metres, z up, adjusted to the survey
#           results/scenes/{scene}/residuals.tsv                            what is left at control points, check points, positions
#           .../spread.npz                                                  how far the model may be bent


include: "../functions/sfm.smk"


rule list_photos:
    """The flight's photos, or frames of its video: turn rotated ones upright, and stop at one that cannot be read."""
    input:
        as_inputs(scene_photos),
    output:
        upright=directory("results/scenes/{scene}/photos"),
        photos="results/scenes/{scene}/photos.json",
    log:
        "results/logs/list_photos/{scene}.log",
    benchmark:
        "results/benchmarks/list_photos/{scene}.tsv"
    priority: 1
    conda:
        "../../envs/reconstruction.yaml"
    resources:
        mem_mb=lambda wildcards, attempt: 2000 * attempt,
        runtime=lambda wildcards, attempt: 60 * attempt,
    params:
        source=scene_source,
        options=settings("scene.frames"),
        script=script("photos/list_photos.py"),
        files=state_of(scene_photos),
        code=code("photos/list_photos.py"),
    message:
        "{wildcards.scene}: checking the photos"
    shell:
        "exec python {params.script} --source {params.source} --upright {output.upright} --photos {output.photos} {params.options} &> {log}"


rule extract_frames:
    """Frames from a folder of photos or a video."""
    input:
        as_inputs(object_photos),
    output:
        frames=directory("results/objects/{object}/frames"),
        photos="results/objects/{object}/photos.json",
    log:
        "results/logs/extract_frames/{object}.log",
    benchmark:
        "results/benchmarks/extract_frames/{object}.tsv"
    conda:
        "../../envs/reconstruction.yaml"
    resources:
        mem_mb=lambda wildcards, attempt: 2000 * attempt,
        runtime=lambda wildcards, attempt: 60 * attempt,
    params:
        source=object_source,
        options=settings("object.frames"),
        script=script("photos/extract_frames.py"),
        files=state_of(object_photos),
        code=code("photos/extract_frames.py"),
    message:
        "{wildcards.object}: frames"
    shell:
        "exec python {params.script} --source {params.source} --frames {output.frames} --photos {output.photos} {params.options} &> {log}"


rule extract_scene_features:
    """SIFT features (paper 3.1)."""
    input:
        as_inputs(calibration_of("scene")),
        folder="results/scenes/{scene}/photos",
        photos="results/scenes/{scene}/photos.json",
    output:
        "results/scenes/{scene}/features.db",
    log:
        "results/logs/extract_scene_features/{scene}.log",
    benchmark:
        "results/benchmarks/extract_scene_features/{scene}.tsv"
    priority: 1
    conda:
        "../../envs/reconstruction.yaml"
    threads: SCENE_THREADS
    resources:
        mem_mb=lambda wildcards, attempt: 6000 * attempt,
        runtime=lambda wildcards, attempt: 120 * attempt,
    params:
        options=settings("scene.features"),
        calibration=calibration_flag("scene"),
        files=state_of(calibration_of("scene")),
        script=script("sfm/extract_features.py"),
        code=code("sfm/extract_features.py"),
    message:
        "{wildcards.scene}: features"
    shell:
        "exec python {params.script} --folder {input.folder} --photos {input.photos} --features {output} {params.calibration}"
        " {params.options} &> {log}"


use rule extract_scene_features as extract_object_features with:
    input:
        as_inputs(calibration_of("object")),
        folder="results/objects/{object}/frames",
        photos="results/objects/{object}/photos.json",
    output:
        "results/objects/{object}/features.db",
    log:
        "results/logs/extract_object_features/{object}.log",
    benchmark:
        "results/benchmarks/extract_object_features/{object}.tsv"
    priority: 0
    threads: OBJECT_THREADS
    resources:
        mem_mb=lambda wildcards, attempt: 4000 * attempt,
        runtime=lambda wildcards, attempt: 60 * attempt,
    params:
        options=settings("object.features"),
        calibration=calibration_flag("object"),
        files=state_of(calibration_of("object")),
        script=script("sfm/extract_features.py"),
        code=code("sfm/extract_features.py"),
    message:
        "{wildcards.object}: features"


rule match_scene_features:
    """Match pairs of photos that are near each other by GPS or in time, or all pairs (paper 3.1)."""
    input:
        photos="results/scenes/{scene}/photos.json",
        features="results/scenes/{scene}/features.db",
    output:
        database="results/scenes/{scene}/database.db",
        report="results/scenes/{scene}/matches.json",
    log:
        "results/logs/match_scene_features/{scene}.log",
    benchmark:
        "results/benchmarks/match_scene_features/{scene}.tsv"
    priority: 1
    conda:
        "../../envs/reconstruction.yaml"
    threads: SCENE_THREADS
    resources:
        mem_mb=by_size(6000, features=4),
        runtime=by_size(240, features=2),
    params:
        options=settings("scene.matches"),
        seed=config["seed"],
        script=script("sfm/match_features.py"),
        code=code("sfm/match_features.py"),
    message:
        "{wildcards.scene}: matching"
    shell:
        "exec python {params.script} --photos {input.photos} --features {input.features} --database {output.database}"
        " --matches {output.report} --seed {params.seed} {params.options} &> {log}"


use rule match_scene_features as match_object_features with:
    input:
        photos="results/objects/{object}/photos.json",
        features="results/objects/{object}/features.db",
    output:
        database="results/objects/{object}/database.db",
        report="results/objects/{object}/matches.json",
    log:
        "results/logs/match_object_features/{object}.log",
    benchmark:
        "results/benchmarks/match_object_features/{object}.tsv"
    priority: 0
    threads: OBJECT_THREADS
    resources:
        mem_mb=by_size(4000, features=4),
        runtime=by_size(120, features=2),
    params:
        options=settings("object.matches"),
        seed=config["seed"],
        script=script("sfm/match_features.py"),
        code=code("sfm/match_features.py"),
    message:
        "{wildcards.object}: matching"


rule map_scene_photos:
    """Cameras and sparse points by incremental mapping and bundle adjustment (paper 3.1)."""
    input:
        as_inputs(cameras_of("scene")),
        folder="results/scenes/{scene}/photos",
        photos="results/scenes/{scene}/photos.json",
        database="results/scenes/{scene}/database.db",
    output:
        model=directory("results/scenes/{scene}/sparse"),
        report="results/scenes/{scene}/sparse.json",
    log:
        "results/logs/map_scene_photos/{scene}.log",
    benchmark:
        "results/benchmarks/map_scene_photos/{scene}.tsv"
    priority: 1
    conda:
        "../../envs/reconstruction.yaml"
    threads: SCENE_THREADS
    resources:
        mem_mb=by_size(8000, database=8),
        runtime=by_size(480, database=1),
    params:
        options=settings("scene.sparse"),
        calibrated=calibrated("scene"),
        cameras=cameras_flag("scene"),
        lengths="",
        files=state_of(cameras_of("scene")),
        seed=config["seed"],
        script=script("sfm/map_photos.py"),
        code=code("sfm/map_photos.py"),
    message:
        "{wildcards.scene}: cameras and sparse points"
    shell:
        "exec python {params.script} --folder {input.folder} --photos {input.photos} --database {input.database}"
        " --sparse {output.model} --report {output.report} --calibrated {params.calibrated} {params.cameras} {params.lengths} --seed {params.seed}"
        " {params.options} &> {log}"


use rule map_scene_photos as map_object_photos with:
    input:
        as_inputs(given_of),
        folder="results/objects/{object}/frames",
        photos="results/objects/{object}/photos.json",
        database="results/objects/{object}/database.db",
    output:
        model=directory("results/objects/{object}/sparse"),
        report="results/objects/{object}/sparse.json",
    log:
        "results/logs/map_object_photos/{object}.log",
    benchmark:
        "results/benchmarks/map_object_photos/{object}.tsv"
    priority: 0
    threads: OBJECT_THREADS
    resources:
        mem_mb=by_size(4000, database=8),
        runtime=by_size(120, database=2),
    params:
        options=settings("object.sparse"),
        calibrated=calibrated("object"),
        cameras=cameras_flag("object"),
        lengths=lengths_flag,
        files=state_of(given_of),
        seed=config["seed"],
        script=script("sfm/map_photos.py"),
        code=code("sfm/map_photos.py"),
    message:
        "{wildcards.object}: cameras and sparse points"


rule georegister:
    """Bring the model into metres, east, north and up, by control points or the photos' GPS, adjust it to them, and lay it
    on the scene's cloud."""
    input:
        as_inputs(survey_of),
        as_inputs(cloud_to_lie_on),
        photos="results/scenes/{scene}/photos.json",
        model="results/scenes/{scene}/sparse",
        report="results/scenes/{scene}/sparse.json",
    output:
        model=directory("results/scenes/{scene}/georeferenced"),
        report="results/scenes/{scene}/georeference.json",
        residuals="results/scenes/{scene}/residuals.tsv",
    log:
        "results/logs/georegister/{scene}.log",
    benchmark:
        "results/benchmarks/georegister/{scene}.tsv"
    priority: 1
    conda:
        "../../envs/reconstruction.yaml"
    threads: SCENE_THREADS
    resources:
        mem_mb=by_size(8000, model=8),
        runtime=by_size(120, model=1),
    params:
        options=settings("scene.georegister"),
        survey=survey_flags,
        held=lambda wildcards: wildcards.scene in POSED_SCENES
        and not lies_on_cloud(wildcards),
        crs=crs_flag,
        cloud=lie_on_flag,
        files=state_of(survey_of),
        scan=state_of(cloud_to_lie_on),
        seed=config["seed"],
        script=script("georef/georegister.py"),
        code=code("georef/georegister.py"),
    message:
        "{wildcards.scene}: georeferencing"
    shell:
        "exec python {params.script} --sparse {input.model} --sparse-json {input.report} --photos {input.photos} {params.survey}"
        " --held {params.held} {params.crs} {params.cloud} --georeferenced {output.model} --residuals {output.residuals} --report {output.report} --seed {params.seed} {params.options} &> {log}"


rule estimate_scene_spread:
    """How far the model may be bent, by adjusting it again without some of its photos and with another lens (M10)."""
    input:
        model="results/scenes/{scene}/georeferenced",
        report="results/scenes/{scene}/sparse.json",
    output:
        "results/scenes/{scene}/spread.npz",
    log:
        "results/logs/estimate_scene_spread/{scene}.log",
    benchmark:
        "results/benchmarks/estimate_scene_spread/{scene}.tsv"
    conda:
        "../../envs/reconstruction.yaml"
    threads: OBJECT_THREADS
    resources:
        mem_mb=by_size(4000, model=8),
        runtime=by_size(240, model=2),
    params:
        script=script("georef/estimate_spread.py"),
        code=code("georef/estimate_spread.py"),
    message:
        "{wildcards.scene}: how far the model may be bent"
    shell:
        "exec python {params.script} --sparse {input.model} --sparse-json {input.report} --spread {output} &> {log}"


use rule estimate_scene_spread as estimate_object_spread with:
    input:
        model="results/objects/{object}/sparse",
        report="results/objects/{object}/sparse.json",
    output:
        "results/objects/{object}/spread.npz",
    log:
        "results/logs/estimate_object_spread/{object}.log",
    benchmark:
        "results/benchmarks/estimate_object_spread/{object}.tsv"
    message:
        "{wildcards.object}: how far the model may be bent"

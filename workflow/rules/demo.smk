# The demo: a synthetic drone capture with known truth, and how far its results are from it; in a clone, not where the library is
# installed.
#
# INPUTS    none; config: demo, seed; everything, to compare it
# OUTPUTS   results/demo/{scene}/scene/photos/              the flight, GPS with noise in its EXIF
#           results/demo/{scene}/{object}/photos/           an orbit of each object
#           results/demo/{scene}/{object}/fiducials.tsv     what a person would click in the flight's photos
#           results/demo/{scene}/{object}/prompts.tsv       what a person would click in the object's photos: landmarks in several
#           results/demo/{scene}/{object}/clicks.tsv        the same in one photo; name it in the column prompts
#           results/demo/{scene}/truth/                     cameras, surfaces, masks; read by evaluation, and by the clicks
#           results/scenes/{scene}/truth.json, results/objects/{object}/truth.json
DEMO_OBJECTS = "house|balloon|sculpture"


rule render_scene:
    """Render the mapping flight."""
    output:
        photos=directory("results/demo/{scene}/scene/photos"),
        truth=directory("results/demo/{scene}/truth/scene"),
    log:
        "results/logs/render_scene/{scene}.log",
    benchmark:
        "results/benchmarks/render_scene/{scene}.tsv"
    priority: 1
    conda:
        "../../envs/reconstruction.yaml"
    threads: SCENE_THREADS
    resources:
        mem_mb=4000,
        runtime=30,
    params:
        options=flags(config["demo"]["flight"]),
        camera=config["demo"]["camera"],
        seed=config["seed"],
        script=script("demo/render_scene.py"),
        code=code("demo/render_scene.py"),
    message:
        "Demo {wildcards.scene}: rendering the flight"
    shell:
        "exec python {params.script} --photos {output.photos} --truth {output.truth} --camera {params.camera}"
        " --seed {params.seed} {params.options} &> {log}"


rule render_object:
    """Render the photos around one object."""
    output:
        photos=directory("results/demo/{scene}/{object}/photos"),
        truth=directory("results/demo/{scene}/truth/{object}"),
    log:
        "results/logs/render_object/{scene}-{object}.log",
    benchmark:
        "results/benchmarks/render_object/{scene}-{object}.tsv"
    wildcard_constraints:
        object=DEMO_OBJECTS,
    conda:
        "../../envs/reconstruction.yaml"
    threads: OBJECT_THREADS
    resources:
        mem_mb=4000,
        runtime=30,
    params:
        options=flags(config["demo"]["orbit"]),
        camera=config["demo"]["camera"],
        seed=config["seed"],
        script=script("demo/render_object.py"),
        code=code("demo/render_object.py"),
    message:
        "Demo {wildcards.scene}: rendering the photos around the {wildcards.object}"
    shell:
        "exec python {params.script} --name {wildcards.object} --photos {output.photos} --truth {output.truth}"
        " --camera {params.camera} --seed {params.seed} {params.options} &> {log}"


rule click_fiducials:
    """Click the object in the flight's photos, as a person would: a pixel or so off, where it can be seen."""
    input:
        "results/demo/{scene}/truth/scene",
    output:
        "results/demo/{scene}/{object}/fiducials.tsv",
    log:
        "results/logs/click_fiducials/{scene}-{object}.log",
    benchmark:
        "results/benchmarks/click_fiducials/{scene}-{object}.tsv"
    wildcard_constraints:
        object=DEMO_OBJECTS,
    conda:
        "../../envs/reconstruction.yaml"
    resources:
        mem_mb=2000,
        runtime=10,
    params:
        options="--miss-px 0 2",
        seed=config["seed"],
        script=script("demo/click_points.py"),
        code=code("demo/click_points.py"),
    message:
        "Demo {wildcards.scene}: clicking the {wildcards.object} in the flight's photos"
    shell:
        "exec python {params.script} --name {wildcards.object} --cameras {input}/cameras.json --clicks {output}"
        " --seed {params.seed} {params.options} &> {log}"


# Clicks in the object's own photos, which prompt the masks.
use rule click_fiducials as click_prompts with:
    input:
        "results/demo/{scene}/truth/{object}",
    output:
        "results/demo/{scene}/{object}/prompts.tsv",
    log:
        "results/logs/click_prompts/{scene}-{object}.log",
    benchmark:
        "results/benchmarks/click_prompts/{scene}-{object}.tsv"
    params:
        options="--photos 4 --separation-deg 25",
        seed=config["seed"],
        script=script("demo/click_points.py"),
        code=code("demo/click_points.py"),
    message:
        "Demo {wildcards.scene}: clicking the {wildcards.object} in its own photos"


rule click_object:
    """Click the object in one of its own photos, three spots and a box, some pixels off: prompts for SAM 2."""
    input:
        "results/demo/{scene}/truth/{object}",
    output:
        "results/demo/{scene}/{object}/clicks.tsv",
    log:
        "results/logs/click_object/{scene}-{object}.log",
    benchmark:
        "results/benchmarks/click_object/{scene}-{object}.tsv"
    wildcard_constraints:
        object=DEMO_OBJECTS,
    conda:
        "../../envs/reconstruction.yaml"
    resources:
        mem_mb=2000,
        runtime=10,
    params:
        seed=config["seed"],
        script=script("demo/click_object.py"),
        code=code("demo/click_object.py"),
    message:
        "Demo {wildcards.scene}: clicking the {wildcards.object} in one of its photos"
    shell:
        "exec python {params.script} --truth {input} --clicks {output} --seed {params.seed} &> {log}"


rule evaluate_scene:
    """Compare a rendered scene with its truth: cameras, georeferencing, dense cloud (G8)."""
    input:
        model="results/scenes/{scene}/georeferenced",
        georeference="results/scenes/{scene}/georeference.json",
        cloud="results/scenes/{scene}/dense.ply",
        truth=lambda wildcards: truth_of(scene_row(wildcards.scene)),
    output:
        "results/scenes/{scene}/truth.json",
    log:
        "results/logs/evaluate_scene/{scene}.log",
    benchmark:
        "results/benchmarks/evaluate_scene/{scene}.tsv"
    conda:
        "../../envs/report.yaml"
    resources:
        mem_mb=lambda wildcards, attempt: 4000 * attempt,
        runtime=lambda wildcards, attempt: 30 * attempt,
    params:
        seed=config["seed"],
        script=script("demo/evaluate_scene.py"),
        code=code("demo/evaluate_scene.py"),
    message:
        "{wildcards.scene}: comparing with the truth"
    shell:
        "exec python {params.script} --model {input.model} --georeference-json {input.georeference} --cloud {input.cloud}"
        " --truth-scene {input.truth:q} --report {output} --seed {params.seed} &> {log}"


rule evaluate_object:
    """Compare a rendered object with its truth: masks, cameras, depth after each stage, cloud, registration, fusion (G8)."""
    input:
        workspace=judging_photos,
        sparse="results/objects/{object}/sparse",
        undistorted="results/objects/{object}/undistorted",
        masks=if_masked("results/objects/{object}/masks"),
        stages=if_trained(
            *expand(
                "results/objects/{object}/stage{stage}",
                stage=[1, 2, 3, 4],
                allow_missing=True,
            )
        ),
        cloud="results/objects/{object}/object.ply",
        variants=expand(
            "results/objects/{object}/registration/{variant}/fine.json",
            variant=VARIANTS,
            allow_missing=True,
        ),
        scene=in_scene("dense.ply"),
        fused="results/objects/{object}/fused.ply",
        checked="results/objects/{object}/checked.ply",
        scene_json=in_scene("truth.json"),
        truth_scene=lambda wildcards: truth_of(scene_row(scene_of(wildcards))),
        truth_object=lambda wildcards: truth_of(object_row(wildcards.object)),
    output:
        "results/objects/{object}/truth.json",
    log:
        "results/logs/evaluate_object/{object}.log",
    benchmark:
        "results/benchmarks/evaluate_object/{object}.tsv"
    conda:
        "../../envs/report.yaml"
    resources:
        mem_mb=lambda wildcards, attempt: 4000 * attempt,
        runtime=lambda wildcards, attempt: 30 * attempt,
    params:
        made=options_of("masks", "stages"),
        seed=config["seed"],
        script=script("demo/evaluate_object.py"),
        code=code("demo/evaluate_object.py"),
    message:
        "{wildcards.object}: comparing with the truth"
    shell:
        "exec python {params.script} --workspace {input.workspace} --sparse {input.sparse} --undistorted {input.undistorted}"
        " {params.made} --cloud {input.cloud} --variants {input.variants} --scene {input.scene} --fused {input.fused}"
        " --checked {input.checked} --scene-json {input.scene_json} --truth-scene {input.truth_scene:q} --truth-object {input.truth_object:q}"
        " --report {output} --seed {params.seed} &> {log}"

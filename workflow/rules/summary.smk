# Evaluation against truth (where it is known), figures, tables, and the report page.
#
# INPUTS    everything before; config/scenes.tsv, config/objects.tsv: truth; config: arms, evaluation
# OUTPUTS   results/scenes/{scene}/truth.json, scene.png             only with truth: truth.json
#           results/objects/{object}/truth.json, figures/            only with truth: truth.json
#           results/summary/*.tsv, summary.txt, report.html
TABLES = ["registration", "completion", "ablation", "runtime", "scenes", "objects"]


rule evaluate_scene:
    """Judge a scene whose truth is known: cameras, georeferencing, dense cloud (G8)."""
    input:
        model="results/scenes/{scene}/georeferenced",
        georeference="results/scenes/{scene}/georeference.json",
        cloud="results/scenes/{scene}/dense.ply",
        truth=lambda wildcards: scene_truth(wildcards.scene),
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
        options=flags(config["evaluation"]["scene"]),
        seed=config["seed"],
        script=script("evaluate_scene.py"),
        code=code("evaluate_scene.py"),
    message:
        "Scene {wildcards.scene}: comparing with the truth"
    shell:
        "exec python {params.script} --model {input.model} --georeference {input.georeference} --cloud {input.cloud}"
        " --truth {input.truth:q} --evaluation {output} --seed {params.seed} {params.options} &> {log}"


rule evaluate_object:
    """Judge an object whose truth is known: masks, cameras, depth after each stage, cloud, registration, fusion (G8)."""
    input:
        cameras=POSED,
        masks="results/objects/{object}/masks",
        stages=expand(
            "results/objects/{object}/stage{stage}",
            stage=[1, 2, 3, 4],
            allow_missing=True,
        ),
        cloud="results/objects/{object}/object.ply",
        arms=expand(
            "results/objects/{object}/registration/{arm}/fine.json",
            arm=ARMS,
            allow_missing=True,
        ),
        witness="results/objects/{object}/witness.json",
        before=in_scene("dense.ply"),
        after="results/objects/{object}/fused_scene.ply",
        scene=in_scene("truth.json"),
        truth_scene=lambda wildcards: scene_truth(object_row(wildcards.object)["scene"]),
        truth_object=lambda wildcards: object_row(wildcards.object)["truth"],
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
        options=flags(config["evaluation"]["object"]),
        seed=config["seed"],
        script=script("evaluate_object.py"),
        code=code("evaluate_object.py"),
    message:
        "{wildcards.object}: comparing with the truth"
    shell:
        "exec python {params.script} --cameras {input.cameras} --masks {input.masks} --stages {input.stages}"
        " --cloud {input.cloud} --arms {input.arms} --witness {input.witness} --before {input.before} --after {input.after}"
        " --scene-evaluation {input.scene} --truth-scene {input.truth_scene:q} --truth-object {input.truth_object:q}"
        " --evaluation {output} --seed {params.seed} {params.options} &> {log}"


rule scene_figure:
    """The scene from above and from the side, with its cameras and objects."""
    input:
        cloud="results/scenes/{scene}/dense.ply",
        model="results/scenes/{scene}/georeferenced",
        crops=of_objects("registration/full/crop.ply"),
    output:
        report(
            "results/scenes/{scene}/scene.png",
            category="Scenes",
            caption="../report/scene.rst",
        ),
    log:
        "results/logs/scene_figure/{scene}.log",
    benchmark:
        "results/benchmarks/scene_figure/{scene}.tsv"
    conda:
        "../../envs/report.yaml"
    resources:
        mem_mb=lambda wildcards, attempt: 4000 * attempt,
        runtime=lambda wildcards, attempt: 30 * attempt,
    params:
        objects=objects_in,
        script=script("scene_figure.py"),
        code=code("scene_figure.py"),
    message:
        "Scene {wildcards.scene}: figure"
    shell:
        "exec python {params.script} --name {wildcards.scene} --dense {input.cloud} --georeferenced {input.model}"
        " --crops {input.crops} --objects {params.objects} --figure {output} &> {log}"


rule object_figures:
    """The object before and after, and every step between (the paper's Figures 2, 3 and 5)."""
    input:
        scene=in_scene("dense.ply"),
        fused_scene="results/objects/{object}/fused_scene.ply",
        crop="results/objects/{object}/registration/full/crop.ply",
        crop_json="results/objects/{object}/registration/full/crop.json",
        cloud="results/objects/{object}/object.ply",
        fine="results/objects/{object}/registration/full/fine.json",
        metrics="results/objects/{object}/metrics.json",
        cameras="results/objects/{object}/cameras",
        masks="results/objects/{object}/masks",
        stage1="results/objects/{object}/stage1",
        stage2="results/objects/{object}/stage2",
        stage3="results/objects/{object}/stage3",
        stage4="results/objects/{object}/stage4",
    output:
        report(
            directory("results/objects/{object}/figures"),
            patterns=["{name}.png"],
            category="Objects",
            subcategory="{object}",
            caption="../report/figures.rst",
        ),
    log:
        "results/logs/object_figures/{object}.log",
    benchmark:
        "results/benchmarks/object_figures/{object}.tsv"
    conda:
        "../../envs/report.yaml"
    resources:
        mem_mb=lambda wildcards, attempt: 4000 * attempt,
        runtime=lambda wildcards, attempt: 30 * attempt,
    params:
        script=script("object_figures.py"),
        code=code("object_figures.py"),
    message:
        "{wildcards.object}: figures"
    shell:
        "exec python {params.script} --name {wildcards.object} --scene {input.scene} --fused-scene {input.fused_scene}"
        " --crop {input.crop} --crop-report {input.crop_json} --object-cloud {input.cloud} --fine {input.fine}"
        " --metrics {input.metrics} --cameras {input.cameras} --masks {input.masks} --stage1 {input.stage1}"
        " --stage2 {input.stage2} --stage3 {input.stage3} --stage4 {input.stage4} --figures {output} &> {log}"


rule summary:
    """Tables, and a text that reads well over ssh."""
    input:
        results_of,
    output:
        tables=report(
            expand("results/summary/{table}.tsv", table=TABLES),
            category="Tables",
            caption="../report/table.rst",
        ),
        text="results/summary/summary.txt",
    log:
        "results/logs/summary/all.log",
    benchmark:
        "results/benchmarks/summary/all.tsv"
    conda:
        "../../envs/report.yaml"
    resources:
        mem_mb=1000,
        runtime=10,
    params:
        command=summary_command("results/logs/summary/all.log"),
        code=code("summary.py"),
    message:
        "Summary: tables"
    shell:
        "exec {params.command}"


rule report_page:
    """One page with all pictures and tables, readable offline."""
    input:
        summary="results/summary/summary.txt",
        scenes=expand("results/scenes/{scene}/scene.png", scene=SCENES),
        figures=expand("results/objects/{object}/figures", object=OBJECTS),
    output:
        "results/summary/report.html",
    log:
        "results/logs/report_page/all.log",
    benchmark:
        "results/benchmarks/report_page/all.tsv"
    conda:
        "../../envs/report.yaml"
    resources:
        mem_mb=1000,
        runtime=10,
    params:
        scenes=expand("results/scenes/{scene}", scene=SCENES),
        objects=expand("results/objects/{object}", object=OBJECTS),
        script=script("report.py"),
        code=code("report.py"),
    message:
        "Summary: report page"
    shell:
        "exec python {params.script} --summary results/summary --scenes {params.scenes} --objects {params.objects}"
        " --title scenefuse --report {output} &> {log}"


onerror:
    shell(
        "mkdir -p results/logs/summary; "
        + summary_command("results/logs/summary/onerror.log")
        + " || true"
    )
    print(
        "Some jobs failed; results/summary/summary.txt names them.", file=sys.stderr
    )

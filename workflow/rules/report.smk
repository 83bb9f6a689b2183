# Figures, tables, and the report page.
#
# INPUTS    everything before
# OUTPUTS   results/scenes/{scene}/scene.png, view.ply, view.json, results/objects/{object}/figures/
#           results/summary/*.tsv, summary.txt, details.txt, report.html


include: "../functions/report.smk"


TABLES = [
    "registration",
    "completion",
    "runtime",
    "scenes",
    "objects",
]


rule draw_scene:
    """The scene from above and from the side, with its cameras and objects."""
    input:
        cloud="results/scenes/{scene}/dense.ply",
        georeferenced=if_flown("georeferenced"),
        residuals=if_flown("residuals.tsv"),
        georeference="results/scenes/{scene}/georeference.json",
        crops=of_objects("registration/full/crop.ply"),
    output:
        report(
            "results/scenes/{scene}/scene.png",
            category="Scenes",
            caption="../report/scene.rst",
        ),
    log:
        "results/logs/draw_scene/{scene}.log",
    benchmark:
        "results/benchmarks/draw_scene/{scene}.tsv"
    conda:
        "../../envs/report.yaml"
    resources:
        mem_mb=lambda wildcards, attempt: 4000 * attempt,
        runtime=by_size(30, cloud=0.002),
    params:
        objects=object_folders,
        cameras=options_of("georeferenced", "residuals"),
        script=script("report/draw_scene.py"),
        code=code("report/draw_scene.py"),
    message:
        "{wildcards.scene}: figure"
    shell:
        "exec python {params.script} --name {wildcards.scene} --dense {input.cloud} {params.cameras}"
        " --georeference-json {input.georeference} --objects {params.objects} --figure {output} &> {log}"


rule draw_object:
    """The object before and after, and every step between (the paper's Figures 2, 3 and 5)."""
    input:
        scene=in_scene("dense.ply"),
        fused="results/objects/{object}/fused.ply",
        checked="results/objects/{object}/checked.ply",
        crop="results/objects/{object}/registration/full/crop.ply",
        crop_json="results/objects/{object}/registration/full/crop.json",
        cloud="results/objects/{object}/object.ply",
        fine="results/objects/{object}/registration/full/fine.json",
        missing="results/objects/{object}/missing.ply",
        missing_json="results/objects/{object}/missing.json",
        next_photos="results/objects/{object}/next_photos.csv",
        workspace=if_photographed("results/objects/{object}/undistorted"),
        masks=if_masked("results/objects/{object}/masks"),
        stages=if_trained(
            *expand(
                "results/objects/{object}/stage{stage}",
                stage=[1, 2, 3, 4],
                allow_missing=True,
            )
        ),
    output:
        report(
            directory("results/objects/{object}/figures"),
            patterns=["{name}.png"],
            category="Objects",
            subcategory="{object}",
            caption="../report/figures.rst",
        ),
    log:
        "results/logs/draw_object/{object}.log",
    benchmark:
        "results/benchmarks/draw_object/{object}.tsv"
    wildcard_constraints:
        object=one_of(JOINED),
    conda:
        "../../envs/report.yaml"
    resources:
        mem_mb=by_size(4000, cloud=10),
        runtime=lambda wildcards, attempt: 30 * attempt,
    params:
        photos=options_of("workspace", "masks", "stages"),
        script=script("report/draw_object.py"),
        code=code("report/draw_object.py"),
    message:
        "{wildcards.object}: figures"
    shell:
        "exec python {params.script} --name {wildcards.object} --scene {input.scene} --fused {input.fused} --checked {input.checked}"
        " --crop {input.crop} --crop-json {input.crop_json} --object-cloud {input.cloud} --fine-json {input.fine}"
        " --missing {input.missing} --missing-json {input.missing_json} --next-photos {input.next_photos}"
        " {params.photos} --figures {output} &> {log}"


rule draw_lone_object:
    """An object that lies in no scene: its photos, masks, stages and cloud."""
    input:
        cloud="results/objects/{object}/object.ply",
        sparse="results/objects/{object}/sparse.json",
        workspace="results/objects/{object}/undistorted",
        masks="results/objects/{object}/masks",
        stages=expand(
            "results/objects/{object}/stage{stage}",
            stage=[1, 2, 3, 4],
            allow_missing=True,
        ),
    output:
        report(
            directory("results/objects/{object}/figures"),
            patterns=["{name}.png"],
            category="Objects",
            subcategory="{object}",
            caption="../report/figures.rst",
        ),
    log:
        "results/logs/draw_lone_object/{object}.log",
    benchmark:
        "results/benchmarks/draw_lone_object/{object}.tsv"
    wildcard_constraints:
        object=one_of(LONE),
    conda:
        "../../envs/report.yaml"
    resources:
        mem_mb=by_size(4000, cloud=10),
        runtime=lambda wildcards, attempt: 30 * attempt,
    params:
        script=script("report/draw_lone_object.py"),
        code=code("report/draw_lone_object.py"),
    message:
        "{wildcards.object}: figures"
    shell:
        "exec python {params.script} --name {wildcards.object} --object-cloud {input.cloud} --sparse-json {input.sparse} --workspace {input.workspace}"
        " --masks {input.masks} --stages {input.stages} --figures {output} &> {log}"


rule view_scene:
    """The scene before and after, thinned for the 3D view of the report page."""
    input:
        dense="results/scenes/{scene}/dense.ply",
        completed="results/scenes/{scene}/completed.ply",
        completed_json="results/scenes/{scene}/completed.json",
        georeference="results/scenes/{scene}/georeference.json",
    output:
        "results/scenes/{scene}/view.ply",
        "results/scenes/{scene}/view.json",
    log:
        "results/logs/view_scene/{scene}.log",
    benchmark:
        "results/benchmarks/view_scene/{scene}.tsv"
    conda:
        "../../envs/report.yaml"
    resources:
        mem_mb=lambda wildcards, attempt: 4000 * attempt,
        runtime=by_size(30, completed=0.002),
    params:
        script=script("report/view_scene.py"),
        code=code("report/view_scene.py"),
    message:
        "{wildcards.scene}: 3D view"
    shell:
        "exec python {params.script} --dense {input.dense} --completed {input.completed} --completed-json {input.completed_json}"
        " --georeference-json {input.georeference} --folder results/scenes/{wildcards.scene} &> {log}"


rule write_summary:
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
        details="results/summary/details.txt",
    log:
        "results/logs/write_summary/all.log",
    benchmark:
        "results/benchmarks/write_summary/all.tsv"
    conda:
        "../../envs/report.yaml"
    resources:
        mem_mb=2000,
        runtime=10,
    params:
        command=lambda wildcards: summary_command("results/logs/write_summary/all.log"),
        code=code("report/write_summary.py"),
    message:
        "Summary: tables, texts"
    shell:
        "exec {params.command}"


rule write_report:
    """One page with all pictures and tables, readable offline."""
    input:
        summary="results/summary/summary.txt",
        scenes=there_if_exported("results/scenes/{scene}/scene.png", scene=SCENES),
        views=there_if_exported("results/scenes/{scene}/view.json", scene=SCENES),
        figures=there_if_exported("results/objects/{object}/figures", object=OBJECTS),
        paper=PAPER,
        surfaces=lambda wildcards: exported_surfaces(),
    output:
        "results/summary/report.html",
    log:
        "results/logs/write_report/all.log",
    benchmark:
        "results/benchmarks/write_report/all.tsv"
    conda:
        "../../envs/report.yaml"
    resources:
        mem_mb=1000,
        runtime=10,
    params:
        folders=result_folders,
        paper=flags({"paper": PAPER[1]} if PAPER else {}),
        script=script("report/write_report.py"),
        code=code("report/write_report.py"),
    message:
        "Summary: report page"
    shell:
        "exec python {params.script} --summary results/summary {params.folders} {params.paper}"
        " --report {output} &> {log}"


rule write_pdf:
    """The same on paper; `scenefuse export` asks for it."""
    input:
        summary="results/summary/summary.txt",
        scenes=there_if_exported("results/scenes/{scene}/scene.png", scene=SCENES),
        figures=there_if_exported("results/objects/{object}/figures", object=OBJECTS),
        drawings=[
            f"results/objects/{name}/drawings"
            for name in OBJECTS
            if is_added(Path(f"results/objects/{name}"))
        ],
    output:
        "results/summary/report.pdf",
    log:
        "results/logs/write_pdf/all.log",
    benchmark:
        "results/benchmarks/write_pdf/all.tsv"
    conda:
        "../../envs/report.yaml"
    resources:
        mem_mb=2000,
        runtime=10,
    params:
        folders=result_folders,
        script=script("report/write_pdf.py"),
        code=code("report/write_pdf.py"),
    message:
        "Summary: report on paper"
    shell:
        "exec python {params.script} --summary results/summary {params.folders} --report {output} &> {log}"


onstart:
    hold_run_lock()
    refuse_read_only_folders()
    for line in forecast_run():
        print(line, file=sys.stderr)
    forget_failures()
    mark_as_unfinished()


onsuccess:
    if any(job.rule.name == "write_report" for job in workflow.dag.jobs):
        print(closing_lines(), file=sys.stderr)


onerror:
    record_failures()
    stopped = (
        getattr(workflow.scheduler, "_user_kill", None)
        or workflow.scheduler.running
    )
    keep_going = workflow.execution_settings.keep_going and not stopped
    if keep_going:
        finish_scenes()
    for job in held_up("write_summary"):
        workflow.persistence.started(job)
    run_summary_command("results/logs/write_summary/onerror.log", failed_logs())
    for job in held_up("compare_with_paper") if keep_going else []:
        # If it fails, the page may not show one of before.
        for output in job.output:
            Path(output).unlink(missing_ok=True)
        run_anyway(job)
    for job in held_up("write_report") if keep_going else []:
        run_anyway(job)
    print_failures(stopped)
    print(closing_lines(), file=sys.stderr)

# Camera poses of an object without SfM, for pose_source network.
#
# INPUTS    results/objects/{object}/undistorted/; config: object.poses
# OUTPUTS   results/objects/{object}/poses/, poses.json                     the same photos with other poses


rule find_poses:
    """Camera poses without SfM, for pose_source network (paper 3.2; N11)."""
    input:
        workspace="results/objects/{object}/undistorted",
        workspace_json="results/objects/{object}/undistorted.json",
    output:
        posed=directory("results/objects/{object}/poses"),
        report="results/objects/{object}/poses.json",
    log:
        "results/logs/find_poses/{object}.log",
    benchmark:
        "results/benchmarks/find_poses/{object}.tsv"
    conda:
        "../../envs/training.yaml"
    threads: OBJECT_THREADS
    resources:
        mem_mb=lambda wildcards, attempt: 4000 * attempt,
        runtime=lambda wildcards, attempt: 120 * attempt,
        gpu=config["gpu"],
    params:
        options=settings("object.poses"),
        seed=config["seed"],
        script=script("poses/find_poses.py"),
        code=code("poses/find_poses.py"),
    message:
        "{wildcards.object}: poses without SfM"
    shell:
        "exec python {params.script} --workspace {input.workspace} --posed {output.posed} --report {output.report}"
        " --seed {params.seed} {params.options} &> {log}"

"""The demo's tables of docs/results.md, from a finished run.

make demo, then
PYTHONPATH=. python tests/benchmarks/demo_tables.py --results results --commit COMMIT

writes docs/results/demo_scene.tsv and demo_objects.tsv, and the commit into their rows of docs/results/index.tsv.
"""

from pathlib import Path

from scenefuse.core.settings import ROOT
from scenefuse.core.stage import read_json, run, value

TABLES, OBJECTS = ROOT / "docs/results", ("house", "balloon", "sculpture")


def demo_tables(*, results: Path, commit: str) -> None:
    """Write both tables.

    Args:
        results: folder of a finished demo, with the registration variants that `config/demo.yaml` names.
        commit: whose code the run was made with.
    """
    columns = [object_rows(results / "objects" / name) for name in OBJECTS]
    measures = [[name, *(column[name] for column in columns)] for name in columns[0]]
    _write("demo_objects.tsv", [["measure", *OBJECTS], *measures])
    _write("demo_scene.tsv", [["measure", "value"], *map(list, scene_rows(results / "scenes/demo").items())])
    lines = [line.split("\t") for line in (TABLES / "index.tsv").read_text().splitlines()]
    for line in lines:
        if line[0] in ("demo_objects.tsv", "demo_scene.tsv"):
            line[2], line[4] = commit, "current"
    _write("index.tsv", lines)


def scene_rows(folder: Path) -> dict[str, str]:
    """Measure and value of the scene."""
    truth, sparse = read_json(folder / "truth.json"), read_json(folder / "sparse.json")

    def cm(key: str) -> str:
        return f"{100 * value(truth, key):.1f}"

    turned = [f"{value(truth, f'camera_rotation_{kind}_deg'):.2f}°" for kind in ("median", "max")]
    return {
        "photos registered": f"{value(sparse, 'registered')} of {value(sparse, 'total')}",
        "camera position off, median; largest (cm)": f"{cm('camera_position_median')}; {cm('camera_position_max')}",
        "camera rotation off, median; largest": "; ".join(turned),
        "georeferencing off (GPS noise 0.5 m): position": f"{value(truth, 'georeference_error_median'):.2f} m",
        "georeferencing off: scale": f"{value(truth, 'georeference_scale_error_pct'):.2f} %",
        "dense cloud to true surface, median; 90 % (cm)": f"{cm('cloud_distance_median')}; {cm('cloud_distance_90')}",
        "terrain seen by three photos, covered within 3 GSD": f"{value(truth, 'terrain_covered'):.0%}".replace(
            "%", " %"
        ),
    }


def object_rows(folder: Path) -> dict[str, str]:
    """Measure and value of an object."""
    truth, fine = read_json(folder / "truth.json"), read_json(folder / "registration/full/fine.json")
    psnr = [value(read_json(folder / f"stage{stage}.json"), "psnr_held_out") for stage in (2, 4)]
    variants, diagonal = truth["variants"], value(truth, "diagonal")
    stated = 100 * value(fine, "scale_sd_log"), value(fine, "rotation_sd_deg"), value(fine, "translation_sd")

    def off(variant: str) -> tuple[float, float, float]:
        errors = variants[variant]
        turn, shift = (value(errors, key) for key in ("rotation_error_deg", "translation_error_over_diagonal"))
        return value(errors, "scale_error_pct"), turn, 100 * shift

    def scores(key: str) -> str:
        return "; ".join(f"{value(truth, f'{key}_{at}'):.3f}" for at in ("1pct", "05pct"))

    def rise(at: str) -> str:
        return " → ".join(f"{value(truth, f'scene_f_score_{when}_{at}'):.3f}" for when in ("before", "after"))

    cloud = [f"{value(truth, f'cloud_accuracy_{share}'):.3f}" for share in ("median", "90")]
    full, alone, paper = off("full"), off("clouds_only"), off("paper")
    return {
        "masks by GrabCut, mean IoU": f"{value(truth, 'mask_iou_mean'):.3f}",
        "held-out PSNR, stage 2 → 4 (dB)": " → ".join(f"{decibels:.1f}" for decibels in psnr),
        "depth error after stage 4, median (% d)": f"{100 * value(truth, 'stage4_depth_error'):.2f}",
        "cloud accuracy, median; 90 % (% d)": "; ".join(cloud),
        "cloud F at 1 %; 0.5 %": scores("cloud_f_score"),
        "decision": str(value(fine, "status")),
        "pose off: scale (stated deviation)": f"{full[0]:.2f} % ({stated[0]:.2f})",
        "pose off: rotation": f"{full[1]:.2f}° ({stated[1]:.2f})",
        "pose off: position (% d)": f"{full[2]:.2f} ({100 * stated[2] / diagonal:.2f})",
        "by clouds only: scale, rotation, position": f"{alone[0]:.2f} %, {alone[1]:.2f}°, {alone[2]:.2f}",
        "paper's registration: scale, rotation": f"{paper[0]:.1f} %, {paper[1]:.1f}°",
        "scene F at 1 %, before → after": rise("1pct"),
        "scene F at 0.5 %, before → after": rise("05pct"),
    }


def _write(name: str, rows: list[list[str]]) -> None:
    (TABLES / name).write_text("\n".join("\t".join(row) for row in rows) + "\n")


if __name__ == "__main__":
    run(demo_tables)

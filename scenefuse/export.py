"""`scenefuse export`: what is handed over of finished objects, and one file with all of it."""

import argparse
import os
import re
import subprocess
import sys
from collections.abc import Iterable
from functools import partial
from pathlib import Path
from zipfile import ZIP_DEFLATED, ZipFile

import numpy as np

from scenefuse.core.project import Project, read_project
from scenefuse.core.settings import read_settings
from scenefuse.core.stage import StageError, atomic_file
from scenefuse.core.transforms import along_a_line

EXPORTS = {
    "surface": "results/objects/{object}/surface.glb",
    "drawings": "results/objects/{object}/drawings",
    "cameras": "results/scenes/{scene}/cameras",
    "tiles": "results/scenes/{scene}/tiles",
    "pdf": "results/summary/report.pdf",
}
RULES = ("make_surface", "draw_surface", "export_cameras", "make_tiles", "write_pdf")
REPORT, SUMMARY = Path("results/summary/report.html"), Path("results/summary/summary.txt")
RUN = (sys.executable, "-m", "scenefuse", "run")


def export(arguments: list[str], settings_files: list[Path]) -> int:
    """Make surfaces, drawings, cameras, tiles and a PDF, renew the report page, and pack it; the exit status.

    Args:
        arguments: of the command line; those that are not its own go to Snakemake.
        settings_files: of the project.
    """
    words, others = _parse(arguments)
    if any(word.startswith(("-d", "--directory")) for word in others):
        sys.exit("error: --directory is for scenefuse run; go to the folder of the project, and export there")
    try:
        project = read_project(read_settings(*settings_files))
    except StageError as error:
        sys.exit(f"error: {error}")
    names = _added(words.names, project)
    if words.zip and not REPORT.is_file():
        sys.exit(f"error: --zip needs {REPORT}, which is not here; run the workflow to its end first (scenefuse run)")
    if words.zip and (words.zip.is_dir() or not os.access(words.zip.parent, os.W_OK)):
        sys.exit(
            f"error: {words.zip} cannot be written: it is a folder, or its own is missing or may not be written to"
        )
    if words.facade:
        if len(names) != 1:
            sys.exit("error: --facade is of one object; name it by --object")
        # Once they are kept, every export draws them.
        if not np.isfinite(words.facade).all() or along_a_line(np.reshape(words.facade, (3, 3))):
            sys.exit("error: the three points of --facade lie in a line or are no numbers; click three of its corners")
        Path(f"results/objects/{names[0]}/facade.txt").write_text(" ".join(map(str, words.facade)))
    scenes = sorted(name for name in project.scenes if Path(f"results/scenes/{name}/dense.ply").is_file())
    # Given clouds have no cameras, and a scene that was not completed has no tiles.
    needed = {"cameras": "results/*/*/undistorted", "tiles": "results/scenes/*/completed.ply", "pdf": str(REPORT)}
    asked = words.what or [*EXPORTS]
    what = [item for item in asked if any(Path().glob(needed.get(item, "*")))]
    what, names = [item for item in what if names or "{object}" not in EXPORTS[item]], names or [""]
    targets = {EXPORTS[item].format(object=name, scene=scene) for item in what for name in names for scene in scenes}
    targets = {t for t in targets if not t.endswith("/tiles") or Path(t).with_name("completed.ply").is_file()}
    if not targets:
        sys.exit(f"error: there is nothing to export as {', '.join(asked)}; {SUMMARY} says what the run made")
    ended = subprocess.run([*RUN, *sorted(targets), *others, "--allowed-rules", *RULES]).returncode
    if ended or {"-n", "--dry-run", "--dryrun"} & set(others):
        return ended
    name, scene = ("{" + ",".join(found) + "}" if len(found) > 1 else found[0] for found in (names, scenes))
    print("Export:", ", ".join(EXPORTS[item].format(object=name, scene=scene) for item in what), flush=True)
    ended = _renew_report(others) if REPORT.is_file() else 0
    if words.zip and not ended:
        try:
            # Cameras belong to photos that are not sent.
            write_zip(REPORT, [Path(t) for t in targets if not t.endswith("/cameras")], words.zip)
        except OSError as error:
            sys.exit(f"error: {error}")
        print(f"To send: {words.zip} ({words.zip.stat().st_size / 1e6:.0f} MB); unpacked, open its {REPORT.name}")
    return ended


def _added(named: list[str] | None, project: Project) -> list[str]:
    """The finished objects, or those that are named, without those that were not added to their scenes."""
    from scenefuse.report.run_summary import is_added

    # Results of rows that were removed or renamed stay.
    folders = {name: Path("results/objects", name) for name in named or project.objects}
    missing = [name for name, folder in folders.items() if not (folder / "fused.ply").is_file()]
    if missing and (named or len(missing) == len(folders)):
        if (row := project.objects.get(missing[0])) is None:
            known = ", ".join(project.objects)
            sys.exit(f"error: unknown object '{missing[0]}'; {project.settings['objects']} lists: {known}")
        if not row.get("scene"):
            sys.exit(f"error: {missing[0]} lies in no scene: its result is {folders[missing[0]]}/object.ply, as it is")
        which = f"{folders[missing[0]]}/fused.ply is not" if named else "no results/objects/NAME/fused.ply is"
        sys.exit(f"error: {which} here ({Path.cwd()}); run the workflow first (scenefuse run)")
    refused = [name for name in sorted(folders.keys() - {*missing}) if not is_added(folders[name])]
    if refused and named:
        sys.exit(f"error: {refused[0]} was not added to the scene, so there is no surface of it; {SUMMARY} says why")
    for left_out, why in ((refused, "not added to the scene"), (missing, "not finished, or in no scene")):
        if left_out:
            print(f"Left out: {', '.join(left_out)}, {why}; {SUMMARY} says why", flush=True)
    return sorted(folders.keys() - {*missing, *refused})


def _parse(arguments: list[str]) -> tuple[argparse.Namespace, list[str]]:
    """The options of an export, and those that are Snakemake's."""
    parser = argparse.ArgumentParser(
        prog="scenefuse export",
        description="Make surfaces, drawings, cameras, tiles and a PDF of finished objects, shown in the report."
        " Nothing before them runs again.",
        epilog="All other options are those of scenefuse run, as -n to see what would be made.",
    )
    parser.add_argument("--what", nargs="+", action="extend", choices=EXPORTS, help="default: all of them")
    finished = "default: all that are finished"
    parser.add_argument("--object", nargs="+", action="extend", dest="names", metavar="NAME", help=finished)
    facade = "three points of a facade of one object, to draw it as well"
    parser.add_argument("--facade", nargs=9, type=float, metavar=("X", "Y", "Z") * 3, help=facade)
    parser.add_argument("--zip", type=Path, metavar="FILE", help="and all of it with the report in one file to send")
    return parser.parse_known_args(arguments)


def _renew_report(others: list[str]) -> int:
    """Show in the page what was exported, of which not all is an input of its rule; the exit status."""
    page = ["--quiet", "all", "--forcerun", "write_report", "--allowed-rules", "write_report"]
    return subprocess.run([*RUN, str(REPORT), *others, *page]).returncode


def write_zip(page: Path, exported: Iterable[Path], file: Path) -> None:
    """Write a ZIP archive with page and PDF at its top and, in folders, what the page links to, so that links work.

    Args:
        page: results/summary/report.html; its links to results begin with "../".
        exported: files and folders of the results that go with it, linked or not.
        file: the archive; one that is there is replaced.
    """
    results, text = page.parent.parent, page.read_text(encoding="utf-8")
    given = {*exported, *(results / link for link in re.findall(r'href="\.\./([^"#]+)"', text))}
    files = {path for top in given for path in (top, *top.rglob("*")) if path.is_file() and path.name[0] != "."}
    # A copy may have lost its files' dates.
    packed = partial(ZipFile, mode="w", compression=ZIP_DEFLATED, compresslevel=1, strict_timestamps=False)
    with atomic_file(file) as temporary, packed(temporary) as archive:
        archive.writestr(page.name, text.replace('href="../', 'href="').replace(">results/", ">"))
        for path in sorted(files):
            # What belongs to the summary lies at the top, beside the page.
            archive.write(path, path.name if path.parent == page.parent else path.relative_to(results))

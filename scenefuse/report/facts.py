"""What a client asks of a scene or an object, in words: how large, how exact, what is missing, what went wrong, and
what to do next.

The words are made of a row of scenes.tsv or objects.tsv, for the report page and for summary.txt alike.
"""

import contextlib
import math
import re
from collections.abc import Collection, Mapping, Sequence
from datetime import date
from pathlib import Path
from statistics import NormalDist
from typing import Any

import numpy as np
import pyproj
from PIL.ExifTags import IFD, Base

from scenefuse.cloud.crs import crs_name, unit_name
from scenefuse.core.stage import StageError, read_json, value
from scenefuse.core.version import VERSION
from scenefuse.photos.geodesy import given_place, heights_of
from scenefuse.photos.photo_files import open_picture
from scenefuse.photos.workspace import posed_images, read_model
from scenefuse.report.run_summary import ALONE, ObjectSummary, is_added
from scenefuse.report.values import WORDS, find, length, percent, percents, read_table, records

Row = Mapping[str, Any]
# Photos of a scene whose ground pixels and dates are looked at, spread evenly.
LOOKED_AT = 20
# Others look before as after.
ADDED = ("registered", "ungated")
DONE = (*ADDED, ALONE)
# Of what shares of an object's surface are: of all of it, where masks say what that is.
OF_ALL = ("its surface", None)
# Between the pieces of advice in a cell of objects.tsv.
BETWEEN = " | "
# A wider angle without any photo leaves a side of the object unseen.
MAX_GAP_DEG = 100.0
# Masks are mentioned where more than this share of the photos is left out, or where the others agree by less (IoU).
MAX_LEFT_OUT, MIN_AGREEMENT = 0.1, 0.75
# Photos are mentioned that are more than this brighter or darker than the others, in stops (powers of two).
MAX_EXPOSURE_STOPS = 0.7


def object_facts(row: Row) -> dict[str, str]:
    """Label -> sentence, from a row of objects.tsv; what is not known has no label."""
    has, facts = _known(row), dict[str, str]()
    unit, status = has.get("unit", "scene units"), has["status"]
    why = has.get("reason") if status == "unregistered" else has.get("error")
    if status in DONE:
        # The pose of an ungated one is the clouds', whether photos link it or not.
        why = WORDS["decided_by"].get(has.get("decided_by", "")) if status == "registered" else None
    facts["Result"] = WORDS["results"][status] + _completed(has) + _of_shown(has) + (f": {why}" if why else "")
    if status == "unregistered":
        facts["Result"] += ". Perhaps it is not in this scene, or too little of it"
    if "height" in has:
        sides = " × ".join(length(has[side], unit) for side in ("length", "width")).replace(" scene units ×", " ×")
        facts["Size"] = f"{sides}, {length(has['height'], unit)} high, overall"
    if "surface_missing" in has:
        there, missing, *kinds = _surface(has)
        causes = ", ".join(f"{share} {what}" for what, share in zip(WORDS["missing"].values(), kinds) if share)
        whole = "" if has.get("surface_of") in OF_ALL else f" of {has['surface_of']}"
        aside = [f"{percent(has['surface_plain'])} {WORDS['plain']}"] if has.get("surface_plain") else []
        aside += [f"counted in cells of {length(has['surface_cell'], unit)}"] if "surface_cell" in has else []
        lost = f", {missing} is missing: {causes}" if missing else ""
        facts["Surface"] = f"{there}{whole} is there" + (f" ({'; '.join(aside)})" if aside else "") + lost
        if has.get("ground_missing"):
            facts["Surface"] += f"; of the ground at its foot {percent(has['ground_missing'])} is missing"
    if found := accuracies(row):
        absolute = "; on Earth as exact as the scene (see Position)"
        facts["Accuracy"] = found[0] + (absolute if "crs" in has else "")
    if "scale_sd_log" in has:
        relative = "" if has.get("scene_scale_sd_log") else ", if the scene's is right"
        facts["Scale"] = _trust(scale_sd(row), unit) + relative
        if unit == "scene units":
            known = f"{percent(scale_sd(row))} (standard deviation)"
            facts["Scale"] = f"not in metres; beside the scene it is known to {known}"
    if "registered" in has and "frames" in has:
        taken = f"taken {has['photographed']}" if "photographed" in has else "undated"
        facts["Photos"] = f"{has['registered']:.0f} of {has['frames']:.0f} used, {taken}"
    folder = f"results/objects/{has['object']}"
    if status in ADDED and "added_points" in has:
        facts["File"] = f"{folder}/fused.ply with its surroundings (local frame, {_plural(unit)}; for CloudCompare)"
    elif status == ALONE:
        facts["File"] = f"{folder}/object.ply (a frame of its own, {_plural(has.get('unit', 'object units'))})"
    return _capital(facts | _next(has))


def verdict(row: Row) -> str:
    """What became of an object in a word or two."""
    has = _known(row)
    return WORDS["badges"].get(has["status"], has["status"]) + _completed(has)


def scene_title(name: str) -> str:
    """A heading; a scene is often called so."""
    return "Scene" if name.lower() == "scene" else f"Scene {name}"


def _completed(has: dict[str, Any]) -> str:
    """How much of an object's surface is there, to follow the word "completed"."""
    known = has["status"] == "registered" and "surface_missing" in has and has.get("surface_of") in OF_ALL
    return f" to {_surface(has)[0]}" if known else ""


def _of_shown(has: dict[str, Any]) -> str:
    """How much is there of what photos show: the rest is estimated, and behind a facade there may be none."""
    shown = 1 - has.get("surface_never_seen", 0.0)
    if not _completed(has) or not 0 < shown < 1:
        return ""
    return f" ({percent((1 - has['surface_missing']) / shown)} of what photos show)"


def _surface(has: dict[str, Any]) -> list[str]:
    """The shares of an object's surface that are there, missing, and missing for each reason; they sum up."""
    return percents([has.get(f"surface_{name}", 0.0) for name in WORDS["missing"]])


def scale_sd(row: Row) -> float:
    """Relative standard deviation of lengths by the scale, as far as it is known: of a scene, or an object in one."""
    has = _known(row)
    return math.hypot(*(has.get(f"{of}scale_sd_log", 0.0) for of in ("", "scene_", "gps_", "lengths_")))


def _plural(unit: str) -> str:
    """A unit in words."""
    return "metres" if unit == "m" else unit


def _trust(scale_sd: float, unit: str) -> str:
    """How far lengths can be trusted whose scale has this relative standard deviation."""
    ten = f", {length(10 * scale_sd, 'm')} on a 10 m wall" if unit == "m" else ""
    return f"trust it to {percent(scale_sd)}{ten} (standard deviation)"


def _scale(has: dict[str, Any]) -> str:
    """Whether a scene's lengths can be trusted, and what gives them."""
    if has.get("length_unit", "scene units") == "scene units":
        return "do not trust it: nothing gives it, and lengths are in scene units"
    count, off = has.get("lengths", 0), percent(has.get("length_rms_pct", 0.0) / 100)
    known, disagree = ("one known length", "disagrees") if count == 1 else (f"{count:.0f} known lengths", "disagree")
    beside = f"; {known} {disagree} by {off}" if count else ""
    if has.get("control_points"):
        return f"trust it as far as the {has['control_points']:.0f} control points that give it (see Position){beside}"
    if "gps_scale_sd_log" in has:
        return f"{_trust(has['gps_scale_sd_log'], has['length_unit'])}, by the photos' GPS{beside}"
    if "lengths_scale_sd_log" in has:
        check = f"they disagree by {off}" if count > 1 else "nothing checks it"
        return f"{_trust(has['lengths_scale_sd_log'], 'm')}, by {known}; {check}"
    return f"it is that of the given {given_place(has) or 'cloud'}{beside or '; nothing checks it'}"


def is_current(made: Path, source: Path) -> bool:
    """Whether two files are there, and the first, which is made of the second, is not of an earlier one."""
    return made.is_file() and source.is_file() and made.stat().st_mtime >= source.stat().st_mtime


def has_surface(folder: Path) -> bool:
    """Whether the surface of an object's last fusion is there; that of one that was refused shows the scene alone."""
    whole = all((folder / f"surface.{kind}").is_file() for kind in ("ply", "glb"))  # a person may delete large files
    return whole and is_added(folder) and is_current(folder / "surface.json", folder / "fused.ply")


def surface_facts(folder: Path, row: Row) -> dict[str, str]:
    """The same of the surface in an object's results; nothing where none was made of its last fusion."""
    if not has_surface(folder):
        return {}
    found = read_json(folder / "surface.json")
    if value(found, "status") == "empty":
        return {"Mesh": f"None: {value(found, 'reason')}"}
    place, has = f"results/objects/{folder.name}", _known(row)
    unit = _plural(has.get("unit", "m"))
    of_glb = unit if unit == "scene units" else "metres"
    mesh = f"{place}/surface.ply (local frame, {unit}; for CloudCompare, MeshLab)"
    mesh += f", {place}/surface.glb (the same, {of_glb}, y up; for Blender, web viewers)"
    area = sum(value(found, f"{kind}_area") for kind in ("measured", *WORDS["mesh"]))
    whole = length(area, found["open_area"]["unit"].replace("2", "²"))
    measured, _, *others = percents([value(found, kind) for kind in WORDS["mesh"]])
    rest = [f"{share} {what}" for share, what in zip(others, WORDS["mesh"].values()) if share]
    facts = {"Mesh": mesh, "Mesh area": ", ".join([f"{whole} with its surroundings: {measured} measured", *rest])}
    if not is_current(folder / "drawings/drawings.pdf", folder / "surface.json"):
        return facts
    above = f"; above.tif beside it, for QGIS, is in {crs_name(has['crs'])}" if "crs" in has else ""
    scale = "with scale bars, to no scale in metres" if unit == "scene units" else "to scale"
    return facts | {"Drawings": f"{place}/drawings/drawings.pdf, {scale}{above}"}


def scene_exports(folder: Path) -> dict[str, str]:
    """The same of what `scenefuse export` made in a scene's results."""
    found, place = dict[str, str](), f"results/scenes/{folder.name}"
    if (folder / "cameras/transforms.json").is_file():
        found["Cameras"] = f"{place}/cameras (COLMAP, transforms.json, Metashape's cameras.xml), {WORDS['cameras']}"
    if is_current(folder / "tiles/points/tileset.json", folder / "completed.ply"):
        found["Tiles"] = f"{place}/tiles/points/tileset.json, {place}/tiles/surfaces/tileset.json (3D Tiles 1.1)"
    return found


def accuracies(row: Row) -> list[str]:
    """How exact a scene or an object is, in sentences; the first is the one to quote."""
    has = _known(row)
    unit, found = has.get("unit", "scene units"), list[str]()
    for name, what in WORDS["deviations"].items():
        if name in has:
            found.append(f"{length(has[name], unit)} {what}")
            if f"{name}_90" in has:
                found[-1] += f"; that of nine points in ten is at most {length(has[f'{name}_90'], unit)}"
    if has.get("scale_sd_log"):
        found.append(f"its size beside the scene's is known to {percent(has['scale_sd_log'])}")
    for kind, what in WORDS["errors"].items():
        known = {way: has[name] for way in ("horizontal", "vertical") if (name := f"{kind}_rms_{way}_m") in has}
        found += _errors(what, known) if known else []
    return found


def _next(has: dict[str, Any]) -> dict[str, str]:
    """What to photograph, click or repair, a line each."""
    parts = []
    if has.get("stations"):
        shows = (
            f": this would show {percent(has['stations_show'])} of what no photo shows, or where photos disagree"
            if "stations_show" in has
            else ""
        )
        places = "place" if has["stations"] == 1 else "places"
        table = f"results/objects/{has['object']}/next_photos.csv"
        parts.append(f"photograph it from {has['stations']:.0f} {places} ({table}){shows}")
    if "advice" in has:
        parts += has["advice"].split(BETWEEN)
    return {"Next": "\n".join(part[:1].upper() + part[1:] for part in parts)} if parts else {}


def scene_facts(row: Row) -> dict[str, str]:
    """Label -> sentence, from a row of scenes.tsv; what is not known has no label."""
    has, facts = _known(row), dict[str, str]()
    unit = has.get("length_unit", "scene units")
    if "error" in has:
        facts["Result"] = f"no dense cloud: {has['error']}"
    elif has.get("completed_by") == "none":
        facts["Result"] = f"not completed, for no object was added; {has['completed_points']:,.0f} points, as before"
    elif "completed_points" in has:
        facts["Result"] = f"completed with {has['completed_by']}; {has['completed_points']:,.0f} points"
        if "removed_points" in has and "points" in has:
            added = has["completed_points"] - has["points"] + has["removed_points"]
            facts["Result"] += f": {has['points']:,.0f} of the scene before, of which {has['removed_points']:,.0f} are"
            facts["Result"] += f" removed or replaced by better ones, and {added:,.0f} added"
    elif "points" in has:
        facts["Result"] = f"{has['points']:,.0f} points, not completed with all objects yet"
    if "registered" in has and "photos" in has:
        used = f"{has['registered']:.0f} of {has['photos']:.0f} photos used"
        facts["Photographed"] = f"{has.get('photographed', 'undated')}, {used}"
    elif "error" not in has:
        facts["Photographed"] = "given as a cloud"
    counted = unit_name(pyproj.CRS.from_user_input(has["crs"])) if "crs" in has else unit
    where = crs_name(has["crs"]) if "crs" in has else "in a local frame, without a CRS"
    facts["Coordinates"] = f"{_plural(counted)}, {where}"
    if "latitude_deg" in has:
        north, east, height = has["latitude_deg"], has["longitude_deg"], has.get("altitude_m")
        place = f"{abs(north):.5f}° {'NS'[north < 0]}, {abs(east):.5f}° {'EW'[east < 0]}"
        above = "" if height is None else f", {height:,.1f} m"
        facts["Heights"] = heights_of(has.get("crs"), has.get("control_points"), height, given_place(has))
        facts["Local frame"] = f"metres east, north and up from {place}{above}"
    if found := accuracies(row):
        facts["Position"] = f"absolute, where on Earth the scene lies: {found[0]}"
        if not {"check_rms_horizontal_m", "control_rms_horizontal_m"} & has.keys():
            facts["Position"] += f"; {WORDS['common']}"
    elif "crs" in has:
        facts["Position"] = f"that of the given {given_place(has) or 'cloud'}; nothing checks it"
    if "length_unit" in has:
        facts["Scale"] = _scale(has)
    if "ground_pixel" in has:
        facts["Ground pixel"] = f"{length(has['ground_pixel'], unit)} (GSD), what a photo's pixel covers on the ground"
    if "completed_points" in has:
        file = f"results/scenes/{has['scene']}/completed"
        facts["File"] = f"{file}.copc.laz (for QGIS, CloudCompare)" + (
            f" in these coordinates; {file}.ply in the local frame" if "crs" in has else f", {file}.ply"
        )
    return _capital(facts)


def _capital(facts: dict[str, str]) -> dict[str, str]:
    """Each sentence with a capital; a file's name stays as it is."""
    return {label: text if label == "File" else text[:1].upper() + text[1:] for label, text in facts.items()}


def _errors(what: str, known: dict[str, float]) -> list[str]:
    """Root mean square errors in metres, and what 90 % of normal ones do not exceed; horizontal, vertical, or both."""
    most = {"horizontal": (math.sqrt(math.log(10)), "CE90"), "vertical": (NormalDist().inv_cdf(0.95), "LE90")}
    rms = " and ".join(f"{length(off, 'm')} {way}ly" for way, off in known.items())
    within = " and ".join(f"{length(most[way][0] * off, 'm')} ({most[way][1]})" for way, off in known.items())
    return [f"{what} {rms} off (root mean square)", f"nine of ten less than {within}"]


def rows_of(summary: Path, kind: str, folders: Sequence[Path]) -> list[dict[str, Any]]:
    """The rows of scenes.tsv or objects.tsv of some folders of results; of one that has none, that it is missing."""
    known = {row[kind]: row for row in records(read_table(summary / f"{kind}s.tsv"))}
    missing = {"status": "missing"} if kind == "object" else {"error": "not run yet"}
    return [known.get(folder.name, {kind: folder.name, **missing}) for folder in folders]


def made_today(summary: Path) -> str:
    """By what, today and, if scenes.tsv says so, by whom the results were made."""
    rows = records(read_table(summary / "scenes.tsv"))
    who = dict.fromkeys(filter(None, (_known(row).get("made_by") for row in rows)))
    by = f" by {', '.join(who)}" if who else ""
    return f"Made with scenefuse {VERSION} on {date.today()}{by}."


def made_by(summary: Path) -> str:
    """What summary.txt says of that: results may be exported later, by another version, from a copy."""
    file = summary / "summary.txt"
    text = file.read_text() if file.is_file() else ""
    said = re.search(r"^Made with .+?(?=\ndetails\.txt )", text, re.DOTALL | re.MULTILINE)
    return " ".join(said[0].split()) if said else made_today(summary)


def title_of(objects: Sequence[Path]) -> str:
    """The project's folder and what was completed in it; a name that both have once."""
    return ": ".join(dict.fromkeys(filter(None, [Path.cwd().name, named([folder.name for folder in objects])])))


def closing_lines(summary: Path) -> str:
    """What a run ends with: the result, the report page, the next step.

    Args:
        summary: folder with scenes.tsv, objects.tsv and report.html.
    """
    scenes, objects = (read_table(summary / f"{name}.tsv").to_dict("records") for name in ("scenes", "objects"))
    done = [row for row in objects if row["status"] in DONE]
    files = [
        *(
            summary.parent / f"scenes/{row['scene']}/completed.ply"
            for row in map(_known, scenes)
            if row.get("completed_by", "none") != "none"
        ),
        *(summary.parent / f"objects/{row['object']}/object.ply" for row in objects if row["status"] == ALONE),
    ]
    # First what is not done, then what could be better.
    steps = [f"{row['object']}: {object_facts(row)['Result']}" for row in objects if row not in done]
    found = {row["object"]: object_facts(row).get("Next", "") for row in objects}
    steps += [f"{name}: {step}" for name, text in found.items() for step in text.splitlines()]
    first, *more = steps or ["open the result in CloudCompare or QGIS"]
    page = summary / "report.html"
    return "\n".join(
        [
            f"Result: {len(done)} of {len(objects)} objects completed"
            + (f"; {', '.join(map(str, files))}" if files else ""),
            f"Report: {page if page.is_file() else summary / 'summary.txt'}",
            f"Next:   {first}" + (f" ({len(more)} more in the report)" if more else ""),
        ]
    )


def photographed(folder: Path, photos: str) -> str | None:
    """The day of some photos by their EXIF, or the first and the last day; None where it is not known.

    Args:
        folder: of a scene's or an object's results, whose photos.json lists them.
        photos: the folder in it that holds them.
    """
    try:
        names = [photo["name"] for photo in read_json(folder / "photos.json").get("photos", [])]
    except StageError:
        return None
    days = set()
    for name in {*names[:: max(1, len(names) // LOOKED_AT)], *names[-1:]}:
        try:
            with open_picture(folder / photos / name) as image:
                exif = image.getexif()
                taken = exif.get_ifd(IFD.Exif).get(Base.DateTimeOriginal) or exif.get(Base.DateTime)
        except StageError:
            continue
        # A camera whose clock was never set writes zeros or blanks.
        with contextlib.suppress(ValueError):
            days.add(str(date.fromisoformat(re.sub(r"\D", "-", str(taken)[:10]))))
    return " to ".join(dict.fromkeys([min(days), max(days)])) if days else None


def of_cameras(folder: Path) -> dict[str, Any]:
    """What a pixel covers at the depth of what the photos show (median), in the model's unit, and the lenses, as COLMAP
    names their parameters; nothing without a model."""
    try:
        model = read_model(folder)
    except StageError:
        return {}
    lenses = [
        f"{lens.model.name} {lens.width} × {lens.height} {lens.params_info}: "
        + " ".join(f"{p:.5g}" for p in lens.params)
        for lens in model.cameras.values()
    ]
    images, found = posed_images(model), []
    for image in images[:: max(1, len(images) // LOOKED_AT)]:
        seen = np.array([model.points3D[p.point3D_id].xyz for p in image.get_observation_points2D()])
        if len(seen):
            pose = image.cam_from_world().matrix()
            depth = float(np.median(seen @ pose[2, :3] + pose[2, 3]))
            found.append(depth / model.cameras[image.camera_id].mean_focal_length())
    return {"ground_pixel": float(np.median(found)) if found else None, "lens": named(lenses, "; ")}


def _known(row: Row) -> dict[str, Any]:
    """The cells that hold something."""
    return {name: cell for name, cell in row.items() if cell == cell and cell not in (None, "", "-")}


def diagnose(item: ObjectSummary) -> list[str]:
    """Sentences on an object's photos, masks and clicks, in the order of the stages; none where all is well."""
    said = list[str]()

    def say(cause: str, names: Collection[str] = (), mark: str = ", ", **values: Any) -> None:
        sentence = WORDS["causes"][cause]
        said.append(sentence.format(count=len(names), names=named(list(names), mark), **values))

    def known(name: str, otherwise: Any) -> Any:
        found = find(item.stages, name)
        return otherwise if found is None else found

    doubtful = known("sparse.doubtful_photos", {})
    lost = set(known("sparse.not_registered", [])) - set(doubtful)
    groups = list[str]()
    for model in known("sparse.models_left_out", []):
        if group := sorted(lost & set(model["photos"])):
            lost -= set(group)
            groups.append(named(group))
    if groups:
        say("apart", groups, "; ")
    if lost:
        say("lost", sorted(lost))
    if doubtful:
        say("doubtful", sorted(doubtful))
    if (gap := known("undistorted.largest_gap_deg", 0.0)) > MAX_GAP_DEG:
        first, second = known("undistorted.gap_between", ("?", "?"))
        say("gap", gap=gap, first=first, second=second)
    if clicks := known("masks.clicks_left_out", []):
        say("clicks", clicks, "; ")
    left_out, photos = known("masks.photos_left_out", []), known("masks.photos", 0)
    if len(left_out) > MAX_LEFT_OUT * photos:
        say("masks", left_out, photos=photos)
    if (agreement := known("masks.median_agreement", 1.0)) < MIN_AGREEMENT:
        say("agreement", agreement=agreement)
    if blurred := known("stage2.blurred_photos", {}):
        say("blurred", sorted(blurred))
    stops = {name: abs(math.log2(sum(g) / len(g))) for name, g in known("stage2.photo_gains", {}).items()}
    jumps = sorted((name for name in stops if stops[name] > MAX_EXPOSURE_STOPS), key=lambda name: -stops[name])
    if jumps:
        say("exposure", jumps, stops=MAX_EXPOSURE_STOPS)
    if known("alignment.found", True) is False:
        say("unlinked", reason=known("alignment.reason", ""))
    # The variant that is fused comes first.
    fused = next(iter(item.variants), "")
    if item.status(fused) == "unregistered" and find(item.variants[fused], "crop.mode") == "none":
        say("unmarked")
    return said


def named(items: list[str], mark: str = ", ") -> str:
    """Photos by their names, or sentences, with a mark between them; five of many."""
    more = len(items) - 5
    return mark.join(items[:5]) + (f" and {more} more" if more > 0 else "")

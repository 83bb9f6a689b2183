"""Errors at points and positions that the georeferencing did not use, before and after the adjustment to the survey.

    python tests/benchmarks/control_points.py leave-one-out --photos PHOTOS --control gcp_list.txt --work FOLDER
    python tests/benchmarks/control_points.py simulated --scene SCENE --truth results/demo/demo/truth/scene
    python tests/benchmarks/control_points.py positions --photos PHOTOS --work FOLDER

The first makes each control point a check point in turn. The second clicks 12 control points in the demo's photos by
its true cameras (SCENE is results/scenes/demo), with 1 px of noise, and 4 check points without any, and gives
positions 2 cm or 3 m of noise. The third holds out every fifth photo's GPS position. "before" is the similarity alone,
"after" the adjusted model. A model is made once for each FOLDER, by the workflow's own stages with their shipped
settings, and kept.
"""

import contextlib
import copy
import io
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import pyproj
import tyro
from numpy.typing import NDArray

from demo.evaluate import within
from demo.truth import HIDDEN, Cameras, cast_together, read_cameras, read_mesh, sample_surface, visible
from scenefuse.core.stage import read_json, value
from scenefuse.core.transforms import Array
from scenefuse.georef.control import (
    Control,
    ControlFile,
    LocatedPoint,
    SurveyedPoint,
    locate_points,
    read_control_points,
    seen_at,
)
from scenefuse.georef.georeference import adjust_georeferenced, camera_poses, georeference, gps_cameras
from scenefuse.georef.placement import GeoreferenceSettings
from scenefuse.georef.residuals import rms
from scenefuse.marks.clicks import Click
from scenefuse.photos.frames import VideoSettings, list_photos
from scenefuse.photos.geodesy import LocalFrame
from scenefuse.photos.photos import Photo, read_photos
from scenefuse.photos.workspace import read_model
from scenefuse.sfm.features import FeatureSettings, extract_features
from scenefuse.sfm.gravity import estimate_up
from scenefuse.sfm.lens import LENSES
from scenefuse.sfm.mapping import MappingSettings, map_photos
from scenefuse.sfm.matches import MatchSettings, match_features


@dataclass(frozen=True)
class Capture:
    """A mapped scene: sparse model, name of its lens, photos."""

    model: pycolmap.Reconstruction
    lens: str
    photos: list[Photo]


NO_GPS = GeoreferenceSettings(use_gps=False)
# Points and clicks of the simulation.
CONTROL, CHECK, CLICKS, CLICK_NOISE_PX, SURVEY_NOISE_M = 12, 4, 6, 1.0, (0.02, 0.03)


def solved(
    capture: Capture, control: Control | None, checks: list[LocatedPoint], settings: GeoreferenceSettings
) -> list[Array]:
    """Errors (P, 3; m) of points by their clicks, before and after a model is adjusted to control points and GPS."""
    names, rotations, centres = camera_poses(capture.model)
    gps = gps_cameras(names, centres, capture.photos, settings.gps_accuracy_m)
    found = georeference(gps, control, estimate_up(rotations, centres)[0], settings, 0)
    assert found.frame is not None, found.placement.reason
    target = found.frame.apply(np.array([s.point.position for s in checks]))
    t = found.placement.local_from_model
    placed = copy.deepcopy(capture.model)
    placed.transform(pycolmap.Sim3d(t.scale, pycolmap.Rotation3d(t.rotation), t.translation))
    before = seen_at(checks, placed)[0] - target
    with contextlib.redirect_stdout(io.StringIO()):
        adjust_georeferenced(placed, found, LENSES[capture.lens].freedom)
    return [before, seen_at(checks, placed)[0] - target]


def mapped(photos: Path, work: Path) -> Capture:
    """The sparse model of a folder of photos; made once."""
    listed, database, sparse = work / "photos.json", work / "database.db", work / "sparse"
    if not (work / "sparse.json").is_file():
        upright = work / "photos"
        features = FeatureSettings(max_features=3000, first_octave=0, camera_mode="auto")
        list_photos(source=photos, upright=upright, photos=listed, settings=VideoSettings())
        extract_features(folder=upright, photos=listed, features=work / "features.db", settings=features)
        match_features(
            photos=listed,
            features=work / "features.db",
            database=database,
            matches=work / "matches.json",
            settings=MatchSettings(),
            seed=0,
        )
        map_photos(
            folder=upright,
            photos=listed,
            database=database,
            sparse=sparse,
            report=work / "sparse.json",
            settings=MappingSettings(),
            seed=0,
        )
    return read_capture(work)


def read_capture(folder: Path) -> Capture:
    """What a folder of results holds of a mapped scene."""
    lens = value(read_json(folder / "sparse.json"), "lens")
    return Capture(read_model(folder / "sparse"), lens, read_photos(folder / "photos.json"))


def leave_one_out(photos: Path, control: Path, work: Path, sd_m: float | None = None) -> None:
    """Make each control point a check point in turn, and compare where its clicks put it with its coordinates.

    Args:
        photos: folder of photos.
        control: gcp_list.txt.
        work: folder for the model.
        sd_m: standard deviation of the coordinates, where the file states none.
    """
    capture = mapped(photos, work)
    whole = read_control_points(control, capture.model, capture.photos)
    for note in whole.notes:
        print(note)
    left: list[list[Array]] = []
    rows = [k for k, s in enumerate(whole.located) if not (s.problem or s.point.check)]
    print("point\tclicks\tbefore: east north up (m)\tafter: east north up (m)")
    for row in rows:
        located = [
            replace(s, point=replace(s.point, check=k == row, sd_m=(sd_m, sd_m) if sd_m else s.point.sd_m))
            for k, s in enumerate(whole.located)
        ]
        others = replace(whole, located=located)
        left.append([error[0] for error in solved(capture, others, [located[row]], NO_GPS)])
        point = whole.located[row].point
        print(f"{point.name}\t{len(point.clicks)}\t{_words(left[-1][0])}\t{_words(left[-1][1])}", flush=True)
    _print("left out", list(np.array(left).transpose(1, 0, 2)))


def simulated(scene: Path, truth: Path, seeds: int = 3) -> None:
    """Control points, check points and positions of the demo, simulated from its truth."""
    capture, cameras = read_capture(scene), read_cameras(truth / "cameras.json")
    origin = LocalFrame(*(float(v) for v in value(read_json(truth / "cameras.json"), "origin")))
    places = _ground(truth, cameras)
    for noise_m in (0.02, 3.0):
        for counted in (0, CONTROL):
            found: list[list[Array]] = []
            for seed in range(seeds):
                rng = np.random.default_rng(seed)
                drawn = replace(capture, photos=_with_positions(capture.photos, cameras, origin, noise_m, rng))
                points = [_clicked(k, place, cameras, origin, rng) for k, place in enumerate(zip(*places))]
                sizes = {p.name: (p.width, p.height) for p in drawn.photos}
                located, _ = locate_points(ControlFile(truth, pyproj.CRS.from_epsg(4979), points), drawn.model, sizes)
                control = Control(truth, "", located, []) if counted else None
                checks = [s for s in located if s.point.check and not s.problem]
                found.append(solved(drawn, control, checks, GeoreferenceSettings()))
            _print(f"positions {noise_m:g} m, {counted} control points", [np.concatenate(e) for e in zip(*found)])


def _ground(truth: Path, cameras: Cameras) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Places (P, 3) in the mapped area, far apart, their pixels (P, N, 2), and which photos show them (P, N)."""
    content = read_json(truth / "cameras.json")
    meshes = [read_mesh(truth / "meshes" / f"{name}.ply") for name in ["world", *content["objects"]]]
    low, high = (np.array(corner) for corner in value(content, "mapped_area"))
    places = sample_surface(within(meshes[0], low, high), 4000, 0)
    pixels, seen = visible(cast_together(meshes), cameras, places, HIDDEN)
    good = seen.sum(0) >= CLICKS
    places, pixels, seen = places[good], pixels[:, good].transpose(1, 0, 2), seen[:, good].T
    chosen = [0]
    while len(chosen) < CONTROL + CHECK:
        distance = np.linalg.norm(places[:, None, :2] - places[None, chosen, :2], axis=2).min(1)
        chosen.append(int(distance.argmax()))
    order = np.random.default_rng(0).permutation(chosen)
    return places[order], pixels[order], seen[order]


def _clicked(
    number: int, place: tuple[Array, Array, Array], cameras: Cameras, origin: LocalFrame, rng: np.random.Generator
) -> SurveyedPoint:
    """A point as it would be surveyed and clicked; check points, the last ones, have no error of their own."""
    x_in_truth, pixels, seen = place
    check = number >= CONTROL
    error = np.zeros(3) if check else rng.normal(0, [SURVEY_NOISE_M[0], *SURVEY_NOISE_M])
    photos = rng.choice(np.flatnonzero(seen), CLICKS, replace=False)
    noise_px = 0.0 if check else CLICK_NOISE_PX
    name = f"{'CHK-' if check else ''}{number}"
    clicks = [Click(name, cameras.names[k], *(pixels[k] + rng.normal(0, noise_px, 2))) for k in sorted(photos)]
    position = origin.inverse((x_in_truth + error)[None])[0]
    return SurveyedPoint(name, position, SURVEY_NOISE_M, check, clicks)


def _with_positions(
    photos: list[Photo], cameras: Cameras, origin: LocalFrame, noise_m: float, rng: np.random.Generator
) -> list[Photo]:
    """Photos with the positions of their true cameras and noise; RTK positions state their accuracy."""
    row = {name: k for k, name in enumerate(cameras.names)}
    true = cameras.centres[[row[photo.name] for photo in photos]]
    positions = origin.inverse(true + rng.normal(0, noise_m, true.shape)).tolist()
    sd_m = noise_m if noise_m < 1 else None
    return [
        replace(p, latitude_deg=a, longitude_deg=b, altitude_m=c, horizontal_sd_m=sd_m, vertical_sd_m=sd_m)
        for p, (a, b, c) in zip(photos, positions)
    ]


def positions(photos: Path, work: Path, every: int = 5) -> None:
    """Hold out every fifth photo's GPS position, and compare its camera with it."""
    capture = mapped(photos, work)
    with_gps = [p.name for p in capture.photos if p.has_gps]
    left: list[list[Array]] = []
    for first in range(every):
        held = set(with_gps[first::every])
        kept = [replace(p, latitude_deg=None, longitude_deg=None) if p.name in held else p for p in capture.photos]
        left.append(_at_positions(replace(capture, photos=kept), held, capture.photos))
    _print("held-out positions", [np.concatenate(e) for e in zip(*left)])


def _at_positions(capture: Capture, held: set[str], photos: list[Photo]) -> list[Array]:
    """Errors (N, 3; m) of cameras against held-out positions, before and after."""
    settings = GeoreferenceSettings()
    names, rotations, centres = camera_poses(capture.model)
    gps = gps_cameras(names, centres, capture.photos, settings.gps_accuracy_m)
    found = georeference(gps, None, estimate_up(rotations, centres)[0], settings, 0)
    assert found.frame is not None, found.placement.reason
    placed = copy.deepcopy(capture.model)
    t = found.placement.local_from_model
    placed.transform(pycolmap.Sim3d(t.scale, pycolmap.Rotation3d(t.rotation), t.translation))
    results = []
    for adjusted in (False, True):
        if adjusted:
            with contextlib.redirect_stdout(io.StringIO()):
                adjust_georeferenced(placed, found, LENSES[capture.lens].freedom)
        names, _, centres = camera_poses(placed)
        checked = gps_cameras(names, centres, [p for p in photos if p.name in held], settings.gps_accuracy_m)
        results.append(checked.centres - found.frame.apply(checked.positions))
    return results


def _words(error: Array) -> str:
    return " ".join(f"{e:+.3f}" for e in error)


def _print(label: str, found: Sequence[Array]) -> None:
    for name, error in zip(("before", "after"), found):
        across, up = rms(error[:, :2]), rms(error[:, 2:])
        print(
            f"{label}, {name}: {len(error)} points, RMS horizontally {across:.3f} m, vertically {up:.3f} m", flush=True
        )


def control_points() -> None:
    """One of the three, as the command line says."""
    commands: dict[str, Callable[..., Any]] = {
        "leave-one-out": leave_one_out,
        "simulated": simulated,
        "positions": positions,
    }
    tyro.extras.subcommand_cli_from_dict(commands)


if __name__ == "__main__":
    control_points()

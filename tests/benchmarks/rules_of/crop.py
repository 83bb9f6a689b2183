"""The crop's rules: the share of the object's scene points that are kept, and the share of the crop that is the object.

Trials are the demo's objects in the folder that RESULTS names, each by its masks, by fiducials, and by five clicks in
one scene photo (two photos each); planted scenes with sloping ground and bushes; and finished real captures, folders
in CAPTURES (separated by colons), of which nothing is known: both shares are against the crop with all rules.
"""

import os
from collections.abc import Callable
from contextlib import redirect_stdout
from dataclasses import dataclass, replace
from functools import cache
from io import StringIO
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from rules import Rule
from scipy.spatial import cKDTree
from support.planted import plant

from demo.clicks import PromptSettings, clicks_on
from demo.evaluate import around_object, read_object_truth
from scenefuse.cloud.clouds import read_cloud
from scenefuse.core.stage import StageError, read_json, value
from scenefuse.core.transforms import Array, Sim3
from scenefuse.crop import crop_cloud, crop_scene
from scenefuse.crop.crop_cloud import CropSettings
from scenefuse.crop.crop_scene import CropInputs
from scenefuse.photos.workspace import read_views

RESULTS = Path(os.environ.get("RESULTS", "results"))
CAPTURES = [Path(path) for path in os.environ.get("CAPTURES", "").split(":") if path]
OBJECTS = ("house", "balloon", "sculpture")
# Clicks in one photo: those photos, in the order of how much of the object they show.
PHOTOS = (0, 4)
SLOPES = (0.0, 0.1, 0.2)
TRIALS = len(OBJECTS) * (2 + len(PHOTOS)) + len(SLOPES) + 2 * len(CAPTURES)


@dataclass(frozen=True)
class Trial:
    """A crop to make.

    Attributes:
        kind: capture and mode.
        own: (K, 3) points of the scene that are the object; None where nobody knows.
        crop: makes it: the points that are kept (N, 3).
    """

    kind: str
    own: Array | None
    crop: Callable[[], Array]


@cache
def trial_of(number: int) -> Trial:
    """A trial by its number."""
    for count, make in ((len(OBJECTS) * (2 + len(PHOTOS)), _demo), (len(SLOPES), _planted)):
        if number < count:
            return make(number)
        number -= count
    return _real(*divmod(number, 2))


def _demo(number: int) -> Trial:
    name, mode = OBJECTS[number % len(OBJECTS)], number // len(OBJECTS)
    folder, own = RESULTS / "objects" / name, _own(name)
    known = RESULTS / "demo/demo" / name / "fiducials.tsv"
    marks = [None, known][mode] if mode < 2 else _clicks(name, PHOTOS[mode - 2])
    settings = CropSettings(mode="masks" if mode == 0 else "fiducials")
    kind = f"{name}, {('masks', 'fiducials', 'clicks')[min(mode, 2)]}"
    return Trial(kind, own, _stage(RESULTS / "scenes/demo", folder, marks, settings))


def _stage(scene: Path, folder: Path, marks: Path | None, settings: CropSettings) -> Callable[[], Array]:
    """The stage's crop, without its files."""
    inputs = CropInputs(
        scene / "dense.ply", scene / "georeferenced", scene / "georeference.json", marks,
        folder / "alignment.json", folder / "undistorted", folder / "masks",
    )  # fmt: skip

    def crop() -> Array:
        with redirect_stdout(StringIO()):
            near, cut, _ = crop_scene.crop_of(crop_scene.open_cloud(inputs.scene), inputs, settings)
        return near.points[cut.keep]

    return crop


@cache
def _own(name: str) -> Array:
    """The scene points of an object of the demo."""
    truth = RESULTS / "demo/demo/truth"
    known = read_object_truth(RESULTS / "objects" / name / "undistorted", truth / "scene", truth / name, 20000, seed=0)
    move = Sim3.from_matrix(np.array(value(read_json(RESULTS / "scenes/demo/truth.json"), "truth_from_scene")))
    points = read_cloud(RESULTS / "scenes/demo/dense.ply").points
    return points[around_object(move.apply(points), known)]


def _clicks(name: str, rank: int) -> Path:
    """Five clicks on an object in a scene photo."""
    views = read_views(RESULTS / "scenes/demo/georeferenced")
    shown = sorted(views, key=lambda view: -len(view.visible(_own(name))[0]) / view.project(_own(name))[1].mean())
    view = shown[rank]
    mask: NDArray[np.uint8] = np.zeros((view.height, view.width), np.uint8)
    pixels = view.visible(_own(name))[1]
    mask[pixels[:, 1], pixels[:, 0]] = 1
    closed = cv2.morphologyEx(mask, cv2.MORPH_CLOSE, np.ones((9, 9), np.uint8))
    labels, at = clicks_on(closed > 0, PromptSettings(5, False, (1.0, 4.0)), np.random.default_rng(0))
    path = Path("results/bench/crop_clicks") / f"{name}_{rank}.tsv"
    path.parent.mkdir(parents=True, exist_ok=True)
    rows = [f"{label}\t{view.name}\t{x:.1f}\t{y:.1f}" for label, (x, y) in zip(labels, at)]
    path.write_text("\n".join(["label\tphoto\tx_px\ty_px", *rows]) + "\n")
    return path


def _planted(number: int) -> Trial:
    name, slope = OBJECTS[number], SLOPES[number]
    trial = plant(name, number, slope=slope, clutter=3, depth_maps=False)
    own = trial.scene.points[: round(10000 * trial.coverage)]
    up = np.array([0.0, 0.0, 1.0])

    def crop() -> Array:
        cut = crop_cloud.crop_cloud(trial.scene, trial.fiducials, up, CropSettings())
        return trial.scene.points[cut.keep]

    return Trial(f"planted {name}, slope {slope:g}", own, crop)


def _real(capture: int, mode: int) -> Trial:
    scene = next((CAPTURES[capture] / "results/scenes").iterdir())
    folder = next((CAPTURES[capture] / "results/objects").iterdir())
    settings, marks = CropSettings(), None
    if mode == 1:
        settings, marks = replace(settings, mode="fiducials"), CAPTURES[capture] / "config/fiducials.tsv"
    return Trial(f"{folder.name}, {('masks', 'fiducials')[mode]}", None, _stage(scene, folder, marks, settings))


@cache
def _as_shipped(number: int) -> Array:
    return trial_of(number).crop()


# Votes of the masks, where no rule of theirs is off.
_votes: dict[int, Any] = {}


def evaluate(number: int, rule: Rule | None) -> dict[str, Any]:
    """Both shares of a crop."""
    trial = trial_of(number)
    own = _as_shipped(number) if trial.own is None else trial.own
    row: dict[str, Any] = {"kind": trial.kind, "kept": 0.0, "pure": 0.0, "points": 0}
    before, of = crop_scene.vote, "" if rule is None else rule.where.rpartition(".")[0]
    if of not in (M, S):
        crop_scene.vote = lambda *given: _votes.get(number) or _votes.setdefault(number, before(*given))
    try:
        found = trial.crop()
    except StageError as error:
        return row | {"reason": str(error)[:80]}
    finally:
        crop_scene.vote = before
    same = cKDTree(own).query(found, distance_upper_bound=1e-4)[0] < 1e-4
    return row | {"kept": same.sum() / len(own), "pure": float(same.mean()), "points": len(found), "reason": ""}


def constant(value: Any) -> Callable[[Any], Any]:
    """In the place of a number, whatever that is."""
    return lambda _: value


def around(name: str, where: str) -> list[Rule]:
    """A number halved and doubled."""
    return [
        Rule(f"{name} {by}", where, lambda x, f=factor: type(x)(x * f))
        for by, factor in (("halved", 0.5), ("doubled", 2))
    ]


def _without_others(crop: Any) -> Any:
    """`crop_cloud` that is not told what is something else."""
    return lambda scene, marks, up, settings, other=None: crop(scene, marks, up, settings)


C, S, M = (f"scenefuse.crop.{name}" for name in ("crop_cloud", "crop_scene", "marked"))
RULES = [
    Rule("ground goes", f"{C}.ground_under", lambda _: lambda *__: (None, [])),
    Rule("loose parts go", f"{C}._without_loose_parts", lambda _: lambda points, inside, *__: (inside, [])),
    Rule(
        "what masks call something else goes", f"{S}.crop_cloud", lambda f: lambda a, b, c, d, other=None: f(a, b, c, d)
    ),
    Rule("a vote needs an own point nearby", f"{M}.MAX_BEYOND_POINTS", constant(9.0)),
    Rule("what hides takes no vote", f"{M}.SURFACE_SPACINGS", constant(1e9)),
    Rule("enough photos frame a point", f"{M}.least_framing", lambda _: lambda *__: 0),
    Rule("two pairing distances", f"{C}.SCORE_FRACTION", constant(0.0)),
    Rule("all clicks outside apart by planes", f"{M}.MAX_VARIATION", constant(0.0)),
    Rule("growth is limited", f"{M}.MAX_GROWTH", constant(1e9)),
    Rule("strays mark nothing when growing", f"{M}.without_strays", lambda _: lambda points, _: points),
    Rule("strays mark no foot", f"{C}.STRAY_SHARE", constant(0.0)),
    Rule("ground not over a tenth of the height", f"{C}.FOOT_SHARE", constant(9.0)),
    Rule("ground rises little", f"{C}.MAX_RISE", constant(9.0)),
    *around("two pairing distances", f"{C}.SCORE_FRACTION"),
    *around("least part", f"{C}.MIN_PART_SHARE"),
    *around("foot", f"{C}.FOOT_SHARE"),
    *around("rise", f"{C}.MAX_RISE"),
    *around("ring", f"{C}.RING_FRACTION"),
    *around("ground's thickness", f"{C}.GROUND_FRACTION"),
    *around("cells", f"{M}.CELL_SPACINGS"),
    *around("thickness of what hides", f"{M}.SURFACE_SPACINGS"),
    *around("own points' reach", f"{M}.MAX_BEYOND_POINTS"),
]

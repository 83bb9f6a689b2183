"""Fusion's rules on a finished demo, in the folder that RESULTS names: its objects as they are, and each one spoilt.

A spoilt object has noise of 1 % of its diagonal and a third of it moved by 10 %; the scene around it is the true
surface, and the pose is right: whatever fusion changes there is harm.
"""

import os
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from completed_scene import bad_object, perfect_scene, read_case, scores
from rules import Rule

from scenefuse.cloud.clouds import Cloud, read_cloud
from scenefuse.fuse import measure, modes
from scenefuse.fuse.modes import FusionSettings
from scenefuse.fuse.write import together
from scenefuse.geometry import photo_check, photo_kernel
from scenefuse.geometry.photo_check import Matches, Photos, moved_photos, pack, read_photos
from scenefuse.photos.workspace import read_workspace

RESULTS = Path(os.environ.get("RESULTS", "results"))
OBJECTS = ("house", "balloon", "sculpture")
TRIALS = 2 * len(OBJECTS)


def constant(value: Any) -> Any:
    """The constant `value`, whatever it is with the rule."""
    return lambda before: value


COMPARE, MEASURE, SETTLE = (f"scenefuse.fuse.{name}" for name in ("compare", "measure", "settle"))
CHECK, KERNEL = "scenefuse.geometry.photo_check", "scenefuse.geometry.photo_kernel"
RULES = [
    Rule("what photos see through goes", f"{COMPARE}.MIN_AGREEING", constant(10**9)),
    Rule("two photos see through, not one", f"{COMPARE}.MIN_AGREEING", constant(1)),
    Rule("a share of the photos sees through", f"{COMPARE}.THROUGH_SHARE", constant(0.0)),
    Rule("that share halved", f"{COMPARE}.THROUGH_SHARE", lambda share: share / 2),
    Rule("that share doubled", f"{COMPARE}.THROUGH_SHARE", lambda share: 2 * share),
    Rule("margin halved", f"{COMPARE}.MARGIN", lambda margin: margin / 2),
    Rule("margin doubled", f"{COMPARE}.MARGIN", lambda margin: 2 * margin),
    Rule("same place: deviations halved", f"{COMPARE}.SAME_PLACE_DEVIATIONS", lambda number: number / 2),
    Rule("same place: deviations doubled", f"{COMPARE}.SAME_PLACE_DEVIATIONS", lambda number: 2 * number),
    Rule("the better side by a factor", f"{COMPARE}.BETTER_FACTOR", constant(1.0)),
    Rule("that factor doubled", f"{COMPARE}.BETTER_FACTOR", lambda factor: 2 * factor),
    Rule("roughness adds to the deviation", f"{COMPARE}._rougher", lambda f: lambda a, b, side: (0.0, 0.0)),
    Rule("median deviation of neighbours", f"{COMPARE}._smooth", lambda f: lambda points, deviation: deviation),
    Rule("holes of the object's surface", f"{COMPARE}._beside", lambda f: lambda a, b: np.zeros(len(a))),
    Rule("something is left beside it", f"{COMPARE}._alone", lambda f: lambda a, b, reach: np.zeros(len(a), bool)),
    Rule("most neighbours are measured", f"{MEASURE}.SUPPORT", constant(0.0)),
    Rule("neighbours by the diagonal, not eight", f"{MEASURE}.MAX_NEIGHBOURS", constant(8)),
    Rule("settling", "scenefuse.fuse.modes.settle", lambda f: lambda *_: None),
    Rule("the more certain one of both poses", f"{SETTLE}.MIN_MISPLACED", constant(0.0)),
    Rule("photos of half the size", f"{CHECK}.halved", lambda _: lambda photos: pack([])),
    Rule("a deviation of 1.2 pixels at most", f"{CHECK}.MAX_DEVIATION_PX", constant(np.inf)),
    Rule("no other offset is better", f"{CHECK}.MAX_DROP", constant(9.0)),
    Rule("other references", f"{KERNEL}.REFERENCES", constant(1)),
    Rule("weights by grey", f"{KERNEL}.GREY_FALL", constant(1e9)),
]


@lru_cache(maxsize=1)
def _scene() -> Cloud:
    return read_cloud(RESULTS / "scenes/demo/dense.ply")


@lru_cache(maxsize=1)
def _case(trial: int) -> tuple[Any, Cloud, Photos, Photos]:
    """An object, placed, and the photos of both sides."""
    case = read_case(RESULTS, OBJECTS[trial % len(OBJECTS)], _scene())
    if trial >= len(OBJECTS):
        case = perfect_scene(replace(case, object=bad_object(case)))
    placed = case.object.transformed(case.pose)
    own = read_photos(read_workspace(RESULTS / f"objects/{case.name}/undistorted"), case.object.points)
    theirs = read_photos(read_workspace(RESULTS / "scenes/demo/undistorted"), placed.points)
    return case, placed, moved_photos(own, case.pose), theirs


_known: dict[Any, Matches] = {}


def _matched(points: Any, normals: Any, photos: Photos) -> Matches:
    """`match_in`, kept between rules that do not change it."""
    key = points.tobytes(), np.array([view.projection for view in photos.views]).tobytes()
    if key not in _known:
        _known[key] = photo_check.match_in(points, normals, photos)
    return Matches(*(values.copy() for values in vars(_known[key]).values()))


def evaluate(trial: int, rule: Rule | None) -> dict[str, Any]:
    """F-scores of the completed scene at 0.25, 0.5 and 1 % of the diagonal, points added and taken away."""
    changes_matching = rule is not None and ".geometry.photo" in rule.where
    if rule is None:
        _known.clear()
    _compile(photo_kernel.REFERENCES, photo_kernel.GREY_FALL)
    measure.match_in = photo_check.match_in if changes_matching else _matched
    case, placed, own, theirs = _case(trial)
    fused, _ = modes.fuse_by_evidence(placed, case.scene, own, theirs, FusionSettings(), case.uncertainty)
    found = scores(case, together(fused.kept, fused.added))
    return {
        "kind": case.name + (", spoilt" if trial >= len(OBJECTS) else ""),
        **{f"f_{end}": found[f"f_score_{end}"] for end in ("025pct", "05pct", "1pct")},
        "added": len(fused.added),
        "removed": len(fused.removed),
    }


_compiled: list[tuple[float, ...]] = [(photo_kernel.REFERENCES, photo_kernel.GREY_FALL)]


def _compile(*constants: float) -> None:
    """Compile the kernel again where constants have changed."""
    if constants != _compiled[-1]:
        parts = ("_suitability", "_choose", "_reference_patch", "_match", "_next_reference")
        for name in (*parts, "_match_block", "match_points"):
            getattr(photo_kernel, name).recompile()
        _compiled.append(constants)

"""The trials of the benchmarks of shared photos: what each is like, mapped, and how far a pose is off."""

import os
from typing import get_args

import numpy as np
from scipy.spatial.transform import Rotation
from support.photographed_place import Kind
from support.planted import errors
from support.planted_photos import PhotoTrial, Plan, calibrated, mapped, plant_photos

from scenefuse.core.transforms import Array, Sim3
from scenefuse.sfm.lens import Choice

# The seeds of development are to be looked at; what is published has seeds that nobody has tuned anything on.
FIRST_SEED = {"development": 0, "published": 100_000}
FEW = 40
MEASURES = ("scale_pct", "rotation_deg", "shift_pct")


def drawn(seed: int, bend: float = 1.0) -> Plan:
    """What the trial of a seed is like: kinds alternate, one in four shares few features, one in five has a twin."""
    rng = np.random.default_rng([seed, 1])
    kinds = get_args(Kind)
    least, most = (10, FEW) if seed // len(kinds) % 4 == 0 else (FEW, 400)
    return Plan(
        kind=kinds[seed % len(kinds)],
        scene_photos=int(rng.integers(15, 61)),
        object_photos=int(rng.integers(10, 41)),
        alike=round(float(np.exp(rng.uniform(np.log(least), np.log(most))))),
        strange=float(rng.uniform(0, 0.5)),
        twin=bool(rng.random() < 0.2),
        bend=bend,
        noise_px=(float(rng.uniform(0.3, 0.8)), float(rng.uniform(0.3, 0.8))),
    )


def modelled(seed: int, plan: Plan) -> tuple[PhotoTrial, list[Choice]]:
    """A trial with both models mapped, in frames of their own, and the lenses of the object's and the scene's."""
    trial = plant_photos(seed, plan)
    choices = []
    for side in (trial.obj, trial.scene):
        mapped(side)
        choices.append(calibrated(side))
    trial.scene.move(trial.scene.world_from_model())
    trial.obj.move(_anywhere(seed))
    return trial, choices


def _anywhere(seed: int) -> Sim3:
    """The frame that the object's model happens to be in."""
    rng = np.random.default_rng([seed, 2])
    return Sim3(float(np.exp(rng.uniform(-2, 2))), Rotation.random(random_state=rng).as_matrix(), rng.normal(0, 9, 3))


def off_by(name: str, pose: Sim3, true: Sim3, centre: Array, diagonal: float) -> dict[str, float]:
    """Scale in %, rotation in degrees, shift of the object's centre in % of its diagonal."""
    scale, angle, shift = errors(pose, true, centre, diagonal)
    return {f"{name}_scale_pct": scale, f"{name}_rotation_deg": angle, f"{name}_shift_pct": 100 * shift}


def quiet() -> None:
    """Drop what a worker prints: COLMAP reports every adjustment, whatever its log level."""
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 1)
    os.dup2(nowhere, 2)

"""A planted registration that needs no search: for tests of what is read and written around it."""

from types import SimpleNamespace

import numpy as np

from scenefuse.cloud.clouds import Cloud
from scenefuse.core.transforms import Sim3
from scenefuse.geometry.icp import ScaleRange
from scenefuse.register.decision import Decision
from scenefuse.register.refinement import Outcome
from scenefuse.register.score import Hypothesis, Score
from scenefuse.two_clouds import find as register
from scenefuse.two_clouds.find import Registration


def registered_at_once(monkeypatch, pose: Sim3, registered: bool = True) -> list[tuple[Cloud, Cloud]]:
    """`scenefuse register` finds this pose of the object without looking for it, and no other place.

    Returns:
        Object and scene as the search gets them, each time that it is called.
    """
    searched = list[tuple[Cloud, Cloud]]()

    def search(obj: Cloud, scene: Cloud, *known: object) -> SimpleNamespace:
        searched.append((obj, scene))
        return SimpleNamespace(total=1.0)

    def refined(there: object, settings: object, unit: str) -> Registration:
        origins = np.zeros(3), np.zeros(3)
        best = Hypothesis(pose, "planted", Score(1.0, 1.0, 1.0, None, None, 0.0))
        outcome = Outcome([best], Decision(registered, "planted", "geometry", 1.0, None, None), None)
        return Registration(outcome, origins, ScaleRange(pose.scale, 0.0), {}, unit)

    monkeypatch.setattr(register, "search", search)
    monkeypatch.setattr(register, "refined", refined)
    monkeypatch.setattr(register, "likely_places", lambda *known: [])
    return searched

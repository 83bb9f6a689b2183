"""A planted registration that needs no search: for tests of what is read and written around it."""

import numpy as np

from scenefuse.core.transforms import Sim3
from scenefuse.geometry.icp import ScaleRange
from scenefuse.register.register import Registration


def registered_at_once(monkeypatch, pose: Sim3, registered: bool = True) -> None:
    """`scenefuse register` finds this pose of the object without looking for it, and no second place."""

    def found(*clouds: object, unit: str, **known: object) -> Registration:
        origins = np.zeros(3), np.zeros(3)
        return Registration(registered, "planted", pose, None, origins, ScaleRange(pose.scale, 0.0), {}, unit)

    monkeypatch.setattr("scenefuse.two_clouds.register.register_clouds", found)
    monkeypatch.setattr("scenefuse.two_clouds.register.second_place", lambda *known: None)

"""What is known beside the two clouds: gravity, the scene's free space, and photos that link object and scene."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from scenefuse.registration.free_space import FreeSpace
from scenefuse.registration.refine import Uncertainty
from scenefuse.stage import read_json, value
from scenefuse.transforms import Array, Sim3, rotation_angle_deg


@dataclass(frozen=True)
class Alignment:
    """The similarity that photos of object and scene agree on, found without the clouds.

    Attributes:
        pose: scene_from_object.
        spread: of the pose.
        shared_points: points seen by photos of both sides that support it.
        scale_from_centres: scale from the camera centres alone, or None.
    """

    pose: Sim3
    spread: Uncertainty
    shared_points: int
    scale_from_centres: float | None

    def agrees(self, pose: Sim3, centre: Array, diagonal: float) -> bool:
        """Whether a pose lies within three standard deviations, or within 3 %, 3 degrees and 3 % of the diagonal."""
        scale = abs(np.log(pose.scale / self.pose.scale))
        angle = rotation_angle_deg(pose.rotation @ self.pose.rotation.T)
        shift = float(np.linalg.norm(pose.apply(centre) - self.pose.apply(centre)))
        return bool(
            scale <= max(0.03, 3 * self.spread.scale_sd_log)
            and angle <= max(3.0, 3 * self.spread.rotation_sd_deg)
            and shift <= max(0.03 * diagonal, 3 * self.spread.translation_sd)
        )


@dataclass(frozen=True)
class Evidence:
    """Everything beside the clouds; each part is None where it is not known.

    Attributes:
        ups: unit up directions (3,) in the object's and in the scene's frame.
        free_space: what the scene's cameras saw through.
        alignment: the photos' similarity.
    """

    ups: tuple[Array, Array] | None = None
    free_space: FreeSpace | None = None
    alignment: Alignment | None = None


def known_ups(cameras: Path | None, crop_report: Path) -> tuple[Array, Array] | None:
    """Unit up directions in the object's and in the scene's frame, or None when either is unknown."""
    up_in_object = None if cameras is None else read_json(cameras).get("up_in_camera_frame")
    up_in_scene = read_json(crop_report).get("up_in_scene")
    if not up_in_object or not up_in_scene or up_in_object["value"] is None or up_in_scene["value"] is None:
        return None
    a, b = np.array(up_in_object["value"], float), np.array(up_in_scene["value"], float)
    return a / np.linalg.norm(a), b / np.linalg.norm(b)


def read_alignment(path: Path | None) -> Alignment | None:
    """The alignment of an alignment stage's JSON, or None where it found none."""
    if path is None:
        return None
    content = read_json(path)
    if not value(content, "found"):
        return None
    return Alignment(
        Sim3.from_matrix(np.array(value(content, "scene_from_object"))),
        Uncertainty.even(*(value(content, name) for name in ("scale_sd_log", "rotation_sd_deg", "translation_sd"))),
        value(content, "shared_points"),
        value(content, "scale_from_centres"),
    )

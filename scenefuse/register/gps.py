"""Where the GPS of an object's photos puts it in a georeferenced scene: an estimate that no feature enters."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from scenefuse.core.stage import quantity, read_json, value
from scenefuse.core.transforms import MAX_DEVIATIONS, Array, Sim3
from scenefuse.georef.placement import PHOTOS_OF_ONE_ERROR, GeoreferenceSettings, place_by_gps
from scenefuse.photos.geodesy import LocalFrame, scene_frame
from scenefuse.photos.photos import gps_accuracies, gps_positions, read_photos
from scenefuse.register.landmarks import Landmarks
from scenefuse.sfm.gravity import estimate_up


@dataclass(frozen=True)
class GpsPose:
    """The pose that GPS gives, and how well.

    Heights take no part in what follows: those of two flights often have other zeros.

    Attributes:
        pose: scene_from_object.
        photos: that it rests on.
        turn_sd: standard deviation of log scale, and of the heading in radians.
        shift_sd: of the place in the plane, metres (the scene's unit).
    """

    pose: Sim3
    photos: int
    turn_sd: float
    shift_sd: float

    def differences(self, other: Sim3, at: Array) -> tuple[float, float, float]:
        """Another pose's ratio of scales (log), heading in radians, and shift in the plane, at (3,) of the object."""
        turn = other.rotation @ self.pose.rotation.T
        heading = float(np.arctan2(turn[1, 0] - turn[0, 1], turn[0, 0] + turn[1, 1]))
        shift = float(np.linalg.norm((other.apply(at) - self.pose.apply(at))[:2]))
        return float(np.log(other.scale / self.pose.scale)), heading, shift

    def miss(self, other: Sim3, at: Array) -> float:
        """How far another pose is off, in standard deviations, by the worst of scale, heading and place."""
        scale, heading, shift = self.differences(other, at)
        return max(abs(scale) / self.turn_sd, abs(heading) / self.turn_sd, shift / self.shift_sd)


def pose_by_gps(
    obj: Landmarks,
    scene: Landmarks,
    photos: Path | None,
    scene_photos: Path | None,
    scene_json: Path | None,
    accuracy_m: float,
    seed: int,
) -> GpsPose | None:
    """The similarity of the camera centres to their GPS positions; None where either side has too few, or they spread
    too little beside their accuracy.

    Args:
        obj: the object's cameras.
        scene: the scene's, in metres.
        photos: photos.json of the object.
        scene_photos: photos.json of the scene.
        scene_json: georeference.json of the scene.
        accuracy_m: standard error of positions that state none.
        seed: of RANSAC.
    """
    frame = None if scene_json is None else scene_frame(read_json(scene_json))
    listed = [] if photos is None else read_photos(photos)
    names, positions = gps_positions(listed)
    row_of = {name: row for row, name in enumerate(obj.photos)}
    known = [k for k, name in enumerate(names) if name in row_of]
    if not isinstance(frame, LocalFrame) or len(known) < PHOTOS_OF_ONE_ERROR:
        return None
    rotations, centres = (part[[row_of[names[k]] for k in known]] for part in _cameras(obj))
    target, sd_m = frame.apply(positions[known]), float(np.median(gps_accuracies(listed, accuracy_m)[known, 0]))
    up = estimate_up(rotations, centres)[0]
    placed = place_by_gps(centres, target, up, GeoreferenceSettings(True, accuracy_m), seed, sd_m)
    if placed.status != "georeferenced":
        return None
    there = target[placed.inliers, :2]
    off = placed.local_from_model.apply(centres[placed.inliers])[:, :2] - there
    each = max(sd_m, float(np.sqrt((off**2).mean())))
    of_scene = float(np.hypot(_accuracy_of(scene_photos, accuracy_m), _off_in_plane(scene_json)))
    turn = np.hypot(each / _extent(there), of_scene / _extent(_cameras(scene)[1][:, :2])) * np.sqrt(PHOTOS_OF_ONE_ERROR)
    # What all positions of a flight have in common is not averaged out by more photos.
    return GpsPose(placed.local_from_model, len(there), float(turn), float(np.hypot(each, of_scene)))


def _cameras(landmarks: Landmarks) -> tuple[Array, Array]:
    """World-from-camera rotations (V, 3, 3) and centres (V, 3) of a model's photos."""
    rotations = landmarks.cam_from_model[:, :, :3].transpose(0, 2, 1)
    return rotations, -np.einsum("nij,nj->ni", rotations, landmarks.cam_from_model[:, :, 3])


def _extent(points: Array) -> float:
    """Root of the summed squared distances of points (N, 2) from their mean."""
    return max(float(np.sqrt(((points - points.mean(0)) ** 2).sum())), 1e-12)


def _off_in_plane(scene_json: Path | None) -> float:
    """How far the GPS of a scene's flight lies off its control points or scan in the plane, metres: as much may the
    object's lie off the scene, or not, by another receiver."""
    content = {} if scene_json is None else read_json(scene_json)
    return float(np.linalg.norm(value(content, "gps_shift")[:2])) if "gps_shift" in content else 0.0


def _accuracy_of(photos: Path | None, otherwise_m: float) -> float:
    """Standard error of a side's positions, in metres; also where control points placed it: GPS need not share its
    datum."""
    stated = gps_accuracies([] if photos is None else read_photos(photos), otherwise_m)
    return float(np.median(stated[:, 0])) if len(stated) else otherwise_m


def gps_quantities(gps: GpsPose | None, pose: Sim3 | None, at: Array | None) -> dict[str, Any]:
    """What GPS says of the pose that was found, or of the place where none was; null where it is not known."""
    scale = heading = shift = miss = place = None
    notes = []
    if gps is not None and at is not None:
        place = gps.pose.apply(at)
        about = f"the GPS of {gps.photos} of its photos"
        if pose is None:
            notes.append(
                f"{about} says that it stands {place[0]:.1f} m east and {place[1]:.1f} m north of the scene's"
                f" origin, give or take {gps.shift_sd:.1f} m: click on it there (column fiducials)"
            )
        else:
            scale, heading, shift = gps.differences(pose, at)
            miss, heading = gps.miss(pose, at), float(np.degrees(heading))
            if miss > MAX_DEVIATIONS:
                notes.append(
                    f"{about} contradicts the pose: {np.expm1(abs(scale)):.1%} of scale, {abs(heading):.1f} degrees and"
                    f" {shift:.1f} m in the plane apart, and GPS is known to {gps.turn_sd:.1%},"
                    f" {np.degrees(gps.turn_sd):.1f} degrees and {gps.shift_sd:.1f} m; see in before_after.png if it"
                    " is the object, or its like"
                )
    return {
        "gps_photos": quantity(0 if gps is None else gps.photos, "1"),
        "gps_place": quantity(place, "m"),
        "gps_turn_sd": quantity(None if gps is None else gps.turn_sd, "log scale, radians"),
        "gps_shift_sd": quantity(None if gps is None else gps.shift_sd, "m"),
        "gps_scale_apart": quantity(scale, "log"),
        "gps_heading_apart_deg": quantity(heading, "deg"),
        "gps_shift_apart": quantity(shift, "m"),
        "gps_miss": quantity(miss, "standard deviations"),
        "notes": quantity(notes, ""),
    }

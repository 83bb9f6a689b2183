"""What a registration is given: two clouds, a prior of the scale by their extents, and what is known beside them."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from scipy.spatial import ConvexHull, QhullError

from scenefuse.cloud.clouds import Cloud, read_cloud, voxel_downsample
from scenefuse.core.stage import StageError, quantity, read_json, value
from scenefuse.core.transforms import UP, Array, Sim3, Uncertainty, along_a_line, apart, rotation_between
from scenefuse.geometry.depth_test import FreeSpace
from scenefuse.geometry.icp import ScaleRange
from scenefuse.geometry.surface import SCORE_FRACTION, Surface, prepare
from scenefuse.sfm.gravity import UNSURE_CUES

# Points kept of either cloud. The polish queries a quarter of them; the search, in which poses differ grossly, keeps a
# half and queries a tenth.
SURFACE_POINTS = 12_000


@dataclass(frozen=True)
class Inputs:
    """Files of an object and of the scene around it."""

    object: Path
    """Object cloud (PLY) in its own frame and unit."""
    crop: Path
    """Scene crop (PLY) in the scene frame."""
    crop_json: Path
    """JSON of the crop stage, for what says that z is up in the scene, and for the unit of lengths."""
    workspace_json: Path | None = None
    """JSON with `up_in_camera_frame`, the up direction in the object's frame; without it, or without the key, gravity
    is not used."""

    def clouds(self) -> tuple[Cloud, Cloud]:
        """The object and the scene crop.

        Raises:
            StageError: one of them cannot be registered; see `check_extent`.
        """
        both = read_cloud(self.object), read_cloud(self.crop)
        for cloud, path in zip(both, (self.object, self.crop)):
            check_extent(cloud, str(path))
        return both

    def ups(self) -> tuple[Array, Array] | None:
        """Unit up directions (3,) in the object's and in the scene's frame; None when either is unknown or unsure."""
        of_object = {} if self.workspace_json is None else read_json(self.workspace_json)
        of_scene = read_json(self.crop_json)
        if any(content.get("up_cue", {}).get("value") in UNSURE_CUES for content in (of_object, of_scene)):
            return None
        up = of_object.get("up_in_camera_frame", {}).get("value")
        return None if up is None else (np.array(up, float) / np.linalg.norm(up), UP)

    def length_unit(self) -> str:
        """The unit of the scene's lengths."""
        return str(read_json(self.crop_json)["diagonal"]["unit"])


@dataclass(frozen=True)
class Alignment:
    """The cross-model alignment from shared features, found without the clouds.

    Attributes:
        pose: scene_from_object.
        uncertainty: of the pose.
    """

    pose: Sim3
    uncertainty: Uncertainty

    def agrees(self, pose: Sim3, centre: Array, diagonal: float, times: float = 1.0) -> bool:
        """Whether a pose lies within `times` three standard deviations; at least 3 %, 3 degrees, 3 % of the size."""
        allowed = np.maximum([0.03, 3.0, 0.03 * diagonal], 3 * self.uncertainty.deviations)
        return bool((apart(self.pose, pose, centre) <= times * allowed).all())


@dataclass(frozen=True)
class Constraints:
    """Everything known beside the clouds; each part is None where it is not known.

    Attributes:
        ups: unit up directions (3,) in the object's and in the scene's frame.
        free_space: space that the scene's depth maps show to be empty.
        alignment: from shared features.
    """

    ups: tuple[Array, Array] | None = None
    free_space: FreeSpace | None = None
    alignment: Alignment | None = None


@dataclass(frozen=True)
class Problem:
    """Where does the object lie in the scene?

    Attributes:
        object: any frame and unit.
        scene: the scene's points around the object.
        scales: what the scale may be, scene units per object unit.
        known: what is known beside the clouds.
        seed: of all random choices.
    """

    object: Cloud
    scene: Cloud
    scales: ScaleRange
    known: Constraints = Constraints()
    seed: int = 0

    def surfaces(self, scale: float, fraction: float, most: int) -> tuple[Surface, Surface]:
        """Object and scene thinned alike: `fraction` of the scene's diagonal is one voxel on both sides.

        Args:
            scale: scene units per object unit.
            fraction: of the scene's diagonal.
            most: points kept of either at most.
        """
        voxel = fraction * self.scene.diagonal
        return prepare(self.object, voxel / scale, self.seed, most), prepare(self.scene, voxel, self.seed, most)


def comparable(obj: Cloud, scene: Cloud) -> tuple[Cloud, Cloud]:
    """Object and scene, both without colours where only one of them is grey: how bright a laser's echo is, at its
    wavelength, is no colour."""
    grey = [c.colors is None or not np.ptp(c.colors, axis=1).any() for c in (obj, scene)]
    return (obj, scene) if grey[0] == grey[1] else (replace(obj, colors=None), replace(scene, colors=None))


def check_extent(cloud: Cloud, name: str) -> None:
    """StageError where a cloud's points lie in one place or along one line: nothing fixes a pose of it then."""
    if along_a_line(cloud.points):
        where = "in one place" if cloud.diagonal == 0 else "along one line"
        raise StageError(f"all {len(cloud)} points of {name} lie {where}: a registration needs a surface")


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
    )


@dataclass(frozen=True)
class ScaleSettings:
    """Settings of the scale."""

    width_log: float = 0.5
    """Half width of the scale prior, natural logarithm: 0.5 searches from 0.6 to 1.6 times the estimate."""
    method: Literal["prior", "none"] = "prior"
    """`none` holds the scale at 1: the ablation without scale rectification."""


@dataclass(frozen=True)
class Estimate:
    """One estimate of the scale.

    Attributes:
        name: where it comes from.
        scale: scene units per object unit.
        used: whether the prior's centre uses it.
    """

    name: str
    scale: float
    used: bool


def scale_quantities(ledger: list[Estimate], scales: ScaleRange, method: str) -> dict[str, Any]:
    """The JSON of the scale; every estimate is printed."""
    for e in ledger:
        print(f"{e.name:12s} {e.scale:.5g}", flush=True)
    return {
        "scale": quantity(scales.centre, "scene units per object unit"),
        "width_log": quantity(scales.width, "1"),
        "method": quantity(method, ""),
        "ledger": quantity([{"name": e.name, "scale": e.scale, "used": e.used} for e in ledger], ""),
    }


def estimates(obj: Cloud, scene: Cloud, ups: tuple[Array, Array] | None) -> list[Estimate]:
    """Every estimate of the scale; the paper's whole-cloud RMS ratio comes first.

    Gravity adds two: the footprint (root of the area of the horizontal convex hull, which a flight sees whole)
    and the height. First both clouds are thinned to a point a voxel, so that density does not count, except for the
    paper's. What is flat on either side, to 1 % of the diagonal, gives no estimate.
    """
    even_obj, even_scene = (voxel_downsample(c, SCORE_FRACTION * c.diagonal).points for c in (obj, scene))
    found = [
        Estimate("rms", rms(scene.points) / rms(obj.points), False),
        Estimate("rms_even", rms(even_scene) / rms(even_obj), True),
    ]
    if ups is None:
        extents = {"hull": [_hull_size(p) for p in (even_obj, even_scene)]}
    else:
        level = [p @ rotation_between(up, UP).T for p, up in zip((even_obj, even_scene), ups)]
        extents = {
            "footprint": [_hull_size(p[:, :2]) for p in level],
            "height": [float(np.ptp(np.percentile(p[:, 2], [1, 99]))) for p in level],
        }
    # Half the distance within which points agree: less is noise, of a flat roof seen from above for instance.
    least = [SCORE_FRACTION / 2 * cloud.diagonal for cloud in (obj, scene)]
    for name, (of_object, of_scene) in extents.items():
        if of_object > least[0] and of_scene > least[1]:
            found.append(Estimate(name, of_scene / of_object, True))
    return found


def prior(ledger: list[Estimate], settings: ScaleSettings) -> ScaleRange:
    """The prior made of the estimates.

    Its centre is their upper quartile: what the crop lacks makes all of them too small, rarely too large. The
    registration finds the scale within its width.
    """
    if settings.method == "none":
        return ScaleRange(1.0, 0.0)
    centre = float(np.exp(np.percentile([np.log(e.scale) for e in ledger if e.used], 75)))
    return ScaleRange(centre, settings.width_log)


def rms(points: Array) -> float:
    """Root mean square distance of points from their centroid."""
    return float(np.sqrt(((points - points.mean(0)) ** 2).sum(1).mean()))


def _hull_size(points: Array) -> float:
    """The d-th root of the convex hull's volume (area in the plane); 0 where the points are flat."""
    try:
        return float(ConvexHull(points).volume ** (1 / points.shape[1]))
    except QhullError:
        return 0.0

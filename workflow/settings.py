"""All settings: which section of a settings file fills which dataclass, and the JSON schema that follows from them.

A dataclass of a stage, or of the demo, is the one source of its settings: type, default, unit, bounds and description.
Here stands only where in a settings file each is found, and what differs between scene and object.
"""

import ast
import dataclasses
import inspect
import types
import typing
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

from demo.bodies import Kind
from demo.capture import FlightSettings, OrbitSettings
from scenefuse.core.stage import setting
from scenefuse.crop.crop_cloud import CropSettings
from scenefuse.fuse.modes import FusionSettings
from scenefuse.georef.placement import GeoreferenceSettings
from scenefuse.masks.segmentation import MaskSettings
from scenefuse.mvs.dense_cloud import DenseCloudSettings
from scenefuse.mvs.plane_sweep import DepthMapSettings
from scenefuse.mvs.undistort import UndistortSettings
from scenefuse.nerf.field import FieldSettings
from scenefuse.nerf.object_cloud import CloudSettings
from scenefuse.nerf.train_object_nerf import NerfSettings
from scenefuse.nerf.training import Schedule
from scenefuse.paper.monocular import MonocularSettings
from scenefuse.photos.frames import FrameSettings, VideoSettings
from scenefuse.register.decision import FineSettings
from scenefuse.sfm.features import FeatureSettings
from scenefuse.sfm.mapping import MappingSettings
from scenefuse.sfm.matches import MatchSettings

# Six groups that the rules read themselves; every other setting belongs to a stage, and stands beside it.


@dataclass(frozen=True)
class RunSettings:
    """What concerns the whole run."""

    scenes: str = setting("config/scenes.tsv")
    """Table of scenes."""
    objects: str = setting("config/objects.tsv")
    """Table of objects."""
    seed: int = setting(0, least=0, most=2**31 - 1)
    """Seed of everything random."""
    gpu: int | Literal["auto"] = setting("auto", least=0)
    """GPUs that a stereo or training job asks the scheduler for; `auto` is 1 where Snakemake runs on a machine with an
    NVIDIA card, else 0. On a cluster, say it."""
    keep_maps: bool = setting(True)
    """Whether depth maps and the maps of the object's stages, most of what a run takes on the disk, stay. Otherwise
    each goes when no job needs it any more; a later run that needs it again, for a new gate, picture or object, makes
    it and all that follows from it again."""


@dataclass(frozen=True)
class DemoSettings:
    """What all photos of the demo share."""

    camera: Kind = setting("real")
    """Real: a drone's and a phone's camera, with distortion, a principal point off the middle, vignetting, noise and an
    exposure of its own in every photo, under a white sky. Ideal: a pinhole without any of these, under a blue one."""


@dataclass(frozen=True)
class ChunkSettings:
    """How a scene's depth maps are split into jobs."""

    chunks: int = setting(4, least=1)
    """Jobs that the depth maps of a scene are split into; on a cluster they run side by side."""


@dataclass(frozen=True)
class RecipeSettings:
    """Whose method makes the object."""

    recipe: Literal["scenefuse", "paper"] = setting("scenefuse")
    """`paper` follows the letter of He et al. from depth to fusion (docs/paper.md); use it by config/paper.yaml."""


@dataclass(frozen=True)
class HoldOutSettings:
    """What is left out of the training."""

    hold_out_every: int = setting(8, least=0)
    """Every n-th photo is not trained on and measures quality; 0 holds out none."""


@dataclass(frozen=True)
class PoseSourceSettings:
    """Where the poses of recipe `paper` come from."""

    pose_source: Literal["chain", "sfm"] = setting("chain")
    """Recipe `paper` only: whose poses stages 2 to 4 use, the pose network's motions one after the other or SfM's."""


@dataclass(frozen=True)
class VariantSettings:
    """Which registrations run."""

    variants: tuple[str, ...] = setting(("full",))
    """Registration variants that run, of those in workflow/variants.yaml; `full` is fused and has to be among them, the
    others are compared with it."""


SECTIONS: dict[str, list[Any]] = {
    "": [RunSettings()],
    "demo": [DemoSettings()],
    "demo.flight": [FlightSettings()],
    "demo.orbit": [OrbitSettings()],
    "scene": [ChunkSettings()],
    "scene.frames": [VideoSettings()],
    "scene.features": [FeatureSettings()],
    "scene.matches": [MatchSettings()],
    "scene.sparse": [MappingSettings()],
    "scene.georegister": [GeoreferenceSettings()],
    "scene.undistort": [UndistortSettings()],
    "scene.depth_maps": [DepthMapSettings()],
    "scene.dense_cloud": [DenseCloudSettings()],
    "object": [RecipeSettings(), HoldOutSettings()],
    "object.frames": [FrameSettings()],
    "object.features": [FeatureSettings()],
    "object.matches": [MatchSettings()],
    "object.sparse": [MappingSettings()],
    "object.undistort": [UndistortSettings(max_size_px=1600)],
    "object.masks": [MaskSettings()],
    "object.stage1": [PoseSourceSettings(), MonocularSettings()],
    "object.stage2": [Schedule()],
    "object.stage3": [MonocularSettings(epochs=5)],
    "object.stage4": [Schedule()],
    "object.nerf": [NerfSettings(), FieldSettings(), Schedule()],
    "object.cloud": [CloudSettings()],
    "registration": [VariantSettings()],
    "registration.crop": [CropSettings()],
    "registration.fine": [FineSettings()],
    "fusion": [FusionSettings()],
}
# Keys of a dataclass that its section does not hold: the other section of the same stage sets them.
ELSEWHERE = {("object.nerf", "epochs"), ("object.stage2", "rays_per_epoch"), ("object.stage4", "rays_per_epoch")}


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
        words = [word for part in parts for word in typing.get_args(part)]  # of a Literal
        pattern = {"pattern": f"^({'|'.join(words)})$"} if words else {}
        return {"type": [names.get(part, "string") for part in parts]} | pattern
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

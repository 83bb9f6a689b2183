"""The NeRF on its own: posed photos in; a cloud, maps, held-out renders and numbers out, by the workflow's stages."""

import shutil
import time
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from scenefuse.core.settings import build, problem, read_settings, schema_of
from scenefuse.core.stage import StageError, quantity, read_json, value, write_json
from scenefuse.geometry.surface import ends_of
from scenefuse.mvs.photo_refinement import RefinementSettings
from scenefuse.mvs.undistort import UndistortSettings
from scenefuse.nerf.object_cloud import CloudGates, CloudInputs, CloudSettings, make_object_cloud
from scenefuse.nerf.posed_photos import import_photos
from scenefuse.nerf.rays import LossWeights
from scenefuse.nerf.rendered_maps import RenderedMapSettings
from scenefuse.nerf.train_object_nerf import NerfInputs, NerfSettings, train_object_nerf
from scenefuse.nerf.training import NerfRecipe
from scenefuse.photos.pictures import read_depth, read_gray, read_normals, read_rgb
from scenefuse.photos.sheets import TILE_PX, Image, depth_colors, draw_sheet, save_png


@dataclass(frozen=True)
class TrainingOptions:
    """What a NeRF trained on its own can be told beside the keys of a settings file."""

    recipe: NerfRecipe = NerfRecipe()
    """Batches, rates and samples."""
    losses: LossWeights = LossWeights()
    """Weights of the losses."""
    maps: RenderedMapSettings = RenderedMapSettings()
    """Of the rendered maps."""
    gates: CloudGates = CloudGates()
    """Which points of the cloud are kept."""
    refinement: RefinementSettings = RefinementSettings()
    """Of the rendered depths by photos."""


AS_SHIPPED = TrainingOptions()
# What a run replaces in its folder.
FOLDERS = ("undistorted", "masks", "nerf")


def train_nerf(
    *,
    data: Path,
    out: Path = Path("nerf"),
    images: Path | None = None,
    masks: Path | None = None,
    config: Path | None = None,
    epochs: int = 40,
    seed: int | None = None,
    options: TrainingOptions = AS_SHIPPED,
) -> int:
    """Train a NeRF of one object on posed photos, and write its cloud.

    Reads a COLMAP model, nerfstudio's transforms.json or Blender's transforms_train.json, with masks or alpha. Exit
    status: 0 done, 3 trained but without a cloud, 1 bad input. docs/nerf.md says how to read what it writes.

    Args:
        data: folder with sparse/ (COLMAP) or transforms.json or transforms_train.json, or such a JSON itself.
        out: folder for report.json, object.ply, renders.png, and nerf/ with the model, the maps and the renders.
        images: folder of the photos, where a COLMAP model's are not in images/ beside it.
        masks: folder of masks named like the photos, white on the object; not needed with mask_path or alpha.
        config: YAML of settings that differ from the shipped ones, with the keys of config/config.yaml.
        epochs: epochs of the training; each is `object.nerf.rays_per_epoch` rays.
        seed: of all random choices; the config's if not given.
        options: of the training that are no settings.
    """
    start = time.perf_counter()
    settings = read_settings(config)
    seed = settings["seed"] if seed is None else seed
    if wrong := problem({"seed": seed, "object": {"stage2": {"epochs": epochs}}}, schema_of("config")):
        raise StageError(f"--{wrong.rpartition('.')[2]}; correct it")
    wanted = settings["object"]
    _clear(out)
    workspace, mattes, photos_json = out / "undistorted", out / "masks", out / "steps/photos.json"
    import_photos(
        data=data,
        images=images,
        masks=masks,
        workspace=workspace,
        mattes=mattes,
        report=photos_json,
        settings=build(UndistortSettings, wanted["undistort"]),
    )
    chosen = nerf_settings(wanted, options, epochs, value(read_json(photos_json), "masks_exact"))
    train_object_nerf(
        inputs=NerfInputs(workspace, mattes),
        stage=out / "nerf",
        report=out / "steps/nerf.json",
        checkpoints=out / "checkpoints",
        settings=chosen,
        hold_out_every=wanted["hold_out_every"],
        seed=seed,
    )
    shutil.rmtree(out / "checkpoints", ignore_errors=True)
    save_png(out / "renders.png", render_sheet(workspace, mattes, out / "nerf"))
    fused = replace(build(CloudSettings, wanted["cloud"]), gates=options.gates, refinement=options.refinement)
    inputs = CloudInputs(workspace, photos_json, mattes, out / "nerf", out / "steps/nerf.json")
    refused = _make_cloud(inputs, out, fused, seed)
    report = _report(out, {"nerf": asdict(chosen), "cloud": asdict(fused)}, refused, seed)
    write_json(out / "report.json", report | {"seconds": quantity(round(time.perf_counter() - start, 1), "s")})
    _print_summary(report, out, refused)
    return 0 if refused is None else 3


def _clear(out: Path) -> None:
    """Remove the results of an earlier run, so that none of them can be taken for this one's.

    Raises:
        StageError: the folder is a file, or holds folders of somebody else that would be replaced.
    """
    if out.exists() and not out.is_dir():
        raise StageError(f"--out {out} is a file; give a folder")
    others = [] if (out / "steps/photos.json").exists() else [f for f in FOLDERS if (out / f).exists()]
    if others:
        raise StageError(f"--out {out} holds {others[0]}/, which a run would replace; give another folder")
    for old in ("report.json", "object.ply", "renders.png"):
        (out / old).unlink(missing_ok=True)


def nerf_settings(wanted: dict[str, Any], options: TrainingOptions, epochs: int, exact: bool) -> NerfSettings:
    """Settings and options together; where masks are exact, no band around their edges is left out."""
    built = build(NerfSettings, wanted["nerf"] | {"epochs": epochs})
    recipe = replace(options.recipe, mask_band_px=0) if exact else options.recipe
    return replace(built, recipe=recipe, losses=options.losses, maps=options.maps)


def _make_cloud(inputs: CloudInputs, out: Path, settings: CloudSettings, seed: int) -> str | None:
    """Write the cloud, or say why there is none."""
    cloud, report = out / "object.ply", out / "steps/cloud.json"
    try:
        make_object_cloud(inputs=inputs, cloud=cloud, report=report, settings=settings, seed=seed)
    except StageError as error:
        return str(error)
    return None


def _report(out: Path, settings: dict[str, Any], refused: str | None, seed: int) -> dict[str, Any]:
    """What the three steps say, and all settings."""
    steps = out / "steps"
    return {
        "photos": read_json(steps / "photos.json"),
        "nerf": read_json(steps / "nerf.json"),
        "cloud": {} if refused else read_json(steps / "cloud.json"),
        "no_cloud_because": quantity(refused, ""),
        "settings": quantity(settings, ""),
        "seed": quantity(seed, ""),
    }


def _print_summary(report: dict[str, Any], out: Path, refused: str | None) -> None:
    nerf, cloud = report["nerf"], report["cloud"]
    quality = f"PSNR {value(nerf, 'psnr_held_out'):.2f} dB inside the masks, SSIM {value(nerf, 'ssim'):.3f}"
    written = [out / "report.json", out / "renders.png", out / "nerf", *([] if refused else [out / "object.ply"])]
    print(f"quality    {quality}, on {value(nerf, 'photos_measured')} {value(nerf, 'measured_on')}")
    print(f"cloud      none: {refused}" if refused else f"cloud      {value(cloud, 'points')} points")
    print(f"written    {', '.join(map(str, written))}", flush=True)


def render_sheet(workspace: Path, masks: Path, stage: Path) -> Figure:
    """A row for each of at most six rendered photos: the photo inside its mask, the render, its depth, its normals."""
    photos = {path.stem: path for path in sorted((workspace / "images").iterdir())}
    stems = sorted(path.stem for path in (stage / "renders").glob("*.png"))
    shown = [stems[i] for i in np.unique(np.linspace(0, len(stems) - 1, 6).round().astype(int))]
    note = f"{len(shown)} of {len(stems)} rendered photos; depth near bright, far dark; normals in the camera's axes"
    labels = ["photo in its mask", "render", "depth", "normals"]
    rows = [list(zip(labels, _sheet_row(photos[stem], masks, stage))) for stem in shown]
    height, width = rows[0][0][1].shape[:2]
    tile = (TILE_PX[0], round(TILE_PX[0] * height / width))
    return draw_sheet("Renders beside the photos", note, rows, tile, shown)


def _sheet_row(photo: Path, masks: Path, stage: Path) -> list[Image]:
    render = read_rgb(stage / "renders" / f"{photo.stem}.png")
    size = render.shape[1::-1]
    picture = cv2.resize(read_rgb(photo), size, interpolation=cv2.INTER_AREA)
    matte = cv2.resize(read_gray(masks / f"{photo.stem}.png"), size, interpolation=cv2.INTER_AREA)
    cut_out = (picture * (matte[..., None] / 255.0) + 0.5).astype(np.uint8)
    depth = read_depth(stage / "depth_maps" / f"{photo.name}.bin")
    known = depth[depth > 0]
    low, high = ends_of(known) if len(known) else (0.0, 1.0)
    normals = read_normals(stage / "normal_maps" / f"{photo.name}.bin")
    return [cut_out, render, depth_colors(depth, float(low), float(high)), _normal_colors(normals)]


def _normal_colors(normals: NDArray[np.float32]) -> Image:
    """(H, W, 3) colours of normals: x to the right, y up, z towards the camera; light grey where there is none."""
    axes = normals * np.array([1.0, -1.0, -1.0], np.float32)
    return np.where(normals.any(-1, keepdims=True), axes * 127.5 + 127.5, 235.0).astype(np.uint8)

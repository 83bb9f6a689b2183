"""The NeRF on its own: posed photos in; a cloud, maps, held-out renders and numbers out, by the workflow's stages."""

import shutil
import time
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from scenefuse.io.maps import read_depth, read_normals
from scenefuse.io.settings import build, read_settings
from scenefuse.mvs.photo_refinement import RefinementSettings
from scenefuse.nerf.field import FieldSettings
from scenefuse.nerf.losses import LossWeights
from scenefuse.nerf.object_cloud import CloudSettings, make_object_cloud
from scenefuse.nerf.train_object_nerf import NerfSettings, train_object_nerf
from scenefuse.nerf.training import Schedule
from scenefuse.report.object_sheet import depth_colors
from scenefuse.report.sheets import Image, Sheet, draw_sheet, save_png
from scenefuse.sfm.import_photos import import_photos
from scenefuse.sfm.undistort import UndistortSettings
from scenefuse.stage import StageError, quantity, read_json, value, write_json

NO_CLOUD = 3
SHEET_ROWS = 6


def train_nerf(
    *,
    data: Path,
    out: Path = Path("nerf"),
    images: Path | None = None,
    masks: Path | None = None,
    config: Path | None = None,
    seed: int | None = None,
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
        seed: of all random choices; the config's if not given.
    """
    start = time.perf_counter()
    settings = read_settings(config)
    seed = settings["seed"] if seed is None else seed
    if out.exists() and not out.is_dir():
        raise StageError(f"--out {out} is a file; give a folder")
    for old in ("report.json", "object.ply", "renders.png"):
        (out / old).unlink(missing_ok=True)
    cameras, mattes, stage, steps = out / "cameras", out / "masks", out / "nerf", out / "steps"
    wanted = settings["object"]
    import_photos(
        data=data,
        images=images,
        masks=masks,
        cameras=cameras,
        mattes=mattes,
        report=steps / "photos.json",
        settings=build(UndistortSettings, wanted["undistort"]),
    )
    photos = read_json(steps / "photos.json")
    exact = {"mask_band_px": 0} if value(photos, "masks_exact") else {}
    chosen = wanted["nerf"] | wanted["nerf_alone"] | exact
    refinement = RefinementSettings()
    train_object_nerf(
        cameras=cameras,
        masks=mattes,
        prior=None,
        previous=None,
        stage=stage,
        report=steps / "nerf.json",
        checkpoints=out / "checkpoints",
        field=build(FieldSettings, chosen),
        schedule=build(Schedule, chosen),
        losses=build(LossWeights, chosen),
        refinement=refinement,
        settings=build(NerfSettings, chosen),
        hold_out_every=wanted["hold_out_every"],
        device=chosen["device"],
        seed=seed,
    )
    shutil.rmtree(out / "checkpoints", ignore_errors=True)
    save_png(out / "renders.png", render_sheet(cameras, mattes, stage))
    nerf = read_json(steps / "nerf.json")
    written = [out / "report.json", out / "renders.png", stage]
    try:
        make_object_cloud(
            cameras=cameras,
            masks=mattes,
            stage=stage,
            stage_report=steps / "nerf.json",
            cameras_report=steps / "photos.json",
            cloud=out / "object.ply",
            report=steps / "cloud.json",
            refinement=refinement,
            settings=build(CloudSettings, wanted["cloud"]),
            seed=seed,
        )
        cloud, refused = read_json(steps / "cloud.json"), None
        written.append(out / "object.ply")
    except StageError as error:
        cloud, refused = {}, str(error)
    write_json(
        out / "report.json",
        {
            "photos": photos,
            "nerf": nerf,
            "cloud": cloud,
            "no_cloud_because": quantity(refused, ""),
            "settings": quantity(chosen | {"cloud": wanted["cloud"]}, ""),
            "seed": quantity(seed, ""),
            "seconds": quantity(round(time.perf_counter() - start, 1), "s"),
        },
    )
    quality = f"PSNR {value(nerf, 'psnr_held_out'):.2f} dB inside the masks, SSIM {value(nerf, 'ssim'):.3f}"
    print(f"quality    {quality}, on {value(nerf, 'photos_measured')} {value(nerf, 'measured_on')}")
    print(f"cloud      {value(cloud, 'points')} points" if cloud else f"cloud      none: {refused}")
    print(f"written    {', '.join(map(str, written))}", flush=True)
    return 0 if refused is None else NO_CLOUD


def render_sheet(cameras: Path, masks: Path, stage: Path) -> Image:
    """A row for each of some rendered photos: the photo inside its mask, the render, its depth, its normals."""
    files = {path.stem: path for path in sorted((cameras / "images").iterdir())}
    stems = sorted(path.stem for path in (stage / "renders").glob("*.png"))
    shown = [stems[i] for i in np.unique(np.linspace(0, len(stems) - 1, SHEET_ROWS).round().astype(int))]
    rows: list[list[Image | None]] = []
    for stem in shown:
        render = _rgb(stage / "renders" / f"{stem}.png")
        height, width = render.shape[:2]
        photo = cv2.resize(_rgb(files[stem]), (width, height), interpolation=cv2.INTER_AREA)
        matte = cv2.resize(_rgb(masks / f"{stem}.png"), (width, height), interpolation=cv2.INTER_AREA)
        cut_out = (photo * (matte / 255.0) + 0.5).astype(np.uint8)
        depth = read_depth(stage / "depth_maps" / f"{files[stem].name}.bin")
        known = depth[depth > 0]
        low, high = np.percentile(known, [1, 99]) if len(known) else (0.0, 1.0)
        normals = read_normals(stage / "normal_maps" / f"{files[stem].name}.bin")
        rows.append([cut_out, render, depth_colors(depth, float(low), float(high)), _normal_colors(normals)])
    note = f"{len(shown)} of {len(stems)} rendered photos; depth near bright, far dark; normals in the camera's axes"
    labels = ["photo in its mask", "render", "depth", "normals"]
    tile = (320, round(320 * rows[0][0].shape[0] / rows[0][0].shape[1]))  # type: ignore[union-attr]
    return draw_sheet(Sheet("Renders beside the photos", note, rows, shown, labels, {}, tile))


def _rgb(file: Path) -> Image:
    picture = cv2.imread(str(file), cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    if picture is None:
        raise StageError(f"{file} is not a readable picture; run again")
    return np.asarray(cv2.cvtColor(picture, cv2.COLOR_BGR2RGB), dtype=np.uint8)


def _normal_colors(normals: NDArray[np.float32]) -> Image:
    """(H, W, 3) colours of normals: x to the right, y up, z towards the camera; light grey where there is none."""
    axes = normals * np.array([1.0, -1.0, -1.0], np.float32)
    return np.where(normals.any(-1, keepdims=True), axes * 127.5 + 127.5, 235.0).astype(np.uint8)

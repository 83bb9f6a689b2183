"""Masks from five clicks in one photo, over several choices of the photo and of the clicks, beside true masks.

python tests/benchmarks/clicked_masks.py --folder results/objects/house --truth results/demo/demo/truth/house/masks \\
    --out results/bench/house.tsv
"""

from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path
from typing import Any, Literal
from unittest.mock import patch

import numpy as np
import pandas as pd
from scipy import ndimage

from demo.clicks import PromptSettings, clicks_on, random_misses
from scenefuse.core.settings import build, read_settings
from scenefuse.core.stage import StageError, read_json, run, value
from scenefuse.core.transforms import Array
from scenefuse.geometry.visual_hull import Mask, mask_iou
from scenefuse.marks.clicks import Click, Clicks
from scenefuse.masks import segmentation
from scenefuse.masks.make_masks import supplied_masks
from scenefuse.masks.sam2 import Sam2, load_network
from scenefuse.masks.segmentation import MaskSettings, score_masks
from scenefuse.photos.frames import original_sizes
from scenefuse.photos.photo_files import masks_by_name
from scenefuse.photos.pictures import read_mask
from scenefuse.photos.workspace import Workspace, read_workspace

RIGHT = 0.97
"""IoU from which a mask is right."""
LEAST_PART_PX = 10.0
"""A part whose middle is nearer to its rim is not clicked: clicks miss by up to as much."""


class Remembering:
    """A network that encodes every photo once."""

    def __init__(self, network: Sam2) -> None:
        """Wrap it."""
        self._network = network
        self._known: dict[int, Any] = {}

    def encode(self, image: Any) -> Any:
        """See Sam2; photos are told apart by their pixels."""
        key = hash(np.ascontiguousarray(image).tobytes())
        if key not in self._known:
            self._known[key] = self._network.encode(image)
        return self._known[key]

    def masks(self, *prompts: Any) -> Any:
        """See Sam2."""
        return self._network.masks(*prompts)


@dataclass(frozen=True)
class Object:
    """An object's photos with cameras, and its true masks, (H, W) each, by photo."""

    folder: Path
    photos: Workspace
    up: Array
    sizes: dict[str, tuple[int, int]]
    truth: dict[str, Mask]
    files: dict[str, Path]


def clicked_masks(
    *,
    folder: Path,
    truth: Path,
    out: Path,
    method: Literal["grabcut", "sam2"] = "grabcut",
    photos: int = 10,
    clicks: int = 5,
    box: bool = False,
    part: bool = False,
    wrong: tuple[str, ...] = (),
    config: Path | None = None,
) -> None:
    """Print the IoU of the masks with the true ones for every choice, worst and median; a row of each to a table.

    A choice is a photo and five clicks in it: spots far apart on the true mask, or three of these and the corners of
    its box, each 3 to 10 px off in the original photo.

    Args:
        folder: the object's results, undistorted photos at least.
        truth: folder of the true masks of the original photos.
        out: output table, .tsv.
        method: of the masks.
        photos: how many photos to click in, spread evenly.
        clicks: how many times to click in each.
        box: three clicks inside and the corners of a box in the place of five inside.
        part: the last click inside is in the middle of the thickest of the smaller parts, as docs/clicking.md asks for
            a click on each part.
        wrong: photos whose true mask is wrong.
        config: settings file of the capture; the shipped settings without one.

    Raises:
        StageError: a file is missing.
    """
    shipped = read_settings(config)
    settings = build(MaskSettings, shipped["object"]["masks"] | {"method": method})
    thing, network = _read(folder, truth, wrong), None
    if method == "sam2":
        network = Remembering(load_network(1))
    names = sorted(thing.truth)
    rows, how = [], PromptSettings(inside=3 if box else 5, box=box)
    with_stereo_points = cache(partial(segmentation.with_stereo_points, thing.photos))
    with patch.object(segmentation, "with_stereo_points", lambda _: with_stereo_points()):
        for name in [names[k] for k in np.linspace(0, len(names) - 1, photos).round().astype(int)]:
            for trial in range(clicks):
                rows.append(_trial(thing, name, trial, how, part, network, settings))
                print(" ".join(f"{key} {cell}" for key, cell in rows[-1].items()), flush=True)
    table = pd.DataFrame(rows)
    out.parent.mkdir(parents=True, exist_ok=True)
    table.to_csv(out, sep="\t", index=False, float_format="%.4f")
    failed = int(table.error.astype(bool).sum())
    for column in ("median", "mean", "least", "right", "kept"):
        print(f"{column}: worst {table[column].min():.3f}, median {table[column].median():.3f}", flush=True)
    print(f"{len(table)} choices, {failed} without masks; {len(thing.truth)} photos")


def _read(folder: Path, truth: Path, wrong: tuple[str, ...]) -> Object:
    """An object's photos and true masks."""
    workspace = read_workspace(folder / "undistorted")
    views = [workspace.rgb(view) for view in workspace.views]
    true, _ = supplied_masks(truth, folder / "sparse", views)
    return Object(
        folder,
        replace(workspace, views=views),
        np.array(value(read_json(folder / "undistorted.json"), "up_in_camera_frame")),
        original_sizes(read_json(folder / "photos.json")),
        {name: mask for name, mask in true.items() if name not in wrong},
        masks_by_name(true, truth),
    )


def _smaller_part(mask: Mask) -> Array | None:
    """The middle (2,) of the thickest part that a disk of half the object's inner radius does not fit into."""
    depth = ndimage.distance_transform_edt(np.pad(mask, 1))[1:-1, 1:-1]
    radius = depth.max() / 2
    # An opening by the disk; what is left of the large part's rim is thin.
    opened = ndimage.distance_transform_edt(depth <= radius) < radius
    rest = np.where(opened, 0, ndimage.distance_transform_edt(np.pad(mask & ~opened, 1))[1:-1, 1:-1])
    if rest.max() < LEAST_PART_PX:
        return None
    row, column = np.unravel_index(rest.argmax(), rest.shape)
    return np.array([column, row]) + 0.5


def _trial(
    thing: Object, name: str, trial: int, how: PromptSettings, part: bool, network: Any, settings: MaskSettings
) -> dict[str, Any]:
    """Masks from one choice of clicks, and how like the true ones they are."""
    rng = np.random.default_rng([trial, *name.encode()])
    true = read_mask(thing.files[name])
    labels, pixels = clicks_on(true, how, rng)
    middle = _smaller_part(true) if part else None
    if middle is not None:
        miss = random_misses(1, *how.miss_px, rng)[0]
        pixels[how.inside - 1] = np.clip(middle + miss, 1.0, np.array(true.shape[::-1]) - 1.0)
    marked = Clicks(Path(name), "labels", tuple(Click(label, name, *pixel) for label, pixel in zip(labels, pixels)))
    row: dict[str, Any] = {"photo": name, "trial": trial}
    try:
        found = segmentation.masks_from_prompts(
            marked, thing.folder / "sparse", thing.sizes, thing.photos, thing.up, network, settings, 0
        )
        scored = score_masks(found.masks, found.target, thing.photos.views, settings, found.clicked)
    except StageError as error:
        return row | dict.fromkeys(("median", "mean", "least", "right", "kept", "left_out"), 0) | {"error": str(error)}
    iou = {
        photo: mask_iou(mask, thing.truth[photo])
        for photo, mask in scored.masks.items()
        if photo in thing.truth and photo not in scored.dropped
    }
    least = min(iou, key=lambda photo: iou[photo]) if iou else ""
    values = np.array(list(iou.values()) or [0.0])
    return row | {
        "median": round(float(np.median(values)), 4),
        "mean": round(float(values.mean()), 4),
        "least": round(float(values.min()), 4),
        "right": int((values >= RIGHT).sum()),
        "kept": len(iou),
        "left_out": len(found.left_out),
        "error": "",
        "worst_photo": least,
    }


if __name__ == "__main__":
    run(clicked_masks)

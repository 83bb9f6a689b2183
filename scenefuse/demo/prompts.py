"""Clicks in one photo of an object of the demo, as a person would: spread over what it shows, some pixels off."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from scenefuse.core.stage import StageError, atomic_file, setting
from scenefuse.demo.clicks import random_misses
from scenefuse.photos.pictures import read_mask

# Nobody aims at the last pixel of a part: spots are this deep inside, as a share of the deepest one's depth.
AIMED_DEPTH = 0.2


@dataclass(frozen=True)
class PromptSettings:
    """Clicks on an object in one of its photos."""

    inside: int = setting(5, least=1)
    """Clicks inside the object."""
    box: bool = setting(False)
    """Whether two more are the corners of a box around it."""
    least_miss_px: float = setting(3, unit="px", least=0)
    """How far a click is off the spot that it was meant for, at least."""
    most_miss_px: float = setting(10, unit="px", least=0)
    """The same, at most."""


def click_object(*, truth: Path, clicks: Path, settings: PromptSettings, seed: int) -> None:
    """Click an object of the demo in the photo that shows most of it: a table of labels (label, photo, x_px, y_px).

    Args:
        truth: the object's truth folder, with masks/{photo without suffix}.png.
        clicks: output table, .tsv.
        settings: how it is clicked.
        seed: of the misses.

    Raises:
        StageError: no mask shows the object.
    """
    files = sorted((truth / "masks").glob("*.png"))
    masks = {file.stem: read_mask(file) for file in files}
    if not any(mask.any() for mask in masks.values()):
        raise StageError(f"no mask in {truth}/masks shows the object; render the capture again")
    photo = max(masks, key=lambda name: np.count_nonzero(masks[name]))
    labels, pixels = clicks_on(masks[photo], settings, np.random.default_rng([seed, 4]))
    rows = [f"{label}\t{photo}.jpg\t{x:.1f}\t{y:.1f}" for label, (x, y) in zip(labels, pixels)]
    lines = ["label\tphoto\tx_px\ty_px", *rows]
    with atomic_file(clicks) as temporary:
        temporary.write_text("\n".join(lines) + "\n")
    print(f"{len(pixels)} clicks in {photo}.jpg", flush=True)


def clicks_on(
    mask: NDArray[np.bool_], settings: PromptSettings, rng: np.random.Generator
) -> tuple[list[str], NDArray[np.float64]]:
    """Labels and pixels (N, 2) of clicks on a mask (H, W): spots far apart, each off by a miss in a random direction.

    Args:
        mask: what the photo shows of the object, not empty.
        settings: how it is clicked.
        rng: of the first spot and of the misses.
    """
    depth = ndimage.distance_transform_edt(np.pad(mask, 1))[1:-1, 1:-1]
    aimed = np.argwhere(depth > AIMED_DEPTH * depth.max())[:, ::-1] + 0.5
    spots = [aimed[rng.integers(len(aimed))]]
    gaps = np.full(len(aimed), np.inf)
    while len(spots) < settings.inside:
        gaps = np.minimum(gaps, np.linalg.norm(aimed - spots[-1], axis=1))
        spots.append(aimed[gaps.argmax()])
    labels = ["inside"] * len(spots)
    if settings.box:
        rows, columns = np.nonzero(mask)
        spots += [np.array([columns.min(), rows.min()]), np.array([columns.max(), rows.max()]) + 1.0]
        labels += ["box"] * 2
    found = np.array(spots) + random_misses(len(spots), settings.least_miss_px, settings.most_miss_px, rng)
    return labels, np.clip(found, 1.0, np.array(mask.shape[::-1]) - 1.0)

"""Clicks in photos of the demo, as a person would make them, some pixels off.

Landmarks, corners and tips that are visible, in several photos; or spots spread over an object, in one photo.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from demo.truth import read_cameras, visible
from demo.world import build_world
from scenefuse.core.stage import StageError, atomic_file
from scenefuse.photos.pictures import read_mask

# A point counts as hidden when something lies this far before it.
HIDDEN_M = 0.06
# Nobody aims at the last pixel of a part: spots are this deep inside, as a share of the deepest one's depth.
MIN_DEPTH_SHARE = 0.2


@dataclass(frozen=True)
class ClickSettings:
    """Points clicked in several photos."""

    photos: int = 6
    """Photos used at most."""
    separation_deg: float = 12.0
    """Smallest angle at the object between the views of two photos used."""
    miss_px: tuple[float, float] = (3.0, 10.0)
    """How far a click is off the point that it was meant for, at least and at most."""


@dataclass(frozen=True)
class PromptSettings:
    """Clicks on an object in one of its photos."""

    inside: int = 3
    """Clicks inside the object."""
    box: bool = True
    """Whether two more are the corners of a box around it."""
    miss_px: tuple[float, float] = (3.0, 10.0)
    """How far a click is off the spot that it was meant for, at least and at most."""


def click_points(*, name: str, cameras: Path, clicks: Path, settings: ClickSettings, seed: int) -> None:
    """Click an object's landmarks in a few photos of one capture: the flight (fiducials) or its orbit (prompts).

    Writes a tab-separated table with the columns point, photo, x_px, y_px (pixel centres at +0.5); each point
    appears in at least two photos. Points are clicked only where nothing hides them from the camera.

    Args:
        name: house, balloon or sculpture.
        cameras: the capture's cameras.json.
        clicks: output table, .tsv.
        settings: how they are clicked.
        seed: of the world, as for rendering, and of the clicks' misses.

    Raises:
        StageError: an unknown object, or fewer than four points that two photos see.
    """
    world = build_world(seed)
    landmarks = world.landmarks(name)
    capture = read_cameras(cameras)
    points = np.array(list(landmarks.values()))
    pixels, seen = visible(world.scene, capture, points, HIDDEN_M)
    used = _choose(seen, capture.centres - world.bounds(name).mean(0), settings)
    names = [n for n, count in zip(landmarks, seen[used].sum(0)) if count >= 2]
    if len(names) < 4:
        raise StageError(
            f"only {len(names)} points of {name} are visible in two of the {len(used)} photos used from {cameras}; "
            "render more photos, or allow more photos or a smaller separation for the clicks"
        )
    misses = random_misses(len(landmarks) * len(used), *settings.miss_px, seed)
    lines = ["point\tphoto\tx_px\ty_px"]
    for k, point in enumerate(landmarks):
        for photo, miss in zip(used, misses[k * len(used) :]):
            if point in names and seen[photo, k]:
                x, y = np.clip(pixels[photo, k] + miss, 0, [capture.width, capture.height])
                lines.append(f"{point}\t{capture.names[photo]}\t{x:.2f}\t{y:.2f}")
    _write(clicks, lines)
    print(f"{name}: {len(names)} points in {len(used)} photos", flush=True)


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
    _write(clicks, ["label\tphoto\tx_px\ty_px", *rows])
    print(f"{len(pixels)} clicks in {photo}.jpg", flush=True)


def _write(clicks: Path, lines: list[str]) -> None:
    with atomic_file(clicks) as temporary:
        temporary.write_text("\n".join(lines) + "\n")


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
    aimed = np.argwhere(depth > MIN_DEPTH_SHARE * depth.max())[:, ::-1] + 0.5
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
    found = np.array(spots) + random_misses(len(spots), *settings.miss_px, rng)
    return labels, np.clip(found, 1.0, np.array(mask.shape[::-1]) - 1.0)


def random_misses(count: int, least: float, most: float, seed: int | np.random.Generator) -> NDArray[np.float64]:
    """(count, 2) by how much clicks are off, in random directions and as far as this."""
    if least > most:
        raise StageError(f"clicks cannot miss by {least:g} px at least and {most:g} px at most; change one of the two")
    rng = np.random.default_rng(seed)
    angles, off = rng.uniform(0, 2 * np.pi, count), rng.uniform(least, most, count)
    return off[:, None] * np.stack([np.cos(angles), np.sin(angles)], axis=1)


def _choose(seen: NDArray[np.bool_], towards: NDArray[np.float64], settings: ClickSettings) -> list[int]:
    """Photos, one by one the one that adds most to points seen by fewer than two of those chosen."""
    directions = towards / np.linalg.norm(towards, axis=1, keepdims=True)
    chosen: list[int] = []
    while len(chosen) < settings.photos:
        need = np.maximum(2 - seen[chosen].sum(0), 0) if chosen else np.full(seen.shape[1], 2)
        gain = (seen * (1 + 8 * need)).sum(1).astype(np.float64)
        if chosen:
            closest = np.degrees(np.arccos(np.clip(directions @ directions[chosen].T, -1, 1))).min(1)
            gain[closest < settings.separation_deg] = 0
        if gain.max() <= 0:
            break
        chosen.append(int(gain.argmax()))
    return sorted(chosen)

"""Points clicked in photos of the demo, as a person would: corners and tips that are visible, some pixels off."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from scenefuse.core.stage import StageError, atomic_file, setting
from scenefuse.demo.cameras import read_cameras, visible
from scenefuse.demo.world import build_world

# A point counts as hidden when something lies this far before it, in metres.
HIDDEN_M = 0.06


@dataclass(frozen=True)
class ClickSettings:
    """Points clicked in several photos."""

    photos: int = setting(6, least=0)
    """Photos used at most."""
    separation_deg: float = setting(12, unit="deg", least=0)
    """Smallest angle at the object between the views of two photos used."""
    least_miss_px: float = setting(3, unit="px", least=0)
    """How far a click is off the point that it was meant for, at least."""
    most_miss_px: float = setting(10, unit="px", least=0)
    """The same, at most."""


def click_points(*, name: str, cameras: Path, clicks: Path, settings: ClickSettings, seed: int) -> None:
    """Click an object's landmarks in a few photos of one capture: the flight (fiducials) or its orbit (prompts).

    Writes a tab-separated table with the columns point, photo, x_px, y_px (pixel centres at +0.5); each point
    appears in at least two photos. Points are clicked only where the ray caster says that nothing hides them.

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
    misses = random_misses(len(landmarks) * len(used), settings.least_miss_px, settings.most_miss_px, seed)
    lines = ["point\tphoto\tx_px\ty_px"]
    for k, point in enumerate(landmarks):
        for photo, miss in zip(used, misses[k * len(used) :]):
            if point in names and seen[photo, k]:
                x, y = np.clip(pixels[photo, k] + miss, 0, [capture.width, capture.height])
                lines.append(f"{point}\t{capture.names[photo]}\t{x:.2f}\t{y:.2f}")
    with atomic_file(clicks) as temporary:
        temporary.write_text("\n".join(lines) + "\n")
    print(f"{name}: {len(names)} points in {len(used)} photos", flush=True)


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

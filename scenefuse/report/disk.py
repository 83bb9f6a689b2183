"""The room that results take on the disk: what a run will need, before it begins, and what it has taken."""

import shutil
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import pandas as pd
from PIL import Image

from scenefuse.sfm.photo_files import photo_files
from scenefuse.stage import StageError

# Of the demo, the statue and the dragon (docs/results.md, The room on the disk).
FEATURE_BYTES = 450
"""A feature, in both databases of a model, with its matches."""
PHOTO_BYTES = 2
"""A pixel of a photo: of its copies, as JPEG."""
SCENE_BYTES = 19
"""A pixel of a scene's depth, normal and confidence maps, and its share of the clouds."""
OBJECT_BYTES = 60
"""A pixel of an object's maps of stages 1 to 4, its share of the registration and the pictures."""
LARGEST = 4
"""Parts that the summary names."""


def forecast(kind: str, row: Mapping[str, Any], settings: Mapping[str, Any]) -> int:
    """Bytes that a scene or an object will take; 0 where it is a cloud, or a video, or its photos cannot be read: then
    its own stage says why.

    Args:
        kind: `scene` or `object`.
        row: its row of the table.
        settings: its settings.
    """
    if row.get("cloud") or not row.get("photos"):
        return 0
    try:
        photos = photo_files(Path(row["photos"]))
        with Image.open(photos[0]) as first:
            width, height = first.size
    except (OSError, StageError):
        return 0
    own, longest = settings[kind], max(width, height)
    if kind == "scene":
        photo = min(1.0, own["undistort"]["max_size_px"] / longest)
        maps = SCENE_BYTES * min(photo, own["depth_maps"]["max_image_size_px"] / longest) ** 2
    else:
        photo = min(1.0, own["frames"]["max_width_px"] / width)
        maps = OBJECT_BYTES * min(photo, own["nerf"]["width_px"] / width) ** 2
    pixels = width * height * (PHOTO_BYTES * photo**2 + maps)
    return round(len(photos) * (pixels + FEATURE_BYTES * own["features"]["max_features"]))


def forecast_note(needed: int, results: Path) -> str:
    """What a run needs beside what is free, in a sentence.

    Args:
        needed: bytes of all scenes and objects.
        results: the folder of the results; it need not exist.
    """
    there = next(path for path in (results, *results.absolute().parents) if path.exists())
    taken, free = sum(parts_of(results).values()), shutil.disk_usage(there).free
    note = (
        f"disk: {results} will take about {_gigabytes(needed)} ({_gigabytes(taken)} now), {_gigabytes(free)} are free"
    )
    return note + ("; that is too little: free some space" if needed - taken > free else "")


def disk_table(folders: Iterable[Path]) -> pd.DataFrame:
    """Room that the parts of result folders take: columns name (`scenes/{scene}` for instance), part,
    megabytes; the largest part of each first."""
    rows = [
        {"name": f"{folder.parent.name}/{folder.name}", "part": part, "megabytes": size / 1e6}
        for folder in folders
        for part, size in sorted(parts_of(folder).items(), key=lambda item: -item[1])
    ]
    return pd.DataFrame(rows, columns=["name", "part", "megabytes"])


def disk_line(table: pd.DataFrame, name: str) -> str:
    """All of `scenes/{scene}` or `objects/{object}`, and its largest parts; "" where all are below a megabyte."""
    own = table[table["name"] == name]
    large = own[own["megabytes"] >= 1].head(LARGEST)
    parts = [f"{part} {_gigabytes(1e6 * size)}" for part, size in zip(large["part"], large["megabytes"])]
    return ": ".join([_gigabytes(1e6 * own["megabytes"].sum()), ", ".join(parts)]) if parts else ""


def parts_of(folder: Path) -> dict[str, int]:
    """Bytes of the files in a folder, and of those below each folder in it; links take no room."""
    parts: dict[str, int] = {}
    for path in sorted(folder.rglob("*")):
        if path.is_file() and not path.is_symlink():
            part = path.relative_to(folder).parts[0]
            parts[part] = parts.get(part, 0) + path.stat().st_size
    return parts


def _gigabytes(size: float) -> str:
    return f"{size / 1e9:.3g} GB" if size >= 1e8 else f"{size / 1e6:.3g} MB"

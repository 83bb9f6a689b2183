"""The room that results take on the disk: what a run will need, before it begins, and what it has taken."""

import math
import os
import shutil
import stat
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import pandas as pd
from PIL import Image
from PIL.ExifTags import Base

from scenefuse.core.stage import StageError
from scenefuse.photos.photo_files import photo_files

# Fitted by hand to what the demo took (docs/results.md, The room on the disk).
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
SIDEWAYS = (5, 6, 7, 8)
"""EXIF orientations of photos that are turned by a quarter."""
TEMPORARY = ".tmp-"


def forecast(kind: str, row: Mapping[str, Any], settings: Mapping[str, Any]) -> int | None:
    """Bytes that a scene or an object from photos will take; None where that cannot be told: a cloud, a video, photos
    that are yet to be made or cannot be read. With a cloud beside the photos there are no maps.

    Args:
        kind: `scene` or `object`.
        row: its row of the table.
        settings: its settings.
    """
    if not row.get("photos"):
        return None
    try:
        photos = photo_files(Path(row["photos"]))
        with Image.open(photos[0]) as first:
            turned = first.getexif().get(Base.Orientation) in SIDEWAYS
            width, height = reversed(first.size) if turned else first.size
    except (OSError, StageError, Image.DecompressionBombError):
        return None
    own, longest, count = settings[kind], max(width, height), len(photos)
    if kind == "scene":
        photo = min(1.0, own["undistort"]["max_size_px"] / longest)
        maps = SCENE_BYTES * min(photo, own["depth_maps"]["max_image_size_px"] / longest) ** 2
    else:
        photo = min(1.0, own["frames"]["max_width_px"] / width)
        maps = OBJECT_BYTES * min(photo, own["nerf"]["width_px"] / width) ** 2
        count = math.ceil(count / own["frames"]["frame_step"])
        count = min(count, own["frames"]["max_frames"] or count)
    maps *= not row.get("cloud")
    pixels = width * height * (PHOTO_BYTES * photo**2 + maps)
    return round(count * (pixels + FEATURE_BYTES * own["features"]["max_features"]))


def forecast_note(needed: Mapping[Path, int | None], keep_maps: bool = True) -> str:
    """What a run needs beside what is free, in a sentence; "" where nothing of it can be told.

    Args:
        needed: bytes by folder of results, which need not exist; None where they are unknown.
        keep_maps: whether maps stay; otherwise less is needed at a time.
    """
    known = {folder: size for folder, size in needed.items() if size is not None}
    if not known:
        return ""
    there = next(path for path in next(iter(known)).absolute().parents if path.exists())
    taken = {folder: sum(parts_of(folder).values()) for folder in known}
    free, more = shutil.disk_usage(there).free, sum(max(0, size - taken[folder]) for folder, size in known.items())
    unknown = [folder.name for folder in needed if folder not in known]
    amount = "about" if keep_maps else "less than, as maps go (keep_maps: false),"
    advice = "free some space, or set `keep_maps: false`" if keep_maps else "free some space, unless few run at a time"
    return (
        f"disk: scenes and objects will take {amount} {_size(sum(known.values()))} ({_size(sum(taken.values()))} now),"
        f" {_size(free)} are free"
        + (f"; not counted: {', '.join(unknown)}" if unknown else "")
        + (f"; that is too little: {advice}" if more > free else "")
    )


def disk_table(folders: Iterable[Path]) -> pd.DataFrame:
    """Room that the parts of result folders take: columns name (`scenes/{scene}` for instance), part, megabytes; the
    largest part of each first."""
    rows = [
        {"name": f"{folder.parent.name}/{folder.name}", "part": part, "megabytes": size / 1e6}
        for folder in folders
        for part, size in sorted(parts_of(folder).items(), key=lambda item: (-item[1], item[0]))
    ]
    return pd.DataFrame(rows, columns=["name", "part", "megabytes"])


def disk_line(table: pd.DataFrame, name: str) -> str:
    """All of `scenes/{scene}` or `objects/{object}`, and its largest parts; "" where all are below a megabyte."""
    own = table[table["name"] == name]
    large = own[own["megabytes"] >= 1].head(LARGEST)
    parts = [f"{part} {_size(1e6 * megabytes)}" for part, megabytes in zip(large["part"], large["megabytes"])]
    return ": ".join([_size(1e6 * own["megabytes"].sum()), ", ".join(parts)]) if parts else ""


def parts_of(folder: Path) -> dict[str, int]:
    """Bytes of the files in a folder, and of those below each folder in it; links take no room. What comes and goes
    meanwhile, as jobs write it, is left out."""
    parts: dict[str, int] = {}
    for place, folders, names in os.walk(folder):
        folders[:] = [name for name in folders if TEMPORARY not in name]
        below = Path(place).relative_to(folder).parts
        for name in names:
            try:
                status = os.lstat(os.path.join(place, name))
            except OSError:
                continue
            if TEMPORARY not in name and not stat.S_ISLNK(status.st_mode):
                part = below[0] if below else name
                parts[part] = parts.get(part, 0) + status.st_size
    return parts


def _size(size: float) -> str:
    unit, name = next((u, n) for u, n in ((1e12, "TB"), (1e9, "GB"), (1e6, "MB")) if size >= 0.1 * u or n == "MB")
    return f"{size / unit:.3g} {name}"

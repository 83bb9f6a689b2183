"""Disk space: what a run will need, before it begins, and what its results take."""

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

# Bytes that a feature takes in both databases of a model, with its matches; a pixel of a photo in its copies as JPEG; a
# pixel of a scene's depth, normal and confidence maps, with its share of the clouds; a pixel of an object's maps of
# stages 1 to 4, with its share of the registration and the pictures. Fitted to what the demo took (docs/results.md).
BYTES = {"feature": 450, "photo": 2, "scene": 19, "object": 60}
# Parts that the summary names.
MAX_PARTS = 4
TEMPORARY = ".tmp-"


def forecast(kind: str, row: Mapping[str, Any], settings: Mapping[str, Any]) -> int | None:
    """Bytes that a scene or an object from photos will take, or None where they are not known.

    They are not known of a cloud, a video, and photos that are yet to be made or cannot be read. With a cloud beside
    the photos there are no maps.

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
            # Of the orientations 1 to 8, the last four are turned by a quarter.
            turned = first.getexif().get(Base.Orientation, 1) > 4
            width, height = reversed(first.size) if turned else first.size
    except (OSError, StageError, Image.DecompressionBombError):
        return None
    own, longest, count = settings[kind], max(width, height), len(photos)
    if kind == "scene":
        photo = min(1.0, own["undistort"]["max_size_px"] / longest)
        maps = BYTES[kind] * min(photo, own["depth_maps"]["max_image_size_px"] / longest) ** 2
    else:
        photo = min(1.0, own["frames"]["max_width_px"] / width)
        maps = BYTES[kind] * min(photo, own["nerf"]["width_px"] / width) ** 2
        count = math.ceil(count / own["frames"]["frame_step"])
        count = min(count, own["frames"]["max_frames"] or count)
    maps *= not row.get("cloud")
    pixels = width * height * (BYTES["photo"] * photo**2 + maps)
    return round(count * (pixels + BYTES["feature"] * own["features"]["max_features"]))


def forecast_note(needed: Mapping[Path, int | None], keep_maps: bool = True) -> str:
    """What a run needs and what is free, in a sentence; "" where nothing is known.

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
    """Disk space of the parts of result folders: name (such as `scenes/{scene}`), part, megabytes; largest first."""
    rows = [
        {"name": f"{folder.parent.name}/{folder.name}", "part": part, "megabytes": size / 1e6}
        for folder in folders
        for part, size in sorted(parts_of(folder).items(), key=lambda item: (-item[1], item[0]))
    ]
    return pd.DataFrame(rows, columns=["name", "part", "megabytes"])


def disk_line(table: pd.DataFrame, name: str) -> str:
    """All of `scenes/{scene}` or `objects/{object}`, and its largest parts; "" where all are below a megabyte."""
    own = table[table["name"] == name]
    large = own[own["megabytes"] >= 1].head(MAX_PARTS)
    parts = [f"{part} {_size(1e6 * megabytes)}" for part, megabytes in zip(large["part"], large["megabytes"])]
    return ": ".join([_size(1e6 * own["megabytes"].sum()), ", ".join(parts)]) if parts else ""


def parts_of(folder: Path) -> dict[str, int]:
    """Bytes of the files in a folder, and of those below each folder in it; links take none. Temporary files of
    running jobs are left out."""
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

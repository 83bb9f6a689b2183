"""Disk space that results take."""

import os
import stat
from collections.abc import Iterable
from pathlib import Path

import pandas as pd

TEMPORARY = ".tmp-"


def disk_table(folders: Iterable[Path]) -> pd.DataFrame:
    """Disk space of the parts of result folders: name (such as `scenes/{scene}`), part, megabytes; largest first."""
    rows = [
        {"name": f"{folder.parent.name}/{folder.name}", "part": part, "megabytes": size / 1e6}
        for folder in folders
        for part, size in sorted(parts_of(folder).items(), key=lambda item: (-item[1], item[0]))
    ]
    return pd.DataFrame(rows, columns=["name", "part", "megabytes"])


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


def size_text(size: float) -> str:
    """Bytes in words, such as 1.2 GB."""
    unit, name = next((u, n) for u, n in ((1e12, "TB"), (1e9, "GB"), (1e6, "MB")) if size >= 0.1 * u or n == "MB")
    return f"{size / unit:.3g} {name}"

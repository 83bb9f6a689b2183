"""What stages left, which may lack anything: quantities as one flat table, sizes on the disk, numbers as short text."""

import importlib.resources
import json
import math
import os
import stat
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas as pd
import yaml

Fields = dict[str, dict[str, Any]]
TEMPORARY = ".tmp-"
ASSETS = importlib.resources.files("scenefuse.report") / "assets"


def asset(name: str) -> str:
    """The text of a file in assets/."""
    return (ASSETS / name).read_text(encoding="utf-8")


# Words for statuses, for what they rest on, and for what went wrong.
WORDS: dict[str, dict[str, str]] = yaml.safe_load(asset("report.yaml"))["words"]


def flatten(content: Mapping[str, Any], prefix: str = "") -> Fields:
    """Nested {"group": {"name": {"value", "unit"}}} as {"group.name": {"value", "unit"}}; anything else is left out."""
    fields: Fields = {}
    for name, item in content.items():
        if isinstance(item, Mapping):
            if "value" in item:
                fields[prefix + name] = {"value": item["value"], "unit": item.get("unit", "")}
            else:
                fields |= flatten(item, f"{prefix}{name}.")
    return fields


def load(path: Path) -> Fields:
    """The quantities of a stage JSON; none when it is missing or damaged: a summary never fails on one file."""
    try:
        content = json.loads(Path(path).read_text())
    except (OSError, ValueError):
        return {}
    return flatten(content) if isinstance(content, dict) else {}


def read_table(path: Path) -> pd.DataFrame:
    """A table of the summary, NaN where a cell holds nothing; without rows where there is no such table."""
    try:
        return pd.read_csv(path, sep="\t", na_values=["-"], keep_default_na=False, dtype={"object": str, "scene": str})
    except (FileNotFoundError, pd.errors.EmptyDataError):
        return pd.DataFrame()


def records(table: pd.DataFrame) -> list[dict[str, Any]]:
    """The rows of a table, column -> cell."""
    return [{str(k): v for k, v in row.items()} for row in table.to_dict("records")]


def find(fields: Fields, *names: str) -> Any:
    """The value of the first of `names` that is there: by full name, else by the last part of a name; else None."""
    found = _field(fields, names)
    return None if found is None else found["value"]


def unit_of(fields: Fields, *names: str) -> str | None:
    """The unit of what `find` finds; None when there is nothing."""
    found = _field(fields, names)
    return None if found is None else str(found["unit"])


def _field(fields: Fields, names: tuple[str, ...]) -> dict[str, Any] | None:
    for name in names:
        if name in fields:
            return fields[name]
        for key, item in fields.items():
            if "." not in name and key.rsplit(".", 1)[-1] == name:
                return item
    return None


def number(item: Any) -> str:
    """Four significant digits, no exponent for everyday numbers; '-' for what is absent or no finite number."""
    if isinstance(item, bool):
        return "yes" if item else "no"
    if isinstance(item, int):
        return str(item)
    if isinstance(item, float):
        if not math.isfinite(item):
            return "-"
        return f"{item:.4g}" if abs(item) < 1e4 else f"{item:.0f}"
    return "-" if item is None or item == "" else str(item)


def percent(share: float) -> str:
    """A share of 1 in per cent, to two digits; next to all and next to nothing are never rounded to all and nothing."""
    value = 100 * share
    rest = min(value, 100 - value)
    digits = 0 if rest >= 10 or rest <= 0 else 1 if rest >= 0.1 else 2
    return f"{value:.{digits}f} %"


def percents(parts: Sequence[float]) -> list[str]:
    """The first share of a whole, the sum of the others, and these, in per cent that sum to 100; "" for none."""
    digits = 1 if sum(parts[1:]) >= 0.001 else 2
    whole = 10 ** (digits + 2)
    exact = [whole * part / (sum(parts) or 1.0) for part in parts]
    counts = [math.floor(part) for part in exact]
    # What rounding down leaves goes to the largest remainders.
    for at in sorted(range(len(parts)), key=lambda at: counts[at] - exact[at])[: whole - sum(counts)]:
        counts[at] += 1
    return [f"{100 * n / whole:.{digits}f} %" if n else "" for n in (counts[0], sum(counts[1:]), *counts[1:])]


def length(value: float, unit: str) -> str:
    """A length with its unit: metres in millimetres or centimetres where that is shorter, three digits."""
    if unit == "m" and abs(value) < 1:
        value, unit = (1000 * value, "mm") if abs(value) < 0.1 else (100 * value, "cm")
    digits = f"{value:#.3g}".rstrip(".") if abs(value) < 999.5 else f"{value:,.0f}"
    return f"{digits} {unit}"


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

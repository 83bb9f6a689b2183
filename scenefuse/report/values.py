"""What stages left, which may lack anything: quantities as one flat table, sizes on the disk, numbers as short text."""

import contextlib
import importlib.resources
import json
import math
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
    # Names may be numbers.
    words = dict.fromkeys(("object", "scene", "completed_by", "made_by"), str)
    try:
        return pd.read_csv(path, sep="\t", na_values=["-"], keep_default_na=False, dtype=words)
    except (FileNotFoundError, pd.errors.EmptyDataError):
        return pd.DataFrame()


def records(table: pd.DataFrame) -> list[dict[str, Any]]:
    """The rows of a table, column -> cell."""
    return [{str(k): v for k, v in row.items()} for row in table.to_dict("records")]


def find(fields: Fields, *names: str) -> Any:
    """The value of the first of `names` that is there; else None."""
    return next((fields[name]["value"] for name in names if name in fields), None)


def unit_of(fields: Fields, *names: str) -> str | None:
    """The unit of what `find` finds; None when there is nothing."""
    return next((str(fields[name]["unit"]) for name in names if name in fields), None)


def number(item: Any) -> str:
    """Four significant digits, no exponent for everyday numbers; '-' for what is absent or no finite number."""
    if isinstance(item, bool):
        return "yes" if item else "no"
    if isinstance(item, float):
        if not math.isfinite(item):
            return "-"
        return f"{item:.4g}" if abs(item) < 9999.5 else f"{item:.0f}"
    return "-" if item is None or item == "" else str(item)


def percent(share: float) -> str:
    """A share of 1 in per cent, to two digits; next to all and next to nothing are never rounded to all and nothing."""
    value = 100 * share
    digits = 0 if value <= 0 or value >= 100 or 10 <= value <= 90 else _decimals(value)
    return f"{value:.{digits}f} %"


def _decimals(value: float) -> int:
    """How many decimals keep a number of per cent from all and from nothing; one, where it is neither nor near."""
    rest = round(min(value, 100 - value), 9)
    return max(1, math.ceil(-math.log10(rest))) if rest > 0 else 1


def percents(missing: Sequence[float]) -> list[str]:
    """What some shares leave of a whole, what they take together, and each: per cent that sum to 100, "" for none."""
    digits = _decimals(100 * sum(missing))
    together, each = round(100 * sum(missing), digits), [round(100 * share, digits) for share in missing]
    each[each.index(max(each))] += together - sum(each)
    texts = [f"{part:.{digits}f} %" if round(part, digits) else "" for part in (together, *each)]
    return [f"{100 - together:.{digits}f} %", *texts]


def length(value: float, unit: str) -> str:
    """A length with its unit: metres in millimetres or centimetres where that is shorter, three digits."""
    if unit == "m" and abs(value) < 1:
        value, unit = (1000 * value, "mm") if abs(value) < 0.1 else (100 * value, "cm")
    digits = f"{value:#.3g}".rstrip(".") if abs(value) < 999.5 else f"{value:,.0f}"
    return f"{digits} {unit}"


def bytes_in(folder: Path) -> int:
    """Bytes of the files in and below a folder; links and the temporary files of running jobs are left out."""
    files = (path for path in folder.rglob("*") if TEMPORARY not in path.relative_to(folder).as_posix())
    size = 0
    for path in files:
        # A job that runs meanwhile takes files away.
        with contextlib.suppress(OSError):
            status = path.lstat()
            size += status.st_size if stat.S_ISREG(status.st_mode) else 0
    return size


def size_text(size: float) -> str:
    """Bytes in words, such as 1.2 GB."""
    unit, name = next((u, n) for u, n in ((1e12, "TB"), (1e9, "GB"), (1e6, "MB")) if size >= u or n == "MB")
    return f"{size / unit:.3g} {name}"

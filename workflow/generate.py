"""Write what follows from the code: the schema, the tables of config/README.md, and the numbers in documents.

python workflow/generate.py [--check]: --check writes nothing and names what is stale.
"""

import sys
from pathlib import Path
from typing import Any

import yaml

from scenefuse.config import schema
from workflow import documents
from workflow.documents import ROOT

SCHEMA = ROOT / "workflow/schemas/config.schema.yaml"
PAGE = ROOT / "config/README.md"
START, END = "<!-- settings: written by `make docs`, do not edit -->", "<!-- end of settings -->"


def rows(part: dict[str, Any], prefix: str = "") -> list[str]:
    """One table row for each leaf of a schema: key, shipped value, unit, meaning."""
    lines = []
    for key, leaf in part["properties"].items():
        if "properties" in leaf:
            lines += rows(leaf, f"{prefix}{key}.")
        else:
            text = yaml.safe_dump(leaf["default"], default_flow_style=True, sort_keys=False, width=float("inf"))
            text = text.strip().removesuffix("...").strip()
            lines.append(f"| `{prefix}{key}` | `{text}` | {leaf.get('unit', '')} | {leaf['description']} |")
    return lines


def columns(part: dict[str, Any]) -> list[str]:
    """One table row for each column of a TSV schema."""
    required = part["required"]
    return [
        f"| `{name}` | {'yes' if name in required else 'no'} | {column['description']} |"
        for name, column in part["properties"].items()
    ]


def tables() -> str:
    """All tables of the page, as Markdown."""
    parts = [START, ""]
    for name in ("scenes", "objects"):
        table = yaml.safe_load(SCHEMA.with_name(f"{name}.schema.yaml").read_text())
        parts += [f"### `{name}.tsv`", "", "| column | required | meaning |", "|---|---|---|", *columns(table), ""]
    parts += ["### `config.yaml`", "", "| key | shipped value | unit | meaning |", "|---|---|---|---|"]
    return "\n".join([*parts, *rows(schema()), "", END])


def fresh() -> dict[Path, str]:
    """The files as they should be."""
    pages = documents.fresh()
    before, rest = pages[PAGE].split(START)
    note = "# Written by `make docs` from the settings dataclasses (scenefuse/config.py); do not edit.\n"
    text = note + yaml.safe_dump(schema(), sort_keys=False, allow_unicode=True, width=110)
    return pages | {SCHEMA: text, PAGE: before + tables() + rest.split(END)[1]}


def main() -> int:
    """Write the files, or with --check name those that are stale."""
    stale = {path: text for path, text in fresh().items() if not path.is_file() or path.read_text() != text}
    for path, text in stale.items():
        if "--check" in sys.argv:
            print(f"{path.relative_to(ROOT)} is stale; run: make docs")
        else:
            path.write_text(text)
    return int("--check" in sys.argv and bool(stale))


if __name__ == "__main__":
    sys.exit(main())

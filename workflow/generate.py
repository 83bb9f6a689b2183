"""Write what follows from the code: the schema, the tables of config/README.md, and the numbers in documents.

python workflow/generate.py [--check]: --check writes nothing and names what is stale.
"""

import sys
from pathlib import Path
from typing import Any

import yaml

from workflow import documents
from workflow.documents import ROOT
from workflow.settings import schema

SCHEMA = ROOT / "workflow/schemas/config.schema.yaml"
PAGE = ROOT / "config/README.md"
START, END = "<!-- settings: written by `make docs`, do not edit -->", "<!-- end of settings -->"


# The rendered demo's own sections; their descriptions are in the schema.
LEFT_OUT = ("demo",)


def leaves(part: dict[str, Any], prefix: str = "") -> dict[str, dict[str, Any]]:
    """The leaves of a schema by their keys, `fusion.mode`."""
    found = {}
    for key, leaf in part["properties"].items():
        found |= leaves(leaf, f"{prefix}{key}.") if "properties" in leaf else {prefix + key: leaf}
    return found


def rows() -> list[str]:
    """One table row for each setting: key, shipped value, unit, meaning; what scene and object share once."""
    known = leaves(schema())
    lines = []
    for key, leaf in known.items():
        section, _, rest = key.partition(".")
        twin = known.get(f"{'scene' if section == 'object' else 'object'}.{rest}", {})
        shared = section in ("scene", "object") and twin.get("description") == leaf["description"]
        if section in LEFT_OUT or (shared and section == "object"):
            continue
        values = [shipped(leaf)] if not shared or twin["default"] == leaf["default"] else [shipped(leaf), shipped(twin)]
        cell = " / ".join(f"`{value}`" for value in values)
        lines.append(f"|`{key}`{' *' if shared else ''}|{cell}|{leaf.get('unit', '')}|{leaf['description']}|")
    return lines


def shipped(leaf: dict[str, Any]) -> str:
    """A setting's shipped value, as one writes it."""
    text = yaml.safe_dump(leaf["default"], default_flow_style=True, sort_keys=False, width=float("inf"))
    return text.strip().removesuffix("...").strip()


def columns(part: dict[str, Any]) -> list[str]:
    """One table row for each column of a TSV schema."""
    required = part["required"]
    return [
        f"|`{name}`{' (required)' if name in required else ''}|{column['description']}|"
        for name, column in part["properties"].items()
    ]


def tables() -> str:
    """All tables of the page, as Markdown."""
    parts = [START, ""]
    for name in ("scenes", "objects"):
        table = yaml.safe_load(SCHEMA.with_name(f"{name}.schema.yaml").read_text())
        parts += [f"### `{name}.tsv`", "", "|column|meaning|", "|---|---|", *columns(table), ""]
    note = "Sections with * are there for `scene` and `object`; where their shipped values differ, both are given."
    parts += ["### `config.yaml`", "", note, "", "|key|shipped|unit|meaning|", "|---|---|---|---|"]
    return "\n".join([*parts, *rows(), "", END])


def fresh() -> dict[Path, str]:
    """The files as they should be."""
    pages = documents.fresh()
    before, rest = pages[PAGE].split(START)
    note = "# Written by `make docs` from the settings dataclasses (workflow/settings.py); do not edit.\n"
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

"""Write the tables of config/README.md from the schemas: python workflow/config_docs.py [--check]."""

import sys
from pathlib import Path
from typing import Any

import yaml

ROOT = Path(__file__).resolve().parents[1]
START, END = "<!-- settings: written by `make docs`, do not edit -->", "<!-- end of settings -->"


def rows(schema: dict[str, Any], values: Any, prefix: str = "") -> list[str]:
    """One table row for each leaf key of a schema: key, shipped value, unit, meaning."""
    lines = []
    for key, part in schema["properties"].items():
        name, shipped = f"{prefix}{key}", values.get(key) if isinstance(values, dict) else None
        if "properties" in part:
            lines += rows(part, shipped, f"{name}.")
        else:
            text = yaml.safe_dump(shipped, default_flow_style=True, sort_keys=False, width=float("inf"))
            text = text.strip().removesuffix("...").strip()
            lines.append(f"| `{name}` | `{text}` | {part.get('unit', '')} | {part['description']} |")
    return lines


def columns(schema: dict[str, Any]) -> list[str]:
    """One table row for each column of a TSV schema."""
    required = schema["required"]
    return [
        f"| `{name}` | {'yes' if name in required else 'no'} | {part['description']} |"
        for name, part in schema["properties"].items()
    ]


def tables() -> str:
    """All tables of the page, as Markdown."""
    schemas = {p.name.split(".")[0]: yaml.safe_load(p.read_text()) for p in (ROOT / "workflow/schemas").glob("*.yaml")}
    config = yaml.safe_load((ROOT / "config/config.yaml").read_text())
    parts = [START, ""]
    for name in ("scenes", "objects"):
        parts += [
            f"### `{name}.tsv`",
            "",
            "| column | required | meaning |",
            "|---|---|---|",
            *columns(schemas[name]),
            "",
        ]
    parts += ["### `config.yaml`", "", "| key | shipped value | unit | meaning |", "|---|---|---|---|"]
    return "\n".join([*parts, *rows(schemas["config"], config), "", END])


def main() -> int:
    """Write the page, or with --check say whether it is stale."""
    page = ROOT / "config/README.md"
    text = page.read_text()
    before, rest = text.split(START)
    fresh = before + tables() + rest.split(END)[1]
    if "--check" in sys.argv:
        return int(fresh != text)
    page.write_text(fresh)
    return 0


if __name__ == "__main__":
    sys.exit(main())

"""The unit of a scene's lengths."""

from pathlib import Path

from scenefuse.core.stage import read_json, value


def length_unit(georeference: Path | None) -> str:
    """The unit of lengths in a scene's frame by its `georeference.json`: "m", or (without that file) "scene units"."""
    return "scene units" if georeference is None else str(value(read_json(georeference), "length_unit"))

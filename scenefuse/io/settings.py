"""Settings files: laid over the shipped ones, checked against the schema, and turned into the stages' dataclasses."""

import dataclasses
import difflib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeVar

import jsonschema
import yaml

from scenefuse.stage import StageError

ROOT = Path(__file__).resolve().parents[2]
T = TypeVar("T")


def merge(base: Any, over: Any) -> Any:
    """`base` with the keys of `over` laid over it, at every depth."""
    if not (isinstance(base, dict) and isinstance(over, dict)):
        return over
    return base | {key: merge(base.get(key), value) for key, value in over.items()}


def problem(content: Any, schema: Mapping[str, Any]) -> str | None:
    """The first thing in `content` that a JSON schema does not allow, as one sentence that begins with its key."""
    for error in jsonschema.Draft202012Validator(schema).iter_errors(content):
        key = ".".join(str(part) for part in error.absolute_path)
        message = error.message
        if error.validator == "additionalProperties":
            known = list(error.schema["properties"])
            unknown = next(name for name in error.instance if name not in known)
            close = difflib.get_close_matches(str(unknown), known, 1)
            advice = f"did you mean '{close[0]}'?" if close else f"known keys are: {', '.join(known)}"
            message = f"unknown key '{unknown}'; {advice}"
        return f"{key}: {message}" if key else message
    return None


def shipped_with(mine: Path | None) -> dict[str, Any]:
    """The settings of config/config.yaml with those of another file laid over them, all checked.

    Raises:
        StageError: the file is missing, is no YAML, or holds a key or value that the schema does not allow.
    """
    settings = yaml.safe_load((ROOT / "config/config.yaml").read_text())
    if mine is not None:
        try:
            own = yaml.safe_load(mine.read_text()) or {}
        except OSError:
            raise StageError(f"the settings file {mine} cannot be read; correct its path") from None
        except (yaml.YAMLError, UnicodeDecodeError) as error:
            raise StageError(f"{mine} is no YAML ({' '.join(str(error).split())}); correct it") from None
        if not isinstance(own, dict):
            raise StageError(f"{mine} holds no settings; write keys as in config/config.yaml, `registration:` first")
        settings = merge(settings, own)
    wrong = problem(settings, yaml.safe_load((ROOT / "workflow/schemas/config.schema.yaml").read_text()))
    if wrong:
        raise StageError(f"{mine}, {wrong}")
    return settings


def build(settings: type[T], values: Mapping[str, Any]) -> T:
    """A settings dataclass from the keys of its name in a section of the settings; lists become tuples."""
    names = [field.name for field in dataclasses.fields(settings)]  # type: ignore[arg-type]
    return settings(**{name: tuple(v) if isinstance(v := values[name], list) else v for name in names})

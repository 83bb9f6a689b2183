"""Settings files: laid over the shipped ones, checked against the schema, and turned into the stages' dataclasses."""

import dataclasses
import difflib
import functools
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar, get_type_hints

import jsonschema
import yaml

from scenefuse.core.stage import StageError

PACKAGE = Path(__file__).resolve().parent.parent
SHIPPED = PACKAGE / "shipped"
# Folder with workflow/, scripts/ and config/: inside the package where it was installed, else the clone's.
ROOT = SHIPPED if SHIPPED.is_dir() else PACKAGE.parent
# A project's own settings.
OWN_SETTINGS = Path("config/config.yaml")
# More values than any settings file has; messages about fewer are still short.
MAX_VALUES = 10_000
T = TypeVar("T")
# A JSON schema's validator to which NaN, infinity and what exceeds a float are no numbers; nor is 3.0 an integer, for
# command lines do not take it.
_NUMBERS = jsonschema.Draft202012Validator.TYPE_CHECKER.redefine(
    "number", lambda _, value: type(value) in (int, float) and abs(value) <= sys.float_info.max
)
_TYPES = _NUMBERS.redefine("integer", lambda _, value: type(value) is int)
_Validator = jsonschema.validators.extend(jsonschema.Draft202012Validator, type_checker=_TYPES)


class _UniqueKeys(yaml.SafeLoader):
    """Refuses a key that stands twice in a mapping; YAML's other readers take the last, and lose the first."""

    def compose_mapping_node(self, anchor: dict[Any, yaml.Node]) -> yaml.MappingNode:
        node = super().compose_mapping_node(anchor)
        lines = dict[str, int]()
        for key in (key for key, _ in node.value if isinstance(key, yaml.ScalarNode)):
            if key.value in lines:
                twice = f"the key '{key.value}' stands in line {lines[key.value]} already; bring both together"
                raise yaml.MarkedYAMLError(problem=twice, problem_mark=key.start_mark)
            lines[key.value] = key.start_mark.line + 1
        return node


def merge(base: Any, over: Any) -> Any:
    """`base` with the keys of `over` laid over it, at every depth."""
    if not (isinstance(base, dict) and isinstance(over, dict)):
        return over
    return base | {key: merge(base.get(key), value) for key, value in over.items()}


@functools.cache
def schema_of(name: str) -> dict[str, Any]:
    """The JSON schema of `config`, or of a row of `scenes` or `objects`."""
    return yaml.load(
        (ROOT / f"workflow/schemas/{name}.schema.yaml").read_text(), getattr(yaml, "CSafeLoader", yaml.SafeLoader)
    )


def problem(content: Any, schema: Mapping[str, Any]) -> str | None:
    """The first thing in `content` that a JSON schema does not allow, as one sentence that begins with its key."""
    return problem_at(content, schema)[1]


def problem_at(content: Any, schema: Mapping[str, Any]) -> tuple[list[Any], str | None]:
    """The keys that lead to what `problem` says, and its sentence; None where nothing is wrong."""
    if _grows(content):
        return [], "aliases of YAML expand without end; write what they stand for"
    for error in _Validator(schema).iter_errors(content):
        keys, message = list(error.absolute_path), error.message
        where = ".".join(map(str, keys))
        if error.validator == "additionalProperties":
            known = list(error.schema["properties"])
            unknown = next(name for name in error.instance if name not in known)
            close = difflib.get_close_matches(str(unknown), known, 1)
            advice = f"did you mean '{close[0]}'?" if close else f"known are: {', '.join(known)}"
            keys, message = [*keys, unknown], f"'{unknown}' is unknown; {advice}"
        elif error.validator == "type" and error.instance is None:
            message = "nothing stands behind or below it; remove the line, or fill it in"
        elif error.validator == "pattern" and "advice" in error.schema:
            message = f"'{error.instance}' will not do; {error.schema['advice']}"
        return keys, f"{where}: {message}" if where else message
    return [], None


def place_of(keys: Sequence[Any], path: Path) -> str | None:
    """A settings file and the line of a key in it, for a message; None where the file does not hold the key."""
    node, line = yaml.compose(path.read_text(), yaml.SafeLoader), 0
    for key in keys:
        found = [pair for pair in node.value if pair[0].value == str(key)] if isinstance(node, yaml.MappingNode) else []
        if not found:
            # An item of a list stands where the list does.
            return f"{path}, line {line + 1}" if isinstance(node, yaml.SequenceNode) else None
        line, node = found[-1][0].start_mark.line, found[-1][1]
    return f"{path}, line {line + 1}" if keys else str(path)


def with_defaults(content: Mapping[str, Any], schema: Mapping[str, Any]) -> dict[str, Any]:
    """Settings with the defaults of their JSON schema for every key that they leave out, at every depth."""
    return {
        key: with_defaults(content.get(key) or {}, part) if "properties" in part else content.get(key, part["default"])
        for key, part in schema["properties"].items()
    }


def read_settings(*mine: Path | None) -> dict[str, Any]:
    """The shipped settings with those of files laid over them, one after the other; all checked.

    Raises:
        StageError: a file is missing, is no YAML, or holds a key or value that the schema does not allow.
    """
    own = [read_differences(file) for file in mine if file is not None]
    return with_defaults(functools.reduce(merge, own, {}), schema_of("config"))


def read_yaml(mine: Path) -> Any:
    """The content of a settings file in YAML, in which no key stands twice; errors as of `read_settings`."""
    try:
        return yaml.load(mine.read_text(), _UniqueKeys)
    except OSError:
        raise StageError(f"the settings file {mine} cannot be read; correct its path") from None
    except yaml.MarkedYAMLError as error:
        line = f"line {error.problem_mark.line + 1}: " if error.problem_mark else ""
        raise StageError(f"{mine} is no YAML ({line}{error.problem}); correct it") from None
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise StageError(f"{mine} is no YAML ({' '.join(str(error).split())}); correct it") from None


def read_differences(mine: Path) -> dict[str, Any]:
    """The settings that a file names, checked; errors as of `read_settings`."""
    own = read_yaml(mine) or {}
    if not isinstance(own, dict):
        raise StageError(f"{mine} holds no settings; write keys as in config/config.yaml, `registration:` first")
    keys, wrong = problem_at(own, schema_of("config"))
    if wrong:
        raise StageError(f"{place_of(keys, mine) or mine}, {wrong}")
    return own


def _grows(content: Any) -> bool:
    """Whether content of YAML, whose aliases may repeat each other, has more than `MAX_VALUES` values."""
    left, count = [content], 0
    while left and count <= MAX_VALUES:
        part = left.pop()
        count += 1
        left += part.values() if isinstance(part, dict) else part if isinstance(part, list) else ()
    return bool(left)


def build(settings: type[T], values: Mapping[str, Any]) -> T:
    """A settings dataclass from the keys of its name in a section of the settings, the rest as shipped.

    Lists become tuples; dataclasses inside it are built from the same keys, as a command line flattens them.
    """
    kinds = get_type_hints(settings)
    own = {k: tuple(v) if isinstance(v, list) else v for k, v in values.items() if k in kinds}
    inner = {
        name: build(kind, values)
        for name, kind in kinds.items()
        if isinstance(kind, type) and dataclasses.is_dataclass(kind)
    }
    return settings(**inner | own)

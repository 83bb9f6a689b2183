"""What documents take from elsewhere: numbers of constants from the code, tables from docs/results.

In any page, `0.5<!-- masks.space.MIN_SHARE -->` is the constant MIN_SHARE of scenefuse/masks/space.py,
`30<!-- masks.space.MIN_SHARE % --> %` the same as percent, `four<!-- masks.space.PHOTOS -->` a number as a word.
A field of a dataclass is `module.Class.field`, an entry of a tuple `module.NAME[0]`. Constants are read from the
source: nothing is imported.

Between `<!-- table: docs/results/x.tsv -->` and `<!-- end -->` stands that table, and under it the commit whose code
it measured. docs/results/index.tsv has a row for each table: its command, that commit, the packages that it measured,
and in column `state` the word `older` where these have changed since.
"""

import ast
import functools
import math
import operator
import re
import subprocess
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
LIBRARY = ROOT / "scenefuse"
# In a code span it is an example.
NUMBER = re.compile(r"(?<![`\w.,])([^\s<>(|`]+)(<!-- ?([\w.]+?)(?:\[(\d+)\])?( ?%)? ?-->)")
TABLE = re.compile(r"(<!-- table: docs/(results/\w+\.tsv) -->\n).*?(<!-- end -->)", re.DOTALL)
OLDER = "older"
WORDS = ["no", "one", "two", "three", "four", "five", "six", "seven", "eight", "nine", "ten", "eleven", "twelve"]
OPERATORS = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: operator.truediv,
    ast.Pow: operator.pow,
    ast.LShift: operator.lshift,
    ast.USub: operator.neg,
}
FUNCTIONS = {
    "radians": math.radians,
    "deg2rad": math.radians,
    "degrees": math.degrees,
    "sqrt": math.sqrt,
    "log": math.log,
}


def pages() -> list[Path]:
    """All documents of the repository."""
    return sorted([*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md"), *(ROOT / "config").rglob("*.md")])


def with_numbers(text: str) -> str:
    """`text` with every number that names its constant as the constant is.

    Raises:
        KeyError: a constant is gone, or is no number.
    """
    return NUMBER.sub(lambda match: _written(constant(match[3], match[4]), match[1], bool(match[5])) + match[2], text)


def constant(name: str, index: str | None = None) -> Any:
    """The value of `module.NAME` or `module.Class.field`, below scenefuse.

    Raises:
        KeyError: there is none, or it does not follow from literals.
    """
    parts = name.split(".")
    for count in range(len(parts) - 1, 0, -1):
        path = LIBRARY.joinpath(*parts[:count])
        file = path / "__init__.py" if path.is_dir() else path.with_suffix(".py")
        if file.is_file() and (path.is_file() or not path.is_dir() or count == len(parts) - 1):
            value = _value(file, tuple(parts[count:]))
            return value if index is None else value[int(index)]
    raise KeyError(f"{name}: scenefuse has no such module")


@functools.cache
def _value(file: Path, names: tuple[str, ...]) -> Any:
    body = ast.parse(file.read_text()).body
    for name in names[:-1]:
        body = next((node.body for node in body if isinstance(node, ast.ClassDef) and node.name == name), [])
    for node in body:
        targets = node.targets if isinstance(node, ast.Assign) else [getattr(node, "target", None)]
        for target in targets:
            found = getattr(node, "value", None)
            if isinstance(target, ast.Name) and target.id == names[-1] and found is not None:
                return _evaluated(found, file)
            if isinstance(target, ast.Tuple) and isinstance(found, ast.Tuple):
                for part, value in zip(target.elts, found.elts, strict=True):
                    if isinstance(part, ast.Name) and part.id == names[-1]:
                        return _evaluated(value, file)
        imported = isinstance(node, ast.ImportFrom) and (node.module or "").startswith("scenefuse.")
        if imported and len(names) == 1 and names[0] in {alias.asname or alias.name for alias in node.names}:
            alias = next(alias for alias in node.names if names[0] in (alias.asname, alias.name))
            return constant(f"{node.module.removeprefix('scenefuse.')}.{alias.name}")
    raise KeyError(f"{file.relative_to(ROOT)} has no {'.'.join(names)}")


def _evaluated(node: ast.expr, file: Path) -> Any:
    match node:
        case ast.Constant(value=value):
            return value
        case ast.Name(id=name):
            return _value(file, (name,))
        case ast.Attribute(attr="pi"):
            return math.pi
        case ast.UnaryOp(op=op, operand=inner):
            return OPERATORS[type(op)](_evaluated(inner, file))
        case ast.BinOp(left=left, op=op, right=right):
            return OPERATORS[type(op)](_evaluated(left, file), _evaluated(right, file))
        case ast.Tuple(elts=parts) | ast.List(elts=parts):
            return [_evaluated(part, file) for part in parts]
        case ast.Call(func=ast.Attribute(attr=name), args=[inner]) if name in FUNCTIONS:
            return FUNCTIONS[name](_evaluated(inner, file))
        case ast.Call(keywords=keywords):  # a dataclass's field: setting(default=..., ...) or field(default=...)
            for keyword in keywords:
                if keyword.arg == "default":
                    return _evaluated(keyword.value, file)
            if isinstance(node, ast.Call) and node.args:
                return _evaluated(node.args[0], file)
    raise KeyError(f"{file.relative_to(ROOT)}: {ast.unparse(node)} does not follow from literals")


def _written(value: Any, as_it_was: str, percent: bool) -> str:
    """A number as prose has it: 2,000, 0.25, 1e-6; as a word where it was one."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise KeyError(f"{as_it_was}: {value!r} is no number")
    value = value * 100 if percent else value
    if as_it_was.lower() in WORDS and value in range(len(WORDS)):
        word = WORDS[int(value)]
        return word.capitalize() if as_it_was[0].isupper() else word
    if float(value).is_integer() and abs(value) < 1e12:
        return f"{int(value):,}"
    return re.sub(r"e([+-])0*", lambda sign: "e" + sign[1].replace("+", ""), f"{value:.6g}")


def with_tables(text: str) -> str:
    """`text` with every table as its file has it.

    Raises:
        KeyError: a table has no row in docs/results/index.tsv.
    """
    return TABLE.sub(lambda match: match[1] + _table(match[2]) + match[3], text)


def _table(name: str) -> str:
    entry = measured()[Path(name).name]
    header, *rows = [line.split("\t") for line in (ROOT / "docs" / name).read_text().splitlines()]
    lines = ["|".join(["", *cells, ""]) for cells in [header, ["---"] * len(header), *rows]]
    since = "; the code has changed since" if entry["state"] == OLDER else ""
    return "\n".join([*lines, "", f"*Measured at {entry['commit']}{since}.*", ""])


def measured() -> dict[str, dict[str, str]]:
    """The rows of docs/results/index.tsv by the names of their tables."""
    header, *rows = [line.split("\t") for line in (ROOT / "docs/results/index.tsv").read_text().splitlines()]
    return {row[0]: dict(zip(header, row, strict=True)) for row in rows}


def has_changed(commit: str, packages: str) -> bool | None:
    """Whether modules of these packages are others now than at `commit`; None where Git does not know it.

    Args:
        packages: names below scenefuse/, separated by spaces.
    """
    files = [f"scenefuse/{name}/*.py" for name in packages.split()]
    command = ["git", "-C", str(ROOT), "diff", "--quiet", commit, "--", *files]
    code = subprocess.run(command, capture_output=True, check=False).returncode
    return bool(code) if code in (0, 1) else None


def labels() -> set[str]:
    """The labels of the method, `R8`: the first words of the headings of its pages."""
    found = (
        re.findall(r"^## ([A-Z]\d+) ", page.read_text(), re.MULTILINE) for page in (ROOT / "docs/method").glob("*.md")
    )
    return {label for labels in found for label in labels}


def fresh() -> dict[Path, str]:
    """All documents as they should be."""
    return {page: with_tables(with_numbers(page.read_text())) for page in pages()}

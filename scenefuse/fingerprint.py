"""Content fingerprints of scripts and of every project module they import, for Snakemake's `params:`.

Snakemake does not see an edited library module. A fingerprint in `params:` changes when code that a stage can reach
changes, and not when comments, docstrings, formatting or file dates do.
"""

import ast
import functools
import hashlib
from collections.abc import Iterator
from pathlib import Path


@functools.cache
def fingerprint(script: Path, root: Path) -> str:
    """Twelve hex digits that identify the code of `script` and of all modules below `root` that it imports.

    Raises:
        SyntaxError: a module does not parse.
    """
    digest = hashlib.sha256()
    for module in sorted(_reachable(script, root)):
        digest.update(module.relative_to(root).as_posix().encode() + b"\0")
        digest.update(_normalised(module).encode() + b"\0")
    return digest.hexdigest()[:12]


def _reachable(script: Path, root: Path) -> set[Path]:
    """`script` and, transitively, every module below `root` that it imports, at any depth of its code."""
    todo, seen = [script], set()
    while todo:
        module = todo.pop()
        if module in seen:
            continue
        seen.add(module)
        for name in _imports(_tree(module), module, root):
            parts = name.split(".")
            for length in range(1, len(parts) + 1):
                stem = root.joinpath(*parts[:length])
                todo += [file for file in (stem / "__init__.py", stem.with_suffix(".py")) if file.is_file()]
    return seen


def _imports(tree: ast.Module, module: Path, root: Path) -> Iterator[str]:
    """Absolute dotted names of everything a module may import; names that are no modules do no harm."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = node.module or ""
            if node.level:
                package = module.relative_to(root).parent.parts
                base = ".".join([*package[: len(package) - node.level + 1], *filter(None, [base])])
            yield base
            yield from (f"{base}.{alias.name}" for alias in node.names)


@functools.cache
def _tree(module: Path) -> ast.Module:
    return ast.parse(module.read_text(), filename=str(module))


@functools.cache
def _normalised(module: Path) -> str:
    """The module's code without comments, formatting, and strings that stand alone (docstrings of anything)."""
    tree = ast.parse(module.read_text())
    for node in ast.walk(tree):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            node.body = [part for part in node.body if not _is_docstring(part)] or [ast.Pass()]
    return ast.unparse(ast.fix_missing_locations(tree))


def _is_docstring(part: ast.stmt) -> bool:
    return isinstance(part, ast.Expr) and isinstance(part.value, ast.Constant) and isinstance(part.value.value, str)

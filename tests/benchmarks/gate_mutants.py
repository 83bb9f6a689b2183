"""Does the test of the gate notice when the gate is wrong? Each comparison, `not`, `and` and `or` is inverted in turn.

make mutants
"""

import ast
import copy
import inspect
import sys
import types
from collections.abc import Callable, Iterator
from typing import Any

from unit import test_gate

from scenefuse.geometry.icp import ScaleRange
from scenefuse.register import decision, score

INVERTED: dict[type[ast.cmpop], type[ast.cmpop]] = {
    ast.Lt: ast.GtE, ast.GtE: ast.Lt, ast.Gt: ast.LtE, ast.LtE: ast.Gt, ast.Eq: ast.NotEq, ast.NotEq: ast.Eq,
    ast.Is: ast.IsNot, ast.IsNot: ast.Is, ast.In: ast.NotIn, ast.NotIn: ast.In,
}  # fmt: skip


def gate() -> list[Callable[..., Any]]:
    """The functions that decide: all of the gate's module, and what it asks of a prior and of two poses."""
    own = [f for _, f in inspect.getmembers(decision, inspect.isfunction) if f.__module__ == decision.__name__]
    return [*own, ScaleRange.at_edge, score.distinct]


def mutants(function: Callable[..., Any]) -> Iterator[tuple[int, str, str, types.CodeType]]:
    """Line, the condition as it is and as it becomes, and the code of each mutant of a function."""
    lines, first = inspect.getsourcelines(function)
    tree = ast.parse(inspect.cleandoc("\n" + "".join(lines)) if lines[0][0].isspace() else "".join(lines))
    for k, node in enumerate(ast.walk(tree)):
        if not (isinstance(node, (ast.Compare, ast.BoolOp, ast.UnaryOp)) and _is_condition(node)):
            continue
        changed = copy.deepcopy(tree)
        target = list(ast.walk(changed))[k]
        _invert(target)
        code = compile(ast.fix_missing_locations(changed), function.__code__.co_filename, "exec")
        yield first + node.lineno - 1, ast.unparse(node), ast.unparse(target), _body(code, function)


def _is_condition(node: ast.expr) -> bool:
    return not isinstance(node, ast.UnaryOp) or isinstance(node.op, ast.Not)


def _invert(node: ast.AST) -> None:
    """Change a node in place into its opposite."""
    if isinstance(node, ast.Compare):
        node.ops[0] = INVERTED[type(node.ops[0])]()
    elif isinstance(node, ast.BoolOp):
        node.op = ast.And() if isinstance(node.op, ast.Or) else ast.Or()
    elif isinstance(node, ast.UnaryOp):
        node.operand = ast.UnaryOp(ast.Not(), node.operand)


def _body(module: types.CodeType, function: Callable[..., Any]) -> types.CodeType:
    """The code of a function within that of its source."""
    return next(c for c in module.co_consts if isinstance(c, types.CodeType) and c.co_name == function.__name__)


def caught() -> str | None:
    """What notices that the gate is wrong: the first of its test's cases that fails, or None."""
    checks = [(case.name, lambda case=case: test_gate.check(case)) for case in test_gate.CASES]
    for name, check in [
        *checks,
        ("reported", test_gate.check_reported),
        ("torn", test_gate.check_torn),
        ("mirrored", test_gate.check_mirrored),
    ]:
        try:
            check()
        except Exception:
            return name
    return None


def gate_mutants() -> int:
    """Print a line for each mutant; 1 when one survives."""
    if (wrong := caught()) is not None:
        print(f"the gate fails its own test without any change: {wrong}")
        return 1
    survived = total = 0
    for function in gate():
        original = function.__code__
        for line, before, after, code in mutants(function):
            function.__code__ = code
            try:
                by = caught()
            finally:
                function.__code__ = original
            total, survived = total + 1, survived + (by is None)
            print(f"{function.__qualname__}:{line}  {before}  ->  {after}  {by or 'SURVIVES'}", flush=True)
    print(f"{total} mutants, {total - survived} caught")
    return int(survived > 0)


if __name__ == "__main__":
    sys.exit(gate_mutants())

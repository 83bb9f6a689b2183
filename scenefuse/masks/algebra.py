"""Mask algebra: what an object's masks keep, written as `object and not 'data/house/sky'`."""

import ast
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from scenefuse.core.stage import StageError

Mask = NDArray[np.bool_]


def mask_folders(keep: str) -> list[Path]:
    """The folders of masks that an expression names.

    Args:
        keep: `object`, folders in quotes, `and`, `or`, `not` and brackets.

    Raises:
        StageError: anything else.
    """
    return [Path(str(node.value)) for node in ast.walk(_parsed(keep)) if isinstance(node, ast.Constant)]


def kept_part(keep: str, own: Mask, others: dict[Path, Mask]) -> Mask:
    """The expression's value in one photo.

    Args:
        keep: the expression.
        own: (H, W) the mask of the object.
        others: (H, W) of each folder; a photo without a mask shows nothing of that.
    """

    def value(node: ast.expr) -> Mask:
        if isinstance(node, ast.BoolOp):
            combine = np.logical_and if isinstance(node.op, ast.And) else np.logical_or
            return combine.reduce([value(part) for part in node.values])
        if isinstance(node, ast.UnaryOp):
            return ~value(node.operand)
        return others.get(Path(str(node.value)), np.zeros_like(own)) if isinstance(node, ast.Constant) else own

    return value(_parsed(keep))


def _parsed(keep: str) -> ast.expr:
    def fits(node: ast.AST) -> bool:
        if isinstance(node, ast.BoolOp):
            return all(fits(part) for part in node.values)
        if isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.Not):
            return fits(node.operand)
        if isinstance(node, ast.Constant):
            return isinstance(node.value, str)
        return isinstance(node, ast.Name) and node.id == "object"

    try:
        expression = ast.parse(keep.strip(), mode="eval").body
    except SyntaxError:
        expression = None
    if expression is None or not fits(expression):
        raise StageError(
            f"object.masks.keep cannot be read: {keep}; write object, folders of masks in quotes, and, or, not and "
            "brackets, for instance: object and not 'data/house/sky'"
        )
    return expression

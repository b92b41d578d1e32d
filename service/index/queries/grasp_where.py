"""The language that chooses grasps (`service.model.where`), asked of the rows of the index."""

from __future__ import annotations

import operator
from collections.abc import Callable
from typing import Any, Final

from sqlalchemy import ColumnElement, and_, not_, or_

from service.model.errors import InputError
from service.model.metrics import indexed
from service.model.where import Flag, Joined, Node, Not, OfMetric, OfType

#: Columns by name, of the table of grasps or of rows drawn from it.
Columns = Any

_METRICS: Final = frozenset(metric.name for metric in indexed())
_OPERATORS: Final[dict[str, Callable[[Any, Any], ColumnElement[bool]]]] = {
    "<": operator.lt,
    "<=": operator.le,
    ">": operator.gt,
    ">=": operator.ge,
    "=": operator.eq,
    "!=": operator.ne,
}
_FLAGS: Final[dict[str, Callable[[Columns], ColumnElement[bool]]]] = {
    "judged": lambda grasps: grasps.success.is_not(None),
    "valid": lambda grasps: grasps.valid.is_(True),
    "held": lambda grasps: grasps.success.is_(True),
    # What judges a grasp that was planned in a scene is the lift.
    "lift": lambda grasps: and_(grasps.scene_kind != "free", grasps.success.is_(True)),
    "lift_hard": lambda grasps: grasps.lift_hard.is_(True),
}


def truth(node: Node, grasps: Columns) -> ColumnElement[bool]:
    """An expression in SQL: true or false of each row, never unknown, so that `not` is what is not so.

    Raises:
        InputError: it asks for what the index does not hold.
    """
    if isinstance(node, Joined):
        return (or_ if node.word == "or" else and_)(*(truth(part, grasps) for part in node.parts))
    if isinstance(node, Not):
        return not_(truth(node.part, grasps))
    if isinstance(node, Flag):
        if node.name not in _FLAGS:
            raise _unknown(node.name)
        # A test for truth is false of NULL.
        return _FLAGS[node.name](grasps)
    if isinstance(node, OfMetric):
        if node.name not in _METRICS:
            raise _unknown(node.name)
        return _known(grasps[node.name], node.op, node.bound)
    if isinstance(node, OfType):
        return _known(grasps.grasp_type, node.op, int(node.kind))
    return _OPERATORS[node.op](grasps[node.name], node.word)


def _known(column: Any, op: str, value: float) -> ColumnElement[bool]:
    return and_(column.is_not(None), _OPERATORS[op](column, value))


def _unknown(name: str) -> InputError:
    return InputError(f"the index does not hold {name!r}, the shards do: `graspd grasps where` reads them")

"""Filter expressions (`service.model.where`) evaluated on base shards."""

from collections.abc import Callable, Mapping
from functools import reduce
from operator import and_, or_
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from graspd.service.model import where as expressions
from graspd.service.model.metrics import GRASP_METRICS, GraspMetric
from graspd.service.model.where import Connective, Flag, MetricComparison, Negation, Node, TypeComparison, parse_where
from graspd.service.store import validity
from graspd.service.store.manifests import INDEX_THRESHOLD_M

Array = NDArray[Any]
Mask = NDArray[np.bool_]
#: Function from columns and attributes (hand, object) of a base shard to a mask (N,).
Test = Callable[[Mapping[str, Array], Mapping[str, Any]], Mask]

_METRICS: Final = {metric.name: metric for metric in GRASP_METRICS}
_MASKS: Final = {"valid": validity.valid_mask, "feasible": validity.feasible_mask, "validated": validity.validated_mask}
#: Columns of flags, which are true where the column is 1.
_FLAGS: Final = {"held": "quality/success", "lift": "quality/lift_outcome", "lift_hard": "quality/lift_hard"}


def compile_expression(text: str) -> Test:
    """Compile an expression, or raise InputError; comparisons with a missing metric or nan are false."""
    tree = parse_where(text)
    return lambda columns, said: _evaluate(tree, columns, said)


def _evaluate(node: Node, columns: Mapping[str, Array], said: Mapping[str, Any]) -> Mask:
    count = len(columns["quality/valid"])
    if isinstance(node, Connective):
        join = or_ if node.word == "or" else and_
        return reduce(join, (_evaluate(part, columns, said) for part in node.parts))
    if isinstance(node, Negation):
        return ~_evaluate(node.part, columns, said)
    if isinstance(node, Flag):
        if node.name in _MASKS:
            return _MASKS[node.name](columns)
        path = _FLAGS[node.name]
        return np.asarray(columns[path]) == 1 if path in columns else np.zeros(len(columns["quality/valid"]), bool)
    compare = expressions.OPERATORS[node.op]
    if isinstance(node, MetricComparison):
        values = metric_values(_METRICS[node.name], columns)
        with np.errstate(invalid="ignore"):
            return np.isfinite(values) & np.asarray(compare(values, node.bound))
    if isinstance(node, TypeComparison):
        kinds = np.asarray(columns.get("quality/grasp_type", np.full(count, -1)))
        return np.asarray(compare(kinds, int(node.kind))) & (kinds >= 0)
    return np.full(count, bool(compare(str(said.get(node.name, "")), node.word)))


def metric_values(metric: GraspMetric, columns: Mapping[str, Array]) -> NDArray[np.float64]:
    """Return a metric (N,) of the grasps of a base shard; nan if the shard does not have it."""
    if metric.path not in columns:
        return np.full(len(columns["quality/valid"]), np.nan)
    values = np.asarray(columns[metric.path], float)
    if not metric.swept:
        return values
    thresholds = np.asarray(columns["quality/thresholds_m"], float)
    return np.asarray(values[:, int(np.argmin(np.abs(thresholds - INDEX_THRESHOLD_M)))])

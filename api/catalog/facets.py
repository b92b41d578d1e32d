"""Facets of a list of grasps: numbers of grasps by value, and distributions of metrics.

Counts of a facet ignore the facet's own filter, so they tell what another choice would find. They come from a sample of
about `SAMPLE` grasps in memory, and are estimates for larger lists."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from graspd.api.models import GraspQuery
from graspd.service.model.metrics import AXIS_MEANINGS, GraspMetric, GraspType, IndexLevel, indexed_metrics

#: Number of grasps from which facets are counted: reading more than these takes longer than a page may.
SAMPLE: Final = 4000
BINS: Final = 24
_METRICS: Final = indexed_metrics(IndexLevel.OFFERED)
_WORDS: Final = ("hand", "object", "scene_kind", "robust_weakest")
_NUMBERS: Final = ("valid", "success", "grasp_type", "digits", "neighbours", "lift_hard")
COLUMNS: Final = (*_WORDS, *_NUMBERS, *(metric.name for metric in _METRICS))
#: Codes of the digits of a pinch: the thumb and one other.
PINCH: Final = tuple(1 + (1 << finger) for finger in range(1, 6))
#: Values of each facet in words, with the fields of the query that select them.
_FACETS: Final[dict[str, list[tuple[str, dict[str, str]]]]] = {
    "Verdict": [("valid", {"valid": "true"}), ("rejected", {"valid": "false"}), ("not judged", {"validated": "false"})],
    "Type": [
        ("power: palm or whole fingers", {"type": "power"}),
        ("precision: fingertips", {"type": "precision"}),
        ("pinch: thumb and one fingertip", {"type": "pinch"}),
        ("lateral: sides of fingers", {"type": "lateral"}),
    ],
    "Scene": [
        ("none: free object", {"scene": "free"}),
        ("any scene", {"scene": "any"}),
        *((kind, {"scene": kind}) for kind in ("table", "bin", "shelf")),
        ("from a file", {"scene": "file"}),
    ],
    "Neighbours": [("some", {"neighbours": "true"}), ("none", {"neighbours": "false"})],
    "Lift at half friction": [("lifted", {"lift_hard": "true"}), ("not lifted", {"lift_hard": "false"})],
    "First failure": [(words, {"robust_weakest": axis.word}) for axis, words in AXIS_MEANINGS.items()],
}
_TRUTHS: Final = {"true": 1, "false": 0}

Mask = NDArray[np.bool_]
Columns = Mapping[str, NDArray[Any]]


@dataclass(frozen=True)
class FacetOption:
    words: str
    change: dict[str, str | None]
    """Fields of the query after a click: those of the value, or None for each if it is chosen already."""
    count: int
    chosen: bool


@dataclass(frozen=True)
class Facet:
    title: str
    values: list[FacetOption]


@dataclass(frozen=True)
class MetricFacet:
    """Distribution of a metric; equal bins from `low` to `high`."""

    metric: GraspMetric
    low: float
    high: float
    counts: list[int]


@dataclass(frozen=True)
class Facets:
    found: int
    is_estimate: bool
    values: list[Facet]
    metrics: list[MetricFacet]


def columns_of(rows: Sequence[Sequence[Any]]) -> Columns:
    """Return rows of `COLUMNS` as arrays; missing numbers are nan, missing words empty."""
    parts = list(zip(*rows, strict=True)) or [()] * len(COLUMNS)
    return {
        name: np.array([one or "" for one in part], str) if name in _WORDS else np.array(part, float)
        for name, part in zip(COLUMNS, parts, strict=True)
    }


def count_facets(query: GraspQuery, columns: Columns, share: float, pairs: tuple[Columns, float]) -> Facets:
    """Count a sample of the grasps that pass all filters without facets.

    Args:
        columns: the sample; if it is a part of the list, only with the query's hand and object.
        share: share of the grasps in the sample.
        pairs: the same for all hands and objects."""
    given = {name: str(value).lower() for name, value in query if value is not None}
    found = []
    for name in ("object", "hand"):
        words = {*pairs[0][name].tolist(), *filter(None, [getattr(query, name)])}
        values = [(word, {name: word}) for word in sorted(words)]
        found.append(_facet(name.capitalize(), values, given | _named(query), *pairs))
    given |= _named(query)
    found += [_facet(title, values, given, columns, share) for title, values in _FACETS.items()]
    metrics = [_metric_facet(metric, given, columns) for metric in _METRICS]
    every = round(int(_others(given, columns, ()).sum()) / share)
    return Facets(every, share < 1, [one for one in found if one], [one for one in metrics if one])


def _named(query: GraspQuery) -> dict[str, str]:
    """Return names, whose case has a meaning."""
    return {name: value for name in ("hand", "object") if (value := getattr(query, name))}


def _mask(field: str, value: str, c: Columns) -> Mask:
    """Test the columns as the index tests them for one field of a query."""
    end, _, metric = field.partition("_")
    if end in ("min", "max") and metric in COLUMNS:
        return np.asarray(c[metric] >= float(value) if end == "min" else c[metric] <= float(value))
    if field == "type":
        pinch = np.isin(c["digits"], PINCH) if value == "pinch" else True
        return (c["grasp_type"] == GraspType["PRECISION" if value == "pinch" else value.upper()]) & pinch
    if field == "scene":
        return np.asarray(c["scene_kind"] != "free" if value == "any" else c["scene_kind"] == value)
    if field == "neighbours":
        return np.asarray((c["neighbours"] > 0) == _TRUTHS[value])
    if field == "validated":
        return np.asarray(np.isfinite(c["success"]) == _TRUTHS[value])
    if field == "valid" and value == "false":
        return (c["valid"] == 0) & np.isfinite(c["success"])
    return np.asarray(c[field] == _TRUTHS.get(value, value)) if field in COLUMNS else np.ones(len(c["hand"]), bool)


def _others(given: Mapping[str, str], columns: Columns, own: Sequence[str]) -> Mask:
    """Test the columns for all fields except a facet's own ones."""
    masks = [_mask(field, value, columns) for field, value in given.items() if field not in own]
    return np.asarray(np.logical_and.reduce([np.ones(len(columns["hand"]), bool), *masks]))


def _facet(
    title: str, values: Sequence[tuple[str, dict[str, str]]], given: Mapping[str, str], columns: Columns, share: float
) -> Facet | None:
    own: dict[str, str | None] = {field: None for _, fields in values for field in fields}
    others, found = _others(given, columns, tuple(own)), []
    for words, fields in values:
        mask = others & np.logical_and.reduce([_mask(*one, columns) for one in fields.items()])
        chosen = fields.items() <= given.items()
        if mask.any() or chosen:
            found.append(
                FacetOption(words, {**own, **({} if chosen else fields)}, round(int(mask.sum()) / share), chosen)
            )
    # A choice of one value is none.
    return Facet(title, found) if len(found) > 1 or any(value.chosen for value in found) else None


def _metric_facet(metric: GraspMetric, given: Mapping[str, str], columns: Columns) -> MetricFacet | None:
    own, values = (f"min_{metric.name}", f"max_{metric.name}"), columns[metric.name]
    bounds = [float(given[name]) for name in own if name in given]
    ends = [*values[np.isfinite(values)].tolist(), *bounds]
    if not ends or (min(ends) == max(ends) and not bounds):
        return None
    low, high = min(ends), max(ends)
    shown = values[_others(given, columns, own) & np.isfinite(values)]
    return MetricFacet(metric, low, high, np.histogram(shown, BINS, (low, high))[0].tolist())

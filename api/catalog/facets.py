"""Facets of a list of grasps: numbers of grasps by value, and distributions of metrics.

Counts of a facet ignore the facet's own filter, so they tell what another choice would find. They come from a sample of
about `SAMPLE` grasps in memory, and are estimates for larger lists."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from graspd.api.models import GraspQuery
from graspd.service.model.metrics import AXIS_MEANINGS, GraspMetric, GraspType, IndexLevel, indexed_metrics

#: Number of grasps from which facets are counted: reading more than these takes longer than a page may.
SAMPLE: Final = 5000
BINS: Final = 24
METRICS: Final = indexed_metrics(IndexLevel.OFFERED)
_FLAGS: Final = ("valid", "success", "grasp_type", "digits", "neighbours", "lift_hard")
_WORDS: Final = ("hand", "object", "scene_kind", "robust_weakest")
COLUMNS: Final = (*_WORDS, *_FLAGS, *(metric.name for metric in METRICS))
#: Digits of a pinch: two, one of them the thumb.
PINCH: Final = tuple(1 + (1 << finger) for finger in range(1, 6))

Mask = NDArray[np.bool_]
Columns = Mapping[str, NDArray[Any]]
_PRECISION: Final = int(GraspType.PRECISION)
#: For each value of a facet: words, fields of the query, and the test of the columns.
_Values = Sequence[tuple[str, dict[str, str], Callable[[Columns], Mask]]]


def columns_of(rows: Sequence[Sequence[Any]]) -> Columns:
    """Return rows of `COLUMNS` as arrays; numbers are nan, words empty, where the index has none."""
    parts = list(zip(*rows, strict=True)) or [()] * len(COLUMNS)
    return {
        name: np.array([one or "" for one in part], str) if name in _WORDS else np.array(part, float)
        for name, part in zip(COLUMNS, parts, strict=True)
    }


def _equal(column: str, field: str, values: Mapping[str, Any]) -> _Values:
    return [(words, {field: word}, lambda c, v=value: c[column] == v) for word, (words, value) in values.items()]  # type: ignore[misc]


def _kinds() -> dict[str, tuple[str, _Values]]:
    """Return title and values of each facet with fixed values."""
    yes = {"true": 1, "false": 0}
    return {
        "verdict": (
            "Verdict",
            [
                ("valid", {"valid": "true"}, lambda c: c["valid"] == 1),
                ("rejected", {"valid": "false"}, lambda c: (c["valid"] == 0) & np.isfinite(c["success"])),
                ("not judged", {"validated": "false"}, lambda c: np.isnan(c["success"])),
            ],
        ),
        "type": (
            "Type",
            [
                ("power: palm or whole fingers", {"type": "power"}, lambda c: c["grasp_type"] == int(GraspType.POWER)),
                ("precision: fingertips", {"type": "precision"}, lambda c: c["grasp_type"] == _PRECISION),
                ("pinch: thumb and one fingertip", {"type": "pinch"}, is_pinch),
                ("lateral: sides of fingers", {"type": "lateral"}, lambda c: c["grasp_type"] == int(GraspType.LATERAL)),
            ],
        ),
        "scene": (
            "Scene",
            [
                ("any scene", {"scene": "any"}, lambda c: c["scene_kind"] != "free"),
                *_equal("scene_kind", "scene", {"free": ("none: free object", "free")}),
                *_equal("scene_kind", "scene", {kind: (kind, kind) for kind in ("table", "bin", "shelf")}),
                *_equal("scene_kind", "scene", {"file": ("from a file", "file")}),
            ],
        ),
        "neighbours": (
            "Neighbours",
            [
                ("some", {"neighbours": "true"}, lambda c: c["neighbours"] > 0),
                ("none", {"neighbours": "false"}, lambda c: c["neighbours"] == 0),
            ],
        ),
        "lift_hard": (
            "Lift at half friction",
            _equal("lift_hard", "lift_hard", dict(zip(yes, (("lifted", 1), ("not lifted", 0)), strict=True))),
        ),
        "robust_weakest": (
            "First failure",
            _equal(
                "robust_weakest",
                "robust_weakest",
                {axis.word: (words, axis.word) for axis, words in AXIS_MEANINGS.items()},
            ),
        ),
    }


def is_pinch(columns: Columns) -> Mask:
    return (columns["grasp_type"] == _PRECISION) & np.isin(columns["digits"], PINCH)


@dataclass(frozen=True)
class FacetValue:
    words: str
    fields: dict[str, str | None]
    """Changes of the query by a click: the value's own fields, or None for each to remove a chosen value."""
    count: int
    chosen: bool


@dataclass(frozen=True)
class Facet:
    title: str
    values: list[FacetValue]


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


def count_facets(query: GraspQuery, columns: Columns, share: float, pairs: tuple[Columns, float]) -> Facets:
    """Count a sample of the grasps that pass all filters without facets.

    Args:
        columns: the sample; with hand and object of the query if it is smaller than the list.
        share: share of the grasps in the sample.
        pairs: the same for all hands and objects."""
    given = {name: str(value).lower() for name, value in query if value is not None and not isinstance(value, float)}
    kinds = _kinds()
    found = []
    for name in ("object", "hand"):
        words = sorted({*np.unique(pairs[0][name]).tolist(), *filter(None, [getattr(query, name)])})
        values = _equal(name, name, {word: (word, word) for word in words})
        own, scale = pairs
        found.append(_facet(name.capitalize(), values, query, given, own, _masks(query, own, kinds), name, scale))
    masks = _masks(query, columns, kinds)
    for name, (title, values) in kinds.items():
        found.append(_facet(title, values, query, given, columns, masks, name, share))
    inside = [one for metric in METRICS if (one := _metric_facet(metric, query, columns, masks)) is not None]
    every = int(np.logical_and.reduce(list(masks.values())).sum())
    return Facets(round(every / share), share < 1, [one for one in found if one is not None], inside)


def _masks(query: GraspQuery, columns: Columns, kinds: Mapping[str, tuple[str, _Values]]) -> dict[str, Mask]:
    """Return the test of each facet's filter on the columns."""
    everything = np.ones(len(columns["hand"]), bool)
    masks = {name: columns[name] == word for name in ("hand", "object") if (word := getattr(query, name))}
    given = {name: str(value).lower() for name, value in query if value is not None}
    for name, (_, values) in kinds.items():
        for _, fields, test in values:
            if fields.items() <= given.items():
                masks[name] = masks.get(name, everything) & test(columns)
    for flag, column in (("validated", np.isfinite(columns["success"])), ("success", columns["success"] == 1)):
        if (wanted := getattr(query, flag)) is not None:
            masks[flag if flag == "success" else "verdict"] = column == wanted
    for metric in METRICS:
        for end, compare in (("min", np.greater_equal), ("max", np.less_equal)):
            if (bound := getattr(query, f"{end}_{metric.name}")) is not None:
                masks[metric.name] = masks.get(metric.name, everything) & compare(columns[metric.name], bound)
    return masks | {"": everything}


def _others(masks: Mapping[str, Mask], own: str) -> Mask:
    return np.asarray(np.logical_and.reduce([mask for name, mask in masks.items() if name != own]))


def _facet(
    title: str,
    values: _Values,
    query: GraspQuery,
    given: Mapping[str, str],
    columns: Columns,
    masks: Mapping[str, Mask],
    name: str,
    share: float,
) -> Facet | None:
    others, found = _others(masks, name), []
    names = {field: None for _, fields, _ in values for field in fields}
    for words, fields, test in values:
        count, chosen = round(int((test(columns) & others).sum()) / share), fields.items() <= given.items()
        if count or chosen:
            found.append(FacetValue(words, dict(names) if chosen else names | fields, count, chosen))
    chosen_any = any(value.chosen for value in found)
    return Facet(title, found) if len(found) > 1 or chosen_any else None


def _metric_facet(
    metric: GraspMetric, query: GraspQuery, columns: Columns, masks: Mapping[str, Mask]
) -> MetricFacet | None:
    values = columns[metric.name]
    known = values[np.isfinite(values)]
    bounds = [getattr(query, f"{end}_{metric.name}") for end in ("min", "max")]
    if not known.size or known.min() == known.max():
        return None if bounds == [None, None] else MetricFacet(metric, *(b or 0.0 for b in bounds), [0] * BINS)
    low, high = float(known.min()), float(known.max())
    counts, _ = np.histogram(values[np.isfinite(values) & _others(masks, metric.name)], BINS, (low, high))
    return MetricFacet(metric, low, high, counts.tolist())

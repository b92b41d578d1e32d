"""The cheapest setting that the stored chart of speed against accuracy promises for a wanted accuracy."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Any, Final

from service.model.domain import AUTO, OFFERED, JobRequest
from service.model.errors import InputError
from service.store.store import Store
from service.store.study_records import latest

#: Accuracies that a target may name, and whether more is better.
METRICS: Final = {"gsr": True, "epsilon": True, "pd_mm": False}

_TARGET: Final = re.compile(r"\s*(gsr|epsilon|pd_mm)\s*(>=|<=)\s*([0-9]*\.?[0-9]+)\s*")


def explicit(store: Store, request: JobRequest) -> JobRequest:
    """The request with a fidelity in the place of `auto`.

    Raises:
        InputError: no chart was published, or nothing in it meets the target.
    """
    return Resolver(store)(request)


class Resolver:
    """`explicit` for many requests: the chart is read once, when the first of them needs it."""

    def __init__(self, store: Store) -> None:
        self._store = store
        self._chart: dict[str, Any] | None = None
        self._hands: set[str] = set()
        self._pairs: set[tuple[str, str]] = set()
        self._found: dict[tuple[str, str, str, str], str] = {}

    def __call__(self, request: JobRequest) -> JobRequest:
        """The request with a fidelity in the place of `auto`; see `explicit`."""
        if request.fidelity != AUTO:
            return request
        if self._chart is None:
            self._read()
        pair = (request.hand, request.object)
        # What the chart does not know is alike to it.
        hand = request.hand if request.hand in self._hands else ""
        key = (request.method, request.target, *(pair if pair in self._pairs else (hand, "")))
        if key not in self._found:
            method, target, hand, object_ = key
            self._found[key] = cheapest(self._chart or {}, target, method=method, hand=hand, object_=object_)
        return request.model_copy(update={"fidelity": self._found[key], "target": ""})

    def _read(self) -> None:
        self._chart = latest(self._store, "charts")
        if self._chart is None:
            raise InputError("fidelity auto needs a chart: run `graspd chart --publish` once, or name a fidelity")
        self._pairs = {(run["hand"], run["object"]) for run in self._chart["runs"]}
        self._hands = {hand for hand, _ in self._pairs}


def parse_target(text: str) -> tuple[str, float]:
    """`gsr>=0.6` as its metric and bound.

    Raises:
        InputError: another form, or a bound on the side where it would ask for a worse grasp.
    """
    found = _TARGET.fullmatch(text)
    if found is None:
        raise InputError(f"{text!r} is no target; write gsr>=0.6, epsilon>=0.2 or pd_mm<=1")
    metric, sign, bound = found.groups()
    if (sign == ">=") != METRICS[metric]:
        raise InputError(f"{text!r}: write {metric}{'>=' if METRICS[metric] else '<='}{bound}")
    return metric, float(bound)


def cheapest(
    chart: Mapping[str, Any], target: str, *, method: str, hand: str, object_: str, offered: Sequence[str] = OFFERED
) -> str:
    """The fidelity of a method with most valid grasps per second among those that meet a target.

    What was measured of this very hand and object counts; else of this hand; else everything.

    Args:
        chart: as `graspd chart` writes it.
        target: see `parse_target`.
        method: the planner.
        hand: name of the hand.
        object_: name of the object.
        offered: fidelities to choose from.

    Raises:
        InputError: no such target, nothing measured of the method, or nothing that meets the target.
    """
    metric, bound = parse_target(target)
    runs = [run for run in chart["runs"] if run["method"] == method and run["fidelity"] in offered]
    known = [run for run in runs if run.get(metric) is not None]
    for same in (("hand", "object"), ("hand",), ()):
        wanted = {"hand": hand, "object": object_}
        near = [run for run in known if all(run[name] == wanted[name] for name in same)]
        if near:
            break
    else:
        raise InputError(f"the stored chart has no run of {method}; run `graspd chart --publish`, or name a fidelity")
    means = {
        fidelity: (_mean(near, fidelity, "valid_per_second"), _mean(near, fidelity, metric))
        for fidelity in dict.fromkeys(run["fidelity"] for run in near)
    }
    good = [name for name, (_, value) in means.items() if (value >= bound if METRICS[metric] else value <= bound)]
    if not good:
        best = (max if METRICS[metric] else min)(value for _, value in means.values())
        raise InputError(f"no fidelity of {method} meets {target}; the best measured {metric} is {best:.3g}")
    return max(good, key=lambda name: means[name][0])


def _mean(runs: Sequence[Mapping[str, Any]], fidelity: str, name: str) -> float:
    values = [float(run[name] or 0.0) for run in runs if run["fidelity"] == fidelity]
    return sum(values) / len(values)

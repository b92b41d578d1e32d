"""Choice of the cheapest fidelity that reaches a required accuracy in the stored charts."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Final, Literal, NamedTuple

from graspd.service.model.domain import JobRequest
from graspd.service.model.errors import InputError
from graspd.service.model.fidelity import AUTO, OFFERED
from graspd.service.model.records import FidelityChoice
from graspd.service.model.renamed import convert_chart
from graspd.service.model.studies import FREE, IN_SCENE, IN_SCENES, SPEEDS
from graspd.service.store.integrity import get_document
from graspd.service.store.records import latest_record_key, scene_chart_kind
from graspd.service.store.store import Store

Row = Mapping[str, Any]
Near = Literal["hand and object", "hand", "all"]

_TARGET: Final = re.compile(r"\s*([a-z_]+)\s*(>=|<=)\s*([0-9]*\.?[0-9]+)\s*")
_EXAMPLES: Final = {False: "gsr>=0.6, epsilon>=0.2 or pd_mm<=1", True: "lift>=0.9, lift_hard>=0.7 or robust>=0.95"}
#: Names and properties of the runs of a chart that are similar to a request, the most similar first.
_NEAR: Final[tuple[tuple[Near, tuple[str, ...]], ...]] = (
    ("hand and object", ("hand", "object")),
    ("hand", ("hand",)),
    ("all", ()),
)


class ChosenFidelity(NamedTuple):
    fidelity: str
    measured_on: Near
    reached: float


@dataclass
class _Chart:
    """Stored chart, and the fidelities chosen from it."""

    key: str
    content: Row
    found: dict[tuple[str, str, str, str], ChosenFidelity] = field(default_factory=dict)

    @cached_property
    def pairs(self) -> set[tuple[str, str]]:
        return {(run["hand"], run["object"]) for run in self.content["runs"]}

    @cached_property
    def hands(self) -> set[str]:
        return {hand for hand, _ in self.pairs}


class FidelityResolver:
    """Replaces the fidelity `auto`, by the newest chart of free objects or of the kind of scene."""

    def __init__(self, store: Store) -> None:
        self._store = store
        self._charts: dict[Any, _Chart] = {}

    def __call__(self, request: JobRequest) -> JobRequest:
        """Return the request with `auto` replaced by a fidelity; errors as in `choose`."""
        return self.choose(request)[0]

    def choose(self, request: JobRequest) -> tuple[JobRequest, FidelityChoice | None]:
        """Return the request with `auto` replaced, and how (None: unchanged); InputError without a match."""
        if request.fidelity != AUTO:
            return request, None
        chart = self._chart(request)
        pair = (request.hand, request.object)
        # The result is the same for all hands without runs in the chart.
        hand = request.hand if request.hand in chart.hands else ""
        key = (request.method, request.target, *(pair if pair in chart.pairs else (hand, "")))
        if key not in chart.found:
            method, target, hand, object_ = key
            chart.found[key] = cheapest_fidelity(chart.content, target, method=method, hand=hand, object_=object_)
        found = chart.found[key]
        reached = round(found.reached, 4)
        how = FidelityChoice(target=request.target, chart=chart.key, measured_on=found.measured_on, reached=reached)
        return request.model_copy(update={"fidelity": found.fidelity, "target": ""}), how

    def _chart(self, request: JobRequest) -> _Chart:
        if request.scene not in self._charts:
            key = latest_record_key(self._store, scene_chart_kind(request.scene_spec))
            if not key:
                raise InputError(_no_chart_text(request))
            self._charts[request.scene] = _Chart(key, convert_chart(get_document(self._store, key)))
        return self._charts[request.scene]


def _no_chart_text(request: JobRequest) -> str:
    if not request.in_scene:
        return "fidelity auto needs a chart: run `graspd chart --publish` once, or name a fidelity"
    scene = request.scene_spec.kind
    asked, named = ("FILE", "of a scene file with the same supports") if scene == "file" else (scene, f"in a {scene}")
    return (
        f"fidelity auto needs a chart of scenes, here {named}, because charts of free objects have no lifts: run "
        f"`python -m benchmarks.scenes_chart --scene {asked} --publish` once in a checkout, or name a fidelity"
    )


def parse_target(text: str, *, in_scene: bool = False) -> tuple[str, float]:
    """Parse a target (`gsr>=0.6`, in a scene `lift>=0.9`) into metric and bound; InputError if invalid."""
    known, examples = IN_SCENES if in_scene else FREE, _EXAMPLES[in_scene]
    found = _TARGET.fullmatch(text)
    if found is None:
        raise InputError(f"{text!r} is no target; write {examples}")
    metric, sign, bound = found.groups()
    if metric not in known:
        where = "in scenes" if in_scene else "of free objects"
        raise InputError(f"{text!r}: charts {where} contain {', '.join(known)}; write {examples}")
    if (sign == ">=") != known[metric]:
        raise InputError(f"{text!r}: write {metric}{'>=' if known[metric] else '<='}{bound}")
    return metric, float(bound)


def cheapest_fidelity(chart: Row, target: str, *, method: str, hand: str, object_: str) -> ChosenFidelity:
    """Return the method's fidelity with most valid grasps per second that meets a target, else InputError.

    Runs of the same hand and object count, else of the hand, else all; in scenes, only grasps planned there.
    """
    in_scene = "scene" in chart
    metric, bound = parse_target(target, in_scene=in_scene)
    more = (IN_SCENES if in_scene else FREE)[metric]
    again = f"`{'python -m benchmarks.scenes_chart' if in_scene else 'graspd chart'} --publish`"
    runs = [run for run in chart["runs"] if run["method"] == method and run["fidelity"] in OFFERED]
    runs = [run for run in runs if run.get("way", IN_SCENE) == IN_SCENE]
    if not runs:
        raise InputError(f"the stored chart has no run of {method}; run {again}, or name a fidelity")
    found = _most_similar_runs(runs, metric, {"hand": hand, "object": object_})
    if found is None:
        raise InputError(f"the stored chart lacks {metric} of {method}; run {again}, or ask for another target")
    measured_on, near = found
    names = dict.fromkeys(run["fidelity"] for run in near)
    means = {name: (_mean_speed(near, name), _mean_metric(near, name, metric)) for name in names}
    known = {name: (speed, value) for name, (speed, value) in means.items() if value is not None}
    good = [name for name, (_, value) in known.items() if (value >= bound if more else value <= bound)]
    if not good:
        best = (max if more else min)(value for _, value in known.values())
        raise InputError(f"no fidelity of {method} meets {target}; the best measured {metric} is {best:.3g}")
    chosen = max(good, key=lambda name: known[name][0])
    return ChosenFidelity(chosen, measured_on, known[chosen][1])


def _most_similar_runs(runs: Sequence[Row], metric: str, wanted: Mapping[str, str]) -> tuple[Near, list[Row]] | None:
    """Return the most similar runs that include `metric`, with the kind of similarity; None without any."""
    for measured_on, same in _NEAR:
        near = [run for run in runs if all(run[name] == wanted[name] for name in same)]
        if any(run.get(metric) is not None for run in near):
            return measured_on, near
    return None


def _mean_speed(runs: Sequence[Row], fidelity: str) -> float:
    """Return the mean speed of a fidelity's runs; a run without a speed counts as 0."""
    own = [run for run in runs if run["fidelity"] == fidelity]
    return sum(float(next((run[key] for key in SPEEDS if key in run), None) or 0.0) for run in own) / len(own)


def _mean_metric(runs: Sequence[Row], fidelity: str, metric: str) -> float | None:
    """Return the mean of a metric over the runs of a fidelity that have a value; None without any."""
    values = [float(run[metric]) for run in runs if run["fidelity"] == fidelity and run.get(metric) is not None]
    return sum(values) / len(values) if values else None

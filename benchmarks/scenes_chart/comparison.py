"""Comparison of two modes: grasps planned in a scene, and free grasps filtered in the same scene.

Methods that cannot plan in scenes run only in the second mode. Both modes use the scenes of an object in turn and have
the same tests. Speed is lifted grasps per second, on a CPU per core-second, so that other load does not change it."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from graspd.service.model.clock import timestamp
from graspd.service.model.digests import digest_json
from graspd.service.model.errors import InputError
from graspd.service.model.scene_spec import SceneSpec
from graspd.service.model.studies import FILTERED, IN_SCENE, IN_SCENES
from graspd.service.model.version import PACKAGE_VERSION, STAGE_REVISIONS
from graspd.studies.bench import clock_of, device_name
from graspd.studies.chart.chart import TRUE_ERROR_M, ChartObject
from graspd.studies.chart.statistics import mark_fronts, rounded_json_value, seconds_to_valid
from graspd.studies.chart.trials import FRICTION, MODELS_SEED, SEED, WARM_SEED, Setting
from graspd.worker.grasps import GraspSet
from graspd.worker.hands.model import HandModel
from graspd.worker.objects.model import ObjectModel
from graspd.worker.planners import PlanRequest, method, synthesize
from graspd.worker.quality.intervals import wilson_interval, wilson_interval_of_mean
from graspd.worker.quality.table import measure
from graspd.worker.scenes.kinds import rest_poses, supports_of
from graspd.worker.scenes.rollout import lift_rollout
from graspd.worker.scenes.trajectory import plan_trajectory
from graspd.worker.simulation.environment import PlacedGrasps, Scenes
from graspd.worker.validation.decomposition import ConvexPieces, decompose
from graspd.worker.validation.lifting import validate_lifts
from graspd.worker.validation.robust import validate_robustness

Row = dict[str, Any]
Say = Callable[[str], None]

#: Columns with shares of all candidates.
SHARES: Final = ("clear", "lift", "lift_dexgraspbench", "lift_hard")
SPEEDS: Final = (("valid_per_second", "seconds"), ("end_to_end_per_second", "end_seconds"))
FORM: Final = 2  # increase when the columns of a row change: cached results are then discarded
#: Key of the speed in candidates, for each speed in lifted grasps.
RAW: Final = {"valid_per_second": "grasps_per_second", "end_to_end_per_second": "candidates_end_to_end_per_second"}
#: Time per grasp [s] from which on the time to the first grasp is not measured in an extra run.
_SHORT_S: Final = 1.0
_NOTHING: Final = {**{f"{name}_count": 0 for name in SHARES}, "robust_sum": 0.0, "first_seconds": 0.0}


@dataclass
class ObjectScenes:
    """An object and its scenes, which are computed on first use."""

    thing: ChartObject
    spec: SceneSpec

    @cached_property
    def validator_object(self) -> ObjectModel:
        """The validator's object, the same for all settings."""
        return self.thing.load(TRUE_ERROR_M)

    @cached_property
    def pieces(self) -> ConvexPieces:
        return decompose(self.validator_object)

    @cached_property
    def scenes(self) -> Scenes:
        poses = rest_poses(self.spec, self.validator_object, count=4, seed=SEED)["scene/object_pose"]
        return Scenes(supports_of(self.spec), poses)


def scene_chart(
    hands: Sequence[HandModel],
    things: Sequence[ChartObject],
    settings: Sequence[Setting],
    spec: SceneSpec,
    *,
    models: int,
    work: Path | None,
    say: Say,
    keep: Callable[[Row], None],
) -> Row:
    """Run all settings on all pairs; a setting's `batch` is its number of grasps per pair.
    Each lifted grasp is lifted again in `models` models around the nominal one. An interrupted run resumes from the
    results in the folder `work`. `say`, `keep` and the result are as in `measure_chart`."""
    runs: list[Row] = []
    for thing in things:
        place = ObjectScenes(thing, spec)
        for hand in hands:
            for setting, way in _planning_modes(settings):
                runs.append(_cached_result(setting, way, hand, place, models, work))
                say(_progress_line(runs[-1]))
            keep(_result(runs, settings, spec, models))
    return _result(runs, settings, spec, models)


def _planning_modes(settings: Sequence[Setting]) -> list[tuple[Setting, str]]:
    modes = {True: (IN_SCENE, FILTERED), False: (FILTERED,)}
    return [(setting, way) for setting in settings for way in modes[bool(method(setting.method).in_scenes)]]


def _cached_result(
    setting: Setting, way: str, hand: HandModel, place: ObjectScenes, models: int, work: Path | None
) -> Row:
    """Return the setting's result on the pair, from its cache file if it exists."""
    said: Row = {"way": way, "method": setting.method, "fidelity": setting.fidelity, "hand": hand.name}
    said |= {"object": place.thing.name, "batch": setting.batch, "options": dict(setting.options)}
    if work is None:
        return said | _run_setting(setting, way, hand, place, models)
    told = place.spec.model_dump(mode="json")
    terms = [
        FORM,
        models,
        said,
        setting.knobs.model_dump(mode="json"),
        told,
        hand.digest,
        place.validator_object.digest,
    ]
    # Results also depend on revision of the planners and device.
    device = [] if setting.run.device == "cpu" else [setting.run.device]
    file = work / f"{digest_json([*terms, STAGE_REVISIONS['synthesize'], *device])}.json"
    if not file.is_file():
        work.mkdir(parents=True, exist_ok=True)
        partial, row = file.with_suffix(".tmp"), said | _run_setting(setting, way, hand, place, models)
        partial.write_text(json.dumps(row, indent=1, allow_nan=False) + "\n")
        partial.replace(file)
    found: Row = json.loads(file.read_text())
    return found


def _run_setting(setting: Setting, way: str, hand: HandModel, place: ObjectScenes, models: int) -> Row:
    """Return counts, shares and speeds of one setting's grasps for a hand and an object."""
    obj = place.thing.load(setting.knobs.face_error_m)
    placed = place.scenes.placed(np.arange(setting.batch) % len(place.scenes.object_pose))
    row: Row = {"grasps": setting.batch, "seconds": 0.0, "end_seconds": 0.0, **_NOTHING}
    note, few = "", min(setting.run.cores, setting.batch)
    clock = clock_of(setting.run.device)
    in_scene = way == IN_SCENE

    def plan(placed: PlacedGrasps, seed: int, warm: bool = False) -> GraspSet:
        options = {**setting.options, **(setting.warm if warm else {})}
        where: dict[str, Any] = {"placed": placed, "rollout": rollout} if in_scene else {}
        wanted = PlanRequest(len(placed.index), setting.knobs, seed, **where)
        return synthesize(hand, obj, wanted, setting.run, method=setting.method, options=options)

    try:
        rollout = lift_rollout(hand, obj, lambda: place.pieces) if in_scene else None
        plan(placed.take(slice(0, 1)), WARM_SEED, warm=True)
        began = clock()
        grasps = plan(placed, SEED)
        row["seconds"] = clock() - began
        validated = ValidatedGrasps(hand, place, grasps, placed)
        row["end_seconds"] = clock() - began
        each = row["end_seconds"] / setting.batch
        row["first_seconds"] = each * few
        if each < _SHORT_S:
            began = clock()
            start = placed.take(slice(0, few))
            ValidatedGrasps(hand, place, plan(start, SEED), start)
            row["first_seconds"] = clock() - began
        row |= validated.counts(models)
    except InputError as error:
        note = str(error)  # the scene has no free approach, or the method refuses the pair
    row["first_grasps"] = few
    told = lift_figures([row])
    told["seconds_to_first"] = seconds_to_valid(told["lift"], [row["first_seconds"]], few)
    return {**row, **told, "scenes": len(place.scenes.object_pose), "note": note}


class ValidatedGrasps:
    """Grasps with trajectories and lift verdicts; the metrics of lifted grasps are only timed."""

    def __init__(self, hand: HandModel, place: ObjectScenes, grasps: GraspSet, placed: PlacedGrasps) -> None:
        way = plan_trajectory(hand, place.validator_object, grasps, placed)
        self.grasps = replace(grasps, approach=way.approach, coming=way.open, lift=way.lift)
        self.hand, self.place, self.placed = hand, place, placed
        self.clear = np.flatnonzero(way.clear)
        self.lifted = self._lifted_rows(self.clear)
        measure(hand, place.validator_object, self.grasps.take(self.lifted), friction=FRICTION)

    def _lifted_rows(self, rows: NDArray[np.intp], **options: Any) -> NDArray[np.intp]:
        if not len(rows):
            return rows
        grasps, placed = self.grasps.take(rows), self.placed.take(rows)
        found = validate_lifts(
            self.hand, self.place.validator_object, grasps, placed, pieces=self.place.pieces, **options
        )
        return rows[found.success == 1]

    def counts(self, models: int) -> Row:
        """Return numbers of clear grasps and of lifted ones by test, and the sum of their robust shares."""
        lifted = self.lifted
        grasps, placed = self.grasps.take(lifted), self.placed.take(lifted)
        given: dict[str, Any] = {"models": models, "seed": MODELS_SEED, "pieces": self.place.pieces}
        shares = validate_robustness(self.hand, self.place.validator_object, grasps, placed=placed, **given).share
        return {
            "clear_count": len(self.clear),
            "lift_count": len(lifted),
            "lift_dexgraspbench_count": len(self._lifted_rows(self.clear, level="dexgraspbench")),
            "lift_hard_count": len(self._lifted_rows(lifted, hard=True)),
            "robust_sum": float(shares.sum()),
        }


def lift_figures(rows: Sequence[Mapping[str, Any]]) -> Row:
    """Return shares of all candidates, lifted grasps per second, and robust share.
    Shares have 95 % intervals (Wilson). All grasps have equal weight; refused cells have no time."""
    grasps = sum(row["grasps"] for row in rows)
    found: Row = {"grasps": grasps}
    for name in SHARES:
        count = sum(row[f"{name}_count"] for row in rows)
        low, high = wilson_interval(count, grasps)
        found |= {f"{name}_count": count, name: count / grasps, f"{name}_low": low, f"{name}_high": high}
    planned = sum(row["grasps"] for row in rows if row["seconds"])
    for speed, key in SPEEDS:
        found[key] = seconds = sum(row[key] for row in rows)
        found[RAW[speed]] = planned / seconds if seconds else 0.0
        for end in ("", "_low", "_high"):
            found[f"{speed}{end}"] = found[f"lift{end}"] * grasps / seconds if seconds else 0.0
    total, lifted = sum(row["robust_sum"] for row in rows), found["lift_count"]
    bar = wilson_interval_of_mean(total, lifted) if lifted else (None, None)
    mean = total / lifted if lifted else None
    found |= {"robust_sum": total, "robust": mean, "robust_low": bar[0], "robust_high": bar[1]}
    return {key: rounded_json_value(value) for key, value in found.items()}


def summarise_runs(runs: Sequence[Row]) -> list[Row]:
    """Return a row for each mode, method, fidelity and batch over all pairs.
    `gain` is the median over pairs of the ratio of speeds, in scene to filtered, where a filtered grasp was lifted."""
    groups: dict[tuple[str, str, str, int], list[Row]] = {}
    for run in runs:
        groups.setdefault((run["way"], run["method"], run["fidelity"], run["batch"]), []).append(run)
    rows = []
    for (way, name, fidelity, batch), own in groups.items():
        row: Row = {"way": way, "method": name, "fidelity": fidelity, "batch": batch, "pairs": len(own)}
        row |= lift_figures(own)
        firsts = [run["seconds_to_first"] for run in own]
        # The time of pairs without a lift is unknown.
        row["seconds_to_first"] = None if None in firsts else rounded_json_value(float(np.mean(firsts)))
        row["pairs_with_one"] = sum(run["lift_count"] > 0 for run in own)
        row["gain"] = _gain(own, groups.get((FILTERED, name, fidelity, batch), [])) if way == IN_SCENE else None
        rows.append(row)
    mark_fronts(rows, IN_SCENES)
    return rows


def _gain(own: Sequence[Row], filtered: Sequence[Row]) -> float | None:
    there = {(run["hand"], run["object"]): run["valid_per_second"] for run in filtered}
    ratios = [run["valid_per_second"] / there[pair] for run in own if there.get(pair := (run["hand"], run["object"]))]
    return rounded_json_value(float(np.median(ratios))) if ratios else None


def _result(runs: Sequence[Row], settings: Sequence[Setting], spec: SceneSpec, models: int) -> Row:
    hands = dict.fromkeys(run["hand"] for run in runs)
    return {
        "created": timestamp(),
        "device": device_name(settings[0].run.device),
        "versions": {"graspd": PACKAGE_VERSION},
        "scene": spec.model_dump(mode="json"),
        "validation": {"protocol": "lift", "level": "lift"},
        "runs": list(runs),
        "models": models,
        "summary": summarise_runs(runs),
        "by_hand": {hand: summarise_runs([run for run in runs if run["hand"] == hand]) for hand in hands},
    }


def _progress_line(run: Row) -> str:
    return (
        f"{run['way']:14s} {run['method']:11s} {run['fidelity']:13s} {run['hand']:18s} {run['object']:20s} "
        f"{run['end_to_end_per_second']:8.3f} lifted/s  clear {run['clear']:.2f}  lift {run['lift']:.2f}  "
        f"half friction {run['lift_hard']:.2f} {run['note']}"
    )

"""Run of a chart: all settings of the command line on all pairs, with interleaved repeats."""

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import warp as wp

from graspd.service.model.clock import timestamp
from graspd.service.model.errors import InputError
from graspd.service.model.fidelity import FIDELITIES
from graspd.service.model.version import PACKAGE_VERSION
from graspd.studies.bench import device_name
from graspd.studies.chart.statistics import rounded_json_value, run_figures, summarise_runs
from graspd.studies.chart.trials import FRICTION, Setting, SettingRuns
from graspd.studies.evaluation import THRESHOLD_M
from graspd.worker.execution_context import ExecutionContext
from graspd.worker.hands.model import HandModel
from graspd.worker.objects.model import ObjectModel
from graspd.worker.planners import method, planner
from graspd.worker.validation.decomposition import decompose

Say = Callable[[str], None]

#: Error bound of the object's mesh for measurement and validation [m]; only meshes for planning depend on the setting.
TRUE_ERROR_M: Final = FIDELITIES["standard"].face_error_m


@dataclass(frozen=True)
class ChartObject:
    """An object, loaded at the error bound [m] of a fidelity."""

    name: str
    load: Callable[[float], ObjectModel]


def measure_chart(
    hands: Sequence[HandModel],
    things: Sequence[ChartObject],
    settings: Sequence[Setting],
    *,
    repeats: int,
    models: int,
    say: Say,
    keep: Callable[[dict[str, Any]], None],
) -> dict[str, Any]:
    """Run all settings on all pairs; validate each held grasp in `models` models around the nominal one.
    `say` receives a line per cell, `keep` the partial result after each pair. Return `runs`, one setting on one pair
    each; `summary` over all pairs; `by_hand` over each hand's objects; and settings of the chart."""
    runs: list[dict[str, Any]] = []
    for thing in things:
        for hand in hands:
            true = thing.load(TRUE_ERROR_M)
            pieces = decompose(true)
            cells = [SettingRuns(s, hand, thing.load(s.knobs.face_error_m), true, pieces) for s in settings]
            for cell in cells:
                cell.warm_up()
            for _ in range(repeats):
                for cell in cells:
                    cell.repeat()
                    cell.time_first(cell.setting.run.cores)
            for cell in cells:
                cell.validate_strictly(models)
                runs.append(_combination_row(cell, hand, thing))
                say(_progress_line(runs[-1]))
            keep(_result(runs, settings, models))
    return _result(runs, settings, models)


def _result(runs: Sequence[dict[str, Any]], settings: Sequence[Setting], models: int) -> dict[str, Any]:
    hands = dict.fromkeys(run["hand"] for run in runs)
    return {
        "created": timestamp(),
        "device": device_name(settings[0].run.device),
        "versions": {"graspd": PACKAGE_VERSION, "warp": wp.config.version},
        "threads": settings[0].run.cores,
        "validation": {"protocol": "dexgraspbench", "level": "standard"},
        "models": models,
        "friction": FRICTION,
        "threshold_m": THRESHOLD_M,
        "runs": list(runs),
        "summary": summarise_runs(runs),
        "by_hand": {hand: summarise_runs([run for run in runs if run["hand"] == hand]) for hand in hands},
    }


def _combination_row(cell: SettingRuns, hand: HandModel, thing: ChartObject) -> dict[str, Any]:
    setting = cell.setting
    names = {"method": setting.method, "fidelity": setting.fidelity, "hand": hand.name, "object": thing.name}
    best = {key: rounded_json_value(value) for key, value in cell.best().items()}
    return {**names, "options": dict(setting.options), **run_figures(cell), "best": best}


def _progress_line(run: dict[str, Any]) -> str:
    return (
        f"{run['method']:11s} {run['fidelity']:13s} {run['hand']:18s} {run['object']:20s} "
        f"{run['end_to_end_per_second']:8.3f} valid/s  dexgraspbench {run['dexgraspbench']:.2f}  hard "
        f"{run['hard']:.2f}  eps {run['epsilon']:.3f}  PD {run['pd_mm']:.2f} mm"
    )


LABEL: Final = "as published"  # label of methods without fidelities: they run with the settings of their source

_VARIANT: Final = re.compile(r"([^:@]+)(?::([\w.]+=[\w.]+(?:\+[\w.]+=[\w.]+)*))?(?:@([1-9]\d{0,3}))?")


def settings_of(
    methods: Sequence[str],
    fidelities: Sequence[str],
    *,
    batches: Sequence[int],
    baseline_batch: int,
    options: Sequence[str],
    quick: bool,
    run: ExecutionContext,
) -> list[Setting]:
    """Return a setting for each fidelity and batch of each method.
    A method without fidelities has one setting. It has `batches[0]` grasps per call by default, or `baseline_batch` if
    the method has an option `steps`, because such grasps take seconds each. Raises InputError: a method or an option is
    unknown."""
    variants = [_parse_method(text) for text in methods]
    given = _parse_options(options, [name for name, _, _ in variants])
    found: list[Setting] = []
    for name, changes, size_given in variants:
        known = method(name)
        own = {**(known.quick if quick else {}), **given.get(name, {}), **changes}
        planner(name, own)
        common: dict[str, Any] = {"options": own, "warm": known.quick, "run": run}
        if known.has_fidelities:
            found += [Setting(name, f, FIDELITIES[f], batch=b, **common) for f in fidelities for b in batches]
        else:
            size = baseline_batch if "steps" in known.options.model_fields else batches[0]
            label = " ".join(f"{key}={value}" for key, value in changes.items()) or LABEL
            found.append(Setting(name, label, FIDELITIES["standard"], batch=size_given or size, **common))
    return found


def _parse_method(text: str) -> tuple[str, dict[str, str], int | None]:
    """Parse a method such as `graspit:keep=20@40` into name, options and grasps per call."""
    found = _VARIANT.fullmatch(text)
    if found is None:
        raise InputError(f"{text!r} is no method; write NAME, NAME:OPTION=VALUE or NAME:OPTION=VALUE@GRASPS_PER_CALL")
    name, options, size = found.groups()
    changes = dict(part.split("=", 1) for part in options.split("+")) if options else {}
    return name, changes, int(size) if size else None


def _parse_options(texts: Sequence[str], methods: Sequence[str]) -> Mapping[str, dict[str, str]]:
    found: dict[str, dict[str, str]] = {}
    for text in texts:
        name, colon, rest = text.partition(":")
        option, equals, value = rest.partition("=")
        if not colon or not equals or name not in methods:
            raise InputError(f"--option {text!r}: write METHOD:NAME=VALUE with one of {', '.join(methods)}")
        found.setdefault(name, {})[option] = value
    return found

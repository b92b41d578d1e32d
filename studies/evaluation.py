"""Evaluation of a set of grasps as one row: success by the validator, and medians of all metrics."""

import math
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from enum import IntEnum
from pathlib import Path
from typing import Any, Final, Literal, cast, get_args

import numpy as np
from numpy.typing import NDArray

from graspd.exchange.inputs import Case
from graspd.service.model.errors import InputError, MeshError, choices_text
from graspd.service.model.metrics import perturbed_parameter_name
from graspd.worker.execution_context import DEFAULT_CONTEXT, ExecutionContext
from graspd.worker.grasps import GraspSet
from graspd.worker.quality.contact import contact_distance_consistency_mm
from graspd.worker.quality.diversity import explained_variance, hand_points, least_distance
from graspd.worker.quality.probe import HAND_POINTS, OBJECT_POINTS, probe_of
from graspd.worker.quality.table import DEFAULT_FRICTION, measure
from graspd.worker.scenes.trajectory import plan_trajectory
from graspd.worker.simulation.environment import PlacedGrasps
from graspd.worker.validation.decomposition import decompose
from graspd.worker.validation.displacement import simulated_displacement_cm
from graspd.worker.validation.key import Level
from graspd.worker.validation.lift import LiftOutcome
from graspd.worker.validation.lifting import LiftLevel, LiftVerdicts, validate_lifts
from graspd.worker.validation.protocol import Outcome
from graspd.worker.validation.robust import Robustness, validate_robustness
from graspd.worker.validation.validator import Verdicts, validate

Protocol = Literal["dexgraspbench", "displacement", "lift"]

THRESHOLD_M: Final = 0.005  # contact threshold of contact area, epsilon and volume [m]: the paper's
#: Keys of the row, and the metrics of grasps whose medians they contain.
COLUMNS: Final = {
    "pd_mm": "penetration_depth_mm",
    "spd_mm": "self_penetration_depth_mm",
    "ca_cm2": "contact_area_cm2",
    "iv_cm3": "intersection_volume_cm3",
    "epsilon": "epsilon",
    "wrench_volume": "wrench_volume",
}
#: Seed of the models around the nominal one; no job uses it, so that a job's selection does not bias the result.
MODELS_SEED: Final = 2**31


def evaluate(
    case: Case,
    *,
    protocol: Protocol = "dexgraspbench",
    level: str = "",
    hard: bool = False,
    friction: float | None = None,
    models: int = 0,
    tell: Callable[[Robustness], None] = lambda found: None,
    cache: Path | None = None,
    run: ExecutionContext = DEFAULT_CONTEXT,
) -> dict[str, Any]:
    """Return a row of numbers; undefined ones are None, such as gsr of an object too thin to validate.

    An empty level means standard, for protocol lift level lift. Level dexgraspbench uses the mass and friction of its
    protocol, other levels those of the object.

    - gsr: share that holds; osr: 1 if any holds; sgs: held grasps per second of planning and validation;
      sgs_without_validation: per second of planning alone; verdicts: see `_verdict_rows`
    - medians of pd_mm and spd_mm (penetration, self-penetration), ca_cm2, iv_cm3, epsilon, wrench_volume, cdc_mm, sd_cm
    - diversity: variance explained by the first principal component; nearest_mm: least distance of two grasps
    - with `models` models around the nominal one: robust_share (mean over held grasps), robust_n (their number),
      robust_axes (share by axis); `tell` receives the results
    - protocol lift: clear_share, without collision in approach, closing and lift

    Raises InputError: protocol lift on grasps of a free object, or a level that the protocol lacks."""
    level = checked_level(protocol, level)
    if protocol == "lift" and case.placed is None:
        raise InputError(f"{case.name} has free grasps, but a lift test needs a scene: graspd synth --scene")
    case = case.centred
    if level == "dexgraspbench":
        case = replace(case, obj=case.obj.for_dexgraspbench)
    mu = friction or case.friction or DEFAULT_FRICTION
    table = measure(case.hand, case.obj, case.grasps, friction=mu, thresholds_m=[THRESHOLD_M], run=run)
    row: dict[str, Any] = {"n": len(case.grasps), "protocol": protocol, "level": None, "hard": hard, "mu": mu}
    row |= {"mass_kg": case.obj.mass, "object_friction": case.obj.friction}
    row |= dict.fromkeys(("gsr", "osr", "sgs", "sgs_without_validation", "agreement_published"))
    try:
        pieces = decompose(case.obj, cache=cache)
    except MeshError as error:
        row["note"] = str(error)
        return row | _medians(case, table, None)
    common: dict[str, Any] = {"hard": hard, "pieces": pieces, "run": run}
    if protocol == "dexgraspbench":
        verdicts = validate(case.hand, case.obj, case.grasps, level=cast(Level, level), **common)
        row |= _success(case, verdicts)
        if models:
            row |= _model_results(case, case.grasps, row, models, tell, held=verdicts.success, **common)
    elif protocol == "lift" and case.placed is not None:
        common |= {"placed": case.placed, "level": level}
        grasps, clear = with_trajectories(case, case.placed)
        lifts = validate_lifts(case.hand, case.obj, grasps, **common)
        row |= _lift_rates(lifts, clear)
        if models:
            row |= _model_results(case, grasps, row, models, tell, held=lifts.success, **common)
    sd = simulated_displacement_cm(case.hand, case.obj, case.grasps.grasp, pieces=pieces, run=run)
    return row | pieces.facts | _medians(case, table, sd)


def checked_level(protocol: str, level: str) -> str:
    """Return the level, or the default of the protocol if `level` is empty.
    Raises InputError: the protocol or the level is unknown."""
    if protocol not in get_args(Protocol):
        raise InputError(f"unknown protocol {protocol!r}; choose {choices_text(protocol, get_args(Protocol))}")
    levels = get_args(LiftLevel if protocol == "lift" else Level)
    level = level or ("lift" if protocol == "lift" else "standard")
    if level not in levels:
        raise InputError(f"unknown level {level!r} of protocol {protocol}; choose one of {choices_text(level, levels)}")
    return level


def _model_results(
    case: Case, grasps: GraspSet, row: dict[str, Any], models: int, tell: Callable[[Robustness], None], **given: Any
) -> dict[str, Any]:
    """Return results of models around the nominal one.
    Add to each verdict in `row` the grasp's share (None if not tested) and first failing axis."""
    found = validate_robustness(case.hand, case.obj, grasps, models=models, seed=MODELS_SEED, **given)
    tell(found)
    tried = np.isfinite(found.share)
    for one, share, weakest in zip(row.get("verdicts", []), found.share, found.weakest, strict=True):
        known = math.isfinite(share)
        one |= {
            "robust_share": _rounded(share) if known else None,
            "robust_weakest": perturbed_parameter_name(int(weakest)),
        }
    counts = found.by_axis()
    return {
        "robust_share": _rounded(float(found.share[tried].mean())) if tried.any() else None,
        "robust_models": found.held.shape[1],
        "robust_n": int(tried.sum()),
        "robust_seconds": _rounded(found.seconds),
        "robust_axes": {axis.word: {"share": _rounded(held / n), "n": n} for axis, (held, n) in counts.items()},
    }


def _success(case: Case, verdicts: Verdicts) -> dict[str, Any]:
    if not len(case.grasps):
        return {}
    held = int(verdicts.success.sum())
    made = case.seconds
    whole = None if made is None else made + (0.0 if case.validated else verdicts.seconds)
    row: dict[str, Any] = {
        "level": verdicts.level,
        "gsr": _rounded(held / len(case.grasps)),
        "osr": float(held > 0),
        "sgs": _rounded(held / whole) if whole else None,
        "sgs_without_validation": _rounded(held / made) if made and not case.validated else None,
        "validation_seconds": _rounded(verdicts.seconds),
        "published": 0,
        "reasons": dict(Counter(verdicts.reasons).most_common()),
        "verdict_key": verdicts.terms,
        "verdicts": _verdict_rows(verdicts, verdicts.outcome, Outcome),
        "agreement_published": None,
    }
    if case.published is not None and (known := case.published >= 0).any():
        row["published"] = int(known.sum())
        row["agreement_published"] = _rounded(float((case.published == verdicts.success)[known].mean()))
    return row


def with_trajectories(case: Case, placed: PlacedGrasps) -> tuple[GraspSet, NDArray[np.bool_]]:
    """Return the grasps with their approaches and lifts, and whether each trajectory (N,) is clear."""
    way, grasps = plan_trajectory(case.hand, case.obj, case.grasps, placed), case.grasps
    if grasps.approach is None or grasps.coming is None:
        # Imported files rarely have trajectories.
        grasps = replace(grasps, approach=way.approach, coming=way.open, lift=way.lift)
    return grasps, way.clear


def _lift_rates(verdicts: LiftVerdicts, clear: NDArray[np.bool_]) -> dict[str, Any]:
    count, held = len(clear), int(verdicts.success.sum())
    rows = _verdict_rows(verdicts, verdicts.outcome[:, None], LiftOutcome)
    return {
        "level": verdicts.level,
        "gsr": _rounded(held / max(1, count)),
        "osr": float(held > 0),
        "clear_share": _rounded(float(clear.mean())) if len(clear) else None,
        "validation_seconds": _rounded(verdicts.seconds),
        "reasons": dict(Counter(verdicts.reasons).most_common()),
        "verdict_key": verdicts.terms,
        "verdicts": [row | {"clear": bool(free)} for row, free in zip(rows, clear, strict=True)],
    }


def _verdict_rows(
    verdicts: Verdicts | LiftVerdicts, outcomes: NDArray[Any], kind: type[IntEnum]
) -> list[dict[str, Any]]:
    """Return row, held, outcomes of pushes or lift, margin (None if diverged) and reason of each grasp."""
    columns = zip(verdicts.success, outcomes, verdicts.margin, verdicts.reasons, strict=True)
    return [
        {
            "row": row,
            "held": bool(held),
            "outcomes": [kind(int(one)).name.lower() for one in own],
            "margin": _rounded(margin) if math.isfinite(margin) else None,
            "reason": reason,
        }
        for row, (held, own, margin, reason) in enumerate(columns)
    ]


def _medians(case: Case, table: dict[str, NDArray[Any]], sd: NDArray[np.float64] | None) -> dict[str, Any]:
    probe = probe_of(case.hand, case.obj, hand_points=HAND_POINTS, object_points=OBJECT_POINTS)
    cdc = contact_distance_consistency_mm(case.hand, probe.body_distance(probe.measure(case.grasps.grasp)))
    row = {key: _median(table[f"quality/{name}"]) for key, name in COLUMNS.items()}
    shares = explained_variance(case.grasps.grasp)
    apart = least_distance(hand_points(case.hand, case.grasps.grasp))
    return row | {
        "cdc_mm": _median(cdc),
        "sd_cm": None if sd is None else _median(sd),
        "diversity": _rounded(float(shares[0])) if len(shares) else None,
        "nearest_mm": None if apart is None else _rounded(1e3 * apart),
    }


def _median(values: NDArray[Any]) -> float | None:
    return _rounded(float(np.median(values))) if values.size else None


def _rounded(value: float) -> float:
    return round(float(value), 6)


#: Keys that `combine_rows` summarises by medians over rows.
_MEDIANS: Final = (*COLUMNS, "cdc_mm", "sd_cm", "diversity")


def combine_rows(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Combine rows of several objects: rates over all grasps, osr over objects, medians of their medians."""
    if len(rows) == 1:
        return dict(rows[0])
    out: dict[str, Any] = {"n": sum(row["n"] for row in rows)}
    for key in ("protocol", "level", "hard", "mu"):
        # None stands for different values.
        out[key] = rows[0][key] if all(row[key] == rows[0][key] for row in rows) else None
    validated = [row for row in rows if row["gsr"] is not None]
    out["gsr"] = _rate(validated, "gsr", "n")
    if any("clear_share" in row for row in rows):
        out["clear_share"] = _rate([row for row in rows if row.get("clear_share") is not None], "clear_share", "n")
    out["osr"] = _rounded(float(np.mean([row["osr"] for row in validated]))) if validated else None
    out["agreement_published"] = _rate(validated, "agreement_published", "published")
    if any("robust_share" in row for row in rows):
        out |= _combine_models([row for row in rows if "robust_share" in row])
    for key in ("sgs", "sgs_without_validation"):
        # Held grasps of all rows over the seconds of all rows.
        timed = [row for row in validated if row[key]]
        seconds = sum(row["gsr"] * row["n"] / row[key] for row in timed)
        out[key] = _rounded(sum(row["gsr"] * row["n"] for row in timed) / seconds) if timed else None
    for key in _MEDIANS:
        known = [row[key] for row in rows if row[key] is not None]
        out[key] = _rounded(float(np.median(known))) if known else None
    near = [row["nearest_mm"] for row in rows if row.get("nearest_mm") is not None]
    out["nearest_mm"] = min(near) if near else None
    return out


def _combine_models(rows: list[dict[str, Any]]) -> dict[str, Any]:
    axes: dict[str, list[tuple[float, int]]] = {}
    for row in rows:
        for axis, one in row["robust_axes"].items():
            axes.setdefault(axis, []).append((one["share"], one["n"]))
    total = {axis: sum(n for _, n in parts) for axis, parts in axes.items()}
    return {
        "robust_share": _rate(rows, "robust_share", "robust_n"),
        "robust_models": rows[0]["robust_models"],
        "robust_n": sum(row["robust_n"] for row in rows),
        "robust_axes": {
            axis: {"share": _rounded(sum(share * n for share, n in parts) / total[axis]), "n": total[axis]}
            for axis, parts in axes.items()
        },
    }


def _rate(rows: list[dict[str, Any]], key: str, weight: str) -> float | None:
    """Return the mean over rows in which `key` is known, weighted by their `weight`."""
    known = [row for row in rows if row[key] is not None]
    total = sum(row[weight] for row in known)
    return _rounded(sum(row[key] * row[weight] for row in known) / total) if total else None

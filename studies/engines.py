"""Agreement of engines on the same grasps: success, Cohen's κ, kinds of losses, price of a verdict."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations
from typing import Any

import numpy as np

from graspd.exchange.inputs import Case
from graspd.studies.evaluation import with_trajectories
from graspd.worker.execution_context import DEFAULT_CONTEXT, ExecutionContext
from graspd.worker.validation.decomposition import decompose
from graspd.worker.validation.engines.registry import EngineVerdicts, validate_with_engine


def compare_engines(
    case: Case,
    engines: Sequence[str],
    *,
    lift: bool = False,
    level: str = "standard",
    hard: bool = False,
    run: ExecutionContext = DEFAULT_CONTEXT,
) -> list[EngineVerdicts]:
    """Return the verdicts of each engine on grasps of one file, by pushes or by lifts.
    `level` is that of MuJoCo. Raises InputError: see `validate_with_engine`."""
    case = case.centred
    if level == "dexgraspbench":
        case = replace(case, obj=case.obj.for_dexgraspbench)
    grasps, placed = case.grasps, case.placed if lift else None
    if placed is not None:
        grasps, _ = with_trajectories(case, placed)
    common: dict[str, Any] = {"level": level, "hard": hard, "pieces": decompose(case.obj), "run": run}
    return [validate_with_engine(name, case.hand, case.obj, grasps, placed, **common) for name in engines]


def summarise(files: Sequence[Sequence[EngineVerdicts]]) -> dict[str, Any]:
    """Return n, success and core_ms by engine, agreement and κ of each pair, over grasps of several files.
    `differences` counts by kind of loss the grasps that hold in one engine of a pair only."""
    names = [one.engine for one in files[0]]
    held = {name: np.concatenate([one[k].success == 1 for one in files]) for k, name in enumerate(names)}
    reasons = {name: [r for one in files for r in one[k].reasons] for k, name in enumerate(names)}
    n = max(1, len(held[names[0]]))
    core = {name: sum(one[k].core_s for one in files) for k, name in enumerate(names)}
    pairs = []
    for a, b in combinations(names, 2):
        x, y = held[a], held[b]
        lost = Counter(f"{b}: {reasons[b][row]}" for row in np.flatnonzero(x & ~y))
        lost += Counter(f"{a}: {reasons[a][row]}" for row in np.flatnonzero(y & ~x))
        pairs.append(
            {
                "engines": [a, b],
                "both": int((x & y).sum()),
                "only": [int((x & ~y).sum()), int((y & ~x).sum())],
                "agreement": round(float((x == y).mean()), 4),
                "kappa": cohen_kappa(x, y),
                "differences": dict(lost.most_common()),
            }
        )
    return {
        "n": len(held[names[0]]),
        "success": {name: round(float(held[name].sum()) / n, 4) for name in names},
        "core_ms": {name: round(1e3 * core[name] / n, 1) for name in names},
        "pairs": pairs,
    }


def cohen_kappa(x: Any, y: Any) -> float | None:
    """Return the agreement of two raters (N,) beyond chance; None if chance alone gives full agreement.
    Source: Cohen, "A coefficient of agreement for nominal scales", 1960."""
    a, b = float(np.mean(x)), float(np.mean(y))
    chance = a * b + (1 - a) * (1 - b)
    return round((float(np.mean(x == y)) - chance) / (1 - chance), 4) if chance < 1 else None

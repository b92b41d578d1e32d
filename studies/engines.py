"""Agreement of engines on the same grasps: success, Cohen's κ, kinds of losses, price of a verdict."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import combinations
from pathlib import Path
from typing import Any, Final

import numpy as np

from graspd.exchange.inputs import Case
from graspd.service.model.domain import JobOptions
from graspd.service.model.scene_spec import parse_scene
from graspd.service.store.shards import write_shard
from graspd.studies.evaluation import with_trajectories
from graspd.worker.execution_context import DEFAULT_CONTEXT, ExecutionContext
from graspd.worker.files.provenance import id_of_columns
from graspd.worker.files.synthesis import synthesize_grasps
from graspd.worker.validation.decomposition import decompose
from graspd.worker.validation.engines.registry import EngineVerdicts, validate_with_engine

FRICTIONS: Final = ("full", "half")
#: Verdicts of several engines per file, by hand, scene and friction.
Found = dict[tuple[str, ...], list[list[EngineVerdicts]]]


def plan_candidates(hand: str, obj: str, scene: str, count: int, seed: int, file: Path, *, threads: int = 0) -> Path:
    """Write unselected candidates to a file, unless it exists. Raises the planner's errors."""
    if not file.exists():
        request = JobOptions(grasps=count, seed=seed, want="candidates", validation="none", rechecks=0)
        made = synthesize_grasps(hand, obj, request, place=parse_scene(scene), threads=threads)
        file.write_bytes(write_shard("base", made.arrays, {**made.attributes, "shard_id": id_of_columns(made.arrays)}))
    return file


def compare_frictions(
    case: Case, engines: Sequence[str], *, frictions: Sequence[str] = FRICTIONS, threads: int = 0
) -> dict[str, list[EngineVerdicts]]:
    """Return verdicts on the grasps of one file at full and half friction: pushes, or lifts in scenes.
    Raises the errors of `compare_engines`."""
    given: dict[str, Any] = {} if case.placed is None else {"lift": True, "level": "lift"}
    given["run"] = ExecutionContext(threads=threads)
    return {friction: compare_engines(case, engines, hard=friction == "half", **given) for friction in frictions}


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
    `differences` counts by kind of loss the grasps that hold in one engine of a pair only. With three engines or more,
    `held_back` counts for each engine the grasps that hold in all others, and those of them that hold in it."""
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
    chosen = {name: np.all([held[one] for one in names if one != name], axis=0) for name in names if len(names) > 2}
    return {
        "n": len(held[names[0]]),
        "success": {name: round(float(held[name].sum()) / n, 4) for name in names},
        "core_ms": {name: round(1e3 * core[name] / n, 1) for name in names},
        "pairs": pairs,
        "held_back": {
            name: {"chosen": int(mask.sum()), "held": int((mask & held[name]).sum())} for name, mask in chosen.items()
        },
    }


def cohen_kappa(x: Any, y: Any) -> float | None:
    """Return the agreement of two raters (N,) beyond chance; None if chance alone gives full agreement.
    Source: Cohen, "A coefficient of agreement for nominal scales", 1960."""
    a, b = float(np.mean(x)), float(np.mean(y))
    chance = a * b + (1 - a) * (1 - b)
    return round((float(np.mean(x == y)) - chance) / (1 - chance), 4) if chance < 1 else None


def summarise_groups(found: Found) -> dict[tuple[str, ...], dict[str, Any]]:
    """Return summaries by hand, scene and friction; with several hands, `all` sums them."""
    groups: Found = {}
    for (hand, *where), files in found.items():
        for name in {hand} | ({"all"} if len({key[0] for key in found}) > 1 else set()):
            groups.setdefault((name, *where), []).extend(files)
    return {key: summarise(groups[key]) for key in sorted(groups)}


Rows = Mapping[tuple[str, ...], dict[str, Any]]
GROUPS: Final = ("hand", "scene", "friction")


def matrix_lines(rows: Rows, heads: Sequence[str] = GROUPS) -> list[str]:
    """Format summaries as Markdown: success, price, pairwise agreement, success in a held-back engine.
    `heads` are the headings of the keys."""
    engines = list(next(iter(rows.values()))["success"])
    lines = table(*heads, "n", *(f"{one} holds" for one in engines), *(f"{one} core-ms" for one in engines))
    for key, row in rows.items():
        numbers = [f"{row['success'][one]:.3f}" for one in engines] + [f"{row['core_ms'][one]:.0f}" for one in engines]
        lines.append(_line(*key, row["n"], *numbers))
    told = ("first", "second", "both", "only first", "only second", "agreement", "κ", "first held: second holds")
    lines += ["", *table(*heads, *told, "losses of grasps that differ")] if len(engines) > 1 else []
    for key, row in rows.items():
        for pair in row["pairs"]:
            both, (first, second) = pair["both"], pair["only"]
            lost = ", ".join(f"{count} {reason}" for reason, count in pair["differences"].items())
            numbers = [f"{pair['agreement']:.3f}", "–" if pair["kappa"] is None else f"{pair['kappa']:.2f}"]
            lines.append(_line(*key, *pair["engines"], both, first, second, *numbers, _share(both, both + first), lost))
    return [*lines, "", *held_back_lines(rows, heads)] if len(engines) > 2 else lines


def held_back_lines(rows: Rows, heads: Sequence[str] = GROUPS) -> list[str]:
    """Format as Markdown the success in each engine of grasps chosen by all others, and of all grasps."""
    lines = table(*heads, "held-back engine", "n", "all hold", "chosen", "chosen hold")
    for key, row in rows.items():
        for name, one in row["held_back"].items():
            chosen = one["chosen"], _share(one["held"], one["chosen"])
            lines.append(_line(*key, name, row["n"], f"{row['success'][name]:.3f}", *chosen))
    return lines


def table(*heads: str) -> list[str]:
    """Return the first two lines of a Markdown table."""
    return [_line(*heads), "|---" * len(heads) + "|"]


def _line(*cells: Any) -> str:
    return f"| {' | '.join(map(str, cells))} |"


def _share(part: int, whole: int) -> str:
    return f"{part / whole:.3f}" if whole else "–"

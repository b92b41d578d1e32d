"""Robustness of verdicts: effect of each error of a hand's model on success.

usage: python -m benchmarks.robust DATA_DIR [--work DIR] [--hands allegro ...] [--objects NAME ...] [--out FOLDER]
DATA_DIR holds hands/ and objects/. Candidates at fidelity standard are validated at level standard. Held candidates are
validated again in models that differ along one axis (`--draws` models each), along all axes at once, and as in a job.
`--out` receives robust.json and robust.md. Interrupted runs resume (see cells.py)."""

from __future__ import annotations

import sys
import time
from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.cells import Cell, cell_parser, cells, write_json
from graspd.service.model.metrics import AXIS_MEANINGS, ROBUST_MODELS, PerturbedParameter
from graspd.worker.execution_context import ExecutionContext
from graspd.worker.quality.intervals import wilson_interval
from graspd.worker.validation.decomposition import decompose
from graspd.worker.validation.model import MujocoOptions
from graspd.worker.validation.refit import applicable_fits
from graspd.worker.validation.robust import reaches_share, validate_robustness
from graspd.worker.validation.variant import SHAPES, Models, Variant, axes_of, couplings_of, draw_variant

OBJECTS = ["003_cracker_box", "005_tomato_soup_can", "011_banana", "025_mug"]
#: Seed of the random models; jobs with this seed have other models.
SEED = 9102
SHARES = (0.75, 0.9)
ALL = "all at once"
WORDS = {"hull": "one hull per link", "primitive": "primitives", "capsule": "capsules", "own": ""}


def together(variants: Iterable[Variant]) -> Variant:
    """Combine variants along several axes; if two change the same value, the later one is used."""
    own, changed = asdict(Variant()), dict[str, Any]()
    for one in variants:
        changed |= {name: value for name, value in asdict(one).items() if value != own[name]}
    return replace(Variant(), **changed)


def kinds(cell: Cell, draws: int) -> dict[str, list[Callable[[np.random.Generator], Variant]]]:
    """Return, for each row of the table, functions that draw the variants in which a grasp is validated."""
    hand = cell.hand
    found: dict[str, list[Callable[[np.random.Generator], Variant]]] = {}
    for fit, grown in SHAPES:
        if fit == "own" or fit in applicable_fits(hand):
            name = WORDS[fit] or f"{1e3 * grown:+.0f} mm"
            found[f"{AXIS_MEANINGS[PerturbedParameter.SHAPES]}: {name}"] = [
                lambda _, f=fit, g=grown: Variant(fit=f, grown_m=g)
            ]  # type: ignore[misc]
    for coupling in couplings_of(hand):
        found[f"{AXIS_MEANINGS[PerturbedParameter.COUPLINGS]}: {coupling}"] = [
            lambda _, c=coupling: Variant(coupling=c)
        ]  # type: ignore[misc]
    for axis in axes_of(hand):
        if axis not in (PerturbedParameter.SHAPES, PerturbedParameter.COUPLINGS):
            found[AXIS_MEANINGS[axis]] = [lambda rng, a=axis: draw_variant(a, hand, rng)] * draws  # type: ignore[misc]
    found[ALL] = [lambda rng: together(draw_variant(axis, hand, rng) for axis in axes_of(hand))] * draws
    return found


def study(cell: Cell, draws: int) -> dict[str, Any]:
    """Return for each row of a cell how many held grasps hold again, and the cost as in a job."""
    pieces = decompose(cell.obj)
    held = np.array(cell.verdicts("standard", False)["success"]) == 1
    around = Models(cell.hand, cell.obj, pieces, MujocoOptions())
    rows: dict[str, list[int]] = {}
    for place, (name, ways) in enumerate(kinds(cell, draws).items()):
        rollouts = [
            around.standard(cell.grasps, int(row), way(np.random.default_rng((SEED, place, k, int(row))))).success
            for row in np.flatnonzero(held)
            for k, way in enumerate(ways)
        ]
        rows[name] = [int(sum(rollouts)), len(rollouts)]
    jobs: dict[str, Any] = {}
    for wanted in (0.0, *SHARES):
        began = time.process_time()
        found = validate_robustness(
            cell.hand,
            cell.obj,
            cell.grasps,
            held=held,
            wanted=wanted,
            seed=SEED,
            pieces=pieces,
            run=ExecutionContext(threads=1),
        )
        jobs[f"{wanted:g}"] = {"cpu_seconds": time.process_time() - began, "validated": int((found.held >= 0).sum())}
        if not wanted:
            share, weakest = found.share[held], found.weakest[held]
    return {
        "candidates": len(held),
        "held": int(held.sum()),
        "rows": rows,
        "jobs": jobs,
        "shares": [round(float(one), 6) for one in share],
        "weakest": [int(one) for one in weakest],
        "nominal_cpu_seconds": cell.verdicts("standard", False)["cpu_seconds"],
    }


def summed(hand: str, found: dict[str, dict[str, Any]]) -> dict[str, Any]:
    every = list(found.values())
    rows: dict[str, list[int]] = {}
    for cell in every:
        for name, (held, n) in cell["rows"].items():
            rows[name] = [held + rows.get(name, [0, 0])[0], n + rows.get(name, [0, 0])[1]]
    shares = np.concatenate([np.array(cell["shares"]) for cell in every])
    weakest = Counter(AXIS_MEANINGS[PerturbedParameter(one)] for cell in every for one in cell["weakest"] if one)
    candidates = len(shares)
    reached = {f"{wanted:g}": int(reaches_share(shares, wanted).sum()) for wanted in SHARES}
    return {
        "hand": hand,
        "candidates": sum(cell["candidates"] for cell in every),
        "held": candidates,
        "rows": rows,
        "share": float(shares.mean()),
        "reached": reached,
        "weakest": dict(weakest.most_common()),
        "cpu_ms": {
            wanted: 1e3 * sum(cell["jobs"][wanted]["cpu_seconds"] for cell in every) / candidates
            for wanted in every[0]["jobs"]
        },
        "validated": {
            wanted: sum(cell["jobs"][wanted]["validated"] for cell in every) / candidates for wanted in every[0]["jobs"]
        },
        "nominal_cpu_ms": 1e3
        * sum(cell["nominal_cpu_seconds"] for cell in every)
        / sum(c["candidates"] for c in every),
        "cells": found,
    }


def page(done: list[dict[str, Any]], objects: list[str], draws: int) -> str:
    hands = [one["hand"] for one in done]
    held = ", ".join(f"{one['hand']} {one['held']}" for one in done)
    lines = [
        "# Robustness of verdicts",
        "",
        f"Made by `python -m benchmarks.robust`. Candidates at fidelity *standard* on {', '.join(objects)}, "
        f"{done[0]['candidates'] // len(objects)} on each. Those that hold at level *standard* in the nominal model "
        f"({held}) were validated again in models with one difference. Each grasp was tested in {draws} random models "
        "per difference, but once in each kind of collision shapes and couplings. Cells: share that still holds, with "
        "its 95 % interval (Wilson, for independent verdicts).",
        "",
        f"| difference | {' | '.join(hands)} |",
        f"| --- |{' --- |' * len(hands)}",
    ]
    names = list(dict.fromkeys(name for one in done for name in one["rows"]))
    names = [name for name in names if name != ALL] + [ALL]
    lines += [f"| {name} | {' | '.join(_cell(one['rows'].get(name)) for one in done)} |" for name in names]
    lines += [
        "",
        f"Validation as with `--robust`: {ROBUST_MODELS} models per grasp, each with one difference, in random order. "
        "*First failure*: difference of the first model in which a grasp failed, with the number of such grasps.",
        "",
        "| | " + " | ".join(hands) + " |",
        f"| --- |{' --- |' * len(hands)}",
        "| mean share | " + " | ".join(f"{one['share']:.2f}" for one in done) + " |",
    ]
    for wanted in SHARES:
        cells_ = [_cell([one["reached"][f"{wanted:g}"], one["held"]]) for one in done]
        lines.append(f"| share ≥ {wanted:g} | {' | '.join(cells_)} |")
    lines += [
        "| first failure | "
        + " | ".join(", ".join(f"{name} {n}" for name, n in list(one["weakest"].items())[:4]) for one in done)
        + " |",
        "| core-ms per candidate, nominal verdict | "
        + " | ".join(f"{one['nominal_cpu_ms']:.0f}" for one in done)
        + " |",
    ]
    for wanted in ("0", *(f"{share:g}" for share in SHARES)):
        what = "all models" if wanted == "0" else f"until {wanted} is decided"
        each = " | ".join(f"{one['cpu_ms'][wanted]:.0f} ({one['validated'][wanted]:.1f} models)" for one in done)
        lines.append(f"| core-ms per held grasp, {what} | {each} |")
    return "\n".join([*lines, "", "CPU times were measured under other load; their error is about 10 %.", ""])


def _cell(counts: list[int] | None) -> str:
    if counts is None:
        return "-"
    low, high = wilson_interval(*counts)
    return f"{100 * counts[0] / counts[1]:.0f} % ({100 * low:.0f} to {100 * high:.0f})"


def main() -> None:
    parser = cell_parser(__doc__, objects=OBJECTS, grasps=16)
    parser.add_argument("--draws", type=int, default=2, help="models per axis and grasp")
    parser.add_argument("--out", type=Path)
    args = parser.parse_args()
    done = []
    for hand in args.hands:
        found = {}
        for cell in cells(args.data, args.work, hand, args.grasps, args.objects):
            found[cell.object_name] = cell.kept(f"robust-{args.draws}", lambda cell=cell: study(cell, args.draws))  # type: ignore[misc]
            sys.stderr.write(f"{hand}: {cell.object_name}\n")
        done.append(summed(hand, found))
    text = page(done, args.objects, args.draws)
    sys.stdout.write(text)
    if args.out:
        write_json(args.out / "robust.json", done)
        (args.out / "robust.md").write_text(text)


if __name__ == "__main__":
    main()

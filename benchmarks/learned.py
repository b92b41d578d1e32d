"""Seeds from a network against fast_graspd's own: processor time to the first valid grasp, and valid grasps a second.

usage: python -m benchmarks.learned --network NET.npz [OTHER.npz ...] [--data DATA_DIR] [--objects NAME ...]
           [--many 32] [--seeds 5] [--starts 4 ...] [--out FOLDER]
       DATA_DIR holds objects/; without it objects are files or names of built-in ones

On a table, at standard fidelity, certified: both methods get the same scenes, seeds and convex pieces, in turn, on one
thread. A second is one of processor time, validator and metrics included; what a pair is made ready with once is none
of it. Whether a network has seen the objects is for whoever chooses them to say. Hands are the built-in ones.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from graspd.service.model.domain import JobOptions
from graspd.service.model.errors import InputError
from graspd.service.model.fidelity import FIDELITIES
from graspd.service.model.scene_spec import SceneSpec
from graspd.service.model.version import PACKAGE_VERSION
from graspd.worker.execution_context import ExecutionContext
from graspd.worker.generation import validated_grasps
from graspd.worker.hands.load import hand_from_path
from graspd.worker.hands.model import HandModel
from graspd.worker.objects.model import ObjectModel
from graspd.worker.objects.prepare import object_from_path
from graspd.worker.planners.known_networks import keep_file, kept
from graspd.worker.scenes.placement import scenes_of
from graspd.worker.simulation.environment import Scenes
from graspd.worker.validation.decomposition import decompose

#: Not a seed that any setting was chosen with.
SEED = 404
FIDELITY = FIDELITIES["standard"]
#: Tries for a grasp before it counts as not found.
BUDGET = 16.0
HELD_OUT = ("006_mustard_bottle", "025_mug", "035_power_drill", "061_foam_brick")
TITLES = {
    "hand": "hand",
    "object": "object",
    "method": "method",
    "found": "first found",
    "first": "CPU s to the first",
    "valid": "valid share of candidates",
    "rate": "valid per CPU s",
    "gain": "rate over fast_graspd",
}


def study(
    hand: HandModel, obj: ObjectModel, methods: dict[str, dict[str, Any]], *, many: int, seeds: int
) -> list[dict[str, Any]]:
    """A row for each method: the first valid grasp of each seed, and of one batch of `many`, in the same scenes."""
    pieces = decompose(obj)
    tables = [scenes_of(SceneSpec(kind="table"), obj, [], count=4, seed=SEED + k)[0] for k in range(seeds)]
    found: dict[str, list[Any]] = {name: [] for name in methods}
    batch = {}

    def made(name: str, count: int, scenes: Scenes, seed: int, want: str = "valid") -> tuple[int, int, float]:
        request = JobOptions(
            method=name.split()[0],
            options=methods[name],
            fidelity=FIDELITY,
            seed=seed,
            want=want,
            rechecks=0,
            budget=BUDGET if count == 1 else 4.0,
        )
        began = time.process_time()
        done = validated_grasps(
            hand, obj, request, count=count, scenes=scenes, pieces=lambda _: pieces, run=ExecutionContext(threads=1)
        )
        return int(done.columns["quality/valid"].sum()), done.candidates, time.process_time() - began

    for name in methods:
        made(name, 1, tables[0], SEED - 1, "candidates")  # makes ready what is kept
    for number, scenes in enumerate(tables):
        for name in methods:
            found[name].append(made(name, 1, scenes, SEED + number))
    for name in methods:
        batch[name] = made(name, many, tables[0], SEED, "candidates")
    own = batch["fast_graspd"][0] / batch["fast_graspd"][2]
    return [
        {
            "hand": hand.name,
            "object": obj.name,
            "method": name,
            "many": many,
            "seeds": seeds,
            "found": sum(one[0] for one in found[name]),
            "firsts": [round(one[2], 3) for one in found[name]],
            "first": float(np.median([one[2] for one in found[name]])),
            "valid": batch[name][0] / batch[name][1],
            "seconds": batch[name][2],
            "rate": batch[name][0] / batch[name][2],
            "gain": batch[name][0] / batch[name][2] / own if own else None,
        }
        for name in methods
    ]


def table(rows: Sequence[dict[str, Any]]) -> str:
    lines = ["| " + " | ".join(TITLES.values()) + " |", "| --- | --- | --- |" + " --: |" * (len(TITLES) - 3)]
    for row in rows:
        shown = row | {"found": f"{row['found']} of {row['seeds']}"}
        lines.append("| " + " | ".join(_cell(shown[name]) for name in TITLES) + " |")
    return "\n".join(lines)


def page(rows: Sequence[dict[str, Any]], networks: dict[str, str], command: str) -> str:
    """The table as a page of the docs, with what each network says of itself."""
    many, seeds = rows[0]["many"], rows[0]["seeds"]
    lines = [
        "# Seeds from a network",
        "",
        f"graspd {PACKAGE_VERSION}, `{command}`: a table, {FIDELITY.name} fidelity, validated by lifts, one thread. "
        f"CPU s to the first: processor time until one grasp is valid, median over {seeds} seeds, including those that "
        f"stopped after {BUDGET:g} candidates. Valid share and rate: one batch of {many}. Times include planning, "
        "validation and metrics, but not loading.",
        "",
        *(f"- `{digest}`: {about or 'no description'}" for digest, about in networks.items()),
        "",
        table(rows),
        "",
    ]
    return "\n".join(lines)


def _cell(value: Any) -> str:
    if value is None:
        return "-"
    return f"{value:.2f}" if isinstance(value, float) else str(value)


def _object(name: str, data: Path | None) -> ObjectModel:
    mesh = name if data is None else str(data / "objects" / name / "clean.stl")
    found = object_from_path(mesh, face_error_m=FIDELITY.face_error_m)
    return found if data is None else replace(found, name=name)


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--network", nargs="+", type=Path, required=True)
    parser.add_argument("--data", type=Path)
    parser.add_argument("--objects", nargs="+", default=list(HELD_OUT))
    parser.add_argument("--many", type=int, default=32)
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--starts", type=int, nargs="+", default=[4])
    parser.add_argument("--out", type=Path)
    given = parser.parse_args(arguments)
    rows, networks = [], {}
    try:
        for file in given.network:
            digest = keep_file(file)
            network = kept(digest)
            networks[digest] = f"{network.hand}. {network.about}"
            methods: dict[str, dict[str, Any]] = {"fast_graspd": {}} | {
                f"learned starts={n}": {"network": digest, "starts": n} for n in given.starts
            }
            for name in given.objects:
                obj = _object(name, given.data)
                rows += study(hand_from_path(network.hand), obj, methods, many=given.many, seeds=given.seeds)
                sys.stdout.write(table(rows[-len(methods) :]) + "\n")
                sys.stdout.flush()
    except InputError as error:
        sys.stderr.write(f"{error}\n")
        return 2
    if given.out is not None:
        command = "python -m benchmarks.learned " + " ".join(
            f"--{name} {' '.join(str(Path(str(part)).name) for part in parts)}"
            for name, parts in (
                ("network", given.network),
                ("objects", given.objects),
                ("starts", given.starts),
                ("many", [given.many]),
                ("seeds", [given.seeds]),
            )
        )
        given.out.mkdir(parents=True, exist_ok=True)
        (given.out / "learned.json").write_text(json.dumps({"networks": networks, "rows": rows}, indent=1) + "\n")
        (given.out / "learned.md").write_text(page(rows, networks, command))
    return 0


if __name__ == "__main__":
    sys.exit(main())

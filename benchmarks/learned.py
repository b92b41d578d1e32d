"""Starts from a network compared with fast_graspd's own: time to the first valid grasp, and rate.

usage: python -m benchmarks.learned --network NET.npz [OTHER.npz ...] [--data DATA_DIR] [--objects NAME ...]
           [--many 32] [--seeds 5] [--starts 4 ...] [--out FOLDER]
       DATA_DIR holds objects/; without it objects are files or names of built-in ones

Grasps are planned on a table at fidelity standard and validated. Both methods run alternately on one thread, with the
same scenes, seeds and convex pieces. Times are processor time, including validator and metrics, without one-time
preparation of a pair. Choose objects that were not in a network's training set. Hands are the built-in ones."""

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
from graspd.worker.planners.network_cache import cache_file, load_network
from graspd.worker.scenes.placement import scenes_of
from graspd.worker.simulation.environment import Scenes
from graspd.worker.validation.decomposition import decompose

#: Seed that was not used to choose any setting.
SEED = 404
FIDELITY = FIDELITIES["standard"]
#: Largest number of candidates per grasp.
BUDGET = 16.0
HELD_OUT = ("006_mustard_bottle", "025_mug", "035_power_drill", "061_foam_brick")
TITLES = {
    "hand": "hand",
    "object": "object",
    "method": "method",
    "found": "seeds with a valid grasp",
    "first": "CPU s to the first",
    "valid": "valid share",
    "rate": "valid per CPU s",
    "gain": "relative to fast_graspd",
}


def study(
    hand: HandModel, obj: ObjectModel, methods: dict[str, dict[str, Any]], *, many: int, seeds: int
) -> list[dict[str, Any]]:
    """Return a row per method: first valid grasp of each seed and a batch of `many`, in the same scenes."""
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
        made(name, 1, tables[0], SEED - 1, "candidates")  # fills the caches
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
    """Return the table as a page of the docs, with the description of each network."""
    many, seeds = rows[0]["many"], rows[0]["seeds"]
    lines = [
        "# Seeds from a network",
        "",
        f"graspd {PACKAGE_VERSION}, `{command}`: a table, fidelity *{FIDELITY.name}*, validated by lifts, one thread. "
        "Methods of a pair ran alternately.",
        "",
        f"- *CPU s to the first*: processor time until one grasp is valid or {BUDGET:g} candidates are tested, "
        f"median over {seeds} random seeds.",
        f"- *Valid share* and *valid per CPU s*: of one batch of {many} candidates.",
        "- Times include planning, validation and metrics, but not loading.",
        "",
        "Networks:",
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
            digest = cache_file(file)
            network = load_network(digest)
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

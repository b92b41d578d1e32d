"""Success of candidates by hand and object, and their quality by hand, as Markdown.

usage: python -m benchmarks.success DATA_DIR [GRASPS [HAND ...]]     DATA_DIR holds hands/ and objects/
The validator is MuJoCo with the DexGraspBench protocol, level `standard` (see worker/validation)."""

from __future__ import annotations

import sys
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.cells import planned
from graspd.service.model.fidelity import FIDELITIES
from graspd.worker.hands.load import hand_from_path
from graspd.worker.hands.model import HandModel
from graspd.worker.objects.model import ObjectModel
from graspd.worker.objects.prepare import object_from_path
from graspd.worker.quality.table import measure
from graspd.worker.validation.decomposition import decompose
from graspd.worker.validation.validator import validate

HANDS = {
    "Allegro": "allegro/allegro_hand_right.urdf",
    "Barrett": "barrett_bh280/bh280.urdf",
    "Shadow": "shadow/shadow_hand_right.urdf",
}
#: Seed that was not used to choose any setting.
SEED = 101
#: Friction and contact threshold of ε, and number of best grasps per object by ε, as in table 2 of the paper.
FRICTION, THRESHOLD_M, BEST = 1.0, 0.005, 10
COLUMNS = ("contact_area_cm2", "epsilon", "wrench_volume", "intersection_volume_cm3")


@dataclass
class Results:
    success: list[NDArray[np.int8]] = field(default_factory=list)
    hard: list[NDArray[np.int8]] = field(default_factory=list)
    dexgraspbench: list[NDArray[np.int8]] = field(default_factory=list)
    depth: list[NDArray[np.generic]] = field(default_factory=list)
    best: list[list[float]] = field(default_factory=list)
    seconds: float = 0.0

    def add(self, hand: HandModel, obj: ObjectModel, count: int) -> str:
        pieces = decompose(obj)
        found = planned(hand, obj, count=count, seed=SEED)
        self.seconds += found.seconds
        self.success.append(validate(hand, obj, found, pieces=pieces).success)
        self.hard.append(validate(hand, obj, found, hard=True, pieces=pieces).success)
        self.dexgraspbench.append(validate(hand, obj, found, level="dexgraspbench", pieces=pieces).success)
        table = measure(hand, obj, found, friction=FRICTION, thresholds_m=[THRESHOLD_M])
        self.depth.append(table["quality/penetration_depth_mm"])
        order = np.argsort(table["quality/epsilon"][:, 0])[::-1][:BEST]
        self.best.append([float(table[f"quality/{name}"][order].mean()) for name in COLUMNS])
        return f"{self.success[-1].mean():.2f} | {self.hard[-1].mean():.2f}"

    def summary(self) -> str:
        held = np.array(self.success)
        cells = [f"{held.mean():.3f}", f"{np.array(self.hard).mean():.3f}"]
        cells += [f"{np.array(self.dexgraspbench).mean():.3f}", f"{held.any(axis=1).mean():.2f}"]
        cells += [f"{np.median(np.concatenate(self.depth)):.2f}"]
        cells += [f"{value:.2f}" for value in np.mean(self.best, axis=0)]
        cells += [f"{held.size / self.seconds:.1f}", f"{held.sum() / self.seconds:.1f}"]
        return " | ".join(cells)


def main(data: Path, count: int, names: list[str]) -> None:
    hands = {name: hand_from_path(data / "hands" / HANDS[name]) for name in names}
    results = {name: Results() for name in names}
    _row("object", *(f"{n} | {n} hard" for n in hands))
    _row("---", *["--: | --:"] * len(hands))
    for path in sorted((data / "objects").glob("*/clean.stl")):
        obj = object_from_path(path, face_error_m=FIDELITIES["standard"].face_error_m)
        _row(path.parent.name, *(results[name].add(hand, obj, count) for name, hand in hands.items()))
    titles = (
        "success",
        "hard",
        "DexGraspBench",
        "OSR",
        "median penetration mm",
        "CA cm²",
        "ε",
        "Vol",
        "IV cm³",
        "candidates/s",
        "valid/s",
    )
    sys.stdout.write("\n")
    _row("hand", *titles)
    _row("---", *["--:"] * len(titles))
    for name, result in results.items():
        _row(name, result.summary())


def _row(*cells: str) -> None:
    sys.stdout.write(f"| {' | '.join(cells)} |\n")
    sys.stdout.flush()


if __name__ == "__main__":
    main(Path(sys.argv[1]), int(sys.argv[2]) if len(sys.argv) > 2 else 32, sys.argv[3:] or list(HANDS))

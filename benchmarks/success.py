"""Success of the planner's grasps in the independent engine, per hand and object, as Markdown.

usage: python benchmarks/success.py DATA_DIR [GRASPS]     DATA_DIR holds hands/ and objects/
The referee is MuJoCo with the DexGraspBench protocol, level `certificate` (see worker/quality/referee).
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

from service.domain import FIDELITIES
from worker.hands.load import hand_from_path
from worker.objects.prepare import object_from_path
from worker.planners import synthesize
from worker.quality.referee.judge import judge

HANDS = {
    "Allegro": "allegro/allegro_hand_right.urdf",
    "Barrett": "barrett_bh280/bh280.urdf",
    "Shadow": "shadow/shadow_hand_right.urdf",
}
#: Not a seed that any setting was chosen with.
SEED = 101


def main(data: Path, count: int) -> None:
    fidelity = FIDELITIES["standard"]
    hands = {name: hand_from_path(data / "hands" / path) for name, path in HANDS.items()}
    sys.stdout.write(f"| object | {' | '.join(f'{n} | {n} hard' for n in hands)} |\n")
    sys.stdout.write("| --- |" + " --: | --: |" * len(hands) + "\n")
    rates: list[list[float]] = []
    for path in sorted((data / "objects").glob("*/clean.stl")):
        obj = object_from_path(path, face_error_m=fidelity.face_error_m)
        rates.append([])
        for hand in hands.values():
            found = synthesize(hand, obj, count=count, fidelity=fidelity, seed=SEED, device="cpu")
            for hard in (False, True):
                rates[-1].append(float(judge(hand, obj, found, hard=hard).success.mean()))
        sys.stdout.write(f"| {path.parent.name} | " + " | ".join(f"{r:.2f}" for r in rates[-1]) + " |\n")
        sys.stdout.flush()
    means = np.array(rates).mean(axis=0)
    sys.stdout.write("| **mean** | " + " | ".join(f"**{r:.3f}**" for r in means) + " |\n")


if __name__ == "__main__":
    main(Path(sys.argv[1]), int(sys.argv[2]) if len(sys.argv) > 2 else 32)

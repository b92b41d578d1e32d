"""Effect of the planner's settings: success of Allegro grasps with one setting changed, as Markdown.

usage: python -m benchmarks.recipes DATA_DIR [--objects NAME ...] [--grasps 32]

DATA_DIR holds hands/ and objects/. Candidates are planned without rollouts, so the planner's merit alone selects them.
Seconds are processor time of all threads, including postures."""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

from graspd.service.model.fidelity import FIDELITIES, Fidelity
from graspd.worker.hands.load import hand_from_path
from graspd.worker.objects.prepare import object_from_path
from graspd.worker.planners import synthesize
from graspd.worker.planners.port import PlanRequest
from graspd.worker.validation.validator import validate

OBJECTS = ("003_cracker_box", "011_banana", "006_mustard_bottle", "048_hammer", "077_rubiks_cube", "035_power_drill")
SEED = 101
CHANGES: dict[str, dict[str, Any]] = {
    "standard": {},
    "one start, no selection": {"starts": 1, "finalists": 1},
    "two starts, both refined": {"starts": 2, "finalists": 2},
    "four starts, one refined": {"starts": 4, "finalists": 1},
    "no projection": {"polish_iterations": 0},
    "initial dilation at first contact": {"dilation": "touch"},
    "13 velocities": {"velocities": 13},
    "contact solver: Gauss-Seidel": {"contact_solver": "gauss_seidel"},
}


def recipes() -> dict[str, Fidelity]:
    standard = FIDELITIES["standard"]
    found = {name: standard.model_copy(update=change) for name, change in CHANGES.items()}
    return found | {
        "attraction term only, no simulation": FIDELITIES["control"],
        "settings of the Fast-Grasp'D paper": FIDELITIES["paper"],
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path)
    parser.add_argument("--objects", nargs="*", default=OBJECTS)
    parser.add_argument("--grasps", type=int, default=32)
    given = parser.parse_args()
    hand = hand_from_path(given.data / "hands" / "allegro" / "allegro_hand_right.urdf")
    error = FIDELITIES["standard"].face_error_m
    objects = [
        object_from_path(given.data / "objects" / name / "clean.stl", face_error_m=error) for name in given.objects
    ]
    # Prepare kernels and pieces before the timed runs.
    validate(
        hand, objects[0], synthesize(hand, objects[0], PlanRequest(count=2, fidelity=FIDELITIES["standard"], seed=1))
    )
    sys.stdout.write(f"| setting | success | core-seconds for {given.grasps} grasps |\n| --- | --: | --: |\n")
    for name, fidelity in recipes().items():
        rates, seconds = [], 0.0
        for obj in objects:
            began = time.process_time()
            found = synthesize(hand, obj, PlanRequest(count=given.grasps, fidelity=fidelity, seed=SEED))
            seconds += time.process_time() - began
            rates.append(float(validate(hand, obj, found).success.mean()))
        sys.stdout.write(f"| {name} | {np.mean(rates):.2f} | {seconds / len(objects):.1f} |\n")
        sys.stdout.flush()


if __name__ == "__main__":
    main()

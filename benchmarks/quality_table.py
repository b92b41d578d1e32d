"""How long the quality table of 1,000 grasps takes, and what its parts cost.

usage: python -m benchmarks.quality_table [HAND] [OBJECT] [--grasps 1000]     files, or built-in names
The grasps are made first and do not count. Prints wall and CPU seconds of the table at three contact thresholds.
"""

from __future__ import annotations

import argparse
import sys
import time

import numpy as np

from graspd.service.model.cores import available_cores
from graspd.service.model.fidelity import FIDELITIES
from graspd.worker.execution_context import ExecutionContext
from graspd.worker.grasps import Posture
from graspd.worker.hands.load import hand_from_path
from graspd.worker.objects.prepare import object_from_path
from graspd.worker.planners import synthesize
from graspd.worker.planners.port import PlanRequest
from graspd.worker.quality.probe import HAND_POINTS, OBJECT_POINTS, probe_of
from graspd.worker.quality.table import DEFAULT_THRESHOLDS_M, measure
from graspd.worker.quality.volume import SharedVolume

SAMPLE = 64


def show(done: float, total: float, message: str) -> None:
    sys.stderr.write(f"\r{message}: {done:.0f} of {total:.0f} ")
    sys.stderr.flush()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("hand", nargs="?", default="allegro")
    parser.add_argument("object", nargs="?", default="mug")
    parser.add_argument("--grasps", type=int, default=1000)
    args = parser.parse_args()
    fidelity = FIDELITIES["standard"]
    hand, obj = hand_from_path(args.hand), object_from_path(args.object, face_error_m=fidelity.face_error_m)
    grasps = synthesize(
        hand, obj, PlanRequest(count=args.grasps, fidelity=fidelity, seed=1), ExecutionContext(progress=show)
    )
    wall, cpu = time.perf_counter(), time.process_time()
    table = measure(hand, obj, grasps, run=ExecutionContext(progress=show))
    wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    sys.stderr.write("\n")
    probe = probe_of(hand, obj, hand_points=HAND_POINTS, object_points=OBJECT_POINTS)
    sample = Posture(grasps.grasp.hand_pose[:SAMPLE], grasps.grasp.joint_positions[:SAMPLE])
    began = time.thread_time()
    found = probe.measure(sample)
    distances = time.thread_time() - began
    began = time.thread_time()
    SharedVolume(hand, obj).of(found.bodies, found.piece_distance < probe.sample_spacing)
    volumes = time.thread_time() - began
    n, count = len(sample), len(grasps)
    sys.stdout.write(
        f"{count} grasps of {hand.name} on {obj.name}, {len(obj.faces)} faces, {len(DEFAULT_THRESHOLDS_M)} thresholds: "
        f"{wall:.1f} s wall on {available_cores()} cores, {cpu:.1f} s CPU; a grasp takes {1e3 * cpu / count:.1f} ms "
        f"CPU, of which distances {1e3 * distances / n:.1f}, intersection volume {1e3 * volumes / n:.1f}, the rest "
        f"wrench spaces; median epsilon {np.median(table['quality/epsilon'][:, 1]):.2f}\n"
    )


if __name__ == "__main__":
    main()

"""Planner throughput by number of hand points and by error of the object's faces, each changed alone.

python -m benchmarks.bench_points DATA --out docs/results/bench-points"""

from __future__ import annotations

import argparse
import sys
from functools import partial
from pathlib import Path

from graspd.service.model.fidelity import FIDELITIES
from graspd.studies.bench import bench, write
from graspd.worker.engines import backend
from graspd.worker.hands.load import hand_from_path
from graspd.worker.objects.prepare import object_from_path


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path, help="folder with hands/ and objects/")
    parser.add_argument("--points", type=int, nargs="*", default=(500, 1000, 4000))
    parser.add_argument("--face-errors", type=float, nargs="*", default=(0.0, 0.001, 0.003), help="[m]")
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--out", type=Path, required=True, help="folder of bench.json and bench.md")
    given = parser.parse_args()
    backend.start_warp()
    plain = FIDELITIES["standard"]
    changes = [{"fine_points": n, "name": f"standard/points={n}"} for n in given.points]
    changes += [{"face_error_m": error, "name": f"standard/error={error:g}"} for error in given.face_errors]
    result = bench(
        hand_from_path(given.data / "hands/allegro/allegro_hand_right.urdf"),
        lambda error: object_from_path(given.data / "objects/025_mug/clean.stl", face_error_m=error),
        fidelities=[plain, *(plain.model_copy(update=change) for change in changes)],
        batches=[32],
        threads=[2],
        device="cpu",
        repeats=given.repeats,
        joins=[1],
        say=partial(print, file=sys.stderr),
    )
    write(result, given.out)


if __name__ == "__main__":
    main()

"""Diversity of standard candidates: similar pairs, grasp types, approach directions.

usage: python -m benchmarks.diversity DATA_DIR [--work DIR] [--hands allegro ...] [--objects NAME ...] [--grasps 64]
DATA_DIR holds hands/ and objects/. Prints Markdown. Interrupted runs resume; grasps are shared with other studies (see
cells.py)."""

from __future__ import annotations

import sys
from collections import Counter

import numpy as np

from benchmarks.cells import Cell, cell_parser, cells
from graspd.service.model.metrics import DIRECTION_CELLS, GraspType, entropy_bits
from graspd.worker.quality.diversity import grasp_distances, hand_points
from graspd.worker.quality.table import measure

NEAR_MM = (5, 10, 20)


def line(cell: Cell) -> tuple[str, list[int]]:
    """Return a table row and numbers of pairs: those closer than each of `NEAR_MM`, then all."""
    grasp = cell.grasps.grasp
    rows, others = np.triu_indices(len(grasp), 1)
    apart = 1e3 * grasp_distances(hand_points(cell.hand, grasp), rows, others)
    columns = measure(cell.hand, cell.obj, cell.grasps, thresholds_m=[0.005])
    types = Counter(GraspType(int(one)).name.lower() for one in columns["quality/grasp_type"])
    cells_used = np.bincount(columns["quality/approach_cell"], minlength=DIRECTION_CELLS).tolist()
    near = [int((apart < bound).sum()) for bound in NEAR_MM]
    shares = " | ".join(f"{types[name] / len(grasp):.2f}" for name in ("power", "precision", "lateral"))
    text = (
        f"| {cell.hand_name} | {cell.object_name} | {apart.min():.1f} | {' | '.join(map(str, near))} | {shares} "
        f"| {entropy_bits(types.values()):.2f} | {sum(n > 0 for n in cells_used)} | {entropy_bits(cells_used):.2f} |"
    )
    return text, [*near, len(apart)]


def main() -> None:
    parser = cell_parser(__doc__)
    args = parser.parse_args()
    sys.stdout.write(
        f"| hand | object | least distance, mm | {' | '.join(f'pairs < {n} mm' for n in NEAR_MM)} | power | precision "
        "| lateral | entropy of types, bit | directions used | entropy of directions, bit |\n|"
        + " --- |" * 2
        + " --: |" * (7 + len(NEAR_MM))
        + "\n"
    )
    sums = np.zeros(len(NEAR_MM) + 1, int)
    for hand in args.hands:
        for cell in cells(args.data, args.work, hand, args.grasps, args.objects):
            text, counts = line(cell)
            sys.stdout.write(text + "\n")
            sys.stdout.flush()
            sums += counts
    near = ", ".join(f"{s} closer than {n} mm" for n, s in zip(NEAR_MM, sums, strict=False))
    sys.stdout.write(f"\n{sums[-1]} pairs of grasps: {near}.\n")


if __name__ == "__main__":
    main()

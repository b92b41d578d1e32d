"""Penetration, contact and diversity of grasps with and without the final projection, as Markdown.

usage: python -m benchmarks.penetration DATA_DIR [--objects NAME ...] [--grasps 32]

DATA_DIR holds hands/ and objects/ (YCB) and bad/."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np

from graspd.service.model.fidelity import FIDELITIES
from graspd.service.model.transforms import apply
from graspd.worker.hands.kinematics import body_poses
from graspd.worker.hands.load import hand_from_path
from graspd.worker.hands.model import HandModel
from graspd.worker.hands.surface import sample_surface
from graspd.worker.objects.prepare import object_from_path
from graspd.worker.planners import synthesize
from graspd.worker.planners.port import PlanRequest
from graspd.worker.quality.table import measure

COMPACT = ("061_foam_brick", "005_tomato_soup_can", "006_mustard_bottle", "011_banana", "056_tennis_ball")
SHELLS = ("025_mug", "024_bowl")
THIN = ("037_scissors", "048_hammer")
PLATE = "plate of 1 mm"


def nearest_mm(hand: HandModel, poses: np.ndarray, joints: np.ndarray) -> float:
    """Return the smallest mean distance between equal surface points of two grasps [mm]."""
    points = sample_surface(hand, 200)
    bodies = body_poses(hand, poses, joints)
    world = apply(bodies[:, points.body], points.position)
    distance = np.linalg.norm(world[:, None] - world[None], axis=-1).mean(axis=-1)
    return 1e3 * float(distance[np.triu_indices(len(poses), 1)].min())


def row(hand: HandModel, path: Path, label: str, polish: bool, grasps: int) -> str:
    fidelity = FIDELITIES["standard"]
    if not polish:
        fidelity = fidelity.model_copy(update={"polish_iterations": 0})
    obj = object_from_path(path, face_error_m=fidelity.face_error_m)
    found = synthesize(hand, obj, PlanRequest(count=grasps, fidelity=fidelity, seed=2))
    quality = measure(hand, obj, found, friction=1.0)
    depth, own = quality["quality/penetration_depth_mm"], quality["quality/self_penetration_depth_mm"]
    column = int(np.argmin(np.abs(quality["quality/thresholds_m"] - 0.005)))
    area = quality["quality/contact_area_cm2"][:, column]
    shallow = 100 * (depth < 1).mean()
    return (
        f"| {label} | {'yes' if polish else 'no'} | {depth.mean():.2f} | {depth.max():.1f} | {shallow:.0f} % "
        f"| {own.mean():.2f} | {area.mean():.1f} | {quality['quality/epsilon'][:, column].mean():.2f} "
        f"| {nearest_mm(hand, found.grasp.hand_pose, found.grasp.joint_positions):.0f} |"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path)
    parser.add_argument("--objects", nargs="*", default=[*COMPACT, *SHELLS, *THIN, PLATE])
    parser.add_argument("--grasps", type=int, default=32)
    given = parser.parse_args()
    hand = hand_from_path(given.data / "hands" / "allegro" / "allegro_hand_right.urdf")
    sys.stdout.write(
        "| object | projection | penetration mm, mean | penetration mm, largest | below 1 mm | self-penetration mm, "
        "mean "
        "| contact cm² | ε | two most similar, mm |\n"
        "| --- | --- | --: | --: | --: | --: | --: | --: | --: |\n"
    )
    for name in given.objects:
        mesh = Path("bad/thin_sheet_1mm.stl") if name == PLATE else Path("objects", name, "clean.stl")
        for polish in (False, True):
            sys.stdout.write(row(hand, given.data / mesh, name, polish, given.grasps) + "\n")
            sys.stdout.flush()


if __name__ == "__main__":
    main()

"""Forearms below the table: the links above the hand's root in grasps that were planned on a table.

usage: python -m benchmarks.forearm DATA_DIR [--hand shadow/shadow_hand_right.urdf] [--objects 025_mug ...]
           [--grasps 16] [--scenes 4] [--seed 31] [--scene table] [--json OUT]
       DATA_DIR holds hands/ and objects/

Candidates of each object are planned and judged as `graspd synth --want raw --threads 1` does. The vertices of the
collision meshes of all links above the root are then placed by yourdfpy, which shares no code with graspd, at the
stored wrist angles (0 where none are stored). Their lowest height over the table counts, at the grasp and anywhere on
approach and lift. Seconds are CPU time of planning and judging a candidate.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
import yourdfpy

from service.model.domain import JobOptions
from service.model.scene_spec import SceneSpec
from worker.files.synthesis import Synthesized, synthesized
from worker.hands.load import hand_from_path

OBJECTS = ("005_tomato_soup_can", "006_mustard_bottle", "025_mug", "011_banana", "035_power_drill", "077_rubiks_cube")


class Upstream:
    """The links above the root of a hand, by yourdfpy."""

    def __init__(self, urdf: Path, root: str) -> None:
        self.robot = yourdfpy.URDF.load(
            str(urdf), load_meshes=False, build_scene_graph=True, load_collision_meshes=True,
            build_collision_scene_graph=True,
        )  # fmt: skip
        self.root = root
        carrier = {joint.child: joint for joint in self.robot.robot.joints}
        self.links: list[str] = []
        while root in carrier:
            root = carrier[root].parent
            self.links.append(root)

    def lowest(self, joints: dict[str, float], poses: np.ndarray) -> float:
        """Lowest height of their vertices [m] over root poses (P, 4, 4) in the frame of the table."""
        self.robot.update_cfg(joints | dict.fromkeys(set(self.robot.actuated_joint_names) - set(joints), 0.0))
        scene, found = self.robot.collision_scene, []
        for name in scene.graph.nodes_geometry:
            pose, geometry = scene.graph.get(name)
            if self._link(name) in self.links:
                in_base = trimesh.transform_points(scene.geometry[geometry].vertices, pose)
                found.append(in_base)
        to_root = np.linalg.inv(self.robot.get_transform(self.root, collision_geometry=True))
        points = trimesh.transform_points(np.concatenate(found), to_root)
        return float((poses[:, 2, :3] @ points.T + poses[:, 2, 3:4]).min())

    def _link(self, node: str) -> str:
        """The link that a geometry of the collision scene hangs on."""
        links, parents = {link.name for link in self.robot.robot.links}, self.robot.collision_scene.graph.transforms
        while node not in links:
            node = parents.parents[node]
        return node


def matrices(poses: np.ndarray) -> np.ndarray:
    """(N, 4, 4) of poses (N, 7)."""
    found = np.array([trimesh.transformations.quaternion_matrix(pose[3:]) for pose in poses])
    found[:, :3, 3] = poses[:, :3]
    return found


def heights(upstream: Upstream, made: Synthesized) -> np.ndarray:
    """(N, 2) lowest heights [m] of the links above the root: at the grasp, and anywhere on its way."""
    columns, found = made.arrays, []
    names = list(made.attributes.get("wrist_joint_names", []))
    for row, scene in enumerate(columns["grasp/scene_index"]):
        table = matrices(columns["scene/object_pose"][scene][None])
        wrist = columns["grasp/wrist_positions"][row] if names else ()
        joints = dict(zip(names, map(float, wrist), strict=True))
        at = table @ matrices(columns["grasp/hand_pose"][row][None])
        way = [
            columns["grasp/approach"][row],
            columns["pregrasp/hand_pose"][row][None],
            columns["grasp/lift"][row][None],
        ]
        path = table @ matrices(np.concatenate(way))
        lowest = upstream.lowest(joints, at)
        found.append((lowest, min(lowest, upstream.lowest(joints, path))))
    return np.array(found)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path)
    parser.add_argument("--hand", default="shadow/shadow_hand_right.urdf")
    parser.add_argument("--objects", nargs="+", default=OBJECTS)
    parser.add_argument("--grasps", type=int, default=16)
    parser.add_argument("--scenes", type=int, default=4)
    parser.add_argument("--seed", type=int, default=31)
    parser.add_argument("--scene", default="table")
    parser.add_argument("--json", type=Path)
    given = parser.parse_args()
    urdf = given.data / "hands" / given.hand
    upstream = Upstream(urdf, hand_from_path(urdf).root_link)
    rows: list[dict[str, Any]] = []
    ready(urdf, given)
    for name in given.objects:
        began = time.process_time()
        made = planned(urdf, given, name, given.grasps)
        seconds = time.process_time() - began
        low, valid = 1e3 * heights(upstream, made), made.arrays["quality/valid"] == 1
        summary = made.summary()
        rows.append(
            {
                "object": name,
                "candidates": len(valid),
                "valid": int(valid.sum()),
                "lifted": round(summary["lift_share"] * len(valid)),
                "clear": round(summary["clear_share"] * len(valid)),
                "below_at_grasp": int((low[valid, 0] < 0).sum()),
                "below_on_way": int((low[valid, 1] < 0).sum()),
                "deepest_mm": round(max(0.0, -float(low[valid].min(initial=0.0))), 1),
                "seconds": round(seconds / len(valid), 3),
            }
        )
        sys.stdout.write(json.dumps(rows[-1]) + "\n")
        sys.stdout.flush()
    sys.stdout.write(json.dumps(total(rows)) + "\n")
    if given.json:
        given.json.write_text(json.dumps({"rows": rows, "all": total(rows)}, indent=1) + "\n")


def planned(urdf: Path, given: argparse.Namespace, name: str, count: int) -> Synthesized:
    """Candidates of the hand on an object."""
    mesh = given.data / "objects" / name / "clean.stl"
    request = JobOptions(grasps=count, seed=given.seed, want="raw")
    place = SceneSpec(kind=given.scene)
    return synthesized(str(urdf), str(mesh), request, place=place, scenes=given.scenes, device="cpu", threads=1)


def ready(urdf: Path, given: argparse.Namespace) -> None:
    """Kernels, pieces and postures that are made once and kept, so that they cost no candidate."""
    for name in given.objects:
        planned(urdf, given, name, 1)


def total(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Shares over all objects."""
    counts = {key: sum(row[key] for row in rows) for key in rows[0] if key not in ("object", "deepest_mm", "seconds")}
    valid = max(1, counts["valid"])
    return counts | {
        "lift_share": round(counts["lifted"] / counts["candidates"], 3),
        "below_share": round(counts["below_on_way"] / valid, 3),
        "deepest_mm": max(row["deepest_mm"] for row in rows),
        "seconds": round(float(np.mean([row["seconds"] for row in rows])), 3),
    }


if __name__ == "__main__":
    main()

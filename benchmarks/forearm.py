"""Collisions of forearms (the links above the hand's root) in grasps planned in scenes.

usage: python -m benchmarks.forearm DATA_DIR [--hand shadow/shadow_hand_right.urdf] [--objects 025_mug ...]
           [--grasps 16] [--scenes 4] [--seed 31] [--scene table] [--beside 048_hammer ...] [--json OUT]
       DATA_DIR holds hands/ and objects/

Candidates of each object are planned and validated as by `graspd synth --want candidates --threads 1`. Then yourdfpy,
which shares no code with graspd, places the collision meshes of all links above the root. Wrist angles are the stored
ones, or 0. Results on approach, grasp and lift are the lowest height of the meshes' vertices, and the common volume
with supports or neighbours, by manifold3d. Seconds are CPU time of planning and validation per candidate."""

from __future__ import annotations

import argparse
import json
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
import yourdfpy

from graspd.service.model.domain import JobOptions
from graspd.service.model.scene_spec import Box, NeighbourSpec, SceneSpec, scene_supports
from graspd.worker.files.synthesis import SynthesisResult, synthesize_grasps
from graspd.worker.hands.load import hand_from_path

OBJECTS = ("005_tomato_soup_can", "006_mustard_bottle", "025_mug", "011_banana", "035_power_drill", "077_rubiks_cube")

#: Checked postures of a grasp besides its approach.
POSES = ("pregrasp/hand_pose", "grasp/hand_pose", "grasp/lift")
#: Smaller common volumes are rounding errors [m^3].
COMMON_M3 = 1e-9


class Upstream:
    """The links above the root of a hand, by yourdfpy."""

    def __init__(self, urdf: Path, root: str) -> None:
        self.robot = yourdfpy.URDF.load(
            str(urdf),
            load_meshes=False,
            build_scene_graph=True,
            load_collision_meshes=True,
            build_collision_scene_graph=True,
        )
        self.root = root
        carrier = {joint.child: joint for joint in self.robot.robot.joints}
        self.links: list[str] = []
        while root in carrier:
            root = carrier[root].parent
            self.links.append(root)

    def at(self, joints: dict[str, float]) -> list[trimesh.Trimesh]:
        """Return the collision meshes of the links in the frame of the root."""
        self.robot.update_cfg(joints | dict.fromkeys(set(self.robot.actuated_joint_names) - set(joints), 0.0))
        scene, found = self.robot.collision_scene, []
        to_root = np.linalg.inv(self.robot.get_transform(self.root, collision_geometry=True))
        for name in scene.graph.nodes_geometry:
            pose, geometry = scene.graph.get(name)
            if self._link(name) in self.links:
                mesh = scene.geometry[geometry].copy().apply_transform(to_root @ pose)
                found.append(mesh if mesh.is_volume else mesh.convex_hull)
        return found

    def _link(self, node: str) -> str:
        """Return the link of a geometry in the collision scene."""
        links, parents = {link.name for link in self.robot.robot.links}, self.robot.collision_scene.graph.transforms
        while node not in links:
            node = parents.parents[node]
        return node


def matrices(poses: np.ndarray) -> np.ndarray:
    found = np.array([trimesh.transformations.quaternion_matrix(pose[3:]) for pose in poses])
    found[:, :3, 3] = poses[:, :3]
    return found


@dataclass(frozen=True)
class Found:
    """Results of N grasps for the links above the root, on approach, grasp and lift."""

    lowest: np.ndarray
    """(N,) lowest heights [mm]."""
    inside: np.ndarray
    """(N,) whether the links collide with a support or neighbour."""


def look(upstream: Upstream, made: SynthesisResult, beside: list[trimesh.Trimesh]) -> Found:
    """Return the results for the links above the root of each grasp, among supports and neighbours."""
    columns, lowest, inside = made.arrays, [], []
    names = list(made.attributes.get("wrist_joint_names", []))
    supports = [solid(one) for one in scene_supports(made.place)]
    for row, scene in enumerate(columns["grasp/scene_index"]):
        wrist = columns["grasp/wrist_positions"][row] if names else ()
        links = upstream.at(dict(zip(names, map(float, wrist), strict=True)))
        others = [
            mesh.copy().apply_transform(matrix(columns["scene/neighbour_pose"][scene][k]))
            for k, mesh in enumerate(beside)
        ]
        to_scene = matrix(columns["scene/object_pose"][scene])
        way = [*columns["grasp/approach"][row], *(columns[name][row] for name in POSES)]
        placed = [mesh.copy().apply_transform(to_scene @ matrix(pose)) for pose in way for mesh in links]
        lowest.append(1e3 * min(float(mesh.vertices[:, 2].min()) for mesh in placed))
        inside.append(any(meets(a, b) for a in placed for b in (*supports, *others)))
    return Found(np.array(lowest), np.array(inside))


def solid(support: Any) -> trimesh.Trimesh:
    """Return the solid of a support; for a horizontal half-space, its uppermost metre."""
    if isinstance(support, Box):
        return trimesh.creation.box(support.size, transform=matrix(np.asarray(support.pose)))
    return trimesh.creation.box((6.0, 6.0, 1.0), transform=matrix(np.array([0, 0, support.offset - 0.5, 1, 0, 0, 0])))


def meets(a: trimesh.Trimesh, b: trimesh.Trimesh) -> bool:
    """Return whether the common volume of two solids exceeds `COMMON_M3`."""
    if (a.bounds[0] > b.bounds[1]).any() or (b.bounds[0] > a.bounds[1]).any():
        return False
    return float(trimesh.boolean.intersection([a, b], engine="manifold").volume) > COMMON_M3


def matrix(pose: np.ndarray) -> np.ndarray:
    found = trimesh.transformations.quaternion_matrix(pose[3:])
    found[:3, 3] = pose[:3]
    return np.asarray(found)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path)
    parser.add_argument("--hand", default="shadow/shadow_hand_right.urdf")
    parser.add_argument("--objects", nargs="+", default=OBJECTS)
    parser.add_argument("--grasps", type=int, default=16)
    parser.add_argument("--scenes", type=int, default=4)
    parser.add_argument("--seed", type=int, default=31)
    parser.add_argument("--scene", default="table")
    parser.add_argument("--beside", nargs="+", default=())
    parser.add_argument("--json", type=Path)
    given = parser.parse_args()
    urdf = given.data / "hands" / given.hand
    upstream = Upstream(urdf, hand_from_path(urdf).root_link)
    others = [trimesh.load(given.data / "objects" / name / "clean.stl") for name in given.beside]
    rows: list[dict[str, Any]] = []
    ready(urdf, given)
    for name in given.objects:
        began = time.process_time()
        made = planned(urdf, given, name, given.grasps)
        seconds = time.process_time() - began
        found, valid = look(upstream, made, others), made.arrays["quality/valid"] == 1
        summary = made.summary()
        rows.append(
            {
                "object": name,
                "candidates": len(valid),
                "valid": int(valid.sum()),
                "lifted": round(summary["lift_share"] * len(valid)),
                "clear": round(summary["clear_share"] * len(valid)),
                "below": int((found.lowest[valid] < 0).sum()),
                "inside": int(found.inside[valid].sum()),
                "deepest_mm": round(max(0.0, -float(found.lowest[valid].min(initial=0.0))), 1),
                "seconds": round(seconds / len(valid), 3),
            }
        )
        sys.stdout.write(json.dumps(rows[-1]) + "\n")
        sys.stdout.flush()
    sys.stdout.write(json.dumps(total(rows)) + "\n")
    if given.json:
        given.json.write_text(json.dumps({"rows": rows, "all": total(rows)}, indent=1) + "\n")


def planned(urdf: Path, given: argparse.Namespace, name: str, count: int) -> SynthesisResult:
    mesh = given.data / "objects" / name / "clean.stl"
    request = JobOptions(grasps=count, seed=given.seed, want="candidates")
    beside = tuple(NeighbourSpec(object=str(given.data / "objects" / one / "clean.stl")) for one in given.beside)
    place = SceneSpec(kind=given.scene, neighbours=beside)
    return synthesize_grasps(str(urdf), str(mesh), request, place=place, scenes=given.scenes, device="cpu", threads=1)


def ready(urdf: Path, given: argparse.Namespace) -> None:
    """Prepare cached kernels, pieces and postures before the timed run."""
    for name in given.objects:
        planned(urdf, given, name, 1)


def total(rows: list[dict[str, Any]]) -> dict[str, Any]:
    counts = {key: sum(row[key] for row in rows) for key in rows[0] if key not in ("object", "deepest_mm", "seconds")}
    valid = max(1, counts["valid"])
    return counts | {
        "lift_share": round(counts["lifted"] / counts["candidates"], 3),
        "below_share": round(counts["below"] / valid, 3),
        "inside_share": round(counts["inside"] / valid, 3),
        "deepest_mm": max(row["deepest_mm"] for row in rows),
        "seconds": round(float(np.mean([row["seconds"] for row in rows])), 3),
    }


if __name__ == "__main__":
    main()

"""Drops of the convex hull against drops of convex pieces, and grasps that a forearm would block."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any, Final

import mujoco
import numpy as np

from benchmarks.modelling.common import SEED, Floats, Row, Subject, cpu, share
from graspd.service.model.transforms import compose, quat_rotate
from graspd.worker.objects.model import ObjectModel
from graspd.worker.scenes import simulate
from graspd.worker.scenes.clearance import transfer_grasps
from graspd.worker.scenes.rest import RestingFaces, same_face_mask
from graspd.worker.validation.decomposition import ConvexPieces, decompose

#: Forearm: a straight round rod from the palm through the Allegro's flange, along -z of its root [m].
AWAY: Final = np.array([0.0, 0.0, -1.0])
FOREARM_RADIUS_M: Final = 0.04
FOREARM_M: Final = 0.3


def drops(objects: list[ObjectModel], count: int) -> list[Row]:
    """Return per object the agreement of both models on resting faces of equal releases, and the cost."""
    rows = []
    for obj in objects:
        pieces = decompose(obj)
        hull = simulate._build_table(obj)
        model = _in_pieces(obj, pieces, hull.model)
        tables = {"hull": hull, "pieces": replace(hull, model=model, data=mujoco.MjData(model))}
        rests, seconds = {}, {}
        for name, table in tables.items():
            with cpu() as clock:
                rests[name] = [simulate._drop_until_rest(table, (SEED, k)) for k in range(count)]
            seconds[name] = clock.seconds
        faces = {name: np.array([rest.face for rest in found]) for name, found in rests.items()}
        again = np.array([simulate._drop_until_rest(hull, (SEED + 1, k)).face for k in range(count)])
        rows.append(
            {
                "object": obj.name,
                "pieces": len(pieces),
                "drops": count,
                "same_face": share(
                    int(sum(_same(hull.faces, a, b) for a, b in zip(faces["hull"], faces["pieces"], strict=True))),
                    count,
                ),
                "distance": _distance(hull.faces, faces["hull"], faces["pieces"]),
                "distance_of_two_seeds": _distance(hull.faces, faces["hull"], again),
                "cost_ratio": seconds["pieces"] / seconds["hull"],
            }
        )
    return rows


def _in_pieces(obj: ObjectModel, pieces: ConvexPieces, hull: Any) -> Any:
    """Return a drop's scene with the object's pieces as collision shapes; the rest is as in `hull`."""
    spec = simulate.spec_above_table([obj])
    body = spec.body("0")
    spec.delete(body.geoms[0])
    spec.delete(spec.mesh("0"))
    for i, corners in enumerate(pieces.vertices):
        mesh = spec.add_mesh(name=f"piece{i}")
        mesh.uservert = np.asarray(corners, np.float32).ravel()
        mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_CONVEX
        geom = body.add_geom(condim=6, friction=[0.8, 0.005, 0.002], solref=[0.006, 1.0])
        geom.type, geom.meshname = mujoco.mjtGeom.mjGEOM_MESH, f"piece{i}"
        # The pieces touch only the table: pieces of one body do not collide.
    model = spec.compile()
    assert np.isclose(model.body_mass[1], hull.body_mass[1])
    return model


def _same(faces: RestingFaces, a: int, b: int) -> bool:
    return bool(same_face_mask(faces, int(a), np.array([b]))[0])


def _distance(faces: RestingFaces, a: Any, b: Any) -> float:
    """Return the total variation distance of the shares of resting faces: 0 equal, 1 disjoint."""
    left, total = list(b), 0
    for face in a:
        match = next((k for k, other in enumerate(left) if _same(faces, face, other)), None)
        if match is not None:
            left.pop(match)
            total += 1
    return 1.0 - total / len(a)


def forearm(root: Floats, palm: Floats) -> tuple[Floats, Floats]:
    """Return the lowest height (K,) of forearm ends at poses (K, 7), and the sine (K,) of their slopes."""
    far = quat_rotate(root[:, 3:], np.tile(palm + FOREARM_M * AWAY, (len(root), 1)))[:, 2]
    slope = quat_rotate(root[:, 3:], np.tile(AWAY, (len(root), 1)))[:, 2]
    # Lowest point on the rim of the end.
    return root[:, 2] + far - FOREARM_RADIUS_M * np.sqrt(np.maximum(0.0, 1 - slope**2)), slope


def arm(subjects: list[Subject], scenes: int) -> Row:
    """Return the share of clear grasps on a table whose forearm would collide with the table at contact."""
    kept, hit, down, candidates, distinct = 0, 0, 0, 0, 0
    for s in subjects:
        poses = simulate.drop(s.obj, count=scenes, seed=SEED)["scene/object_pose"]
        found = transfer_grasps(s.hand, s.grasps.grasp, s.grasps.pregrasp, poses)
        valid = np.flatnonzero(found["grasp/valid"])
        distinct += len(np.unique(found["grasp/base_index"][valid]))
        base = s.grasps.grasp.hand_pose[found["grasp/base_index"][valid]]
        root = compose(poses[found["grasp/scene_index"][valid]], base)
        lowest, slope = forearm(root, s.hand.palm.centre)
        kept, candidates = kept + len(valid), candidates + len(found["grasp/valid"])
        hit, down = hit + int((lowest < 0).sum()), down + int((slope < 0).sum())
    if not kept:
        return {"candidates": candidates, "kept": 0}
    return {
        "candidates": candidates,
        "kept": kept,
        "distinct_grasps": distinct,
        "in_the_table": share(hit, kept),
        "downward": share(down, kept),
    }


def study(subjects: list[Subject], objects: Callable[[], list[ObjectModel]], count: int) -> dict[str, Any]:
    return {"drops": drops(objects(), count), "arm": arm(subjects, count // 2)}

"""Rest poses in which a surface change of 1 mm makes objects roll or topple: geometry and simulation.

usage: python -m benchmarks.rolling DATA_DIR [--objects 011_banana ...] [--variants 8] [--page OUT.md]
       DATA_DIR holds objects/

The drops exclude no stable face; for a face that scenes do not use, the table has the reason. The simulation has the
physics of the lift test without a hand and lasts as long as a hand closes. It uses the object's own pieces, and pieces
whose corners are moved by up to 1 mm."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final
from unittest.mock import patch

import mujoco
import numpy as np

from graspd.service.model.transforms import Floats, quat_conjugate, quat_multiply, quat_rotate
from graspd.worker.objects.model import ObjectModel
from graspd.worker.objects.prepare import object_from_path
from graspd.worker.scenes import simulate
from graspd.worker.scenes.rest import CHANGE_M, RestingFaces, lay_flat, resting_faces
from graspd.worker.validation.decomposition import decompose
from graspd.worker.validation.model import FRICTION, MujocoOptions, add_object

SEED, DROPS, SECONDS = 5, 64, 0.8
HEAD: Final = """# Rest poses in which objects roll or topple

`python -m benchmarks.rolling DATA`: resting faces of each object after {drops} drops. A turn is a rotation of the
object.

- *Drops*: number of drops that end on the face.
- *Turn by geometry*: largest turn that a change of the surface by 1 mm allows.
- *Pose*: kept, or the reason why scenes do not use the face.
- *Own pieces*: turn in simulation with the object's convex pieces; *changed*: largest turn with {variants} changes of
  these pieces by up to 1 mm.

"""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path)
    parser.add_argument("--objects", nargs="+")
    parser.add_argument("--variants", type=int, default=8)
    parser.add_argument("--page", type=Path, help="file for the table in Markdown")
    given = parser.parse_args()
    rows = [
        "| object | drops | turn by geometry [deg] | pose | own pieces [deg] | changed [deg] |",
        "|---|--:|--:|---|--:|--:|",
    ]
    for mesh in sorted((given.data / "objects").glob("*/clean.stl")):
        name = mesh.parent.name
        if not given.objects or name in given.objects:
            rows += [
                f"| {name} | {row} |" for row in poses_of(object_from_path(mesh, face_error_m=5e-4), given.variants)
            ]
            print("\n".join(row for row in rows if name in row), flush=True)  # noqa: T201
    if given.page:
        given.page.write_text(HEAD.format(variants=given.variants, drops=DROPS) + "\n".join(rows) + "\n")


def poses_of(obj: ObjectModel, variants: int) -> list[str]:
    """Return the table cells of each resting face, the most frequent face first."""
    faces = resting_faces(obj)
    table = simulate._build_table(obj.centred)
    with patch.object(RestingFaces, "can_topple", lambda self, face: False):
        found = np.array([simulate._drop_until_rest(table, (SEED, k)).face for k in range(DROPS)])
    steady, cells = not all(faces.can_roll(int(face)) for face in found), []
    for face, count in sorted(zip(*np.unique(found, return_counts=True), strict=True), key=lambda one: -one[1]):
        turn, _ = faces.possible_motion(int(face))
        pose = lay_flat(faces, int(face), np.array([0.0, 0, 0, 1, 0, 0, 0]))
        angles = np.degrees(turns(obj, pose, variants))
        word = "topples" if faces.can_topple(int(face)) else "rolls" if steady and faces.can_roll(int(face)) else "kept"
        cells.append(f"{count} | {np.degrees(turn):.0f} | {word} | {angles[0]:.1f} | {angles[1:].max():.1f}")
    return cells


def turns(obj: ObjectModel, pose: Floats, variants: int) -> Floats:
    """Return (1 + variants,) angles by which an object rotates from a pose (7,) on a table [rad]."""
    pieces, rng = decompose(obj).vertices, np.random.default_rng(0)
    changed = [[p + CHANGE_M * rng.uniform(-1, 1, p.shape) / np.sqrt(3) for p in pieces] for _ in range(variants)]
    return np.array([turn(obj, some, pose) for some in (pieces, *changed)])


def turn(obj: ObjectModel, pieces: Sequence[Floats], pose: Floats) -> float:
    """Return the angle by which the object rotates from the pose with these pieces [rad]."""
    physics, friction, spec = MujocoOptions(), [*FRICTION, 1e-4], mujoco.MjSpec()
    option: Any = spec.option
    option.timestep, option.impratio, option.noslip_iterations = physics.timestep, 10.0, physics.noslip_iterations
    option.integrator, option.cone = mujoco.mjtIntegrator.mjINT_IMPLICITFAST, mujoco.mjtCone.mjCONE_ELLIPTIC
    add_object(spec, obj, pieces, friction, obj.mass)
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0, 0, 0.1], condim=4, friction=friction)
    model = spec.compile()
    data = mujoco.MjData(model)
    lowest = min(float((quat_rotate(pose[3:], part) + pose[:3])[:, 2].min()) for part in pieces)
    data.qpos[:3] = pose[:3] + quat_rotate(pose[3:], obj.centre_of_mass) - [0, 0, lowest]
    data.qpos[3:] = pose[3:]
    mujoco.mj_step(model, data, nstep=round(SECONDS / physics.timestep))
    turned = quat_multiply(data.qpos[3:], quat_conjugate(pose[3:]))
    return float(2 * np.arctan2(np.linalg.norm(turned[1:]), abs(turned[0])))


if __name__ == "__main__":
    main()

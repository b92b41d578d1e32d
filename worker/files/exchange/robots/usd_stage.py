"""Grasps as USD stages, one file each: hand and object posed, and their way over time. Needs the extra `usd`.

A stage is in metres and z up. Its default values show the grasp; time samples, 24 a second, lead from the standoff to
the lift.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final

import numpy as np

from service.model.errors import InputError
from service.model.transforms import Floats, pose_to_matrix
from worker.files.exchange.names import prim_names
from worker.files.exchange.robots.bundle import Bundle
from worker.files.exchange.robots.solids import Solid, hand_meshes, object_mesh, support_meshes
from worker.hands.kinematics import body_poses
from worker.robots.execution import Executions, posed_bodies
from worker.robots.timing import Trajectory

RATE: Final = 24.0


def write(bundle: Bundle, folder: Path) -> list[Path]:
    """Write `GRASP.usd` with `/World/HAND/LINK`, `/World/OBJECT` and `/World/scene`.

    Raises:
        InputError: usd-core is not installed.
    """
    try:
        from pxr import Usd, UsdGeom
    except ImportError:
        raise InputError("the format usd needs usd-core; run pip install 'graspd[usd]'") from None
    folder.mkdir(parents=True, exist_ok=True)
    found, written = bundle.found, []
    moving, thing, standing = hand_meshes(found), object_mesh(found), support_meshes(found)
    for row, trajectory in enumerate(bundle.trajectories):
        written.append(folder / f"{bundle.name(row)}.usd")
        written[-1].unlink(missing_ok=True)
        stage = Usd.Stage.CreateNew(str(written[-1]))
        UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
        UsdGeom.SetStageMetersPerUnit(stage, 1.0)
        stage.SetTimeCodesPerSecond(RATE)
        stage.SetStartTimeCode(0.0)
        stage.SetEndTimeCode(RATE * float(trajectory.time[-1]))
        stage.SetDefaultPrim(UsdGeom.Xform.Define(stage, "/World").GetPrim())
        object_prim, hand_prim = bundle.prims
        root = f"/World/{hand_prim}"
        UsdGeom.Xform.Define(stage, root)
        bodies, times = _bodies(found, trajectory), RATE * trajectory.time
        at_grasp = posed_bodies(found, "grasp", row)
        for solid, name in zip(moving, prim_names([solid.name for solid in moving]), strict=True):
            _add(stage, f"{root}/{name}", solid, at_grasp[solid.body], bodies[:, solid.body], times)
        pose = found.object_pose[row]
        _add(stage, f"/World/{object_prim}", thing, pose, _object_poses(found, row, trajectory), times)
        for solid in standing:
            _add(stage, f"/World/scene/{solid.name}", solid)
        stage.Save()
    return written


def _bodies(found: Executions, trajectory: Trajectory) -> Floats:
    """(K, L, 7) bodies of the hand at each point; the hand's joints are the last of the trajectory's."""
    joints = trajectory.joints[:, -len(found.hand.joint_names) :]
    return body_poses(found.hand, trajectory.hand_pose, joints)


def _object_poses(found: Executions, row: int, trajectory: Trajectory) -> Floats:
    """(K, 7) of the object: at rest, then carried by the lift."""
    poses = np.tile(found.object_pose[row], (len(trajectory.time), 1))
    lifting = np.array([phase == "lift" for phase in trajectory.phase])
    start = found.postures["squeeze"].hand_pose[row, :3]
    poses[lifting, :3] += trajectory.hand_pose[lifting, :3] - start
    return poses


def _add(
    stage: Any, path: str, solid: Solid, pose: Floats | None = None, poses: Floats | None = None, times: Any = ()
) -> None:
    from pxr import Gf, UsdGeom, Vt

    frame = UsdGeom.Xform.Define(stage, path)
    if pose is not None and poses is not None:
        operation = frame.AddTransformOp()
        # USD multiplies row vectors.
        operation.Set(Gf.Matrix4d(pose_to_matrix(pose).T))
        for time, matrix in zip(times, pose_to_matrix(poses), strict=True):
            operation.Set(Gf.Matrix4d(matrix.T), float(time))
    mesh = UsdGeom.Mesh.Define(stage, f"{path}/mesh")
    mesh.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(solid.vertices, np.float32)))
    mesh.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(np.full(len(solid.faces), 3, np.int32)))
    mesh.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(np.ascontiguousarray(solid.faces, np.int32).ravel()))
    mesh.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    mesh.CreateDisplayColorAttr([Gf.Vec3f(*solid.colour)])
    low, high = (np.asarray(bound(solid.vertices, axis=0), float) for bound in (np.min, np.max))
    mesh.CreateExtentAttr([Gf.Vec3f(*map(float, low)), Gf.Vec3f(*map(float, high))])

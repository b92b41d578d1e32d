"""Grasps as posed meshes, one file each: binary glTF (+y up), and USD stages over time (extra `usd`).

A stage is in metres, z up, at 24 time codes per second. Default values show the grasp, time samples the motion."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from graspd.exchange.plan import plain_name, prim_names
from graspd.exchange.robots.bundle import Bundle
from graspd.service.model.errors import InputError
from graspd.service.model.transforms import Floats, pose_to_matrix
from graspd.worker.episodes.execution import Executions, RobotTrajectory, posed_bodies
from graspd.worker.hands.kinematics import body_poses
from graspd.worker.hands.primitives import hull
from graspd.worker.hands.robot import Ints
from graspd.worker.objects.glb_document import Document, rounded_values
from graspd.worker.objects.mesh_geometry import corner_normals
from graspd.worker.rendering.hands import drawn_bodies, hand_parts
from graspd.worker.simulation.environment import Obstacle

#: Rotation from z up to glTF's y up, as x y z w.
_UPRIGHT: Final = [-float(np.sqrt(0.5)), 0.0, 0.0, float(np.sqrt(0.5))]


def write_glb(bundle: Bundle, folder: Path) -> list[Path]:
    """Write `GRASP.glb` with a node for each link, the object, each support and `tool_frame`."""
    folder.mkdir(parents=True, exist_ok=True)
    found, written = bundle.found, []
    moving, thing, standing = hand_meshes(found), object_mesh(found), support_meshes(found)
    for row in range(len(found)):
        document = Document()
        nodes: list[dict[str, Any]] = [{"name": bundle.grasp_name(row), "rotation": _UPRIGHT}]
        bodies = posed_bodies(found, "grasp", row)
        poses = [*(bodies[solid.body] for solid in moving), found.object_pose[row], *(None for _ in standing)]
        for solid, pose in zip([*moving, thing, *standing], poses, strict=True):
            primitive = document.add_triangles(solid.vertices, solid.faces, solid.normals, solid.colour)
            nodes.append({"name": solid.name, "mesh": document.add_mesh([primitive]), **_node_transform(pose)})
        nodes.append({"name": "tool_frame", **_node_transform(found.tool_pose("grasp")[row])})
        nodes[0]["children"] = list(range(1, len(nodes)))
        said = {"kind": "grasp", "row": int(found.rows[row]), "frame": found.frame, "tool_frame": found.tool.name}
        written.append(folder / f"{bundle.grasp_name(row)}.glb")
        written[-1].write_bytes(document.to_bytes(nodes, said))
    return written


def _node_transform(pose: Floats | None) -> dict[str, Any]:
    if pose is None:
        return {}
    return {"translation": rounded_values(pose[:3]), "rotation": rounded_values(np.roll(pose[3:], -1))}


Colour = tuple[float, float, float]
OBJECT_COLOUR: Final[Colour] = (0.72, 0.2, 0.04)
SUPPORT_COLOUR: Final[Colour] = (0.5, 0.5, 0.47)
SLAB_M: Final = (1.0, 0.02)  # width and thickness of the slab that shows a half-space [m]


@dataclass(frozen=True)
class Solid:
    """A mesh in the frame of its carrier."""

    name: str
    vertices: Floats
    faces: Ints
    normals: Floats  # (F, 3, 3) unit normals of the corners of faces
    colour: Colour  # linear RGB, 0 .. 1.
    body: int | None = None  # body of the hand to which the mesh belongs; None for the object and supports


def hand_meshes(found: Executions) -> list[Solid]:
    """Return the hand's visible meshes in their bodies' frames.
    The second and further meshes of a body are numbered."""
    bodies, made = drawn_bodies(found.hand), []
    for number, part in enumerate(hand_parts(found.hand)):
        before = bodies[:number].count(bodies[number])
        name = found.hand.body_names[bodies[number]] + (f"_{before + 1}" if before else "")
        solid = part.solid
        made.append(Solid(name, solid.vertices, solid.faces, solid.corner_normals, part.look.base, part.body))
    return made


def object_mesh(found: Executions) -> Solid:
    """Return the object's mesh in its own frame."""
    obj = found.obj
    return Solid(plain_name(obj.name), obj.vertices, obj.faces, obj.corner_normals, OBJECT_COLOUR)


def support_meshes(found: Executions) -> list[Solid]:
    """Return the supports in the frame of the scene; half-spaces as slabs around the objects."""
    supports = () if found.placed is None else found.placed.supports
    middle = found.object_pose[:, :3].mean(axis=0)
    hulls = [hull(_corners(one, middle)) for one in supports]
    return [
        Solid(f"support_{k}", vertices, faces, corner_normals(vertices, faces), SUPPORT_COLOUR)
        for k, (vertices, faces) in enumerate(hulls)
    ]


def _corners(support: Obstacle, middle: Floats) -> Floats:
    if len(support.corners):
        return support.corners
    normal, offset = support.planes[0, :3], float(support.planes[0, 3])
    foot = middle - (middle @ normal - offset) * normal
    across = np.cross(normal, np.eye(3)[int(np.argmin(np.abs(normal)))])
    across /= np.linalg.norm(across)
    width, thickness = SLAB_M
    ends = [(a, b, c) for a in (-0.5, 0.5) for b in (-0.5, 0.5) for c in (-1, 0)]
    beside = np.cross(normal, across)
    return np.array([foot + width * (a * across + b * beside) + thickness * c * normal for a, b, c in ends])


RATE: Final = 24.0  # time codes per second


def write_usd(bundle: Bundle, folder: Path) -> list[Path]:
    """Write `GRASP.usd` with `/World/HAND/LINK`, `/World/OBJECT` and `/World/scene`.
    Raises InputError: usd-core is missing."""
    try:
        from pxr import Usd, UsdGeom
    except ImportError:
        raise InputError("the format usd needs usd-core; run pip install 'graspd[usd]'") from None
    folder.mkdir(parents=True, exist_ok=True)
    found, written = bundle.found, []
    moving, thing, standing = hand_meshes(found), object_mesh(found), support_meshes(found)
    for row, trajectory in enumerate(bundle.trajectories):
        written.append(folder / f"{bundle.grasp_name(row)}.usd")
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
        # Joints of the arm, if any, come before the hand's.
        joints = trajectory.joints[:, -len(found.hand.joint_names) :]
        bodies, times = body_poses(found.hand, trajectory.hand_pose, joints), RATE * trajectory.time
        at_grasp = posed_bodies(found, "grasp", row)
        for solid, name in zip(moving, prim_names([solid.name for solid in moving]), strict=True):
            _add_mesh_prim(stage, f"{root}/{name}", solid, at_grasp[solid.body], bodies[:, solid.body], times)
        pose = found.object_pose[row]
        _add_mesh_prim(stage, f"/World/{object_prim}", thing, pose, _object_poses(found, row, trajectory), times)
        for solid in standing:
            _add_mesh_prim(stage, f"/World/scene/{solid.name}", solid)
        stage.Save()
    return written


def _object_poses(found: Executions, row: int, trajectory: RobotTrajectory) -> Floats:
    """Return (K, 7) object poses: at rest, then carried by the lift."""
    poses = np.tile(found.object_pose[row], (len(trajectory.time), 1))
    lifting = np.array([phase == "lift" for phase in trajectory.phase])
    start = found.postures["squeeze"].hand_pose[row, :3]
    poses[lifting, :3] += trajectory.hand_pose[lifting, :3] - start
    return poses


def _add_mesh_prim(
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

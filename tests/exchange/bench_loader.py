"""DexGraspBench's loader, rebuilt: what it does was read in its source (evaluation, base class of the tests, hand and
object specs) and is written anew here; MuJoCo then loads what it would load."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import yaml
from scipy.spatial.transform import Rotation, Slerp

PREFIX = "child-"


@dataclass
class Loaded:
    """One grasp as the evaluator holds it."""

    grasp: dict[str, Any]
    hand: dict[str, Any]
    model: Any
    data: Any

    def at(self, qpos: np.ndarray) -> None:
        """Hand and object where the evaluator puts them: hand first, object last."""
        self.data.qpos[: len(qpos)] = qpos
        self.data.qpos[-7:] = self.grasp["obj_pose"]
        mujoco.mj_forward(self.model, self.data)

    def controls(self, qpos: np.ndarray) -> np.ndarray:
        dense = np.zeros((self.model.nu, self.model.nv))
        data = self.data
        mujoco.mju_sparse2dense(dense, data.actuator_moment, data.moment_rownnz, data.moment_rowadr, data.moment_colind)
        return dense[:, 6:-6] @ qpos[7:]


def load(root: Path, npy: Path, config: str, *, mass: float = 0.1, tabletop: bool = False) -> Loaded:
    """As the evaluator does, in a checkout at `root`: all paths in the files are relative to it.

    `tabletop` is its setting of that name: a floor at z = 0.
    """
    grasp = np.load(npy, allow_pickle=True).item()
    info = json.loads((root / grasp["obj_path"] / "info" / "simplified.json").read_text())
    volume = info["mass"] / (info["density"] * info["scale"] ** 3)
    density = mass / (volume * grasp["obj_scale"] ** 3)
    hand = yaml.safe_load((root / "config" / "hand" / f"{config}.yaml").read_text())
    spec = mujoco.MjSpec()
    spec.meshdir = str(root)
    option = spec.option
    option.timestep, option.integrator = 0.004, mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    option.cone, option.impratio, option.noslip_iterations = mujoco.mjtCone.mjCONE_ELLIPTIC, 10, 2
    # Off in 3.3.2, the version that it pins.
    later = int(mujoco.mjtDisableBit.mjDSBL_MULTICCD) | int(mujoco.mjtDisableBit.mjDSBL_ISLAND)
    option.disableflags = int(mujoco.mjtDisableBit.mjDSBL_GRAVITY) | later
    _add_hand(spec, root, hand["xml_path"])
    if tabletop:
        plane = mujoco.mjtGeom.mjGEOM_PLANE
        spec.worldbody.add_geom(name="object_collision_floor", type=plane, size=[0, 0, 1.0])
    _add_object(spec, root / grasp["obj_path"] / "urdf" / "meshes", grasp["obj_scale"], density)
    for geom in spec.geoms:
        geom.condim = 4
        geom.friction[:2] = [0.6, 0.02]
    model = spec.compile()
    return Loaded(grasp, hand, model, mujoco.MjData(model))


def _add_hand(spec: Any, root: Path, file: str) -> None:
    child = mujoco.MjSpec.from_file(str(root / file))
    for mesh in child.meshes:
        mesh.file = str(Path(file).parent / child.meshdir / mesh.file)
    child.meshdir = spec.meshdir
    for geom in child.geoms:
        geom.solimp[:3], geom.solref[:2] = [0.5, 0.99, 0.0001], [0.005, 1]
    base = spec.worldbody.add_frame().attach_body(child.worldbody, PREFIX, "")
    base.add_freejoint(name="hand_freejoint")
    spec.worldbody.add_body(name="mocap_body", mocap=True)
    hold = np.zeros(mujoco.mjNEQDATA)
    hold[10] = 1
    spec.add_equality(
        type=mujoco.mjtEq.mjEQ_WELD,
        objtype=mujoco.mjtObj.mjOBJ_BODY,
        name1="mocap_body",
        name2=f"{PREFIX}world",
        data=hold,
        solimp=[0.9, 0.95, 0.001, 0.5, 2],
    )


def _add_object(spec: Any, pieces: Path, scale: float, density: float) -> None:
    body = spec.worldbody.add_body(name="object")
    body.add_freejoint(name="obj_freejoint")
    for file in pieces.iterdir():
        name = file.name.replace(".obj", "")
        spec.add_mesh(name=name, file=str(file), scale=[scale] * 3)
        number = name.replace("convex_piece_", "")
        geom: dict[str, Any] = {"type": mujoco.mjtGeom.mjGEOM_MESH, "meshname": name}
        body.add_geom(name=f"object_visual_{number}", density=0, contype=0, conaffinity=0, **geom)
        body.add_geom(name=f"object_collision_{number}", density=density, **geom)


def tabletop_test(found: Loaded) -> tuple[bool, float, float]:
    """Its verdict on a grasp in its setting `tabletop` with a flying hand; way [m] and turn [deg] at its end."""
    model, data, grasp = found.model, found.data, found.grasp
    start, *rest = (grasp[f"{name}_qpos"] for name in ("pregrasp", "grasp", "squeeze"))
    data.mocap_pos[0], data.mocap_quat[0], data.ctrl[:] = start[:3], start[3:7], 0
    found.at(start)
    data.ctrl[:] = found.controls(start)
    mujoco.mj_forward(model, data)
    # World, floor and hand count as the hand, the object is the last body: what the evaluator compares.
    if any(contact.dist < -0.010 for contact in data.contact):
        return False, 100.0, 100.0
    aim = data.qpos[-7:].copy()
    aim[2] += 0.1
    data.xfrc_applied[-1] = [0, 0, -1.0, 0, 0, 0]
    raised = rest[-1].copy()
    raised[2] += 0.1
    for a, b in ((start, rest[0]), (rest[0], rest[1]), (rest[1], raised)):
        _move(found, a, b)
    moved = float(np.linalg.norm(data.qpos[-7:-4] - aim[:3]))
    turn = Rotation.from_quat(data.qpos[-4:], scalar_first=True) * Rotation.from_quat(aim[3:], scalar_first=True).inv()
    turned = float(np.degrees(turn.magnitude()))
    return moved < 0.05 and turned < 15, moved, turned


def _move(found: Loaded, a: np.ndarray, b: np.ndarray) -> None:
    rotations = Slerp([0, 1], Rotation.from_quat([a[3:7], b[3:7]], scalar_first=True))
    begin, end = found.controls(a), found.controls(b)
    for share in np.linspace(0, 1, 11)[1:]:
        found.data.mocap_pos[0] = (1 - share) * a[:3] + share * b[:3]
        found.data.mocap_quat[0] = rotations(share).as_quat(scalar_first=True)
        found.data.ctrl[:] = (1 - share) * begin + share * end
        mujoco.mj_step(found.model, found.data, nstep=10)


def files_of(root: Path, config: str, experiment: str = "graspd") -> list[Path]:
    return sorted((root / "output" / f"{experiment}_{config}" / "graspdata").glob("**/*.npy"))

"""DexGraspBench's figures of a folder in its layout, by its evaluator rebuilt on MuJoCo alone.

    graspd export DATASET --format dexgraspbench --all -o BENCH
    python -m benchmarks.bench_evaluator BENCH --config allegro [--tabletop] [--most 8]

What the evaluator does was read in its source (evaluation, base class of the tests, hand and object specs); its code
is not a package. Only the files of the folder are read, nothing of graspd, so the export is checked with its figures.
"""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Final

import mujoco
import numpy as np
import typer
import yaml
from scipy.spatial.transform import Rotation, Slerp

PREFIX: Final = "child-"
#: Limits of a held object's motion [m], [degrees], of penetration at the start [m], and reach of contacts [m].
MOVED_M, TURNED_DEG, DEEP_M, NEAR_M = 0.05, 15.0, 0.01, 0.01


@dataclass
class Loaded:
    grasp: dict[str, Any]
    hand: dict[str, Any]
    model: mujoco.MjModel
    data: mujoco.MjData

    def at(self, qpos: np.ndarray) -> None:
        """Hand and object where the evaluator puts them: hand first, object last."""
        mujoco.mj_resetData(self.model, self.data)
        self.data.qpos[: len(qpos)] = qpos
        self.data.qpos[-7:] = self.grasp["obj_pose"]
        self.data.mocap_pos[0], self.data.mocap_quat[0] = qpos[:3], qpos[3:7]
        mujoco.mj_forward(self.model, self.data)

    def controls(self, qpos: np.ndarray) -> np.ndarray:
        dense = np.zeros((self.model.nu, self.model.nv))
        data = self.data
        mujoco.mju_sparse2dense(dense, data.actuator_moment, data.moment_rownnz, data.moment_rowadr, data.moment_colind)
        return dense[:, 6:-6] @ qpos[7:]

    def start(self) -> bool:
        """Put the hand at the pregrasp; return False if it penetrates deeply."""
        first = self.grasp["pregrasp_qpos"]
        self.at(first)
        self.data.ctrl[:] = self.controls(first)
        mujoco.mj_forward(self.model, self.data)
        # World, floor and hand count as the hand, the object is the last body: what the evaluator compares.
        return all(contact.dist >= -DEEP_M for contact in self.data.contact)

    def move(self, a: np.ndarray, b: np.ndarray) -> None:
        rotations = Slerp([0, 1], Rotation.from_quat([a[3:7], b[3:7]], scalar_first=True))
        begin, end = self.controls(a), self.controls(b)
        for share in np.linspace(0, 1, 11)[1:]:
            self.data.mocap_pos[0] = (1 - share) * a[:3] + share * b[:3]
            self.data.mocap_quat[0] = rotations(share).as_quat(scalar_first=True)
            self.data.ctrl[:] = (1 - share) * begin + share * end
            mujoco.mj_step(self.model, self.data, nstep=10)

    def motion(self, aim: np.ndarray) -> tuple[float, float]:
        """Return how far the object is from a pose [m], [degrees]."""
        now = self.data.qpos[-7:]
        turn = Rotation.from_quat(now[3:], scalar_first=True) * Rotation.from_quat(aim[3:], scalar_first=True).inv()
        return float(np.linalg.norm(now[:3] - aim[:3])), float(np.degrees(turn.magnitude()))


def load(
    root: Path, npy: Path, config: str, *, mass: float = 0.1, tabletop: bool = False, hard: bool = False
) -> Loaded:
    """As the evaluator does, in a checkout at `root`: all paths in the files are relative to it.

    `tabletop` is its setting of that name: a floor at z = 0. `hard`: half friction, a tenth of the torsional friction.
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
        geom.friction[:2] = [0.3, 0.002] if hard else [0.6, 0.02]
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
    data, grasp = found.data, found.grasp
    first, second, last = (grasp[f"{name}_qpos"] for name in ("pregrasp", "grasp", "squeeze"))
    if not found.start():
        return False, 100.0, 100.0
    aim = data.qpos[-7:].copy()
    aim[2] += 0.1
    data.xfrc_applied[-1] = [0, 0, -1.0, 0, 0, 0]
    raised = last.copy()
    raised[2] += 0.1
    for a, b in ((first, second), (second, last), (last, raised)):
        found.move(a, b)
    moved, turned = found.motion(aim)
    return moved < MOVED_M and turned < TURNED_DEG, moved, turned


def pushes_test(found: Loaded) -> tuple[bool, float, float]:
    """Its verdict on a free grasp in its setting `fc`: six pushes of 1 N for 2 s; way [m] and turn [deg] at the end."""
    first, second, last = (found.grasp[f"{name}_qpos"] for name in ("pregrasp", "grasp", "squeeze"))
    moved = turned = 100.0
    for push in (*-np.eye(3), *np.eye(3)):
        if not found.start():
            return False, 100.0, 100.0
        aim = found.data.qpos[-7:].copy()
        found.move(first, second)
        found.move(second, last)
        found.data.xfrc_applied[-1, :3] = push
        for _ in range(10):
            mujoco.mj_step(found.model, found.data, nstep=50)
            moved, turned = found.motion(aim)
            if moved >= MOVED_M or turned >= TURNED_DEG:
                return False, moved, turned
    return True, moved, turned


def contact_metrics(found: Loaded) -> tuple[float, float]:
    """Return its penetration depth of hand and object, and its contact distance consistency, at the grasp [mm]."""
    model, data = found.model, found.data
    mine = [geom for geom in range(model.ngeom) if model.geom(geom).name.startswith("object_collision")]
    model.geom_margin[mine] = model.geom_gap[mine] = NEAR_M
    found.at(found.grasp["grasp_qpos"])
    deep, near = 0.0, dict.fromkeys(found.hand["finger_prefix"], NEAR_M)
    for contact in data.contact:
        bodies = [int(model.geom_bodyid[geom]) for geom in (contact.geom1, contact.geom2)]
        # The object is the last body, the mocap body the one before.
        if model.nbody - 1 in bodies and min(bodies) < model.nbody - 2:
            deep = min(deep, contact.dist)
            name = model.body(min(bodies)).name.removeprefix(PREFIX)
            if finger := next((one for one in near if name.startswith(one)), None):
                near[finger] = min(near[finger], contact.dist)
    model.geom_margin[mine] = model.geom_gap[mine] = 0.0
    return -1e3 * deep, 1e3 * (max(near.values()) - min(near.values()))


def verdicts(root: Path, config: str, tabletop: bool, file: Path) -> tuple[str, bool, bool, float, float, np.ndarray]:
    """Return the object, both verdicts, both metrics [mm], and the posture relative to the object of a grasp."""
    test = tabletop_test if tabletop else pushes_test
    held = test(found := load(root, file, config, tabletop=tabletop))[0]
    hard = held and test(load(root, file, config, tabletop=tabletop, hard=True))[0]
    pose, qpos = found.grasp["obj_pose"], found.grasp["grasp_qpos"]
    back = Rotation.from_quat(pose[3:], scalar_first=True).inv()
    turn = (back * Rotation.from_quat(qpos[3:7], scalar_first=True)).as_rotvec()
    posture = np.concatenate([back.apply(qpos[:3] - pose[:3]), turn, qpos[7:]])
    return file.parts[-3], held, hard, *contact_metrics(found), posture


def chosen_files(root: Path, config: str, tabletop: bool, most: int, objects: str) -> Iterator[Path]:
    """Yield the first files of each object."""
    of: dict[str, list[Path]] = defaultdict(list)
    for file in sorted((root / "output" / f"graspd{'_tabletop' * tabletop}_{config}" / "graspdata").rglob("*.npy")):
        of[file.parts[-3]].append(file)
    for name, files in of.items():
        if not objects or name in objects.split(","):
            yield from files[: most or None]


def main(
    root: Annotated[Path, typer.Argument(help="Folder of the export.")],
    config: Annotated[str, typer.Option(help="Name of the model of the hand, such as graspd_barrett.")],
    tabletop: Annotated[bool, typer.Option("--tabletop", help="Grasps on tables: lifts instead of pushes.")] = False,
    objects: Annotated[str, typer.Option(help="Names of objects, comma-separated; default: all.")] = "",
    most: Annotated[int, typer.Option(help="Grasps of each object, the first ones; 0: all.")] = 0,
) -> None:
    """Print GSR, OSR, GSR at low friction, PD, CDC and D."""
    files = list(chosen_files(root, config, tabletop, most, objects))
    with ProcessPoolExecutor(2) as pool:
        rows = list(pool.map(partial(verdicts, root, config, tabletop), files, chunksize=4))
    objects = {row[0]: any(one[1] for one in rows if one[0] == row[0]) for row in rows}
    held = [row for row in rows if row[1]]
    postures = np.array([row[5] for row in held])
    variances = np.linalg.svd(postures - postures.mean(axis=0), compute_uv=False) ** 2
    figures = {
        "objects": len(objects),
        "grasps": len(rows),
        "GSR": round(len(held) / len(rows), 4),
        "OSR": round(sum(objects.values()) / len(objects), 4),
        "GSR at low friction": round(sum(row[2] for row in rows) / len(rows), 4),
        "PD [mm]": round(float(np.mean([row[3] for row in held])), 3),
        "CDC [mm]": round(float(np.mean([row[4] for row in held])), 3),
        "D": round(float(variances[0] / variances.sum()), 3),
    }
    typer.echo(json.dumps({"config": config, "setting": "tabletop" if tabletop else "fc", **figures}))


if __name__ == "__main__":
    typer.run(main)

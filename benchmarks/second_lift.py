"""Second lift of valid table grasps, by a test that shares no code with the validator.

usage: python -m benchmarks.second_lift DATA_DIR [--hands allegro ...] [--objects 025_mug ...] [--grasps 16]
           [--scenes 4] [--seed 1400] [--mass KG] [--page OUT.md]
       DATA_DIR holds hands/ and objects/; objects need a mass in their meta.json

The model has real gravity, MuJoCo's default contacts at 1 ms, CoACD pieces of another threshold, and the hand on a
stiff vertical slide. The hand closes and squeezes in 1 s, rises 10 cm in 1 s and holds for 2 s. A grasp lifts if the
object has then risen by more than 5 cm. Lost grasps are repeated with MuJoCo's noslip solver, without which friction
creeps."""

from __future__ import annotations

from typing import Any, Final
from xml.etree import ElementTree as ET

import coacd
import mujoco
import numpy as np
import trimesh
from numpy.typing import NDArray

from benchmarks.cells import HANDS
from benchmarks.masses import arguments, masses
from graspd.service.model.domain import JobOptions
from graspd.service.model.scene_spec import parse_scene
from graspd.service.model.transforms import compose
from graspd.worker.files.synthesis import synthesize_grasps
from graspd.worker.hands.load import hand_from_path
from graspd.worker.hands.model import HandModel, JointType

SEED: Final = 1400
HEAD: Final = """# A second lift of valid grasps

`python -m benchmarks.second_lift DATA`: second lift test of valid table grasps of objects with published masses. It has
real gravity, MuJoCo's default contacts at 1 ms, other convex pieces and a stiff vertical slide. It lifts for 1 s and
holds for 2 s at friction 0.6. *Share*: share of the valid grasps that lift again. *Noslip*: number of lost grasps that
lift with four iterations of MuJoCo's noslip solver, without which friction creeps. {grasps} grasps wanted per pair of
hand and object, {scenes} scenes, seed {seed}.

"""
FRICTION: Final = "0.6 0.01 0.0001"
NOSLIP: Final = 4
RISE_M: Final = 0.1
CLOSE_S, RISE_S, HOLD_S = 1.0, 1.0, 2.0


def main() -> None:
    parser = arguments(__doc__, SEED)
    parser.add_argument("--mass", type=float, help="mass of every object [kg]; by default the published masses")
    given = parser.parse_args()
    heads = ("hand", "object", "mass [kg]", "valid", "lifted again", "share", "noslip")
    rows = [f"| {' | '.join(heads)} |", "|---" * len(heads) + "|"]
    total = np.zeros(3, int)
    for name in given.hands:
        hand = hand_from_path(str(given.data / "hands" / HANDS[name]))
        of_hand = np.zeros(3, int)
        for obj, mass in masses(given.data).items():
            if given.objects and obj not in given.objects:
                continue
            found = again(given, name, hand, obj, given.mass or mass)
            of_hand += found
            rows.append(line(name, obj, f"{given.mass or mass:g}", found))
            print(rows[-1], flush=True)  # noqa: T201
        rows.append(line(name, "all", "", of_hand))
        print(rows[-1], flush=True)  # noqa: T201
        total += of_hand
    rows.append(line("all", "all", "", total))
    print(rows[-1], flush=True)  # noqa: T201
    if given.page:
        given.page.write_text(HEAD.format(**vars(given)) + "\n".join(rows) + "\n")


def line(hand: str, obj: str, mass: str, counts: NDArray[np.intp]) -> str:
    valid, lifted, noslip = counts.tolist()
    share = f"{lifted / valid if valid else float('nan'):.3f}"
    return f"| {hand} | {obj} | {mass} | {valid} | {lifted} | {share} | {noslip} |"


def again(given: Any, name: str, hand: HandModel, obj: str, mass: float) -> NDArray[np.intp]:
    """Return counts of a pair: valid grasps, grasps that lift here, lost grasps that lift with noslip."""
    mesh_file = given.data / "objects" / obj / "clean.stl"
    request = JobOptions(
        grasps=given.grasps, rechecks=0, seed=given.seed, scene="table", scenes=given.scenes, mass=mass
    )
    made = synthesize_grasps(
        str(given.data / "hands" / HANDS[name]),
        str(mesh_file),
        request,
        place=parse_scene("table"),
        scenes=given.scenes,
    ).arrays
    rows = np.flatnonzero(made["quality/valid"])
    if not len(rows):
        return np.zeros(3, int)
    model = lift_model(hand, trimesh.load_mesh(mesh_file), mass)
    lost = [row for row in rows if not lifts(model, hand, made, int(row))]
    model.opt.noslip_iterations = NOSLIP
    return np.array([len(rows), len(rows) - len(lost), sum(lifts(model, hand, made, int(row)) for row in lost)])


def lift_model(hand: HandModel, mesh: trimesh.Trimesh, mass: float) -> Any:
    """Compile the test of a hand and an object with this mass [kg]; meshes are inline."""
    root = ET.Element("mujoco")
    ET.SubElement(root, "compiler", angle="radian")
    ET.SubElement(root, "option", timestep="0.001", integrator="implicitfast", cone="elliptic", impratio="10")
    ET.SubElement(root, "size", memory="64M")
    assets, world = ET.SubElement(root, "asset"), ET.SubElement(root, "worldbody")
    ET.SubElement(world, "geom", type="plane", size="1 1 .1", friction=FRICTION, condim="4")
    carriage = ET.SubElement(world, "body", name="carriage", gravcomp="1")
    ET.SubElement(carriage, "joint", name="rise", type="slide", axis="0 0 1", armature="2")
    ET.SubElement(carriage, "inertial", pos="0 0 0", mass="1", diaginertia=".01 .01 .01")
    bodies, leading = [ET.SubElement(carriage, "body", name="b0", gravcomp="1")], {}
    actuators, equality, contact = (ET.SubElement(root, kind) for kind in ("actuator", "equality", "contact"))
    for b in range(1, hand.bodies):
        pose = hand.origin[b]
        body = ET.SubElement(
            bodies[hand.parent[b]], "body", name=f"b{b}", pos=said(pose[:3]), quat=said(pose[3:]), gravcomp="1"
        )
        bodies.append(body)
        d = int(hand.dof[b])
        kind = "hinge" if hand.joint_type[b] == JointType.REVOLUTE else "slide"
        damping = 0.02 * float(hand.stiffness[d])
        ET.SubElement(body, "joint", name=f"j{b}", type=kind, axis=said(hand.axis[b]), damping=f"{damping:g}")
        if d in leading:
            first = leading[d]
            ratio = hand.multiplier[b] / hand.multiplier[first]
            shift = hand.offset[b] - ratio * hand.offset[first]
            poly = said([shift, ratio, 0, 0, 0])
            # Gears and tendons are nearly as stiff as the time step allows.
            stiff = {"solref": ".004 1", "solimp": ".99 .999 .001"}
            ET.SubElement(equality, "joint", joint1=f"j{b}", joint2=f"j{first}", polycoef=poly, **stiff)
        else:
            leading[d] = b
            effort = float(hand.effort[d])
            ET.SubElement(
                actuators,
                "position",
                name=f"a{d}",
                joint=f"j{b}",
                kp=f"{hand.stiffness[d]:g}",
                forcerange=f"{-effort:g} {effort:g}",
                forcelimited="true",
            )
    for i, piece in enumerate(hand.pieces):
        vertices = said(piece.vertices.ravel())
        ET.SubElement(assets, "mesh", name=f"h{i}", vertex=vertices, inertia="convex")
        ET.SubElement(bodies[piece.body], "geom", type="mesh", mesh=f"h{i}", friction=FRICTION, condim="4", mass="0")
    for b, body in enumerate(bodies):
        part = max(float(hand.masses[b]), 1e-3)
        ET.SubElement(body, "inertial", pos="0 0 0", mass=f"{part:g}", diaginertia=said([1e-4 * part + 1e-6] * 3))
    for a, b in sorted(hand.neighbours):
        ET.SubElement(contact, "exclude", body1=f"b{a}", body2=f"b{b}")
    ET.SubElement(actuators, "position", name="lift", joint="rise", kp="50000", dampratio="1")
    thing = ET.SubElement(world, "body", name="object")
    ET.SubElement(thing, "freejoint", name="object")
    moments = mesh.copy()
    moments.density = mass / abs(mesh.volume)
    tensor = moments.moment_inertia
    full = [tensor[0, 0], tensor[1, 1], tensor[2, 2], tensor[0, 1], tensor[0, 2], tensor[1, 2]]
    ET.SubElement(thing, "inertial", pos=said(mesh.center_mass), mass=f"{mass:g}", fullinertia=said(full))
    coacd.set_log_level("error")
    for i, (vertices, _) in enumerate(coacd.run_coacd(coacd.Mesh(mesh.vertices, mesh.faces), threshold=0.03, seed=7)):
        ET.SubElement(assets, "mesh", name=f"o{i}", vertex=said(np.asarray(vertices).ravel()), inertia="convex")
        ET.SubElement(thing, "geom", type="mesh", mesh=f"o{i}", friction=FRICTION, condim="4", mass="0")
    return mujoco.MjModel.from_xml_string(ET.tostring(root, encoding="unicode"))


def lifts(model: Any, hand: HandModel, made: Any, row: int) -> bool:
    """Return whether the object has risen by more than 5 cm at the end."""
    data = mujoco.MjData(model)
    pose = np.asarray(made["scene/object_pose"][made["grasp/scene_index"][row]], float)
    base = compose(pose, np.asarray(made["grasp/hand_pose"][row], float))
    start = compose(pose, np.asarray(made["pregrasp/hand_pose"][row], float))
    # The slide only rises, so the pose of body b0 moves the palm from pregrasp to grasp.
    model.body("b0").pos[:], model.body("b0").quat[:] = start[:3], start[3:]
    ways = [hand.reduce(np.asarray(made[f"{name}/joint_positions"][row], float)) for name in WAYS]
    data.qpos[model.joint("object").qposadr[0] :][:7] = pose
    for b in hand.joint_body:
        d = int(hand.dof[b])
        value = hand.multiplier[b] * ways[0][d] + hand.offset[b]
        data.qpos[model.joint(f"j{b}").qposadr[0]] = value
    leading = {int(hand.dof[b]): int(b) for b in reversed(hand.joint_body)}

    def command(q: Any, rise: float) -> None:
        for d, b in leading.items():
            data.ctrl[d_of[d]] = hand.multiplier[b] * q[d] + hand.offset[b]
        data.ctrl[model.actuator("lift").id] = rise

    d_of = {d: model.actuator(f"a{d}").id for d in leading}
    for k in range(50):
        share = (k + 1) / 50
        moved = start + share * (base - start)
        model.body("b0").pos[:], model.body("b0").quat[:] = moved[:3], moved[3:] / np.linalg.norm(moved[3:])
        command(ways[0] + share * (ways[1] - ways[0]), 0.0)
        mujoco.mj_step(model, data, nstep=round(1000 * CLOSE_S / 100))
    for k in range(50):
        command(ways[1] + (k + 1) / 50 * (ways[2] - ways[1]), 0.0)
        mujoco.mj_step(model, data, nstep=round(1000 * CLOSE_S / 100))
    low = data.body("object").xipos[2]
    for k in range(100):
        s = (k + 1) / 100
        command(ways[2], RISE_M * s**3 * (10 - 15 * s + 6 * s * s))
        mujoco.mj_step(model, data, nstep=round(10 * RISE_S))
    mujoco.mj_step(model, data, nstep=round(1000 * HOLD_S))
    return bool(data.body("object").xipos[2] - low > RISE_M / 2)


#: Postures commanded one after the other.
WAYS: Final = ("pregrasp", "grasp", "squeeze")


def said(values: Any) -> str:
    return " ".join(f"{float(value):.9g}" for value in np.asarray(values).ravel())


if __name__ == "__main__":
    main()

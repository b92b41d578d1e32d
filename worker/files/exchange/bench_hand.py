"""A hand as DexGraspBench keeps it: an MJCF model with position actuators, and the configuration that names it.

The model's world frame is the frame of our root link, so `qpos` begins with our pose of it. Bodies are named
`root_<link>` and `f<number of the finger>_<link>`: the evaluator finds fingers by the beginning of a body's name.
"""

from __future__ import annotations

import json
import xml.etree.ElementTree as ElementTree
from pathlib import Path
from typing import Any, Final
from xml.etree.ElementTree import Element, SubElement

import mujoco
import numpy as np

from worker.files.exchange.objects import write_obj
from worker.hands.model import ConvexPiece, HandModel, JointType

#: Joint damping over position gain [s]: that of DexGraspBench's Allegro hand.
_DAMPING_TIME: Final = 0.02
#: A coupling is stiffer than a contact, or a pressed finger would stretch it.
_COUPLING: Final = {"solref": "0.008 1", "solimp": "0.98 0.999 0.0001 0.5 2"}
_BARE: Final = {"mass": 1e-3, "radius": 0.01}
_COLOUR: Final = (0.87, 0.45, 0.2, 1.0)


def write_hand(hand: HandModel, config: str, root: Path) -> Path:
    """Write model and configuration of a hand below `root`, which stands for a checkout of DexGraspBench.

    Args:
        hand: the hand.
        config: name of the configuration, `hand=...` of the evaluator.

    Returns:
        the model's file, relative to `root`.
    """
    folder = Path("assets") / "hand" / config
    (root / folder / "meshes").mkdir(parents=True, exist_ok=True)
    for number, piece in enumerate(hand.pieces):
        if piece.kind == "hull":
            write_obj(root / folder / "meshes" / f"piece_{number:03}.obj", piece.vertices, piece.faces)
    tree = _model(hand)
    ElementTree.indent(tree)
    (root / folder / "hand.xml").write_text(ElementTree.tostring(tree, encoding="unicode") + "\n")
    (root / "config" / "hand").mkdir(parents=True, exist_ok=True)
    (root / "config" / "hand" / f"{config}.yaml").write_text(_configuration(hand, folder / "hand.xml"))
    return folder / "hand.xml"


def joint_order(file: Path) -> tuple[str, ...]:
    """Joints of a model in the order of its `qpos`: MuJoCo's own, not the URDF's."""
    model = mujoco.MjModel.from_xml_path(str(file))
    return tuple(model.joint(number).name for number in range(model.njnt))


def body_names(hand: HandModel) -> tuple[str, ...]:
    """Name of each body in the model."""
    return tuple(f"{'root' if b == 0 else _finger(hand, b)}_{name}" for b, name in enumerate(hand.body_names))


def _finger(hand: HandModel, body: int) -> str:
    """The finger that a body belongs to: the root's child above it."""
    while hand.parent[body] > 0:
        body = int(hand.parent[body])
    return f"f{np.flatnonzero(hand.parent == 0).tolist().index(body)}"


def _configuration(hand: HandModel, model: Path) -> str:
    """JSON values are YAML as they are."""
    names = body_names(hand)
    fingers = [f"{_finger(hand, int(b))}_" for b in np.flatnonzero(hand.parent == 0)]
    values: dict[str, Any] = {
        "xml_path": model.as_posix(),
        "mocap": True,
        "exclude_table_contact": None,
        "tendon": None,
        "color": list(_COLOUR),
        "finger_prefix": fingers,
        "valid_body_name": list(names),
        "tip_body_name": [names[b] for b in hand.fingertips],
    }
    return "".join(f"{key}: {json.dumps(value)}\n" for key, value in values.items())


def _model(hand: HandModel) -> Element:
    top = Element("mujoco", model=hand.name)
    SubElement(top, "compiler", angle="radian", meshdir="meshes", autolimits="true")
    assets, world = SubElement(top, "asset"), SubElement(top, "worldbody")
    names, bodies = body_names(hand), list[Element]()
    for b in range(hand.bodies):
        if b == 0:
            body = SubElement(world, "body", name=names[0])
        else:
            pose = hand.origin[b]
            above = bodies[int(hand.parent[b])]
            body = SubElement(above, "body", name=names[b], pos=_text(pose[:3]), quat=_text(pose[3:]))
            _add_joint(body, hand, b)
        bodies.append(body)
        _add_solids(body, assets, hand, b)
    _add_exclusions(SubElement(top, "contact"), hand, names)
    if hand.tendons:
        _add_tendons(SubElement(top, "tendon"), hand)
    _add_drives(SubElement(top, "equality"), SubElement(top, "actuator"), hand)
    return top


def _joint_of(hand: HandModel, body: int) -> str:
    return hand.joint_names[hand.joint_body.tolist().index(body)]


def _add_joint(body: Element, hand: HandModel, b: int) -> None:
    d, m, shift = int(hand.dof[b]), float(hand.multiplier[b]), float(hand.offset[b])
    ends = sorted((m * float(hand.lower[d]) + shift, m * float(hand.upper[d]) + shift))
    SubElement(
        body,
        "joint",
        name=_joint_of(hand, b),
        axis=_text(hand.axis[b]),
        range=_text(ends),
        type="hinge" if hand.joint_type[b] == JointType.REVOLUTE else "slide",
        damping=_text([_DAMPING_TIME * float(hand.stiffness[d])]),
    )


def _add_solids(body: Element, assets: Element, hand: HandModel, b: int) -> None:
    mass = max(float(hand.masses[b]), _BARE["mass"])
    mine = [(number, piece) for number, piece in enumerate(hand.pieces) if piece.body == b]
    if not mine:
        inertia = 0.4 * mass * _BARE["radius"] ** 2
        SubElement(body, "inertial", pos="0 0 0", mass=_text([mass]), diaginertia=_text([inertia] * 3))
        return
    share = np.array([float(np.prod(np.ptp(piece.vertices, axis=0))) for _, piece in mine])
    for (number, piece), part in zip(mine, share / share.sum(), strict=True):
        geom = SubElement(body, "geom", {"mass": _text([mass * float(part)]), **_shape(piece, number)})
        if piece.kind == "hull":
            geom.set("mesh", f"piece_{number:03}")
            SubElement(assets, "mesh", name=f"piece_{number:03}", file=f"piece_{number:03}.obj")


def _shape(piece: ConvexPiece, number: int) -> dict[str, str]:
    if piece.kind == "hull":
        return {"name": f"piece_{number:03}", "type": "mesh"}
    size = [0.5 * extent for extent in piece.size]
    if piece.kind != "box":
        # Radius, then half the length.
        size = [piece.size[0], *(0.5 * length for length in piece.size[1:])]
    place = {"pos": _text(piece.pose[:3]), "quat": _text(piece.pose[3:])}
    return {"name": f"piece_{number:03}", "type": piece.kind, "size": _text(size), **place}


def _add_exclusions(contact: Element, hand: HandModel, names: tuple[str, ...]) -> None:
    """Neighbours, and parents with their children: these touch by design."""
    pairs = set(hand.neighbours) | {(int(hand.parent[b]), b) for b in range(1, hand.bodies)}
    for a, b in sorted(pairs):
        SubElement(contact, "exclude", body1=names[a], body2=names[b])


def _add_drives(equality: Element, actuators: Element, hand: HandModel) -> None:
    """A position actuator on the first joint of each degree of freedom; the others are coupled to that joint. Dofs on a
    tendon have one on it."""
    pulled = {d: tendon for tendon in hand.tendons for d in tendon.dofs}
    for d, name in enumerate(hand.dof_names):
        if (tendon := pulled.get(d)) is not None:
            if d == min(tendon.dofs):
                limit = tendon.limit(hand.effort)
                SubElement(
                    actuators,
                    "position",
                    name=name,
                    tendon=tendon.name,
                    kp=_text([tendon.gain(hand.stiffness)]),
                    forcerange=_text([-limit, limit]),
                )
            continue
        lead, *others = [int(b) for b in hand.joint_body if hand.dof[b] == d]
        m = float(hand.multiplier[lead])
        limit = float(hand.effort[d]) / abs(m)
        SubElement(
            actuators,
            "position",
            name=name,
            joint=_joint_of(hand, lead),
            kp=_text([float(hand.stiffness[d]) / m**2]),
            forcerange=_text([-limit, limit]),
        )
        for b in others:
            ratio = float(hand.multiplier[b]) / m
            start = float(hand.offset[b]) - ratio * float(hand.offset[lead])
            pair = {"joint1": _joint_of(hand, b), "joint2": _joint_of(hand, lead)}
            SubElement(equality, "joint", {**pair, "polycoef": _text([start, ratio, 0, 0, 0]), **_COUPLING})


def _add_tendons(tendons: Element, hand: HandModel) -> None:
    for tendon in hand.tendons:
        fixed = SubElement(tendons, "fixed", name=tendon.name)
        for d, pull in zip(tendon.dofs, tendon.coefficients, strict=True):
            SubElement(fixed, "joint", joint=hand.dof_names[d], coef=_text([pull]))


def _text(values: Any) -> str:
    return " ".join(f"{float(value):.12g}" for value in values)

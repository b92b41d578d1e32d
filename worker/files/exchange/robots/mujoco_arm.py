"""Arm and hand in MuJoCo with a key frame for each posture: to look at, and to start a controller of one's own from.

Nothing is simulated here: bodies have no masses of their own, the object is moved from key frame to key frame.
"""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from pathlib import Path
from xml.etree.ElementTree import Element, SubElement

import numpy as np

from worker.files.exchange.robots.bundle import Bundle, Carrier
from worker.files.exchange.robots.mujoco_scene import dress, element_text, one, rename
from worker.robots.execution import POSTURES


def write(bundle: Bundle, folder: Path) -> list[Path]:
    """Write `arm.xml`; nothing where there is no arm."""
    if (carrier := bundle.carrier) is None:
        return []
    tree = ElementTree.fromstring(carrier.world.spec.to_xml())
    tree.set("model", f"{carrier.arm.model.name} with {bundle.found.hand.name}")
    dress(tree, bundle.found, ("hand0", "object"))
    for geom in tree.iterfind("./worldbody/geom"):
        geom.set("rgba", "0.75 0.75 0.72 1")
    for geom in one(tree, ".//body[@name='arm0']").iter("geom"):
        if "rgba" not in geom.attrib:
            geom.set("rgba", "0.85 0.85 0.87 1")
    _add_keys(tree, bundle, carrier)
    rename(tree, _names(bundle, carrier))
    ElementTree.indent(tree)
    file = folder / "arm.xml"
    file.write_text(ElementTree.tostring(tree, encoding="unicode") + "\n")
    return [file]


def _add_keys(tree: Element, bundle: Bundle, carrier: Carrier) -> None:
    keys, world, found = SubElement(tree, "keyframe"), carrier.world, bundle.found
    arms = len(carrier.arm.model.joint_names)
    for row, paths in enumerate(carrier.paths):
        ends = [paths[0].joints[0], *(path.joints[-1] for path in paths)]
        for posture, joints in zip(POSTURES, ends, strict=True):
            thing = found.lifted_object_pose[row] if posture == "lift" else found.object_pose[row]
            qpos = np.zeros(world.model.nq)
            qpos[world.arm_qpos], qpos[world.hand_qpos] = joints[:arms], joints[arms:]
            SubElement(
                keys,
                "key",
                name=f"{bundle.name(row)}/{posture}",
                qpos=element_text(qpos),
                mpos=element_text(thing[:3]),
                mquat=element_text(thing[3:]),
            )


def _names(bundle: Bundle, carrier: Carrier) -> dict[str, str]:
    """The arm's and the hand's own names; those of the hand that the arm has as well begin with `hand_`."""
    found: dict[str, str] = {}
    taken = {"object", "world", "flange"}
    for prefix, model in (("arm", carrier.arm.model), ("hand", bundle.found.hand)):
        names = [name if name not in taken else f"{prefix}_{name}" for name in model.body_names]
        found |= {f"{prefix}{k}": name for k, name in enumerate(names)}
        taken |= set(names)
    return found

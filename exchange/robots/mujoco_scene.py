"""Grasps as MuJoCo scenes with a key frame per posture: the validator's scene, and one with the arm.

The world is the frame of the grasps, z up in a scene. A weld to a mocap body moves the hand's root. Position actuators
have the names of the degrees of freedom. Gravity acts only in scenes with supports, and not on the hand."""

import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping
from itertools import product, zip_longest
from pathlib import Path
from typing import Any, Final
from xml.etree.ElementTree import Element, SubElement

import numpy as np

from graspd.exchange.plan import plain_name
from graspd.exchange.robots.bundle import Bundle, Carrier
from graspd.service.model.matter import ACCELERATION
from graspd.service.model.transforms import compose
from graspd.worker.episodes.execution import POSTURES, Executions
from graspd.worker.hands.model import HandModel
from graspd.worker.validation.decomposition import decompose
from graspd.worker.validation.model import MujocoOptions, Scene, build_scene, scene_spec

#: Colours of the hand, the object, and everything else.
_COLOURS: Final = ("0.36 0.45 0.58 1", "0.87 0.45 0.2 1", "0.75 0.75 0.72 1")
_SPEC_NAMES: Final = {"vertex": "uservert"}  # attributes of MJCF that have other names in `MjSpec`


def write(bundle: Bundle, folder: Path) -> list[Path]:
    """Write `scene.xml`, `replay.py`, which validates its grasps, and for an arm `arm.xml`."""
    found, pieces = bundle.found, decompose(bundle.found.obj)
    folder.mkdir(parents=True, exist_ok=True)
    around = ((), ()) if found.placed is None else (found.placed.supports, found.placed.neighbours)
    physics = MujocoOptions()
    scene = build_scene(found.hand, found.obj, pieces, physics, *around)
    spec = scene_spec(found.hand, found.obj, pieces, physics, *around)
    spec.modelname = f"{plain_name(found.hand.name)} and {plain_name(found.obj.name)}"
    tree = ElementTree.fromstring(spec.to_xml())
    restore_digits(tree, spec)
    for geom in tree.iter("geom"):
        number = scene.model.geom(geom.attrib["name"]).id
        geom.set("user", number_text([scene.tip_geoms[number], scene.pressing[number]]))
    site = {"name": "object_frame", "pos": number_text(-scene.centre), "size": "0.002", "group": "4"}
    SubElement(only_element(tree, ".//body[@name='object']"), "site", site)
    _set_physics(tree, found)
    neighbours = (f"neighbour{k}" for k in range(len(scene.neighbours)))
    add_appearance(tree, found, ("body0", "object", "supports", *neighbours))
    keys = SubElement(tree, "keyframe")
    for row, posture in product(range(len(found)), POSTURES):
        SubElement(
            keys, "key", {"name": f"{bundle.grasp_name(row)}/{posture}", **_key_frame(found, scene, posture, row)}
        )
    rename(tree, _names(found.hand))
    ElementTree.indent(tree)
    file, script = folder / "scene.xml", folder / "replay.py"
    file.write_text(ElementTree.tostring(tree, encoding="unicode") + "\n")
    script.write_text(Path(__file__).with_name("replay.py").read_text())
    return [file, script, *_write_arm(bundle, folder)]


def restore_digits(tree: Element, spec: Any) -> None:
    """Write numbers with all digits, as differences below MuJoCo's six digits can change verdicts."""
    for tag in ("body", "joint", "geom", "mesh"):
        for element in tree.iter(tag):
            source = getattr(spec, tag)(element.get("name")) if element.get("name") else None
            for key, text in element.attrib.items():
                values = getattr(source, _SPEC_NAMES.get(key, key), None)
                if values is not None and not isinstance(values, str) and np.ndim(values) == 1:
                    written = text.split()
                    exact = np.asarray(values, float)[: len(written)]
                    if np.allclose(exact, np.array(written, float), rtol=1e-5, atol=1e-9):
                        element.set(key, number_text(exact))


def _set_physics(tree: Element, found: Executions) -> None:
    """Fix supports in the world; set gravity as in the lift test, without effect on the hand."""
    option = only_element(tree, "option")
    support = tree.find(".//body[@name='supports']")
    if support is not None:
        support.attrib.pop("mocap", None)
    if found.placed is None:
        option.set("gravity", "0 0 0")
    else:
        option.set("gravity", f"0 0 {-ACCELERATION:g}")
        for body in only_element(tree, ".//body[@name='body0']").iter("body"):
            body.set("gravcomp", "1")
    flag = option.find("flag")
    if flag is not None:
        flag.attrib.pop("gravity", None)


def add_appearance(tree: Element, found: Executions, names: tuple[str, ...]) -> None:
    """Colour the bodies `names`; add a light and a default view, without effect on physics."""
    for name, colour in zip_longest(names, _COLOURS[: len(names)], fillvalue=_COLOURS[-1]):
        for body in tree.findall(f".//body[@name='{name}']"):
            for geom in body.iter("geom"):
                geom.set("rgba", colour)
    world, size = only_element(tree, "worldbody"), 2 * found.obj.radius + 0.3
    middle = found.object_pose[0, :3]
    above = number_text(middle + np.array([0.5, -0.5, 2.0]))
    world.insert(0, Element("light", pos=above, dir="-0.25 0.25 -1", diffuse="0.9 0.9 0.9"))
    visual = SubElement(tree, "visual")
    SubElement(visual, "headlight", ambient="0.4 0.4 0.4", diffuse="0.4 0.4 0.4")
    SubElement(visual, "global", azimuth="130", elevation="-25", offwidth="1280", offheight="960")
    SubElement(tree, "statistic", center=number_text(middle), extent=number_text([size]))


def _key_frame(found: Executions, scene: Scene, posture: str, row: int) -> dict[str, str]:
    """Return state and targets of a key frame.
    The fingers' state in squeeze and lift is that of the grasp."""
    command = found.postures[posture]
    stands = found.postures["grasp"] if posture in ("squeeze", "lift") else command
    pose = command.hand_pose[row]
    qpos = np.zeros(scene.model.nq)
    qpos[scene.joint_qpos] = stands.joint_positions[row]
    qpos[scene.root_qpos : scene.root_qpos + 7] = pose
    at = found.lifted_object_pose[row] if posture == "lift" else found.object_pose[row]
    qpos[scene.object_qpos : scene.object_qpos + 7] = compose(at, np.array([*scene.centre, 1, 0, 0, 0]))
    for k, free in enumerate(scene.neighbours):
        assert found.placed is not None and found.placed.neighbour_pose is not None
        rest = found.placed.neighbour_pose[found.placed.index[row], k]
        qpos[free.qpos : free.qpos + 7] = compose(rest, np.array([*free.centre, 1, 0, 0, 0]))
    control = scene.controls(command.joint_positions[row])
    values = {"qpos": qpos, "ctrl": control, "mpos": pose[:3], "mquat": pose[3:]}
    return {name: number_text(value) for name, value in values.items()}


def _names(hand: HandModel) -> Mapping[str, str]:
    """Map the validator's names to the hand's own, with the prefix `hand_` if they are reserved (`taken`)."""
    taken = {"object", "supports", "root", "mocap", "world"}
    found: dict[str, str] = {}
    for prefix, names in (("body", enumerate(hand.body_names)), ("dof", enumerate(hand.dof_names))):
        found |= {f"{prefix}{k}": name if name not in taken else f"hand_{name}" for k, name in names}
    joints = zip(hand.joint_body, hand.joint_names, strict=True)
    return found | {f"joint{b}": name if name not in taken else f"hand_{name}" for b, name in joints}


def rename(tree: Element, names: Mapping[str, str]) -> None:
    """Rename bodies, joints, tendons and actuators in all references."""
    for element in tree.iter():
        if element.tag not in ("mesh", "geom", "key", "site"):
            element.attrib.update({key: names[text] for key, text in element.attrib.items() if text in names})


def only_element(tree: Element, path: str) -> Element:
    found = tree.find(path)
    assert found is not None, path
    return found


def number_text(values: Any) -> str:
    """Return numbers in MJCF's format."""
    return " ".join(f"{float(value):.17g}" for value in np.ravel(values))


def _write_arm(bundle: Bundle, folder: Path) -> list[Path]:
    if (carrier := bundle.carrier) is None:
        return []
    tree = ElementTree.fromstring(carrier.world.spec.to_xml())
    tree.set("model", f"{carrier.arm.model.name} with {bundle.found.hand.name}")
    add_appearance(tree, bundle.found, ("hand0", "object"))
    for geom in tree.iterfind("./worldbody/geom"):
        geom.set("rgba", "0.75 0.75 0.72 1")
    for geom in only_element(tree, ".//body[@name='arm0']").iter("geom"):
        if "rgba" not in geom.attrib:
            geom.set("rgba", "0.85 0.85 0.87 1")
    _add_arm_keys(tree, bundle, carrier)
    rename(tree, _arm_names(bundle, carrier))
    ElementTree.indent(tree)
    file = folder / "arm.xml"
    file.write_text(ElementTree.tostring(tree, encoding="unicode") + "\n")
    return [file]


def _add_arm_keys(tree: Element, bundle: Bundle, carrier: Carrier) -> None:
    keys, world, found = SubElement(tree, "keyframe"), carrier.world, bundle.found
    arms = len(carrier.arm.model.joint_names)
    for row, paths in enumerate(carrier.paths):
        ends = [paths[0].joints[0], *(path.joints[-1] for path in paths)]
        beside = (
            found.placed.neighbour_pose[found.placed.index[row]] if found.placed and found.placed.neighbours else []
        )
        for posture, joints in zip(POSTURES, ends, strict=True):
            thing = found.lifted_object_pose[row] if posture == "lift" else found.object_pose[row]
            qpos = np.zeros(world.model.nq)
            qpos[world.arm_qpos], qpos[world.hand_qpos] = joints[:arms], joints[arms:]
            stand = np.stack([thing, *beside])
            at = {"mpos": number_text(stand[:, :3]), "mquat": number_text(stand[:, 3:])}
            SubElement(keys, "key", {"name": f"{bundle.grasp_name(row)}/{posture}", "qpos": number_text(qpos), **at})


def _arm_names(bundle: Bundle, carrier: Carrier) -> dict[str, str]:
    """Map names in the scene to the links' own, with the prefix `arm_` or `hand_` if reserved or repeated."""
    found: dict[str, str] = {}
    taken = {"object", "world", "flange"}
    for prefix, model in (("arm", carrier.arm.model), ("hand", bundle.found.hand)):
        names = [name if name not in taken else f"{prefix}_{name}" for name in model.body_names]
        found |= {f"{prefix}{k}": name for k, name in enumerate(names)}
        taken |= set(names)
    return found

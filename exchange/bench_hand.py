"""Hands in DexGraspBench's layout: MJCF model with position actuators, configuration, map of joints.

The model's world frame is the frame of graspd's root link, so `qpos` begins with this link's pose. Names of bodies are
`root_<link>` and `f<number of the finger>_<link>`, because the evaluator finds fingers by prefix."""

import json
import xml.etree.ElementTree as ElementTree
from dataclasses import asdict, dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, Final

import mujoco
import numpy as np
from pydantic import TypeAdapter, ValidationError

from graspd.exchange.imported import write_obj
from graspd.exchange.robots.mujoco_scene import only_element, rename, restore_digits
from graspd.service.model.errors import InputError
from graspd.service.model.transforms import IDENTITY_POSE, Floats, compose, invert
from graspd.worker.hands.model import HandModel
from graspd.worker.validation.model import add_hand

_COLOUR: Final = (0.87, 0.45, 0.2, 1.0)


def write_hand(hand: HandModel, config: str, root: Path) -> Path:
    """Write a hand's model and configuration file; return the model's path, relative to `root`."""
    folder = Path("assets") / "hand" / config
    (root / folder / "meshes").mkdir(parents=True, exist_ok=True)
    spec = mujoco.MjSpec()
    spec.modelname, spec.compiler.degree = hand.name, False
    add_hand(spec, spec.worldbody.add_body(name="body0"), hand, {})
    spec.compile()
    tree = ElementTree.fromstring(spec.to_xml())
    restore_digits(tree, spec)
    only_element(tree, "compiler").set("meshdir", "meshes")
    for mesh in tree.iter("mesh"):
        mesh.set("file", f"{mesh.get('name')}.obj")
        del mesh.attrib["vertex"]
    for number, piece in enumerate(hand.pieces):
        if piece.kind == "hull":
            write_obj(root / folder / "meshes" / f"hand{number}.obj", piece.vertices, piece.faces)
    names = {f"body{b}": name for b, name in enumerate(body_names(hand))}
    names |= {f"joint{b}": name for b, name in zip(hand.joint_body, hand.joint_names, strict=True)}
    rename(tree, names | {f"dof{d}": name for d, name in enumerate(hand.dof_names)})
    ElementTree.indent(tree)
    (root / folder / "hand.xml").write_text(ElementTree.tostring(tree, encoding="unicode") + "\n")
    (root / "config" / "hand").mkdir(parents=True, exist_ok=True)
    (root / "config" / "hand" / f"{config}.yaml").write_text(_configuration(hand, folder / "hand.xml"))
    return folder / "hand.xml"


def body_names(hand: HandModel) -> tuple[str, ...]:
    """Return the names (L,) of the hand's bodies in the model."""
    return tuple(f"{'root' if b == 0 else _finger_prefix(hand, b)}_{name}" for b, name in enumerate(hand.body_names))


def _finger_prefix(hand: HandModel, body: int) -> str:
    """Return the finger of a body, numbered by the child of the root that leads to the body."""
    return f"f{np.flatnonzero(hand.parent == 0).tolist().index(hand.chain(body)[-1])}"


def _configuration(hand: HandModel, model: Path) -> str:
    """Return the configuration as JSON, which is valid YAML."""
    names = body_names(hand)
    fingers = [f"{_finger_prefix(hand, int(b))}_" for b in np.flatnonzero(hand.parent == 0)]
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


#: Folders of an experiment with grasps, and with grasps collected for training; the mapping is in the parent folder.
GRASPS: Final = "graspdata"
COLLECTED: Final = "succ_collect"
FILE: Final = "hand_mapping.json"
#: Folders of grasps and of results of the evaluator, which have the same fields.
_FOLDERS: Final = (GRASPS, COLLECTED, "evaluation", "succgrasp")


@dataclass(frozen=True)
class HandMapping:
    """Map between graspd's postures and `qpos`: the model's root pose (7,), then joints in its order."""

    hand: str
    root_link: str
    config: str  # value of the benchmark's option `hand`: the configuration that names the model
    model: str
    root_in_model: tuple[float, ...]
    """(7,) pose of graspd's root link in the frame of the model's root; m, w x y z."""
    joints: tuple[tuple[str, str], ...]
    """(model's joint, URDF's joint) in the order of `qpos`; angles are the same."""
    links: tuple[tuple[str, str], ...] = ()

    def qpos(self, hand: HandModel, root: Floats, joints: Floats) -> Floats:
        """Return `qpos` (7 + J,) from graspd's root pose (7,) and joints (J,)."""
        return np.concatenate([compose(root, invert(np.array(self.root_in_model))), joints[self._joint_order(hand)]])

    def posture(self, hand: HandModel, qpos: Floats) -> tuple[Floats, Floats]:
        """Return graspd's root poses (N, 7) and joints (N, J) from `qpos` (N, 7 + J).
        Raises InputError, like `qpos`: the hand has another root link or other joints."""
        joints = np.empty_like(qpos[:, 7:])
        joints[:, self._joint_order(hand)] = qpos[:, 7:]
        return compose(qpos[:, :7], np.array(self.root_in_model)), joints

    def _joint_order(self, hand: HandModel) -> list[int]:
        names = [ours for _, ours in self.joints]
        if hand.root_link != self.root_link or sorted(names) != sorted(hand.joint_names):
            raise InputError(
                f"the grasps are of {self.hand} with root link {self.root_link!r} and {len(names)} joints, but "
                f"{hand.name} has root link {hand.root_link!r} and {len(hand.joint_names)} joints; check --hand"
            )
        return [hand.joint_names.index(name) for name in names]

    def write(self, folder: Path) -> None:
        said = asdict(self) | {"unit": "m, rad", "quaternion": "w x y z", "qpos": "root position, quaternion, joints"}
        folder.mkdir(parents=True, exist_ok=True)
        (folder / FILE).write_text(json.dumps(said, indent=1) + "\n")


def load_mapping(file: Path) -> HandMapping | None:
    """Load the mapping of a grasp file's experiment; None if there is none.
    Raises InputError: the mapping is invalid."""
    for above in file.resolve().parents:
        if above.name in _FOLDERS:
            return _read_mapping(above.parent / FILE)
    return None


@lru_cache(maxsize=64)
def _read_mapping(path: Path) -> HandMapping | None:
    if not path.is_file():
        return None
    try:
        found = TypeAdapter(HandMapping).validate_json(path.read_bytes())
    except ValidationError:
        raise InputError(f"{path} is no mapping of a hand; export the grasps again or remove this file") from None
    if (numbers := len(found.root_in_model)) != len(IDENTITY_POSE):
        raise InputError(f"{path}: root_in_model has {numbers} numbers instead of {len(IDENTITY_POSE)}")
    return found


_SHADOW: Final = tuple(
    f"{finger}J{number}"
    for finger, count in (("FF", 4), ("MF", 4), ("RF", 4), ("LF", 5), ("TH", 5))
    for number in range(count, 0, -1)
)
_ALLEGRO: Final = tuple(f"{finger}j{number}" for finger in ("ff", "mf", "rf", "th") for number in range(4))
_ALLEGRO_URDFS: Final = (
    tuple(f"joint_{number}.0" for number in range(16)),
    tuple(
        f"{finger}_{part}"
        for finger in ("index", "middle", "ring", "thumb")
        for part in ("rotation" if finger == "thumb" else "abduction", "proximal", "middle", "distal")
    ),
)
_LEAP: Final = (
    *(f"{finger}_{part}" for finger in ("if", "mf", "rf") for part in ("mcp", "rot", "pip", "dip")),
    *(f"th_{part}" for part in ("cmc", "axl", "mcp", "ipl")),
)
#: Palm and joints, in the order of `_LEAP`, of MuJoCo Menagerie's file and of the vendor's URDF.
_LEAP_FILES: Final = (
    ("palm", _LEAP),
    ("palm_lower", ("1", "0", "2", "3", "5", "4", "6", "7", "9", "8", *(str(number) for number in range(10, 16)))),
)
#: Pose of the palm of DexGraspBench's Allegro hand in the model's world frame: a rotation alone.
_ALLEGRO_ROOT: Final = (0.0, 0.0, 0.0, 0.0, 0.5**0.5, 0.0, 0.5**0.5)
#: Pose of the palm of DexGraspBench's Shadow hand. The wrist below the palm is omitted.
_SHADOW_ROOT: Final = (0.0, 0.0, 0.034, 1.0, 0.0, 0.0, 0.0)
#: Pose of the palm of DexGraspBench's LEAP hand, and the place of the first joint in its frame [m]. The left hand has
#: the same names, but another place.
_LEAP_ROOT: Final = (0.0, 0.0, 0.1, 0.0, 1.0, 0.0, 0.0)
_LEAP_FIRST: Final = (-0.007, 0.023, -0.0187)


def benchmark_mapping(hand: HandModel) -> HandMapping | None:
    """Return the mapping to DexGraspBench's own model of the hand; None if it has none."""

    def mapping(config: str, root: tuple[float, ...], joints: tuple[tuple[str, str], ...]) -> HandMapping:
        return HandMapping(hand.name, hand.root_link, config, f"assets/hand/{config}/right_hand.xml", root, joints)

    for names in _ALLEGRO_URDFS:
        if set(names) == set(hand.joint_names) and hand.root_link in ("base_link", "palm"):
            return mapping("allegro", _ALLEGRO_ROOT, tuple(zip(_ALLEGRO, names, strict=True)))
    if set(_SHADOW) == set(hand.joint_names) and hand.root_link == "palm":
        return mapping("shadow", _SHADOW_ROOT, tuple((f"rh_{name}", name) for name in _SHADOW))
    for palm, names in _LEAP_FILES:
        body, pose = hand.frames.get(palm, (-1, IDENTITY_POSE))
        if body == 0 and set(names) == set(hand.joint_names):
            first = hand.origin[hand.joint_body[hand.joint_names.index(names[0])]]
            if np.allclose(compose(invert(pose), first)[:3], _LEAP_FIRST, rtol=0, atol=1e-3):
                root = compose(np.array(_LEAP_ROOT), invert(pose))
                return mapping("leap", tuple(root.tolist()), tuple(zip(_LEAP, names, strict=True)))
    return None

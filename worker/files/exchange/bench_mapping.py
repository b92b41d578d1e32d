"""How a hand of ours lies in the model that a benchmark evaluates: root frame and joints, for writers and readers."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, Final

import numpy as np
from pydantic_core import from_json

from service.model.errors import InputError
from service.model.transforms import IDENTITY_POSE, Floats, compose, invert
from worker.files.exchange.bench_hand import body_names
from worker.hands.model import HandModel

#: Folder of the grasps of an experiment; the mapping lies beside it.
GRASPS: Final = "graspdata"
#: Folder of grasps that were collected for training.
COLLECTED: Final = "succ_collect"
FILE: Final = "hand_mapping.json"
#: Folders of files with the same fields: grasps, and what the evaluator makes of them.
_FOLDERS: Final = (GRASPS, COLLECTED, "evaluation", "succgrasp")


@dataclass(frozen=True)
class HandMapping:
    """`qpos` = pose of the model's root (7,), then its joints in its own order."""

    hand: str
    root_link: str
    """Our root, a link of the URDF."""
    config: str
    """Configuration of the benchmark that names the model: `hand=...`."""
    model: str
    root_in_model: tuple[float, ...]
    """(7,) pose of our root link in the frame that `qpos` begins with the pose of; m, w x y z."""
    joints: tuple[tuple[str, str], ...]
    """(model's joint, URDF's joint) in the order of `qpos`; angles are the same."""
    links: tuple[tuple[str, str], ...] = ()
    """(model's body, URDF's link)"""

    def qpos(self, hand: HandModel, root: Floats, joints: Floats) -> Floats:
        """(7 + J,) from our root's pose (7,) and our joints (J,)."""
        return np.concatenate([compose(root, invert(np.array(self.root_in_model))), joints[self._order(hand)]])

    def posture(self, hand: HandModel, qpos: Floats) -> tuple[Floats, Floats]:
        """Our root's poses (N, 7) and our joints (N, J) from (N, 7 + J)."""
        joints = np.empty_like(qpos[:, 7:])
        joints[:, self._order(hand)] = qpos[:, 7:]
        return compose(qpos[:, :7], np.array(self.root_in_model)), joints

    def _order(self, hand: HandModel) -> list[int]:
        names = [ours for _, ours in self.joints]
        if hand.root_link != self.root_link or sorted(names) != sorted(hand.joint_names):
            raise InputError(
                f"the grasps are of {self.hand} from {self.root_link!r} on with {len(names)} joints, {hand.name} "
                f"begins at {hand.root_link!r} and has {len(hand.joint_names)}; is --hand the right hand?"
            )
        return [hand.joint_names.index(name) for name in names]

    def write(self, folder: Path) -> None:
        """As JSON for people and programs."""
        said = asdict(self) | {"unit": "m, rad", "quaternion": "w x y z", "qpos": "root position, quaternion, joints"}
        (folder / FILE).write_text(json.dumps(said, indent=1) + "\n")


def mapping_of(file: Path) -> HandMapping | None:
    """The mapping that lies beside the folder of a grasp's file; None where there is none.

    Raises:
        InputError: it is there and cannot be read.
    """
    for above in file.resolve().parents:
        if above.name in _FOLDERS:
            return _read(above.parent / FILE)
    return None


@lru_cache(maxsize=64)
def _read(path: Path) -> HandMapping | None:
    if not path.is_file():
        return None
    try:
        said: dict[str, Any] = from_json(path.read_bytes())
        pose = tuple(float(value) for value in said["root_in_model"])
        joints, links = (tuple((str(a), str(b)) for a, b in said[key]) for key in ("joints", "links"))
        hand, root, config, model = (str(said[key]) for key in ("hand", "root_link", "config", "model"))
    except (ValueError, TypeError, KeyError):
        raise InputError(f"{path} is no mapping of a hand; export the grasps again or remove it") from None
    if len(pose) != len(IDENTITY_POSE):
        raise InputError(f"{path}: root_in_model has {len(pose)} numbers instead of {len(IDENTITY_POSE)}")
    return HandMapping(hand, root, config, model, pose, joints, links)


def link_names(hand: HandModel) -> tuple[tuple[str, str], ...]:
    """(body of our model, link of the URDF) of every body."""
    return tuple(zip(body_names(hand), hand.body_names, strict=True))


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
#: Their Allegro palm lies turned in the model's world frame: quaternion 0 1 0 1.
_ALLEGRO_ROOT: Final = (0.0, 0.0, 0.0, 0.0, 0.5**0.5, 0.0, 0.5**0.5)
#: Their Shadow palm keeps the place that it has above the wrist, which is left out.
_SHADOW_ROOT: Final = (0.0, 0.0, 0.034, 1.0, 0.0, 0.0, 0.0)


def of_the_benchmark(hand: HandModel) -> HandMapping | None:
    """The mapping onto DexGraspBench's own model of the same hand; None where it has none."""
    for names in _ALLEGRO_URDFS:
        if set(names) == set(hand.joint_names) and hand.root_link in ("base_link", "palm"):
            joints = tuple(zip(_ALLEGRO, names, strict=True))
            return _theirs(hand, "allegro", _ALLEGRO_ROOT, joints)
    if set(_SHADOW) == set(hand.joint_names) and hand.root_link == "palm":
        return _theirs(hand, "shadow", _SHADOW_ROOT, tuple((f"rh_{name}", name) for name in _SHADOW))
    return None


def _theirs(hand: HandModel, config: str, root: tuple[float, ...], joints: tuple[tuple[str, str], ...]) -> HandMapping:
    return HandMapping(hand.name, hand.root_link, config, f"assets/hand/{config}/right_hand.xml", root, joints)

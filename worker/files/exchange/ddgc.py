"""DDGC's grasps of the Barrett hand: `barrett_translation_K.npy` and `barrett_representation_K.npy` of a scene.

Lundell et al., DDGC, RA-L 2021. For each object of the scene a list of grasps: position and quaternion x y z w of the
hand in the object's frame; eight joint angles, spread, medial and distal of finger 1, of finger 2, then medial and
distal of finger 3, closing positive.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Final

import numpy as np

from service.model.errors import InputError
from worker.files.exchange.imported import Imported, completed, joints_by_name
from worker.files.exchange.objects import scaled_object
from worker.files.exchange.pickles import load_npy
from worker.grasps import Posture
from worker.hands.load import hand_from_path
from worker.hands.model import HandModel

#: What the name of each joint matches, in the order of the file: finger and phalanx in words, or the maker's numbers.
ROLES: Final = tuple(
    rf"(?=.*{finger}).*({words})|j{finger}{number}"
    for finger, phalanges in (("1", "smd"), ("2", "smd"), ("3", "md"))
    for words, number in ({"s": ("prox|spread", 1), "m": ("med", 2), "d": ("dist", 3)}[part] for part in phalanges)
)


def read(path: Path, *, hand: str, obj: str, number: int = 0) -> list[Imported]:
    """The grasps of one object of a scene.

    Args:
        path: `barrett_translation_K.npy`; its `barrett_representation_K.npy` lies beside it.
        hand: URDF or built-in Barrett hand whose joints name finger (1, 2, 3) and phalanx (spread or prox, med, dist).
        obj: mesh of the object.
        number: which object of the scene.

    Raises:
        InputError: not such files, or no such object in the scene.
    """
    beside = path.with_name(path.name.replace("translation", "representation"))
    if beside == path or not beside.is_file():
        raise InputError(f"{path} needs its barrett_representation_K.npy beside it")
    places, joints = (list(load_npy(file)) for file in (path, beside))
    if number >= len(places) or len(places) != len(joints):
        raise InputError(f"{path} has {len(places)} objects and {beside.name} {len(joints)}; none is number {number}")
    place, values = np.asarray(places[number], float), np.asarray(joints[number], float)
    if place.ndim != 2 or place.shape[1] != 7 or values.shape != (len(place), len(ROLES)):
        raise InputError(f"{path}: object {number} has grasps of shape {place.shape} and joints of {values.shape}")
    model, thing = hand_from_path(hand), scaled_object(obj)
    pose = np.concatenate([place[:, :3], place[:, 6:], place[:, 3:6]], axis=1)
    grasp = Posture(pose, joints_by_name(model, _names(model), values * _signs(model), what=str(path)))
    return [Imported(model, thing, completed(model, thing, grasp), thing.name)]


def _names(hand: HandModel) -> list[str]:
    """The hand's joint for each role."""
    names = []
    for role in ROLES:
        found = [name for name in hand.joint_names if re.search(role, name)]
        if len(found) != 1:
            raise InputError(f"{hand.name} has no one joint that matches {role!r}: it is no Barrett hand")
        names.append(found[0])
    return names


def _signs(hand: HandModel) -> np.ndarray:
    """Where the hand's joint closes towards negative angles, the file's sign is turned."""
    high, low = hand.expand(hand.upper[None])[0], hand.expand(hand.lower[None])[0]
    return np.array(
        [
            1.0 if max(high[k], low[k]) > -min(high[k], low[k]) else -1.0
            for k in (hand.joint_names.index(name) for name in _names(hand))
        ]
    )

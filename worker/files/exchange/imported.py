"""Grasps that came from elsewhere, before our quality stage has seen them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from service.model.errors import InputError
from service.model.transforms import Floats
from worker.grasps import GraspSet, Posture
from worker.hands.model import HandModel
from worker.objects.model import ObjectModel
from worker.quality.postures import pregrasp, squeeze
from worker.simulation.surroundings import Placed


@dataclass(frozen=True)
class Origin:
    """Where grasps come from, and on what terms."""

    format: str
    source: str
    """Where a reader finds them: an address or a citation."""
    licence: str


@dataclass(frozen=True)
class Imported:
    """Grasps of one hand on one object, all three postures."""

    hand: HandModel
    obj: ObjectModel
    grasps: GraspSet
    name: str
    """Of the object, as the source calls it."""
    scale: float = 1.0
    """Factor that the source puts on the object's mesh."""
    published: NDArray[np.int8] | None = None
    """(N,) success as published: 1, 0, -1 unknown."""
    placed: Placed | None = None
    """The scenes that the grasps are for, if any."""


def completed(hand: HandModel, obj: ObjectModel, grasp: Posture) -> GraspSet:
    """Grasps with postures of ours before and after contact, for sources that have only the grasp."""
    return GraspSet(grasp, pregrasp(hand, obj, grasp), squeeze(hand, obj, grasp), np.full(len(grasp), np.nan))


def verdicts(values: Sequence[Any] | NDArray[Any]) -> NDArray[np.int8]:
    """(N,) what a file says of its grasps as 1 held, 0 dropped, -1: nothing that says so."""
    return np.array([int(value) if value in (0, 1) else -1 for value in np.ravel(values).tolist()], np.int8)


def joints_by_name(hand: HandModel, names: Sequence[str], values: Any, *, what: str) -> Floats:
    """(N, J) joint positions in the hand's order from (N, n) values in the order of `names`.

    Joints that the source does not have are led by a mimic or stand at their middle.

    Raises:
        InputError: a name is not a joint of the hand, or the widths differ.
    """
    given = np.atleast_2d(np.asarray(values, float))
    if given.shape[1] != len(names):
        raise InputError(f"{what}: {given.shape[1]} joint values for {len(names)} joints")
    if unknown := [name for name in names if name not in hand.joint_names]:
        raise InputError(
            f"{what}: {hand.name} has no joint {unknown[0]!r}; its joints are {', '.join(hand.joint_names)}"
        )
    order = [hand.joint_names.index(name) for name in names]
    middle = hand.expand(0.5 * (hand.lower + hand.upper)[None])[0]
    out = np.tile(middle, (len(given), 1))
    out[:, order] = given
    return out

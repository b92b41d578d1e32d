"""Trajectories of grasps in base shards: postures from standoff or pregrasp to squeeze or lift."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from pydantic_core import from_json

from graspd.service.model.errors import InputError
from graspd.service.model.scene_spec import SceneSpec
from graspd.service.model.transforms import Floats, slerp
from graspd.service.store.shards import Shard

#: Names of postures at which a phase begins or ends. Waypoints between them have no name.
STOPS: Final = ("standoff", "pregrasp", "grasp", "squeeze", "lift")


@dataclass(frozen=True)
class Waypoint:
    """One posture of the trajectory, in the frame of the object's rest pose."""

    name: str
    """One of `STOPS`, or empty."""
    hand_pose: Floats
    """(7,) root link: x y z [m], unit quaternion w x y z."""
    joint_positions: Floats
    """(J,) [rad or m]"""
    carried: Floats
    """(3,) displacement of the lifted object from its rest position [m]."""


def trajectory_of(shard: Shard, row: int) -> list[Waypoint]:
    """Return the trajectory of a grasp: pregrasp, grasp, squeeze; approach and lift if present.

    The last waypoint of the approach and the pregrasp have the same hand pose; the fingers close between them.
    """
    rest = np.zeros(3)

    def posture_waypoint(name: str) -> Waypoint:
        pose, joints = (np.asarray(shard[f"{name}/{part}"][row], float) for part in ("hand_pose", "joint_positions"))
        return Waypoint(name, pose, joints, rest)

    way = [posture_waypoint("pregrasp"), posture_waypoint("grasp"), posture_waypoint("squeeze")]
    if "grasp/approach" in shard.arrays:
        joints = np.asarray(shard["grasp/approach_joint_positions"][row], float)
        poses = np.asarray(shard["grasp/approach"][row], float)
        way[:0] = [Waypoint("" if k else "standoff", pose, joints, rest) for k, pose in enumerate(poses)]
    if "grasp/lift" in shard.arrays:
        pose, squeeze = np.asarray(shard["grasp/lift"][row], float), way[-1]
        way.append(Waypoint("lift", pose, squeeze.joint_positions, pose[:3] - squeeze.hand_pose[:3]))
    return way


def slider_positions(way: Sequence[Waypoint]) -> Floats:
    """Return the slider position of each waypoint (W,): 0, 1, 2, ... for `STOPS`, evenly spaced between."""
    stops = [k for k, point in enumerate(way) if point.name]
    return np.interp(np.arange(len(way)), stops, np.arange(len(stops)))


def waypoint_at(way: Sequence[Waypoint], place: float) -> Waypoint:
    """Interpolate the posture at a slider position: linear for positions and joints, slerp for rotations."""
    places = slider_positions(way)
    place = float(np.clip(place, places[0], places[-1]))
    k = min(int(np.searchsorted(places, place, side="right")) - 1, len(way) - 2)
    a, b = way[k], way[k + 1]
    share = (place - places[k]) / (places[k + 1] - places[k])

    def interpolate(first: Floats, second: Floats) -> Floats:
        return np.asarray((1 - share) * first + share * second)

    turn = slerp(a.hand_pose[3:], b.hand_pose[3:], float(share))
    name = a.name if share == 0 else b.name if share == 1 else ""
    pose = np.concatenate([interpolate(a.hand_pose[:3], b.hand_pose[:3]), turn])
    return Waypoint(name, pose, interpolate(a.joint_positions, b.joint_positions), interpolate(a.carried, b.carried))


def wrist_angles(shard: Shard, rows: NDArray[np.integer[Any]]) -> Floats | None:
    """Return the angles (N, U) of wrist joints above the hand's root [rad]; None if the shard has none."""
    angles = shard.arrays.get("grasp/wrist_positions")
    return None if angles is None else np.asarray(angles, float)[rows]


def scene_spec_of(shard: Shard) -> SceneSpec | None:
    """Return the scene of a shard's grasps or pictures; None for free objects. InputError if invalid."""
    text = shard.attributes.get("scene")
    if text is None:
        return None
    try:
        return SceneSpec(**from_json(str(text)))
    except (ValueError, TypeError):
        raise InputError("the shard's attribute scene is not a valid scene") from None


def planned_scene_of(shard: Shard) -> SceneSpec | None:
    """Return the scene in which grasps were planned, None for free ones; InputError if invalid."""
    spec = scene_spec_of(shard)
    return None if spec is None or spec.kind == "free" or "grasp/scene_index" not in shard.arrays else spec

"""From proposals to lifts: what a robot does that knows its hand, the table and what its camera saw, and nothing else.

A proposal is carried out open loop: from a standoff along its way in, fingers opened wider than it says where the table
has room for that, then to its grasp and its squeeze, then up. Only what the table forbids is fixed before: a hand that
would stand in it is raised. The mesh of the object is the simulator's alone.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from examples.train_grasp_predictor.samples import Floats, Sight
from graspd.baselines.learned.network import Proposals
from graspd.service.model.transforms import apply, compose, invert
from graspd.worker.grasps import GraspSet, Posture
from graspd.worker.hands.kinematics import body_poses
from graspd.worker.hands.model import HandModel
from graspd.worker.hands.surface import sample_surface
from graspd.worker.objects.model import ObjectModel
from graspd.worker.quality.table import measure
from graspd.worker.simulation.environment import CLEAR_M, RISE_M, STANDOFF_M, UP, Environment, Obstacle, PlacedGrasps
from graspd.worker.simulation.obstacles import obstacle_clearance
from graspd.worker.validation.decomposition import ConvexPieces
from graspd.worker.validation.lift import LiftOutcome
from graspd.worker.validation.lifting import validate_lifts

#: Fingers open by the first of these shares of their range, beyond the proposed pregrasp, for which there is room.
OPENED: Final = (0.15, 0.1, 0.05, 0.0)
#: Most by which a hand is raised out of the table [m].
MOST_RAISED_M: Final = 0.05
#: Postures of the way in.
WAYPOINTS: Final = 6
#: Points of the hand that are looked at, and the least distance on the way from what the camera saw [m].
_POINTS: Final = 400
SEEN_M: Final = 0.002
#: Of epsilon: contacts within this [m].
CONTACT_M: Final = 0.005


@dataclass(frozen=True)
class Ready:
    """Proposals as they are carried out, and what the robot knows of them before."""

    hands: Proposals
    opened: Floats
    """(N, J) joints of the hand that comes."""
    table: NDArray[np.bool_]
    """(N,) whether the hand as it was proposed would have stood in the table at its grasp."""
    clear: NDArray[np.bool_]
    """(N,) whether grasp and way are clear of the table, and the way of the points that the camera saw."""


def made_ready(hand: HandModel, proposed: Proposals, sight: Sight) -> Ready:
    """Proposals for one picture, opened, and raised out of the table by no more than they stand in it.

    How far the hand is to squeeze is no place where it will stand: the object is between.
    """
    at_grasp = obstacle_clearance(hand, Posture(proposed.hand_pose, proposed.joints), [table()])
    first = _raised(proposed, CLEAR_M - at_grasp)
    opened, room = wider(hand, proposed.pregrasp, OPENED[0]), np.full(len(proposed), -np.inf)
    for share in OPENED:
        tight = np.flatnonzero(room < CLEAR_M)
        if len(tight):
            opened[tight] = wider(hand, proposed.pregrasp[tight], share)
            room[tight] = _room_on_the_way(hand, part_of(first, tight), opened[tight])
    hands = _raised(first, CLEAR_M - room)
    lowest = np.minimum(
        obstacle_clearance(hand, Posture(hands.hand_pose, hands.joints), [table()]),
        _room_on_the_way(hand, hands, opened),
    )
    clear = (lowest >= 0.5 * CLEAR_M) & _passes(hand, hands, opened, sight)
    return Ready(hands, opened, at_grasp < 0.0, clear)


def _raised(hands: Proposals, by: Floats) -> Proposals:
    pose = hands.hand_pose.copy()
    pose[:, 2] += np.clip(by, 0.0, MOST_RAISED_M)
    return replace(hands, hand_pose=pose)


def part_of(hands: Proposals, which: NDArray[np.intp]) -> Proposals:
    """Some of the proposals."""
    return Proposals(*(np.asarray(part)[which] for part in vars(hands).values()))


def taken(ready: Ready, which: NDArray[np.intp]) -> Ready:
    """Some of the proposals."""
    return Ready(part_of(ready.hands, which), ready.opened[which], ready.table[which], ready.clear[which])


def wider(hand: HandModel, joints: Floats, share: float) -> Floats:
    """(N, J) joints, closing ones opened by a share of their range."""
    q = hand.reduce(joints)
    return np.asarray(hand.expand(np.clip(q - share * hand.closing * hand.span, hand.lower, hand.upper)))


def tighter(hand: HandModel, joints: Floats, by: float) -> Floats:
    """(N, J) joints, closing ones closed by so much [rad or m]."""
    q = hand.reduce(joints)
    return np.asarray(hand.expand(np.clip(q + by * hand.closing, hand.lower, hand.upper)))


def chosen(ready: Ready, count: int) -> NDArray[np.intp]:
    """(count,) which proposals are carried out: the first that are clear, then others."""
    return np.argsort(~ready.clear, kind="stable")[:count]


def way_in(hands: Proposals) -> Floats:
    """(N, W, 7) from the standoff to the grasp's place."""
    poses = np.repeat(hands.hand_pose[:, None], WAYPOINTS, axis=1)
    poses[..., :3] -= np.linspace(STANDOFF_M, 0.0, WAYPOINTS)[:, None] * hands.approach[:, None]
    return poses


def table() -> Environment:
    """What the robot knows to stand around: a table whose top is z = 0, which fingertips may touch."""
    top = Obstacle.half_space([0.0, 0.0, 1.0], 0.0)
    return Environment((Obstacle(top.planes, top.corners, tips_m=0.0),), UP)


def _room_on_the_way(hand: HandModel, hands: Proposals, opened: Floats) -> Floats:
    """(N,) least distance of the coming hand from the table [m]; fingertips may touch."""
    path = way_in(hands)
    n, steps = path.shape[:2]
    coming = Posture(path.reshape(-1, 7), np.repeat(opened, steps, axis=0))
    return np.asarray(obstacle_clearance(hand, coming, [table()]).reshape(n, steps).min(axis=1))


def _passes(hand: HandModel, hands: Proposals, opened: Floats, sight: Sight) -> NDArray[np.bool_]:
    """(N,) whether the coming hand's surface keeps `SEEN_M` from the points that were seen."""
    path = way_in(hands)
    n, steps = path.shape[:2]
    points = hand_points(hand, path.reshape(-1, 7), np.repeat(opened, steps, axis=0))
    # Farther away it does not matter how far: a search without a bound takes ten times as long.
    distance, _ = cKDTree(sight.points).query(points.reshape(-1, 3), distance_upper_bound=SEEN_M)
    return np.asarray(np.isinf(distance).reshape(n, -1).all(axis=1))


def hand_points(hand: HandModel, pose: Floats, joints: Floats) -> Floats:
    """(N, H, 3) points on the hand's surface."""
    surface = sample_surface(hand, _POINTS)
    return np.asarray(apply(body_poses(hand, pose, joints)[:, surface.body], surface.position))


@dataclass(frozen=True)
class Lifted:
    """What became of N proposals."""

    lift: NDArray[np.bool_]
    hard: NDArray[np.bool_]
    """At half the friction besides."""
    outcome: NDArray[np.uint8]
    """`LiftOutcome`."""
    epsilon: Floats
    """(N,) of the hand as it was proposed."""


def carried_out(
    hand: HandModel, obj: ObjectModel, pieces: ConvexPieces, ready: list[Ready], seen: list[Sight], *, epsilon: bool
) -> Lifted:
    """Lift tests of all proposals of some pictures of one object."""
    index = np.repeat(np.arange(len(seen)), [len(one.hands) for one in ready])
    lying = np.array([sight.object_pose for sight in seen])
    back = invert(lying[index])
    pose, path, grasp, squeeze, opened = (
        np.concatenate([part(one) for one in ready])
        for part in (
            lambda one: one.hands.hand_pose,
            lambda one: way_in(one.hands),
            lambda one: one.hands.joints,
            lambda one: one.hands.squeeze,
            lambda one: one.opened,
        )
    )
    own = compose(back, pose)
    raised = pose.copy()
    raised[:, :3] += RISE_M * UP
    grasps = GraspSet(
        Posture(own, grasp),
        Posture(own, opened),
        Posture(own, squeeze),
        np.full(len(own), np.nan),
        approach=compose(back[:, None], path),
        coming=opened,
        lift=Posture(compose(back, raised), squeeze),
        scene=index,
    )
    placed = PlacedGrasps(table().obstacles, lying, index)
    lifts = validate_lifts(hand, obj, grasps, placed, pieces=pieces)
    lift, hard = lifts.outcome == LiftOutcome.LIFTED, np.zeros(len(own), bool)
    rows = np.flatnonzero(lift)
    if len(rows):
        again = validate_lifts(hand, obj, grasps.take(rows), placed.take(rows), hard=True, pieces=pieces)
        hard[rows] = again.success == 1
    found = np.full(len(own), np.nan)
    if epsilon:
        columns = measure(hand, obj, grasps, friction=1.0)
        at = int(np.argmin(np.abs(np.asarray(columns["quality/thresholds_m"]) - CONTACT_M)))
        found = np.asarray(columns["quality/epsilon"], float)[:, at]
    return Lifted(lift, hard, lifts.outcome, found)

"""Open-loop execution of proposals by a robot that knows only hand, table and the camera's points.

The hand approaches from a standoff, closes to the grasp and the squeeze, and rises. During the approach, fingers are
opened wider than proposed if the table leaves room. A hand that would penetrate the table is raised beforehand. Only
the simulator knows the mesh of the object.
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

#: Opening of the fingers beyond the proposed pregrasp, in shares of their range; the first that leaves room is used.
OPENED: Final = (0.15, 0.1, 0.05, 0.0)
#: Largest rise of a hand out of the table [m].
MOST_RAISED_M: Final = 0.05
#: Waypoints of the approach.
WAYPOINTS: Final = 6
#: Number of hand points, and their least distance from the camera's points on the approach [m].
_POINTS: Final = 400
SEEN_M: Final = 0.002
#: Contact threshold of epsilon [m].
CONTACT_M: Final = 0.005


@dataclass(frozen=True)
class Ready:
    """Proposals ready for execution, with checks by the robot."""

    hands: Proposals
    opened: Floats
    """(N, J) joints of the hand on the approach."""
    table: NDArray[np.bool_]
    """(N,) whether the proposed grasp penetrates the table."""
    clear: NDArray[np.bool_]
    """(N,) whether grasp and approach are clear of the table, and the approach also of the camera's points."""


def made_ready(hand: HandModel, proposed: Proposals, sight: Sight) -> Ready:
    """Open the fingers of proposals for one picture; raise hands until they are clear of the table.

    The squeeze is not checked, because the object blocks the fingers before they reach it.
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
    """Return the proposals at the indices `which`."""
    return Proposals(*(np.asarray(part)[which] for part in vars(hands).values()))


def taken(ready: Ready, which: NDArray[np.intp]) -> Ready:
    """Return the ready proposals at the indices `which`."""
    return Ready(part_of(ready.hands, which), ready.opened[which], ready.table[which], ready.clear[which])


def wider(hand: HandModel, joints: Floats, share: float) -> Floats:
    """Return joints (N, J) with closing joints opened by a share of their range."""
    q = hand.reduce(joints)
    return np.asarray(hand.expand(np.clip(q - share * hand.closing * hand.span, hand.lower, hand.upper)))


def tighter(hand: HandModel, joints: Floats, by: float) -> Floats:
    """Return joints (N, J) with closing joints closed further by `by` [rad or m]."""
    q = hand.reduce(joints)
    return np.asarray(hand.expand(np.clip(q + by * hand.closing, hand.lower, hand.upper)))


def chosen(ready: Ready, count: int) -> NDArray[np.intp]:
    """Return the indices (count,) of the proposals to execute: clear ones first."""
    return np.argsort(~ready.clear, kind="stable")[:count]


def way_in(hands: Proposals) -> Floats:
    """Return the approach (N, W, 7) of the root link from the standoff to the grasp."""
    poses = np.repeat(hands.hand_pose[:, None], WAYPOINTS, axis=1)
    poses[..., :3] -= np.linspace(STANDOFF_M, 0.0, WAYPOINTS)[:, None] * hands.approach[:, None]
    return poses


def table() -> Environment:
    """Return the known obstacles: a table with its top at z = 0, which fingertips may touch."""
    top = Obstacle.half_space([0.0, 0.0, 1.0], 0.0)
    return Environment((Obstacle(top.planes, top.corners, tips_m=0.0),), UP)


def _room_on_the_way(hand: HandModel, hands: Proposals, opened: Floats) -> Floats:
    """Return the least distance (N,) of the hand from the table on the approach [m]; fingertips may touch."""
    path = way_in(hands)
    n, steps = path.shape[:2]
    coming = Posture(path.reshape(-1, 7), np.repeat(opened, steps, axis=0))
    return np.asarray(obstacle_clearance(hand, coming, [table()]).reshape(n, steps).min(axis=1))


def _passes(hand: HandModel, hands: Proposals, opened: Floats, sight: Sight) -> NDArray[np.bool_]:
    """Check (N,) whether the hand keeps `SEEN_M` from the camera's points on the approach."""
    path = way_in(hands)
    n, steps = path.shape[:2]
    points = hand_points(hand, path.reshape(-1, 7), np.repeat(opened, steps, axis=0))
    # A search without a distance limit takes ten times as long.
    distance, _ = cKDTree(sight.points).query(points.reshape(-1, 3), distance_upper_bound=SEEN_M)
    return np.asarray(np.isinf(distance).reshape(n, -1).all(axis=1))


def hand_points(hand: HandModel, pose: Floats, joints: Floats) -> Floats:
    """Return points (N, H, 3) on the hand's surface."""
    surface = sample_surface(hand, _POINTS)
    return np.asarray(apply(body_poses(hand, pose, joints)[:, surface.body], surface.position))


@dataclass(frozen=True)
class Lifted:
    """Outcomes of N executed proposals."""

    lift: NDArray[np.bool_]
    hard: NDArray[np.bool_]
    """Whether the hand also lifts at half friction."""
    outcome: NDArray[np.uint8]
    """`LiftOutcome`."""
    epsilon: Floats
    """(N,) of the executed grasps; nan: not measured."""


def carried_out(
    hand: HandModel, obj: ObjectModel, pieces: ConvexPieces, ready: list[Ready], seen: list[Sight], *, epsilon: bool
) -> Lifted:
    """Run the lift test of all proposals for some pictures of one object."""
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

"""Jaws of a gripper and pads of a hand: surfaces that meet on closing, their opening and closing line.

A gripper is a hand with at most two degrees of freedom. Its closing motion brings opposing surfaces (pads) together.
Everything follows from geometry, so a joint at 0 may be open or closed."""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Final

import numpy as np
from numpy.typing import NDArray

from graspd.service.model.transforms import IDENTITY_POSE, Floats, apply, quat_conjugate, quat_rotate, spread_directions
from graspd.worker.hands.closing import closing_posture
from graspd.worker.hands.kinematics import body_poses
from graspd.worker.hands.model import HandModel, JointType, SurfacePoints
from graspd.worker.hands.surface import sample_surface
from graspd.worker.objects.memory_cache import cached_by_content

Ints = NDArray[np.intp]

#: Largest number of degrees of freedom that close a gripper.
MAX_DOFS: Final = 2
#: Number of points that represent the hand's surface.
_POINTS: Final = 1600
#: Two surfaces face each other if their normals are opposite to within 37 degrees.
_FACING_COS: Final = 0.8
#: Largest lateral offset of surfaces that face each other, in distances between sample points.
_ASIDE: Final = 1.5
#: Least speed at which facing surfaces approach each other, as a share of the fastest speed.
_FAST: Final = 0.5
#: A pad is the part of a jaw within this distance of the first contact [m].
_PAD_DEPTH_M: Final = 0.003
#: Shares of the joint ranges at which the hand is checked for hidden surfaces.
_LOOKS: Final = (0.5, 0.02, 0.98)
#: Surfaces move ahead if their speed along their normals is at least this share of the fastest point's speed.
_LEADING: Final = 0.3
#: A body carries a pad if its area that faced the other jaw is at least this share of the largest such area.
_PAD_SHARE: Final = 0.4
#: Number of postures between open and closed.
_STEPS: Final = 17
#: Pads face each other if the difference of their mean normals is longer than this: normals at least 60 degrees apart.
_TOWARDS: Final = 1.0
#: Pads nearer than this touch [m].
_TOUCH_M: Final = 2e-4
#: Motions of the ends are not planar if the ratio of their smallest to largest singular value exceeds this.
_IN_SPACE: Final = 0.2


@dataclass(frozen=True)
class Jaws:
    """Closing motion of a gripper: K postures from open to contact of the pads, or to the limits."""

    q: Floats  # (K, D) dof values
    width: Floats  # (K,) clear width between the pads [m]
    middle: Floats  # (K, 3) point between the pads, root frame [m]
    axis: Floats  # (K, 3) unit vector from the first pad to the second, root frame
    speed: Floats  # (K, D, 2) motion of each pad towards the other per dof [m/rad or 1]
    bodies: tuple[tuple[int, ...], tuple[int, ...]]
    """Bodies with the first and with the second pad; 0 is the root, a jaw that does not move."""
    points: SurfacePoints  # points on both pads
    first: NDArray[np.bool_]  # (P,) mask of the points on the first pad
    length: float  # extent of the pads along the approach [m]; 0 if no approach is known

    @cached_property
    def opening(self) -> float:
        return float(self.width.max())

    def speeds(self, q: Floats) -> Floats:
        """Return `speed` (n, D, 2) at dof values (n, D)."""
        apart = np.linalg.norm((q[:, None] - self.q) / np.maximum(np.ptp(self.q, axis=0), 1e-9), axis=2)
        return self.speed[np.argmin(apart, axis=1)]

    def nearest_postures(self, width: Floats) -> tuple[Floats, Floats, Floats]:
        """Return dof values (n, D), middles and axes (n, 3) at the available widths nearest to `width` (n,)."""
        order = np.argsort(self.width, kind="stable")
        q, middle, axis = (
            np.column_stack([np.interp(width, self.width[order], column[order]) for column in array.T])
            for array in (self.q, self.middle, self.axis)
        )
        return q, middle, axis / np.linalg.norm(axis, axis=1, keepdims=True)


def closing_by_geometry(hand: HandModel) -> Floats:
    """Return each dof's direction (D,) that brings opposing surfaces together: +1, -1, or 0 for none.
    The sign is opposite to that of a sum over postures from the lower to the upper limits. Each summand is the area of
    facing surfaces times the speed at which they separate."""
    points = _visible_points(hand)
    balance, total = np.zeros(hand.dofs), np.zeros(hand.dofs)
    for share in np.linspace(0.05, 0.95, 5):
        q = hand.lower + share * hand.span
        place, normal = posed_points(hand, points, q)
        motions = [_point_velocities(hand, points, q, dof) for dof in range(hand.dofs)]
        # Absolute speed along the normal, relative to the fastest point's speed.
        speeds = [np.abs(np.einsum("ni,ni->n", m, normal)) / np.abs(m).max(initial=1e-12) for m in motions]
        moved = np.max(speeds, axis=0) > _LEADING
        first, second, _ = _facing_pairs(place, normal, points, np.flatnonzero(moved))
        for dof, motion in enumerate(motions):
            rate = np.einsum("ni,ni->n", motion[second] - motion[first], normal[first])
            # The rate of sliding surfaces is rounding noise.
            rate[np.abs(rate) < 1e-3 * np.abs(motion).max(initial=1e-12)] = 0.0
            balance[dof] += points.area[first] @ rate
            total[dof] += points.area[first] @ np.abs(rate)
    return np.where(np.abs(balance) > 0.2 * np.maximum(total, 1e-12), -np.sign(balance), 0.0)


@cached_by_content(32)
def jaws_of(hand: HandModel) -> Jaws | None:
    """Return the jaws of a complete hand; None if it is no gripper."""
    return find_jaws(hand, hand.palm.approach)


def find_jaws(hand: HandModel, approach: Floats | None = None) -> Jaws | None:
    """Find the jaws of a hand with known `closing`; None if it has none.
    A gripper has at most `MAX_DOFS` dofs, at least one of which closes it, and opposing surfaces on two sides."""
    closing = np.flatnonzero(hand.closing)
    if not 1 <= len(closing) <= MAX_DOFS or hand.dofs > MAX_DOFS:
        return None
    points = _visible_points(hand)
    path = closing_posture(hand, np.linspace(0.0, 1.0, _STEPS)[:, None])
    if _is_centric(hand, points, path):
        return None
    if (met := _closed_posture(hand, points, path)) is None:
        return None
    closed, first, second, faced = met
    place, normal = posed_points(hand, points, closed)
    if (sides := _pad_points(place, normal, points, np.union1d(first, second), faced)) is None:
        return None
    share = float(np.max(np.abs(closed - path[0]) / np.maximum(np.abs(path[-1] - path[0]), 1e-12)))
    return _measure_jaws(hand, points, sides, closing_posture(hand, np.linspace(0.0, share, _STEPS)[:, None]), approach)


def _visible_points(hand: HandModel) -> SurfacePoints:
    """Sample the hand's surface in the posture that hides least of it: pads of closed jaws may overlap."""
    seen = [sample_surface(replace(hand, preshape=hand.lower + share * hand.span), _POINTS) for share in _LOOKS]
    return seen[int(np.argmax([points.area.sum() for points in seen]))]


def posed_points(hand: HandModel, points: SurfacePoints, q: Floats) -> tuple[Floats, Floats]:
    """Return points (P, 3) and normals (P, 3) of the hand at a posture q (D,), root frame [m]."""
    pose = body_poses(hand, IDENTITY_POSE, hand.expand(q))[0][points.body]
    return apply(pose, points.position), quat_rotate(pose[:, 3:], points.normal)


def _point_velocities(hand: HandModel, points: SurfacePoints, q: Floats, dof: int) -> Floats:
    """Return the derivative (N, 3) of the points by a dof [m/rad or 1]."""
    step = np.eye(hand.dofs)[dof] * (1e-4 * max(float(hand.span[dof]), 1e-3))
    return (posed_points(hand, points, q + step)[0] - posed_points(hand, points, q - step)[0]) / (2 * step[dof])


def _facing_pairs(place: Floats, normal: Floats, points: SurfacePoints, among: Ints) -> tuple[Ints, Ints, Floats]:
    """Return points of `among` that face another body, the nearest facing point of each, and gaps [m]."""
    aside = _ASIDE * np.sqrt(points.area.sum() / len(points))
    first, second, gaps = [], [], []
    for i in among:
        way = place - place[i]
        gap = way @ normal[i]
        near = (gap > -_TOUCH_M) & (normal @ normal[i] < -_FACING_COS) & (points.body != points.body[i])
        near &= np.einsum("ni,ni->n", way, way) - gap * gap < aside * aside
        found = np.flatnonzero(near)
        if len(found):
            j = int(found[np.argmin(gap[found])])
            first.append(i)
            second.append(j)
            gaps.append(gap[j])
    return np.array(first, np.intp), np.array(second, np.intp), np.array(gaps)


def _is_centric(hand: HandModel, points: SurfacePoints, path: Floats) -> bool:
    """Check whether three or more digits close around one point, as in a centric gripper.
    Jaws and their linkages move in one plane; digits around a point do not."""
    ends = [body for body in set(points.body.tolist()) if body not in hand.parent]
    if len(ends) < 3:
        return False
    q, step = path[len(path) // 2], path[-1] - path[0]
    motion = sum(
        (_point_velocities(hand, points, q, d) * step[d] for d in range(hand.dofs)), np.zeros((len(points), 3))
    )
    way = np.array([motion[points.body == body].mean(axis=0) for body in ends])
    strength = np.linalg.svd(way, compute_uv=False)
    return bool(strength[2] > _IN_SPACE * strength[0])


def _closed_posture(hand: HandModel, points: SurfacePoints, path: Floats) -> tuple[Floats, Ints, Ints, Floats] | None:
    """Return the posture at which pads meet, else the last with approaching ones, and the first pairs.
    Also return the area (L,) of each body that faced another body before contact, summed over postures."""
    best: tuple[Floats, Ints, Ints, Floats] | None = None
    step, faced = path[-1] - path[0], np.zeros(hand.bodies)
    for k in range(len(path)):
        place, normal = posed_points(hand, points, path[k])
        motion = sum(
            (_point_velocities(hand, points, path[k], d) * step[d] for d in range(hand.dofs)), np.zeros((1, 3))
        )
        leading = np.einsum("ni,ni->n", motion, normal) > _LEADING * np.abs(motion).max(initial=1e-12)
        first, second, gap = _facing_pairs(place, normal, points, np.flatnonzero(leading))
        rate = np.einsum("ni,ni->n", motion[first] - motion[second], normal[first])
        fast = rate > _FAST * rate.max(initial=1e-9)
        if not fast.any():
            continue
        first, second, gap, rate = first[fast], second[fast], gap[fast], rate[fast]
        when = np.maximum(gap, 0.0) / rate
        for side in (first, second) if k < len(path) // 2 or not faced.any() else ():
            faced += np.bincount(points.body[side], points.area[side], minlength=hand.bodies)
        soonest = when <= np.quantile(when, 0.02) + _PAD_DEPTH_M / rate
        best = path[k], first[soonest], second[soonest], faced
        left = float(np.quantile(when, 0.02))
        if left < 1.0 / (_STEPS - 1):
            # Contact occurs before the next posture.
            return np.clip(path[k] + left * step, hand.lower, hand.upper), first[soonest], second[soonest], faced
    return best


def _pad_points(
    place: Floats, normal: Floats, points: SurfacePoints, every: Ints, faced: Floats
) -> tuple[Ints, Ints] | None:
    """Return the points of the two pads, or None if they are not on different bodies."""
    # Dominant direction of the normals, weighted by area.
    values, vectors = np.linalg.eigh((points.area[every, None] * normal[every]).T @ normal[every])
    line = vectors[:, int(np.argmax(values))]
    line = -dominant_sign(line) * line
    along = normal[every] @ line
    one, two = (_points_on_pads(every[side > _FACING_COS], points, faced) for side in (along, -along))
    if not len(one) or not len(two) or set(points.body[one]) & set(points.body[two]):
        return None
    # The first pad faces the second: it has the lower coordinate along the line.
    return (one, two) if (place[one].mean(axis=0) @ line) <= place[every].mean(axis=0) @ line else (two, one)


def dominant_sign(line: Floats) -> float:
    """Return -1 if a line's largest component (the first of equal ones) is negative, else 1.
    The sign of a vector from a decomposition is rounding noise."""
    size = np.abs(line)
    return float(np.sign(line[int(np.argmax(size > (1 - 1e-6) * size.max()))]))


def _points_on_pads(side: Ints, points: SurfacePoints, faced: Floats) -> Ints:
    most = float(faced[points.body[side]].max(initial=0.0))
    return side[faced[points.body[side]] >= _PAD_SHARE * most]


def _measure_jaws(
    hand: HandModel, points: SurfacePoints, sides: tuple[Ints, Ints], path: Floats, approach: Floats | None
) -> Jaws | None:
    """Measure widths, middles and axes of the pads on a path; None if closed pads do not face each other."""
    one, two = sides
    width, middle, axes = np.zeros(len(path)), np.zeros((len(path), 3)), np.zeros((len(path), 3))
    speed, facing = np.zeros((len(path), hand.dofs, 2)), np.zeros(len(path), bool)
    for k, q in enumerate(path):
        place, normal = posed_points(hand, points, q)
        axis = normal[one].mean(axis=0) - normal[two].mean(axis=0)
        # Pads that do not face each other cannot hold: jaws are not opened that far.
        facing[k] = float(np.linalg.norm(axis)) > _TOWARDS
        axis /= max(float(np.linalg.norm(axis)), 1e-9)
        low, high = place[one] @ axis, place[two] @ axis
        width[k] = float(np.quantile(high, 0.1) - np.quantile(low, 0.9))
        middle[k] = (place[one].mean(axis=0) + place[two].mean(axis=0)) / 2
        axes[k] = axis
        for dof in range(hand.dofs):
            motion = _point_velocities(hand, points, q, dof)
            speed[k, dof] = (motion[one] @ axis).mean(), -(motion[two] @ axis).mean()
    if not facing[-1]:
        return None
    both = np.concatenate([one, two])
    kept = slice(int(np.flatnonzero(~facing).max(initial=-1)) + 1, None)
    place, _ = posed_points(hand, points, path[kept][len(path[kept]) // 2])
    along = place[both] @ (approach if approach is not None else np.zeros(3))
    bodies = [tuple(np.unique(points.body[side]).tolist()) for side in sides]
    return Jaws(
        path[kept],
        np.maximum(width, 0.0)[kept],
        middle[kept],
        axes[kept],
        speed[kept],
        (bodies[0], bodies[1]),
        SurfacePoints(points.body[both], points.position[both], points.normal[both], points.area[both]),
        np.arange(len(both)) < len(one),
        float(np.ptp(along)),
    )


def prismatic_dofs(hand: HandModel) -> NDArray[np.bool_]:
    """Return a mask (D,) of the dofs that drive prismatic joints: their unit is the metre."""
    return np.array([JointType.PRISMATIC in hand.joint_type[hand.dof == d] for d in range(hand.dofs)])


#: A pad is the fastest part of a fingertip: this upper share of the tip's range of speeds, and thus of its length.
PAD: Final = 0.5
#: Least cosine of a pad's normals with its motion.
_AHEAD: Final = 0.7
#: Number of directions in which a fingertip is measured.
_DIRECTIONS: Final = 256
#: Number of surface points for the pads.
_PAD_POINTS: Final = 1000


@dataclass(frozen=True)
class Pad:
    """Part of a body's surface that presses on objects, in the body's frame."""

    body: int
    centre: Floats  # (3,) [m]
    normal: Floats  # (3,) unit: pressing direction
    points: Floats  # (P, 3) surface points [m]; empty if the body has no shape


def pads_of(hand: HandModel) -> tuple[Pad, ...]:
    """Return the pads of a gripper, or the inner sides of a hand's fingertips."""
    jaws = jaws_of(hand)
    if jaws is None:
        return tuple(fingertip_pad(hand, tip) for tip in hand.fingertips)
    found = []
    for side in (jaws.first, ~jaws.first):
        for body in np.unique(jaws.points.body[side]).tolist():
            mine = side & (jaws.points.body == body)
            place, look = jaws.points.position[mine], jaws.points.normal[mine].mean(axis=0)
            found.append(Pad(body, place.mean(axis=0), look / max(float(np.linalg.norm(look)), 1e-9), place))
    return tuple(found)


def fingertip_pad(hand: HandModel, tip: int) -> Pad:
    """Return the pad of a fingertip: the end of the side that moves forward when the last joint closes."""
    points = sample_surface(hand, _PAD_POINTS)
    mine = points.body == tip
    place, normal = points.position[mine], points.normal[mine]
    chain = hand.chain(tip)
    driven = [b for b in chain if hand.closing[hand.dof[b]] != 0] or chain
    if not len(place) or not driven:
        return Pad(tip, np.zeros(3), np.array([0.0, 0, 1]), np.zeros((0, 3)))
    # A joint that turns the tip about its own axis moves no side forward; a joint nearer to the palm then decides.
    chosen = next((part for body in driven if (part := _leading_points(hand, tip, body, place, normal)).any()), None)
    if chosen is None:
        # No joint decides, and the normals of a whole tip cancel: use the side that faces as the palm does.
        pose = body_poses(hand, IDENTITY_POSE, hand.expand(hand.preshape))[0, tip]
        ahead = quat_rotate(quat_conjugate(pose[3:]), hand.palm.approach)
        chosen = normal @ ahead > _AHEAD
        if not chosen.any():
            return Pad(tip, place.mean(axis=0), ahead, place)
    look = normal[chosen].mean(axis=0)
    return Pad(tip, place[chosen].mean(axis=0), look / max(float(np.linalg.norm(look)), 1e-9), place[chosen])


def least_fingertip_width(hand: HandModel) -> float:
    """Return the least width of a fingertip in any direction [m]; 0 if one has no shape."""
    ways, tips = spread_directions(_DIRECTIONS), []
    for tip in hand.fingertips:
        corners = [piece.vertices for piece in hand.pieces if piece.body == tip]
        tips.append(float(np.ptp(np.concatenate(corners) @ ways.T, axis=0).min()) if corners else 0.0)
    return min(tips, default=0.0)


def _leading_points(hand: HandModel, tip: int, driven: int, place: Floats, normal: Floats) -> NDArray[np.bool_]:
    """Return a mask (P,) of the fastest points of a tip that a body's joint moves along their normals."""
    dof = int(hand.dof[driven])
    step = np.eye(hand.dofs)[dof] * (1e-4 * (hand.closing[dof] or 1.0))
    q = np.stack([hand.preshape, hand.preshape + step])
    pose = body_poses(hand, np.tile(IDENTITY_POSE, (2, 1)), hand.expand(q))[:, tip]
    moved = apply(pose[:, None], place)
    move = quat_rotate(quat_conjugate(pose[0, 3:]), moved[1] - moved[0])
    speed = np.linalg.norm(move, axis=1)
    ahead = np.einsum("ij,ij->i", move / np.maximum(speed, 1e-12)[:, None], normal) > _AHEAD
    far = speed >= speed.max() - PAD * np.ptp(speed)
    return np.asarray(ahead & far if (ahead & far).any() else ahead)

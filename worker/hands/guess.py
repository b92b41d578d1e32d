"""Guesses of values that a URDF lacks: fingertips, closing, palm and pre-shape; options override them."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from graspd.service.model.errors import HandError, did_you_mean
from graspd.service.model.transforms import IDENTITY_POSE, Floats, apply, compose, quat_rotate
from graspd.worker.hands import closing
from graspd.worker.hands.closing import closing_posture, shared_bodies, tip_positions
from graspd.worker.hands.jaws import MAX_DOFS, Jaws, closing_by_geometry, dominant_sign, find_jaws, prismatic_dofs
from graspd.worker.hands.kinematics import body_poses
from graspd.worker.hands.model import HandModel, PalmFrame
from graspd.worker.hands.options import HandOptions
from graspd.worker.hands.tree import Tree
from graspd.worker.objects.disk_cache import cached_step

#: Share of the range from open to closed in the approach posture.
PRESHAPE_SHARE = 0.25
#: Number of iterations over closing and palm, which depend on each other.
LOOKS = 2
#: Fingers are opposed if the sum of tip motions across the hand is below this share of their total length. The share is
#: 0 for equal fingers around an axis, .3 to .55 for two fingers against one, and .75 or more for hands with a thumb.
OPPOSED = 0.65
#: Tips are level with their fingers' bases if they are ahead of the bases by at most this share of the bases' spread.
LEAST_AHEAD = 0.1
#: Two estimated unit vectors contradict each other if their sum is shorter than this. The direction is then unknown.
CONTRADICTING = 0.2
#: Tips close along their dominant line if the motion across it is below this share of the motion along it.
SIDEWAYS = 0.3
#: Angle below which two lines, or a line and a root axis, coincide [degrees].
SAME_LINE = 1.0
#: Angles within which lines and root axes may refine a rough and a precise direction [degrees].
ROUGH, GOOD = 40.0, 10.0
#: Largest number of joints whose axes are considered.
_JOINTS = 64
#: A wrist or rim that is higher than this above the surface between the fingers is not the palm [m].
RIM_M = 0.02


def complete_hand(hand: HandModel, tree: Tree, options: HandOptions) -> HandModel:
    """Fill in fingertips, closing, palm and preshape of the hand: as stated, else as guessed."""
    hand = replace(hand, fingertips=_fingertips(hand, tree, options))
    stated = dict(_values_by_dof(hand, tree, options.closing))
    hand = replace(hand, closing=closing.closing_by_limits(hand))
    slide = prismatic_dofs(hand)
    if hand.dofs <= MAX_DOFS or slide.any():
        seen = replace(hand, closing=_gripper_closing(hand, stated))
        if (jaws := find_jaws(seen)) is not None:
            return _complete_gripper(seen, jaws, tree, options)
        # Sliding dofs close in the direction that brings surfaces together.
        hand = replace(hand, closing=np.where(slide, seen.closing, hand.closing))
    for _ in range(LOOKS):
        hand = _with_palm(hand, tree, options)
        hand = replace(hand, closing=np.where(slide, hand.closing, closing.closing_by_tips(hand)))
    # A joint's stated closing does not change the guess for another joint.
    return _with_palm(replace(hand, closing=_with_stated_closing(hand.closing, stated)), tree, options)


def _with_stated_closing(guessed: Floats, stated: Mapping[int, float]) -> Floats:
    result = guessed.copy()
    for dof, direction in stated.items():
        result[dof] = np.sign(direction)
    return result


def _with_palm(hand: HandModel, tree: Tree, options: HandOptions) -> HandModel:
    approach = _stated_approach(hand, tree, options)
    if approach is None:
        approach, _ = guess_approach(hand)
    hand = replace(hand, preshape=_preshape(hand, tree, options))
    return replace(hand, palm=_palm(hand, tree, options, approach))


def _complete_gripper(hand: HandModel, jaws: Jaws, tree: Tree, options: HandOptions) -> HandModel:
    """Set up a gripper from its jaws: open on the approach, palm behind the point between the pads."""
    approach = _stated_approach(hand, tree, options)
    if approach is None:
        approach = _approach_of_jaws(hand, jaws)
    pads = tuple(body for side in jaws.bodies for body in side if body > 0)
    hand = replace(hand, fingertips=hand.fingertips if options.fingertips else pads)
    hand = replace(hand, preshape=_preshape(hand, tree, options, share=0.0))
    if options.palm is not None:
        return replace(hand, palm=_palm(hand, tree, options, approach))
    between = jaws.middle[len(jaws.middle) // 2]
    corners = [piece.vertices for piece in hand.pieces if piece.body == 0]
    height = float((np.concatenate(corners) @ approach).max()) if corners else 0.0
    # If one jaw is part of the palm, the palm ends at the pads.
    centre = between + min(height - float(between @ approach), 0.0) * approach
    return replace(hand, palm=PalmFrame(centre, approach))


def _approach_of_jaws(hand: HandModel, jaws: Jaws) -> Floats:
    """Return a gripper's approach: from palm to pads, perpendicular to closing line and axes of hinges."""
    half = len(jaws.q) // 2
    poses, axis = body_poses(hand, IDENTITY_POSE, hand.expand(jaws.q[half]))[0], jaws.axis[half]
    palm = [piece.vertices.mean(axis=0) for piece in hand.pieces if piece.body == 0]
    bases = [poses[b, :3] for b in range(1, hand.bodies) if hand.parent[b] == 0]
    way = jaws.middle[half] - np.mean(palm or bases, axis=0)
    ahead = _unit(way - (way @ axis) * axis)
    if (line := _common_direction(hand, ahead, ROUGH, 2, axis)) is not None:
        return line
    # A root frame that is not aligned with the closing line does not suggest an approach.
    return _snap_to_axis(ahead) if _angle(axis, _root_axis(axis)) < GOOD else ahead


def _gripper_closing(hand: HandModel, stated: Mapping[int, float]) -> Floats:
    """Return closing of a possible gripper: as stated, else from facing surfaces, else from limits.
    Raises HandError: fingers slide, and nothing opposes them."""
    seen = closing_by_geometry(hand)
    if not seen.any() and not stated and prismatic_dofs(hand).all():
        raise HandError(
            f"no two surfaces of the hand come together when {', '.join(hand.dof_names[:4])} moves: its fingers are "
            "missing or have no collision shapes (add them), or do not move towards each other (correct axes or limits)"
        )
    return _with_stated_closing(np.where((seen == 0) & ~prismatic_dofs(hand), hand.closing, seen), stated)


def _fingertips(hand: HandModel, tree: Tree, options: HandOptions) -> tuple[int, ...]:
    """Return the bodies of the stated links, else the leaves of the tree."""
    for name in options.fingertips:
        if name not in tree.known:
            raise HandError(f"the hand has no link {name!r} to be a fingertip{did_you_mean(name, tree.links)}")
    stated = [tree.links[name][0] for name in options.fingertips if name in tree.links]
    leaves = [body for body in range(1, hand.bodies) if body not in hand.parent]
    return tuple(dict.fromkeys(stated or leaves))


def guess_approach(hand: HandModel) -> tuple[Floats, bool]:
    """Return the direction out of the palm, and whether both sides of the palm are equally likely.
    The direction is the sum of two estimates. The mean motion of the closing fingertips points out of a human-like
    palm. The half-closed tips lie ahead of a gripper's palm. If fingers oppose each other, their motions cancel: see
    `_approach_between_fingers`."""
    ways, ahead = _tip_motions(hand), _unit(_palm_to_tips(hand))
    if _residual_motion(ways, ahead) < OPPOSED:
        return _approach_between_fingers(hand)
    mean = _unit(ways.sum(axis=0)) + ahead
    tied = bool(np.linalg.norm(mean) < CONTRADICTING)
    rough = ahead if tied else _unit(mean)
    line = _common_direction(hand, rough, ROUGH, 3)
    return (_snap_to_axis(rough) if line is None else line), tied


def _tip_motions(hand: HandModel) -> Floats:
    return tip_positions(hand, closing_posture(hand, 0.4)) - tip_positions(hand, closing_posture(hand, 0.05))


def _palm_to_tips(hand: HandModel) -> Floats:
    """Return the vector (3,) from the middle of the palm to the middle of the half-closed hand's tips."""
    body = shared_bodies(hand)[-1]
    q = closing_posture(hand, 0.6)
    pose = body_poses(hand, IDENTITY_POSE, hand.expand(q))[0, body]
    palm = [apply(pose, piece.vertices.mean(axis=0)) for piece in hand.pieces if piece.body == body]
    return np.asarray(tip_positions(hand, q).mean(axis=0) - np.mean(palm or [pose[:3]], axis=0))


def _residual_motion(ways: Floats, ahead: Floats) -> float:
    """Return the ratio |sum of motions| / sum of |motions| of the tips across `ahead`.
    The ratio is 0 if fingers close around an axis, 1 if all move the same way."""
    axis = _unit(ahead)
    across = ways - np.outer(ways @ axis, axis)
    return float(np.linalg.norm(across.sum(axis=0)) / max(np.linalg.norm(across, axis=1).sum(), 1e-12))


def _approach_between_fingers(hand: HandModel) -> tuple[Floats, bool]:
    """Return the direction out of the palm between opposed fingers, and whether its sign is a tie.
    The direction is from finger bases to half-closed tips, normal to any common closing line; a tie if coplanar."""
    body = shared_bodies(hand)[-1]
    q = closing_posture(hand, 0.5)
    poses = body_poses(hand, IDENTITY_POSE, hand.expand(q))[0]
    bases, ends = poses[hand.parent == body, :3], tip_positions(hand, q)
    along = ends.mean(axis=0) - bases.mean(axis=0)
    spread = float(np.linalg.norm(bases - bases.mean(axis=0), axis=1).max())
    tied = bool(np.linalg.norm(along) < LEAST_AHEAD * max(spread, 1e-6))
    if tied:
        # The plane's normal has no preferred sign: the sign is arbitrary and reported as a tie.
        normal = np.linalg.svd(np.vstack([bases, ends]) - bases.mean(axis=0))[2][-1]
        along = normal * dominant_sign(normal)
    else:
        ways = _tip_motions(hand)
        _, strength, lines = np.linalg.svd(ways - ways.mean(axis=0))
        if len(ways) > 1 and strength[1] < SIDEWAYS * strength[0]:
            # Unequal numbers of fingers on the two sides shift the mean of their tips.
            along = along - (along @ lines[0]) * lines[0]
    along = _unit(along)
    line = _common_direction(hand, along, GOOD, 2)
    return (_snap_to_axis(along, GOOD / 2) if line is None else line), tied


def _common_direction(
    hand: HandModel, rough: Floats, within: float, least: int, beside: Floats | None = None
) -> Floats | None:
    """Return a direction within `within` degrees of `rough` that at least `least` lines share; else None.
    Lines are the joint axes, `beside`, and their common normals."""
    body = hand.joint_body[:_JOINTS]
    pose = body_poses(hand, IDENTITY_POSE, hand.expand(np.clip(0.0, hand.lower, hand.upper)))[0, body]
    axes = quat_rotate(pose[:, 3:], hand.axis[body])
    axes = axes if beside is None else np.vstack([axes, beside])
    one, other = np.triu_indices(len(axes), 1)
    across = np.cross(axes[one], axes[other])
    length = np.linalg.norm(across, axis=1)
    lines = np.concatenate([axes, across[length > 0.5] / length[length > 0.5, None]])
    lines = lines * np.where(lines @ rough < 0, -1.0, 1.0)[:, None]
    lines = lines[lines @ rough > np.cos(np.deg2rad(within))]
    alike = lines @ lines.T > np.cos(np.deg2rad(SAME_LINE))
    shared = alike.sum(axis=1)
    if shared.max(initial=0) < least:
        return None
    return _snap_to_axis(_unit(lines[alike[int(np.argmax(shared))]].mean(axis=0)), SAME_LINE)


def _snap_to_axis(mean: Floats, within: float = ROUGH) -> Floats:
    """Return the nearest root axis if it is less than `within` degrees away; else the unit direction."""
    axis = _root_axis(mean)
    return axis if _angle(mean, axis) < within else _unit(mean)


def _root_axis(direction: Floats) -> Floats:
    axis = int(np.argmax(np.abs(direction)))
    return np.asarray(np.sign(direction[axis]) * np.eye(3)[axis])


def _angle(one: Floats, other: Floats) -> float:
    return float(np.rad2deg(np.arctan2(np.linalg.norm(np.cross(one, other)), one @ other)))


def _unit(vector: Floats) -> Floats:
    return vector / max(float(np.linalg.norm(vector)), 1e-9)


def _stated_approach(hand: HandModel, tree: Tree, options: HandOptions) -> Floats | None:
    """Return the stated approach in the root frame, with the joints between root and palm at rest."""
    stated = options.palm.approach if options.palm and options.palm.approach else options.approach
    if stated is None:
        return None
    if np.linalg.norm(stated) < 1e-9:
        raise HandError("the palm's approach direction is zero; give a direction such as [0, 0, 1]")
    body, link_pose = _palm_link(tree, options)
    rest = hand.expand(np.clip(0.0, hand.lower, hand.upper))
    pose = compose(body_poses(hand, IDENTITY_POSE, rest)[0, body], link_pose)
    direction = quat_rotate(pose[3:], np.asarray(stated))
    return direction / np.linalg.norm(direction)


def _palm_link(tree: Tree, options: HandOptions) -> tuple[int, Floats]:
    if options.palm is None:
        return 0, IDENTITY_POSE
    if options.palm.link not in tree.links:
        link = options.palm.link
        raise HandError(f"the hand has no link {link!r} to be its palm{did_you_mean(link, tree.links)}")
    return tree.links[options.palm.link]


def _palm(hand: HandModel, tree: Tree, options: HandOptions, approach: Floats) -> PalmFrame:
    """Return the stated palm; else the point at which a ray between the finger bases leaves the palm."""
    body, link_pose = _palm_link(tree, options)
    poses = body_poses(hand, IDENTITY_POSE, hand.expand(hand.preshape))[0]
    pose = compose(poses[body], link_pose)
    if options.palm and options.palm.centre is not None:
        return PalmFrame(apply(pose, np.asarray(options.palm.centre)), approach)
    if options.palm is None:
        body = int(np.argmax(np.bincount(hand.parent[1:], minlength=hand.bodies)))
    parts = [apply(poses[body], p.vertices) for p in hand.pieces if p.body == body]
    bases = poses[[b for b in range(1, hand.bodies) if hand.parent[b] == body], :3]
    corners = np.concatenate(parts) if parts else poses[body, None, :3]
    middle = (corners.min(axis=0) + corners.max(axis=0)) / 2
    through = (middle + bases.mean(axis=0)) / 2 if len(bases) else middle
    height = float((corners @ approach).max())
    centre = through + (height - through @ approach) * approach
    if len(bases):
        # A point below the region that the half-closed fingers cover.
        beneath = (bases.mean(axis=0) + tip_positions(hand, closing_posture(hand, 0.5)).mean(axis=0)) / 2
        surface = _exit_distance(parts, beneath, approach)
        if surface is not None and surface < height - RIM_M:
            return PalmFrame(beneath + (surface - beneath @ approach) * approach, approach)
    return PalmFrame(centre, approach)


def _exit_distance(parts: Sequence[Floats], point: Floats, direction: Floats) -> float | None:
    """Return the coordinate along `direction` at which a line through `point` leaves the last convex part.
    Parts are corners (V, 3); None if the line meets no part."""
    ends = []
    for corners in parts:
        planes = cached_step("planes", [corners], partial(_planes, corners))["0"]
        rate, room = planes[:, :3] @ direction, -(planes[:, :3] @ point + planes[:, 3])
        # A plane parallel to the line has no intersection; if it excludes the point, the line misses the part.
        across = np.abs(rate) > 1e-9
        first = np.max(room[across & (rate < 0)] / rate[across & (rate < 0)], initial=-np.inf)
        last = np.min(room[across & (rate > 0)] / rate[across & (rate > 0)], initial=np.inf)
        if first <= last and (room[~across] >= 0).all():
            ends.append(float(point @ direction) + float(last))
    return max(ends, default=None)


def _planes(corners: Floats) -> list[Floats]:
    """Return one array (F, 4): planes n x + d <= 0 of the hull of corners (V, 3)."""
    from scipy.spatial import ConvexHull  # slow to load

    return [np.asarray(ConvexHull(corners).equations)]


def _preshape(hand: HandModel, tree: Tree, options: HandOptions, share: float = PRESHAPE_SHARE) -> Floats:
    q = closing_posture(hand, share)
    for dof, value in _values_by_dof(hand, tree, options.preshape):
        if not hand.lower[dof] - 1e-6 <= value <= hand.upper[dof] + 1e-6:
            raise HandError(
                f"preshape of {hand.dof_names[dof]!r} is {value:g}, outside its limits "
                f"{hand.lower[dof]:.3g} .. {hand.upper[dof]:.3g}"
            )
        q[dof] = value
    return np.clip(q, hand.lower, hand.upper)


def _values_by_dof(hand: HandModel, tree: Tree, values: Mapping[str, float]) -> list[tuple[int, float]]:
    for name in values:
        if name not in tree.known:
            known = ", ".join(hand.dof_names[:8]) + (", ..." if hand.dofs > 8 else "")
            raise HandError(f"{name!r} is no joint of the hand ({known}){did_you_mean(name, hand.dof_names)}")
    return [(hand.dof_names.index(name), value) for name, value in values.items() if name in hand.dof_names]

"""Guesses for what a URDF does not say: fingertips, closing directions, palm and pre-shape. Each can be overridden."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from graspd.service.model.errors import HandError, did_you_mean
from graspd.service.model.transforms import IDENTITY_POSE, Floats, apply, compose, quat_rotate
from graspd.worker.hands.closing import carriers, closing_by_limits, closing_by_tips, posture, tips
from graspd.worker.hands.jaws import MAX_DOFS, Jaws, closing_by_geometry, find_jaws, sign_of, slides
from graspd.worker.hands.kinematics import body_poses
from graspd.worker.hands.model import HandModel, PalmFrame
from graspd.worker.hands.options import HandOptions
from graspd.worker.hands.tree import Tree
from graspd.worker.objects.disk_cache import recalled

#: Share of the way from open to closed at which the hand approaches.
PRESHAPE_SHARE = 0.25
#: How often closing and palm, which follow from each other, are looked at.
LOOKS = 2
#: Fingertips whose ways across the hand sum to less than this share of their lengths close on one another: 0 of like
#: fingers around an axis, .3 to .55 where two oppose one, .75 and more of hands with a thumb.
OPPOSED = 0.65
#: Tips that are no farther ahead of where their fingers begin than this share of these places' spread are beside them.
LEAST_AHEAD = 0.1
#: A sum of two unit witnesses that is shorter than this tells no direction: they contradict each other.
CONTRADICTING = 0.2
#: Tips whose ways across their strongest line are less than this share of it close along that line.
SIDEWAYS = 0.3
#: Lines this near to each other are one line, and a root axis so near to it is it [degrees].
SAME_LINE = 1.0
#: Lines and root axes this near to a rough direction may be what it stands for [degrees]; and to a good one.
ROUGH, GOOD = 40.0, 10.0
#: Joints whose axes are looked at.
_JOINTS = 64
#: A wrist or a rim that stands so far above the palm between the fingers is not the palm [m].
RIM_M = 0.02


def complete(hand: HandModel, tree: Tree, options: HandOptions) -> HandModel:
    """The hand with fingertips, closing, palm and preshape filled in: as stated, else as guessed."""
    hand = replace(hand, fingertips=_fingertips(hand, tree, options))
    stated = dict(_by_dof(hand, tree, options.closing))
    hand = replace(hand, closing=closing_by_limits(hand))
    slide = slides(hand)
    if hand.dofs <= MAX_DOFS or slide.any():
        seen = replace(hand, closing=_closing_seen(hand, stated))
        if (jaws := find_jaws(seen)) is not None:
            return _gripper(seen, jaws, tree, options)
        # Fingertips that slide are known by the surfaces that come together.
        hand = replace(hand, closing=np.where(slide, seen.closing, hand.closing))
    for _ in range(LOOKS):
        hand = _with_palm(hand, tree, options)
        hand = replace(hand, closing=np.where(slide, hand.closing, closing_by_tips(hand)))
    # What is stated of one joint changes no guess of another.
    return _with_palm(replace(hand, closing=_with(hand.closing, stated)), tree, options)


def _with(closing: Floats, stated: Mapping[int, float]) -> Floats:
    """(D,) the closing, as stated where it is."""
    closing = closing.copy()
    for dof, direction in stated.items():
        closing[dof] = np.sign(direction)
    return closing


def _with_palm(hand: HandModel, tree: Tree, options: HandOptions) -> HandModel:
    """The hand with the preshape and the palm that follow from its closing."""
    approach = _stated_approach(hand, tree, options)
    if approach is None:
        approach = _guess_approach(hand)
    hand = replace(hand, preshape=_preshape(hand, tree, options))
    return replace(hand, palm=_palm(hand, tree, options, approach))


def _gripper(hand: HandModel, jaws: Jaws, tree: Tree, options: HandOptions) -> HandModel:
    """The hand with what its jaws tell: it comes open, the pads ahead, and takes hold between them."""
    approach = _stated_approach(hand, tree, options)
    if approach is None:
        approach = _approach_of_jaws(hand, jaws)
    pads = tuple(body for side in jaws.bodies for body in side if body > 0)
    hand = replace(hand, fingertips=hand.fingertips if options.fingertips else pads)
    hand = replace(hand, preshape=_preshape(hand, tree, options, share=0.0))
    if options.palm is None:
        between = jaws.middle[len(jaws.middle) // 2]
        corners = [piece.vertices for piece in hand.pieces if piece.body == 0]
        height = float((np.concatenate(corners) @ approach).max()) if corners else 0.0
        # A jaw that is part of the palm reaches as far as the pads do.
        centre = between + min(height - float(between @ approach), 0.0) * approach
        return replace(hand, palm=PalmFrame(centre, approach))
    return replace(hand, palm=_palm(hand, tree, options, approach))


def _approach_of_jaws(hand: HandModel, jaws: Jaws) -> Floats:
    """Direction ahead of a gripper: across its joints' axes and the line on which it closes, where it has hinges."""
    ahead, axis = _unit(_ahead(hand, jaws)), jaws.axis[len(jaws.q) // 2]
    if (line := _line_of_joints(hand, ahead, ROUGH, 2, axis)) is not None:
        return line
    # A root frame that the jaws do not close along says nothing.
    return _snapped(ahead) if _angle(axis, _root_axis(axis)) < GOOD else ahead


def _ahead(hand: HandModel, jaws: Jaws) -> Floats:
    """Direction from the palm to between the pads, across the line on which they close."""
    half = len(jaws.q) // 2
    poses = body_poses(hand, IDENTITY_POSE, hand.expand(jaws.q[half]))[0]
    palm = [piece.vertices.mean(axis=0) for piece in hand.pieces if piece.body == 0]
    bases = [poses[b, :3] for b in range(1, hand.bodies) if hand.parent[b] == 0]
    way = jaws.middle[half] - np.mean(palm or bases, axis=0)
    return np.asarray(way - (way @ jaws.axis[half]) * jaws.axis[half])


def _closing_seen(hand: HandModel, stated: Mapping[int, float]) -> Floats:
    """Closing of a hand that may be a gripper: as stated, else as its surfaces come together, else by its limits.

    Raises:
        HandError: fingers slide, and nothing opposes them.
    """
    seen = closing_by_geometry(hand)
    if not seen.any() and not stated and slides(hand).all():
        raise HandError(
            f"no two surfaces of the hand come together when {', '.join(hand.dof_names[:4])} moves: its fingers are "
            "missing or have no collision shapes (add them), or do not move towards each other (correct axes or limits)"
        )
    return _with(np.where((seen == 0) & ~slides(hand), hand.closing, seen), stated)


def _fingertips(hand: HandModel, tree: Tree, options: HandOptions) -> tuple[int, ...]:
    """Bodies of the stated links, else the leaves of the tree."""
    for name in options.fingertips:
        if name not in tree.known:
            raise HandError(f"the hand has no link {name!r} to be a fingertip{did_you_mean(name, tree.links)}")
    kept = [tree.links[name][0] for name in options.fingertips if name in tree.links]
    if kept:
        return tuple(dict.fromkeys(kept))
    return tuple(body for body in range(1, hand.bodies) if body not in set(hand.parent.tolist()))


def _guess_approach(hand: HandModel) -> Floats:
    """Direction out of the palm: see `_witnessed`."""
    return _witnessed(hand)[0]


def approach_is_tied(hand: HandModel) -> bool:
    """Whether nothing tells on which side of its fingers a hand takes hold."""
    return _witnessed(hand)[1]


def _witnessed(hand: HandModel) -> tuple[Floats, bool]:
    """Direction out of the palm, and whether that is a tie.

    Two witnesses: the mean way of the fingertips as the hand closes, which points out of a human-like palm; and where
    the tips of the half-closed hand are, which is ahead of the palm on a gripper but also far along the fingers of a
    human-like hand. Their sum errs least. Where fingers oppose each other the ways of their tips cancel, and what is
    left of them is sideways or rounding noise: see `_between_fingers`.
    """
    ways, ahead = _ways(hand), _unit(_tips_ahead(hand))
    if _cancelling(ways, ahead) < OPPOSED:
        return _between_fingers(hand)
    mean = _unit(ways.sum(axis=0)) + ahead
    tied = bool(np.linalg.norm(mean) < CONTRADICTING)
    rough = ahead if tied else _unit(mean)
    line = _line_of_joints(hand, rough, ROUGH, 3)
    return (_snapped(rough) if line is None else line), tied


def _ways(hand: HandModel) -> Floats:
    """(T, 3) ways of the fingertips as the hand closes."""
    return tips(hand, posture(hand, 0.4)) - tips(hand, posture(hand, 0.05))


def _tips_ahead(hand: HandModel) -> Floats:
    """(3,) from the middle of the palm to that of the tips of the half-closed hand."""
    body = carriers(hand)[-1]
    pose = body_poses(hand, IDENTITY_POSE, hand.expand(posture(hand, 0.6)))[0, body]
    palm = [apply(pose, piece.vertices.mean(axis=0)) for piece in hand.pieces if piece.body == body]
    return np.asarray(tips(hand, posture(hand, 0.6)).mean(axis=0) - (np.mean(palm, axis=0) if palm else pose[:3]))


def _cancelling(ways: Floats, ahead: Floats) -> float:
    """Share of the tips' ways across `ahead` that their sum keeps: 0 where fingers close around an axis, 1 where all go
    the same way."""
    axis = _unit(ahead)
    across = ways - np.outer(ways @ axis, axis)
    return float(np.linalg.norm(across.sum(axis=0)) / max(np.linalg.norm(across, axis=1).sum(), 1e-12))


def _between_fingers(hand: HandModel) -> tuple[Floats, bool]:
    """Direction out of the palm of a hand whose fingers oppose each other: from where they begin to their half-closed
    tips, across the line on which they close if they do so on one; and whether that is a tie, since they lie in the
    plane in which they begin."""
    body = carriers(hand)[-1]
    q = posture(hand, 0.5)
    poses = body_poses(hand, IDENTITY_POSE, hand.expand(q))[0]
    bases, ends = poses[hand.parent == body, :3], tips(hand, q)
    along = ends.mean(axis=0) - bases.mean(axis=0)
    spread = float(np.linalg.norm(bases - bases.mean(axis=0), axis=1).max())
    tied = bool(np.linalg.norm(along) < LEAST_AHEAD * max(spread, 1e-6))
    if tied:
        # The plane's normal is known, its side is not: one is taken, and told.
        normal = np.linalg.svd(np.vstack([bases, ends]) - bases.mean(axis=0))[2][-1]
        along = normal * sign_of(normal)
    else:
        ways = _ways(hand)
        _, strength, lines = np.linalg.svd(ways - ways.mean(axis=0))
        if len(ways) > 1 and strength[1] < SIDEWAYS * strength[0]:
            # More fingers on one side than on the other shift the middle of their tips.
            along = along - (along @ lines[0]) * lines[0]
    along = _unit(along)
    line = _line_of_joints(hand, along, GOOD, 2)
    return (_snapped(along, GOOD / 2) if line is None else line), tied


def _line_of_joints(
    hand: HandModel, rough: Floats, within: float, least: int, beside: Floats | None = None
) -> Floats | None:
    """The direction that most axes of joints, and lines across two of them, agree on near a rough one.

    The hand tells its own directions, however its root frame is turned.

    Args:
        hand: the hand.
        rough: (3,) unit.
        within: how near to it [degrees].
        least: how many must agree; else None.
        beside: (3,) another line, such as that on which jaws close.
    """
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
    if not len(lines) or alike.sum(axis=1).max() < least:
        return None
    mean = _unit(lines[alike[int(np.argmax(alike.sum(axis=1)))]].mean(axis=0))
    return _snapped(mean, SAME_LINE)


def _snapped(mean: Floats, within: float = ROUGH) -> Floats:
    """The direction as a unit vector, on a root axis where it is `within` so many degrees of one."""
    axis = _root_axis(mean)
    return axis if _angle(mean, axis) < within else _unit(mean)


def _root_axis(direction: Floats) -> Floats:
    """The root axis, either way, that is nearest to a direction."""
    axis = int(np.argmax(np.abs(direction)))
    return np.asarray(np.sign(direction[axis]) * np.eye(3)[axis])


def _angle(one: Floats, other: Floats) -> float:
    """Between two directions [degrees]."""
    return float(np.rad2deg(np.arctan2(np.linalg.norm(np.cross(one, other)), one @ other)))


def _unit(vector: Floats) -> Floats:
    return vector / max(float(np.linalg.norm(vector)), 1e-9)


def _stated_approach(hand: HandModel, tree: Tree, options: HandOptions) -> Floats | None:
    """In the root frame, the joints between root and palm at rest."""
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
    """The stated palm; else the point where a ray between the finger bases leaves the palm along the approach."""
    body, link_pose = _palm_link(tree, options)
    poses = body_poses(hand, IDENTITY_POSE, hand.expand(hand.preshape))[0]
    pose = compose(poses[body], link_pose)
    if options.palm and options.palm.centre is not None:
        return PalmFrame(apply(pose, np.asarray(options.palm.centre)), approach)
    if options.palm is None:
        children = np.bincount(hand.parent[1:], minlength=hand.bodies)
        body = int(np.argmax(children))
    parts = [apply(poses[body], p.vertices) for p in hand.pieces if p.body == body]
    bases = poses[[b for b in range(1, hand.bodies) if hand.parent[b] == body], :3]
    corners = np.concatenate(parts) if parts else poses[body, None, :3]
    middle = (corners.min(axis=0) + corners.max(axis=0)) / 2
    through = (middle + bases.mean(axis=0)) / 2 if len(bases) else middle
    height = float((corners @ approach).max())
    centre = through + (height - through @ approach) * approach
    if len(bases):
        # Beneath what the half-closed fingers reach over.
        beneath = (bases.mean(axis=0) + tips(hand, posture(hand, 0.5)).mean(axis=0)) / 2
        surface = _leaves(parts, beneath, approach)
        if surface is not None and surface < height - RIM_M:
            return PalmFrame(beneath + (surface - beneath @ approach) * approach, approach)
    return PalmFrame(centre, approach)


def _leaves(parts: Sequence[Floats], point: Floats, direction: Floats) -> float | None:
    """How far along `direction` a line through `point` leaves the last of some convex parts (V, 3); None: it meets
    none."""
    ends = []
    for corners in parts:
        planes = recalled("planes", [corners], partial(_planes, corners))["0"]
        rate, room = planes[:, :3] @ direction, -(planes[:, :3] @ point + planes[:, 3])
        # Planes along the line bound nothing; those that the point lies outside of are not met at all.
        across = np.abs(rate) > 1e-9
        first = np.max(room[across & (rate < 0)] / rate[across & (rate < 0)], initial=-np.inf)
        last = np.min(room[across & (rate > 0)] / rate[across & (rate > 0)], initial=np.inf)
        if first <= last and (room[~across] >= 0).all():
            ends.append(float(point @ direction) + float(last))
    return max(ends, default=None)


def _planes(corners: Floats) -> list[Floats]:
    """One array (F, 4): planes n x + d <= 0 of the hull of corners (V, 3)."""
    from scipy.spatial import ConvexHull  # slow to load

    return [np.asarray(ConvexHull(corners).equations)]


def _preshape(hand: HandModel, tree: Tree, options: HandOptions, share: float = PRESHAPE_SHARE) -> Floats:
    q = posture(hand, share)
    for dof, value in _by_dof(hand, tree, options.preshape):
        if not hand.lower[dof] - 1e-6 <= value <= hand.upper[dof] + 1e-6:
            raise HandError(
                f"preshape of {hand.dof_names[dof]!r} is {value:g}, outside its limits "
                f"{hand.lower[dof]:.3g} .. {hand.upper[dof]:.3g}"
            )
        q[dof] = value
    return np.clip(q, hand.lower, hand.upper)


def _by_dof(hand: HandModel, tree: Tree, values: Mapping[str, float]) -> list[tuple[int, float]]:
    """(dof, value) of named joints; those that were frozen, coupled or dropped have no say any more."""
    for name in values:
        if name not in tree.known:
            known = ", ".join(hand.dof_names[:8]) + (", ..." if hand.dofs > 8 else "")
            raise HandError(f"{name!r} is no joint of the hand ({known}){did_you_mean(name, hand.dof_names)}")
    return [(hand.dof_names.index(name), value) for name, value in values.items() if name in hand.dof_names]

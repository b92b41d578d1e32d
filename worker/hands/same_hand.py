"""Two models of one hand: which joints are the same, how their bases stand to each other, how far they agree."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np
from numpy.typing import NDArray

from graspd.service.model.errors import InputError
from graspd.service.model.transforms import (
    IDENTITY_POSE,
    Floats,
    apply,
    compose,
    invert,
    quat_from_axis_angle,
    quat_from_matrix,
)
from graspd.worker.hands.kinematics import body_poses
from graspd.worker.hands.model import HandModel

#: Random postures in which two models are compared.
POSTURES: Final = 200
#: To the first of them the bases are fitted.
_FITTED: Final = 40
#: Fingertips that are farther apart than this [m] belong to different hands.
TOLERANCE_M: Final = 1e-3
#: Weight of where a fingertip's middle is in the other model, for hands whose motion does not tell: the jaws of a
#: gripper only shift. Over all postures it moves no fingertip by a nanometre.
_PRIOR: Final = 1e-3
#: What a fit of another hand takes at most; one of the same hand ends by itself or is as good by then.
_LOOKS: Final = 15


@dataclass(frozen=True)
class SameHand:
    """How the joints and the base of `theirs` stand to those of `ours`."""

    ours: HandModel
    theirs: HandModel
    joints: NDArray[np.intp]
    """(J',) for each joint of theirs, the number of the joint of ours."""
    base: Floats
    """(7,) pose of their root in our root's frame."""
    fingertips_m: float
    """Largest distance of a fingertip in one model from the same in the other, over random postures."""

    @cached_property
    def bodies(self) -> NDArray[np.intp]:
        """(L',) for each body of theirs, the body of ours that the same joint carries; the root for the root."""
        out = np.zeros(self.theirs.bodies, np.intp)
        out[self.theirs.joint_body] = self.ours.joint_body[self.joints]
        return out

    @cached_property
    def frames(self) -> Floats:
        """(L', 7) pose of each body of theirs in the frame of that body of ours."""
        q = np.clip(0.0, self.ours.lower, self.ours.upper)
        mine = self.ours.expand(q)
        a = body_poses(self.ours, IDENTITY_POSE, mine)[0]
        b = body_poses(self.theirs, self.base, mine[self.joints])[0]
        return compose(invert(a[self.bodies]), b)


def same_hand(
    ours: HandModel,
    theirs: HandModel,
    joint_map: Mapping[str, str] | None = None,
    *,
    tolerance_m: float = TOLERANCE_M,
    seed: int = 0,
) -> SameHand:
    """Match two models of a hand.

    A joint is the one of the same name; where the names of either hand all begin alike (`rh_`, `robot0:`), what they
    begin with does not count, nor does upper or lower case. The bases are put where the fingertips of random postures
    agree best; a fingertip is the middle of the corners of a finger's last body.

    Args:
        ours: the hand that grasps were planned with.
        theirs: another model of it.
        joint_map: joints of ours to joints of theirs, where names do not tell.
        tolerance_m: fingertips that differ by more are those of another hand [m].
        seed: of the postures.

    Raises:
        InputError: a joint of one has no other in the other model, or the fingertips do not agree.
    """
    joints = _matched(ours, theirs, joint_map or {})
    tips = [body for body in ours.fingertips if body]
    rng = np.random.default_rng(seed)
    mine = ours.expand(rng.uniform(ours.lower, ours.upper, (POSTURES, ours.dofs)))
    here = body_poses(ours, np.tile(IDENTITY_POSE, (POSTURES, 1)), mine)
    there = body_poses(theirs, np.tile(IDENTITY_POSE, (POSTURES, 1)), mine[:, joints])
    other = [_body_of_the_same_joint(ours, theirs, joints, body) for body in tips]
    where = np.stack([apply(here[:, b], _middle(ours, b)) for b in tips], axis=1)
    base, places = _fit(where[:_FITTED], there[:_FITTED, other], np.array([_middle(theirs, b) for b in other]))
    error = np.linalg.norm(apply(base, apply(there[:, other], places)) - where, axis=-1)
    if error.max() > tolerance_m:
        worst = tips[int(error.max(axis=0).argmax())]
        raise InputError(
            f"{theirs.name} is no model of {ours.name}: fingertip {ours.body_names[worst]!r} is up to "
            f"{1e3 * error.max():.2f} mm from where {ours.name} has it, {1e3 * tolerance_m:g} mm are allowed; "
            "compare axes and zeros of the joints, or say which are the same: --joint-map OURS=THEIRS"
        )
    return SameHand(ours, theirs, joints, base, float(error.max()))


def _matched(ours: HandModel, theirs: HandModel, joint_map: Mapping[str, str]) -> NDArray[np.intp]:
    for here, there in joint_map.items():
        for name, hand in ((here, ours), (there, theirs)):
            if name not in hand.joint_names:
                raise InputError(f"--joint-map names the joint {name!r}, which {hand.name} does not have")
    said = {there: here for here, there in joint_map.items()}
    plain_ours = {_plain(name, ours.joint_names): name for name in ours.joint_names if name not in joint_map}
    exact = set(plain_ours.values())
    twins = {
        name: said.get(name) or (name if name in exact else plain_ours.get(_plain(name, theirs.joint_names)))
        for name in theirs.joint_names
    }
    missing = [name for name, twin in twins.items() if twin is None]
    found = [ours.joint_names.index(twin) for twin in twins.values() if twin is not None]
    left = [name for k, name in enumerate(ours.joint_names) if k not in found]
    if missing or left or len(set(found)) < len(found):
        parts = [
            f"{hand.name} has {', '.join(names[:6])}{', ...' if len(names) > 6 else ''}"
            for hand, names in ((ours, left), (theirs, missing))
            if names
        ]
        raise InputError(
            f"joints without a twin in the other model: {'; '.join(parts) or 'two are one'}; "
            "say which are the same: --joint-map OURS=THEIRS,..., or leave them out by its asset.json (fix, root)"
        )
    return np.array(found, np.intp)


def _plain(name: str, names: Sequence[str]) -> str:
    """A name without what all of them begin with, up to the last sign that is no letter and no number."""
    alike = 0
    while len(names) > 1 and alike < len(name) and all(other[: alike + 1] == name[: alike + 1] for other in names):
        alike += 1
    return name[max((k + 1 for k in range(alike) if not name[k].isalnum()), default=0) :].lower()


def _body_of_the_same_joint(ours: HandModel, theirs: HandModel, joints: NDArray[np.intp], body: int) -> int:
    joint = ours.joint_body.tolist().index(body)
    return int(theirs.joint_body[joints.tolist().index(joint)])


def _middle(hand: HandModel, body: int) -> Floats:
    """(3,) mean of the corners of a body's pieces; of a body without any, its origin."""
    corners = [piece.vertices for piece in hand.pieces if piece.body == body]
    return np.concatenate(corners).mean(axis=0) if corners else np.zeros(3)


def _fit(where: Floats, poses: Floats, guess: Floats) -> tuple[Floats, Floats]:
    """Pose (7,) of the other base, and places (T, 3) of the fingertips in the frames of their bodies there.

    Least squares over that pose and the place of each fingertip in the frame of its body in the other model.

    Args:
        where: (N, T, 3) fingertips in our base frame.
        poses: (N, T, 7) bodies of fingertips in the other base frame.
        guess: (T, 3) where fingertips are in the frames of these bodies, roughly.
    """
    from scipy.optimize import least_squares  # slow to load

    start = _placed(apply(poses, guess), where)

    def pose_of(x: Floats) -> Floats:
        angle = float(np.linalg.norm(x[3:6]))
        axis = x[3:6] / angle if angle > 0 else np.array([1.0, 0, 0])
        turn = np.concatenate([np.zeros(3), quat_from_axis_angle(axis, np.asarray(angle))])
        return compose(np.concatenate([start[:3] + x[:3], start[3:]]), turn)

    def gap(x: Floats) -> Floats:
        return apply(pose_of(x), apply(poses, x[6:].reshape(-1, 3))) - where

    def residual(x: Floats) -> Floats:
        return np.concatenate([gap(x).ravel(), _PRIOR * (x[6:] - guess.ravel())])

    found = least_squares(
        residual, np.concatenate([np.zeros(6), guess.ravel()]), xtol=1e-12, ftol=1e-12, gtol=1e-15, max_nfev=_LOOKS
    )
    return pose_of(found.x), found.x[6:].reshape(-1, 3)


def _placed(points: Floats, where: Floats) -> Floats:
    """The pose that brings points (..., 3) nearest to others (Kabsch)."""
    a, b = points.reshape(-1, 3), where.reshape(-1, 3)
    left, _, right = np.linalg.svd((a - a.mean(axis=0)).T @ (b - b.mean(axis=0)))
    sign = np.diag([1.0, 1.0, float(np.sign(np.linalg.det(right.T @ left.T)))])
    turn = right.T @ sign @ left.T
    return np.concatenate([b.mean(axis=0) - turn @ a.mean(axis=0), quat_from_matrix(turn)])

"""Comparison of two models of one hand: matching joints, relative pose of bases, fingertip agreement."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np
from numpy.typing import NDArray

from graspd.service.model import transforms
from graspd.service.model.errors import InputError
from graspd.service.model.transforms import IDENTITY_POSE, Floats, apply, compose, invert
from graspd.worker.hands.kinematics import body_poses
from graspd.worker.hands.model import HandModel

#: Number of random postures in the comparison.
POSTURES: Final = 200
#: Number of these postures for the fit of the bases.
_FITTED: Final = 40
#: Largest distance of corresponding fingertips in models of one hand [m].
TOLERANCE_M: Final = 1e-3
#: Weight of a prior on fingertip positions in the other model: fits of grippers need it; it moves tips by nanometres.
_PRIOR: Final = 1e-3
#: Largest number of evaluations of a fit: enough for models of the same hand.
_LOOKS: Final = 15


@dataclass(frozen=True)
class HandMatch:
    """Mapping of the joints and base of the model `theirs` to those of `ours`."""

    ours: HandModel
    theirs: HandModel
    joints: NDArray[np.intp]  # (J',) index of the matching joint of `ours` for each joint of `theirs`
    base: Floats  # (7,) pose of the root of `theirs` in the root frame of `ours`
    fingertips_m: float  # largest distance of corresponding fingertips over random postures [m]

    @cached_property
    def bodies(self) -> NDArray[np.intp]:
        """(L',) body of `ours` with the matching joint for each body of `theirs`; the root for the root."""
        out = np.zeros(self.theirs.bodies, np.intp)
        out[self.theirs.joint_body] = self.ours.joint_body[self.joints]
        return out

    @cached_property
    def frames(self) -> Floats:
        """(L', 7) pose of each body of `theirs` in the frame of the matching body of `ours`."""
        q = np.clip(0.0, self.ours.lower, self.ours.upper)
        mine = self.ours.expand(q)
        a = body_poses(self.ours, IDENTITY_POSE, mine)[0]
        b = body_poses(self.theirs, self.base, mine[self.joints])[0]
        return compose(invert(a[self.bodies]), b)


def match_hands(
    ours: HandModel, theirs: HandModel, joint_map: Mapping[str, str] | None = None, *, tolerance_m: float = TOLERANCE_M
) -> HandMatch:
    """Match two models of a hand: `ours`, for which grasps were planned, and `theirs`.
    Joints are matched by `joint_map` (ours to theirs) or name, ignoring case and a common prefix of all names of a hand
    (`rh_`, `robot0:`). The bases are fitted for the best agreement of fingertips over random postures. A fingertip is
    the mean of the corners of a finger's last body.
    Raises InputError: a joint has no match in the other model, or fingertips differ by more than `tolerance_m` [m]."""
    joints = _matching_bodies(ours, theirs, joint_map or {})
    tips = [body for body in ours.fingertips if body]
    mine = ours.expand(np.random.default_rng(0).uniform(ours.lower, ours.upper, (POSTURES, ours.dofs)))
    here = body_poses(ours, np.tile(IDENTITY_POSE, (POSTURES, 1)), mine)
    there = body_poses(theirs, np.tile(IDENTITY_POSE, (POSTURES, 1)), mine[:, joints])
    twins = dict(zip(ours.joint_body[joints].tolist(), theirs.joint_body.tolist(), strict=True))
    other = [twins[body] for body in tips]
    where = np.stack([apply(here[:, b], _body_centre(ours, b)) for b in tips], axis=1)
    base, places = _fit_base_pose(
        where[:_FITTED], there[:_FITTED, other], np.array([_body_centre(theirs, b) for b in other])
    )
    error = np.linalg.norm(apply(base, apply(there[:, other], places)) - where, axis=-1)
    if error.max() > tolerance_m:
        worst = tips[int(error.max(axis=0).argmax())]
        raise InputError(
            f"{theirs.name} is no model of {ours.name}: fingertip {ours.body_names[worst]!r} is up to "
            f"{1e3 * error.max():.2f} mm from where {ours.name} has it, but {1e3 * tolerance_m:g} mm are allowed; "
            "compare axes and zeros of the joints, or name the pairs: --joint-map OURS=THEIRS"
        )
    return HandMatch(ours, theirs, joints, base, float(error.max()))


def _matching_bodies(ours: HandModel, theirs: HandModel, joint_map: Mapping[str, str]) -> NDArray[np.intp]:
    for here, there in joint_map.items():
        for name, hand in ((here, ours), (there, theirs)):
            if name not in hand.joint_names:
                raise InputError(f"--joint-map names the joint {name!r}, which {hand.name} does not have")
    said = {there: here for here, there in joint_map.items()}
    plain_ours = {_strip_prefix(name, ours.joint_names): name for name in ours.joint_names if name not in joint_map}
    exact = set(plain_ours.values())
    twins = {
        name: said.get(name) or (name if name in exact else plain_ours.get(_strip_prefix(name, theirs.joint_names)))
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
            f"joints without a counterpart in the other model: {'; '.join(parts) or 'two have the same one'}; "
            "name the pairs: --joint-map OURS=THEIRS,..., or leave joints out by the model's asset.json (fix, root)"
        )
    return np.array(found, np.intp)


def _strip_prefix(name: str, names: Sequence[str]) -> str:
    """Strip the names' common prefix up to its last non-alphanumeric character; return lower case."""
    alike = 0
    while len(names) > 1 and alike < len(name) and all(other[: alike + 1] == name[: alike + 1] for other in names):
        alike += 1
    return name[max((k + 1 for k in range(alike) if not name[k].isalnum()), default=0) :].lower()


def _body_centre(hand: HandModel, body: int) -> Floats:
    corners = [piece.vertices for piece in hand.pieces if piece.body == body]
    return np.concatenate(corners).mean(axis=0) if corners else np.zeros(3)


def _fit_base_pose(where: Floats, poses: Floats, guess: Floats) -> tuple[Floats, Floats]:
    """Fit the other model's base pose (7,), and its fingertip positions (T, 3) in its body frames.
    `where` are fingertips (N, T, 3) in the base frame of `ours`. `poses` (N, T, 7) are bodies in the base frame of
    `theirs`. `guess` (T, 3) are approximate positions in these bodies."""
    from scipy.optimize import least_squares  # slow to load

    start = _align_points(apply(poses, guess), where)

    def pose_of(x: Floats) -> Floats:
        angle = float(np.linalg.norm(x[3:6]))
        axis = x[3:6] / angle if angle > 0 else np.array([1.0, 0, 0])
        turn = np.concatenate([np.zeros(3), transforms.quat_from_axis_angle(axis, np.asarray(angle))])
        return compose(np.concatenate([start[:3] + x[:3], start[3:]]), turn)

    def gap(x: Floats) -> Floats:
        return apply(pose_of(x), apply(poses, x[6:].reshape(-1, 3))) - where

    def residual(x: Floats) -> Floats:
        return np.concatenate([gap(x).ravel(), _PRIOR * (x[6:] - guess.ravel())])

    first = np.concatenate([np.zeros(6), guess.ravel()])
    found = least_squares(residual, first, xtol=1e-12, ftol=1e-12, gtol=1e-15, max_nfev=_LOOKS)
    return pose_of(found.x), found.x[6:].reshape(-1, 3)


def _align_points(points: Floats, where: Floats) -> Floats:
    """Return the pose that best aligns `points` (..., 3) with the points `where` (Kabsch)."""
    a, b = points.reshape(-1, 3), where.reshape(-1, 3)
    left, _, right = np.linalg.svd((a - a.mean(axis=0)).T @ (b - b.mean(axis=0)))
    sign = np.diag([1.0, 1.0, float(np.sign(np.linalg.det(right.T @ left.T)))])
    turn = right.T @ sign @ left.T
    return np.concatenate([b.mean(axis=0) - turn @ a.mean(axis=0), transforms.quat_from_matrix(turn)])

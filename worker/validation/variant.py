"""Variants of the validator's model: other plausible shapes, drives, tendons, masses and poses.

A `Variant` describes a model's departure from the nominal one; `draw` draws one, `varied.Models` validates in it.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import asdict, dataclass, replace
from typing import Any, Final, Literal

import numpy as np

from graspd.service.model.metrics import Axis
from graspd.service.model.transforms import Floats
from graspd.worker.hands.model import HandModel
from graspd.worker.validation.refit import Fit, fits_of

Vector = tuple[float, float, float]

#: Range of each axis. Shapes grow or shrink by this [m].
GROWTH_M: Final = 1e-3
#: Factors of drives and of the mass.
FACTOR: Final = 2.0
#: Armature [kg m^2] and dry friction [N m] of DexGraspBench's Shadow, which the protocol otherwise omits.
ARMATURE: Final = 2e-4
DRY_FRICTION: Final = 0.01
#: Sliding friction over the nominal 0.6; the torsional coefficient scales with it.
FRICTIONS: Final = (0.4 / 0.6, 0.8 / 0.6)
CENTRE_M: Final = 5e-3
SHIFT_M: Final = 2e-3
TURN: Final = float(np.radians(2.0))
#: Latest start of a finger after the first, as a share of the time of closing (0.8 s).
LATEST: Final = 0.25

Coupling = Literal["own", "compliant", "separate", "ratio"]


@dataclass(frozen=True)
class Variant:
    """A model near the nominal one; by default the nominal one. Lengths [m]; factors of the model's own values."""

    fit: Fit = "own"
    """Replacement of the hand's collision shapes, see `refit`."""
    grown_m: float = 0.0
    armature: float | None = None
    """Armature of every joint [kg m^2 or kg]; None: the model's own."""
    dry_friction: float | None = None
    """Dry friction of every joint [N m or N]; None: the model's own."""
    damping: float = 1.0
    gain: float = 1.0
    """Position gain over the model's own; torque limits stay."""
    coupling: Coupling = "own"
    """compliant: couplings yield under load; separate, ratio: other readings of tendons, see `recoupled`."""
    friction: float = 1.0
    mass: float = 1.0
    """Mass of the object over the model's own; pushes equal its weight and grow with it."""
    centre_m: Vector = (0.0, 0.0, 0.0)
    object_shift_m: Vector = (0.0, 0.0, 0.0)
    """Shift of the object, in its frame [m]."""
    object_turn: Vector = (0.0, 0.0, 0.0)
    """Rotation vector of the object about its centre of mass [rad]."""
    hand_shift_m: Vector = (0.0, 0.0, 0.0)
    """Constant offset of the hand's root, in its own frame [m]."""
    lags: tuple[float, ...] = ()
    """Per fingertip, delay of its finger after the first, as a share of the time of closing."""


NOMINAL: Final = Variant()


def axes_of(hand: HandModel) -> tuple[Axis, ...]:
    """Return the axes along which models of this hand can differ; couplings only where joints are coupled."""
    missing = set() if couplings_of(hand) else {Axis.COUPLINGS}
    missing |= {Axis.ORDER} if len(hand.fingertips) < 2 else set()
    return tuple(axis for axis in Axis if axis is not Axis.NONE and axis not in missing)


def couplings_of(hand: HandModel) -> tuple[Coupling, ...]:
    """Return other readings of a hand's couplings: dofs that drive several joints, and tendons."""
    rigid: tuple[Coupling, ...] = ("compliant",) if len(hand.joint_body) > hand.dofs else ()
    return (*rigid, "separate", "ratio") if hand.tendons else rigid


def dealt(hand: HandModel, models: int, seed: tuple[int, ...]) -> list[Axis]:
    """Return the axes of a grasp's first models: all of the hand's in random order, then again."""
    axes = axes_of(hand)
    rounds = range(-(-models // len(axes)))
    return [axes[i] for k in rounds for i in np.random.default_rng((*seed, k)).permutation(len(axes))][:models]


def draw(axis: Axis, hand: HandModel, rng: np.random.Generator) -> Variant:
    """Draw a variant of a hand along one axis.

    Directions are uniform on the sphere, sizes uniform in their range, factors log-uniform.

    Raises:
        ValueError: the axis is none, or the hand has no couplings.
    """
    match axis:
        case Axis.SHAPES:
            fit, grown = SHAPES[int(rng.choice(_shapes(hand)))]
            return Variant(fit=fit, grown_m=grown)
        case Axis.JOINTS:
            armature, dry = (float(rng.random() < 0.5) * _factor(rng) for _ in range(2))
            return Variant(
                armature=ARMATURE * armature, dry_friction=DRY_FRICTION * dry, damping=_factor(rng), gain=_factor(rng)
            )
        case Axis.COUPLINGS:
            found = couplings_of(hand)
            return Variant(coupling=found[int(rng.integers(len(found)))])
        case Axis.FRICTION:
            return Variant(friction=float(rng.uniform(*FRICTIONS)))
        case Axis.MASS:
            return Variant(mass=_factor(rng))
        case Axis.CENTRE:
            return Variant(centre_m=_vector(rng, CENTRE_M))
        case Axis.POSE:
            return Variant(object_shift_m=_vector(rng, SHIFT_M), object_turn=_vector(rng, TURN))
        case Axis.CALIBRATION:
            return Variant(hand_shift_m=_vector(rng, SHIFT_M))
        case Axis.ORDER:
            fingers = len(hand.fingertips)
            return Variant(lags=tuple((LATEST * rng.permutation(fingers) / (fingers - 1)).tolist()))
        case _:
            raise ValueError("nothing varies along no axis")


def together(variants: Iterable[Variant]) -> Variant:
    """Combine variants along several axes; where two change the same value, the later one counts."""
    own, changed = asdict(NOMINAL), dict[str, Any]()
    for one in variants:
        changed |= {name: value for name, value in asdict(one).items() if value != own[name]}
    return replace(NOMINAL, **changed)


#: Variants of collision shapes.
SHAPES: Final[tuple[tuple[Fit, float], ...]] = (
    ("hull", 0.0),
    ("primitive", 0.0),
    ("capsule", 0.0),
    ("own", GROWTH_M),
    ("own", -GROWTH_M),
)


def _shapes(hand: HandModel) -> list[int]:
    """Return the rows of `SHAPES` that change something in this hand."""
    fits = fits_of(hand)
    return [i for i, (fit, _) in enumerate(SHAPES) if fit == "own" or fit in fits]


def _factor(rng: np.random.Generator) -> float:
    return float(FACTOR ** rng.uniform(-1.0, 1.0))


def _vector(rng: np.random.Generator, most: float) -> Vector:
    direction = rng.normal(size=3)
    x, y, z = (most * rng.random() * direction / np.linalg.norm(direction)).tolist()
    return x, y, z


def recoupled(hand: HandModel, coupling: Coupling) -> HandModel:
    """Return the hand with its tendons read otherwise; itself without tendons, or for other readings.
    separate: each joint of a tendon gets the drive it would have without the tendon. ratio: joints of a tendon turn as
    one, by equal angles with their coefficients' signs, with the sum of their drives' gains and limits."""
    if not hand.tendons or coupling not in ("separate", "ratio"):
        return hand
    if coupling == "separate":
        return replace(hand, tendons=())
    leader = np.arange(hand.dofs)
    sign = np.ones(hand.dofs)
    for tendon in hand.tendons:
        leader[list(tendon.dofs)] = tendon.dofs[0]
        sign[list(tendon.dofs)] = np.sign(tendon.coefficients) * np.sign(tendon.coefficients[0])
    kept = np.unique(leader)
    drives = np.zeros((len(kept), hand.dofs))
    drives[np.searchsorted(kept, leader), np.arange(hand.dofs)] = sign
    ends = np.sort(np.stack([hand.lower, hand.upper]) * sign, axis=0)
    lower, upper = ends[0][kept].copy(), ends[1][kept].copy()
    for d, place in enumerate(np.searchsorted(kept, leader)):
        lower[place], upper[place] = max(lower[place], ends[0][d]), min(upper[place], ends[1][d])
    moved = hand.dof >= 0
    dof, rate = hand.dof.copy(), hand.multiplier.copy()
    dof[moved] = np.searchsorted(kept, leader[hand.dof[moved]])
    rate[moved] = hand.multiplier[moved] * sign[hand.dof[moved]]
    pulls = np.abs(drives)
    return replace(
        hand,
        tendons=(),
        dof=dof,
        multiplier=rate,
        dof_names=tuple(hand.dof_names[d] for d in kept),
        lower=lower,
        upper=upper,
        effort=pulls @ hand.effort,
        stiffness=pulls @ hand.stiffness,
        preshape=hand.preshape[kept],
        closing=hand.closing[kept],
        velocity=hand.velocity[kept] if len(hand.velocity) else hand.velocity,
    )


def nearest(hand: HandModel, joints: Floats) -> Floats:
    """Return the joint positions (N, J) nearest to the given ones that a hand of fewer dofs can take."""
    dof, rate = hand.dof[hand.joint_body], hand.multiplier[hand.joint_body]
    drive = np.zeros((len(dof), hand.dofs))
    drive[np.arange(len(dof)), dof] = rate
    return hand.expand((joints - hand.offset[hand.joint_body]) @ np.linalg.pinv(drive).T)

"""Variants of the validator's model: other plausible shapes, drives, tendons, masses and poses.

`draw_variant` draws a `Variant`, and `Models` validates in it: new shapes are recompiled, other numbers changed in a
copy."""

import copy
import threading
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Final, Literal

import mujoco
import numpy as np
from numpy.typing import NDArray

from graspd.service.model.metrics import PerturbedParameter
from graspd.service.model.transforms import Floats, compose, invert, quat_from_axis_angle
from graspd.worker.grasps import GraspSet, Posture
from graspd.worker.hands.model import HandModel
from graspd.worker.objects.model import ObjectModel
from graspd.worker.simulation.environment import Neighbour, Obstacle, PlacedGrasps
from graspd.worker.validation.decomposition import ConvexPieces
from graspd.worker.validation.lift import Lift, LiftResult
from graspd.worker.validation.model import MujocoOptions, Scene, build_scene, interpolate_postures, scene_of
from graspd.worker.validation.protocol import STAGES, Rollout, Test
from graspd.worker.validation.refit import Fit, applicable_fits, refit_hand

Vector = tuple[float, float, float]

GROWTH_M: Final = 1e-3  # growth or shrinkage of collision shapes [m]
#: Largest factor on damping, gains, `ARMATURE`, `DRY_FRICTION` and the object's mass; the least is its inverse.
FACTOR: Final = 2.0
#: Armature [kg m^2] and dry friction [N m] of DexGraspBench's Shadow hand, which the protocol omits for other hands.
ARMATURE: Final = 2e-4
DRY_FRICTION: Final = 0.01
#: Range of the factor on sliding and torsional friction: sliding friction 0.4 to 0.8 instead of the nominal 0.6.
FRICTIONS: Final = (0.4 / 0.6, 0.8 / 0.6)
CENTRE_M: Final = 5e-3
SHIFT_M: Final = 2e-3
TURN: Final = float(np.radians(2.0))
LATEST: Final = 0.25  # latest start of a finger after the first one, as a share of the closing time (0.8 s)

Coupling = Literal["own", "compliant", "separate", "ratio"]


@dataclass(frozen=True)
class Variant:
    """A model near the nominal one (the default). Lengths in m; factors apply to the model's own values."""

    fit: Fit = "own"  # replacement of the hand's collision shapes, see `refit`
    grown_m: float = 0.0
    armature: float | None = None  # armature of every joint [kg m^2 or kg]; None for the model's own
    dry_friction: float | None = None  # dry friction of every joint [N m or N]; None for the model's own
    damping: float = 1.0
    gain: float = 1.0  # factor on the position gain; torque limits are unchanged
    coupling: Coupling = "own"  # compliant: couplings yield under load; separate, ratio: see `replace_coupling`
    friction: float = 1.0
    mass: float = 1.0  # factor on the object's mass; pushes equal its weight and grow with it
    centre_m: Vector = (0.0, 0.0, 0.0)
    object_shift_m: Vector = (0.0, 0.0, 0.0)  # shift of the object, in its frame [m]
    object_turn: Vector = (0.0, 0.0, 0.0)  # rotation vector of the object about its centre of mass [rad]
    hand_shift_m: Vector = (0.0, 0.0, 0.0)  # constant offset of the hand's root, in its own frame [m]
    lags: tuple[float, ...] = ()  # delay of each fingertip's finger after the first one, as a share of the closing time


def axes_of(hand: HandModel) -> tuple[PerturbedParameter, ...]:
    """Return the axes along which models of this hand can differ; couplings only where joints are coupled."""
    missing = set() if couplings_of(hand) else {PerturbedParameter.COUPLINGS}
    missing |= {PerturbedParameter.ORDER} if len(hand.fingertips) < 2 else set()
    return tuple(axis for axis in PerturbedParameter if axis is not PerturbedParameter.NONE and axis not in missing)


def couplings_of(hand: HandModel) -> tuple[Coupling, ...]:
    """Return other interpretations of a hand's couplings: dofs that drive several joints, and tendons."""
    rigid: tuple[Coupling, ...] = ("compliant",) if len(hand.joint_body) > hand.dofs else ()
    return (*rigid, "separate", "ratio") if hand.tendons else rigid


def first_axes(hand: HandModel, models: int, seed: tuple[int, ...]) -> list[PerturbedParameter]:
    """Return the axes of a grasp's first models: all axes in random order, then all in another order."""
    axes = axes_of(hand)
    rounds = range(-(-models // len(axes)))
    return [axes[i] for k in rounds for i in np.random.default_rng((*seed, k)).permutation(len(axes))][:models]


def draw_variant(axis: PerturbedParameter, hand: HandModel, rng: np.random.Generator) -> Variant:
    """Draw a variant of a hand along one axis. Raises ValueError: no axis, or the hand has no couplings.
    Directions are uniform on the sphere, sizes uniform in their range, factors log-uniform."""
    match axis:
        case PerturbedParameter.SHAPES:
            fits = {"own", *applicable_fits(hand)}
            fit, grown = SHAPES[int(rng.choice([i for i, (fit, _) in enumerate(SHAPES) if fit in fits]))]
            return Variant(fit=fit, grown_m=grown)
        case PerturbedParameter.JOINTS:
            armature, dry = (float(rng.random() < 0.5) * _draw_factor(rng) for _ in range(2))
            return Variant(
                armature=ARMATURE * armature,
                dry_friction=DRY_FRICTION * dry,
                damping=_draw_factor(rng),
                gain=_draw_factor(rng),
            )
        case PerturbedParameter.COUPLINGS:
            found = couplings_of(hand)
            return Variant(coupling=found[int(rng.integers(len(found)))])
        case PerturbedParameter.FRICTION:
            return Variant(friction=float(rng.uniform(*FRICTIONS)))
        case PerturbedParameter.MASS:
            return Variant(mass=_draw_factor(rng))
        case PerturbedParameter.CENTRE:
            return Variant(centre_m=_draw_vector(rng, CENTRE_M))
        case PerturbedParameter.POSE:
            return Variant(object_shift_m=_draw_vector(rng, SHIFT_M), object_turn=_draw_vector(rng, TURN))
        case PerturbedParameter.CALIBRATION:
            return Variant(hand_shift_m=_draw_vector(rng, SHIFT_M))
        case PerturbedParameter.ORDER:
            fingers = len(hand.fingertips)
            return Variant(lags=tuple((LATEST * rng.permutation(fingers) / (fingers - 1)).tolist()))
        case _:
            raise ValueError("a variant needs an axis other than NONE")


#: Variants of collision shapes.
SHAPES: Final[tuple[tuple[Fit, float], ...]] = (
    ("hull", 0.0),
    ("primitive", 0.0),
    ("capsule", 0.0),
    ("own", GROWTH_M),
    ("own", -GROWTH_M),
)


def _draw_factor(rng: np.random.Generator) -> float:
    return float(FACTOR ** rng.uniform(-1.0, 1.0))


def _draw_vector(rng: np.random.Generator, most: float) -> Vector:
    direction = rng.normal(size=3)
    x, y, z = (most * rng.random() * direction / np.linalg.norm(direction)).tolist()
    return x, y, z


def replace_coupling(hand: HandModel, coupling: Coupling) -> HandModel:
    """Return the hand with its tendons reinterpreted; unchanged without tendons, or for other couplings.
    separate: each joint of a tendon gets the drive it would have without the tendon. ratio: joints of a tendon turn
    together, by equal angles with their coefficients' signs. Gain and limit are then the sums over their drives."""
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


def nearest_feasible_joints(hand: HandModel, joints: Floats) -> Floats:
    """Return the nearest joint positions (N, J) that are feasible for a hand with fewer dofs."""
    dof, rate = hand.dof[hand.joint_body], hand.multiplier[hand.joint_body]
    drive = np.zeros((len(dof), hand.dofs))
    drive[np.arange(len(dof)), dof] = rate
    return hand.expand((joints - hand.offset[hand.joint_body]) @ np.linalg.pinv(drive).T)


#: Solver parameters of compliant couplings: MuJoCo's default, 2.5 times as slow as the protocol's, and softer.
COMPLIANT_SOLREF: Final = (0.02, 1.0)
COMPLIANT_SOLIMP: Final = (0.9, 0.95, 1e-3, 0.5, 2.0)
#: Parts of a variant that need their own compiled model: shapes, their growth, couplings.
_Build = tuple[Fit, float, Coupling]


class Models:
    """Models around the nominal one, for a hand, an object and its environment. Thread-safe."""

    def __init__(
        self,
        hand: HandModel,
        obj: ObjectModel,
        pieces: ConvexPieces,
        physics: MujocoOptions,
        supports: Sequence[Obstacle] = (),
        neighbours: Sequence[Neighbour] = (),
    ) -> None:
        self.hand, self.obj = hand, obj
        self._pieces, self._physics, self._around = pieces, physics, (supports, neighbours)
        self._scenes: dict[_Build, Scene] = {("own", 0.0, "own"): scene_of(hand, obj, pieces, physics, *self._around)}
        self._hands: dict[_Build, HandModel] = {("own", 0.0, "own"): hand}
        self._lock = threading.Lock()
        self._fingers = _finger_of_joint(hand)

    def standard(self, grasps: GraspSet, row: int, variant: Variant) -> Rollout:
        """Validate one grasp in a variant at level standard, for the nominal one bit for bit as `validate`."""
        test = VariantTest(self.scene(variant), variant, self._lags(variant))
        return test.standard(self._project_joints(test.scene, displace_grasp(self.obj, grasps, row, variant)), 0)

    def lift(
        self, grasps: GraspSet, row: int, placed: PlacedGrasps, variant: Variant, *, dexgraspbench: bool = False
    ) -> LiftResult:
        """Lift a grasp in a variant; for the nominal variant the result equals `validate_lifts` bit for bit.
        `placed` has the scenes of all grasps. `dexgraspbench`: run the published test, which needs no approach."""
        number = int(placed.index[row])
        variant = restrict_to_support(variant, placed.scenes[number].up)
        one, where = displace_grasp(self.obj, grasps, row, variant), placed.take(slice(row, row + 1))
        if moves_object(variant):
            pose = compose(placed.object_pose[number], object_motion(self.obj, variant))
            beside = placed.neighbour_pose[number : number + 1]
            where = replace(placed, object_pose=pose[None], index=np.zeros(1, np.intp), neighbour_pose=beside)
        test = VariantLift(self.scene(variant), where, variant, self._lags(variant))
        one = self._project_joints(test.scene, one)
        return test.dexgraspbench(one, 0) if dexgraspbench else test.lift(one, 0)

    def _project_joints(self, scene: Scene, one: GraspSet) -> GraspSet:
        """Project the grasp onto the postures of a hand with fewer dofs."""
        if scene.hand.dofs < self.hand.dofs:
            for part in (one.grasp, one.pregrasp, one.squeeze):
                part.joint_positions = nearest_feasible_joints(scene.hand, part.joint_positions)
            if one.coming is not None:
                one.coming = nearest_feasible_joints(scene.hand, one.coming)
        return one

    def scene(self, variant: Variant) -> Scene:
        """Return the compiled model of a variant, with the addresses for `place` and `command`."""
        built: _Build = (variant.fit, variant.grown_m, "own" if variant.coupling == "compliant" else variant.coupling)
        with self._lock:
            if built not in self._scenes:
                self._hands[built] = replace_coupling(refit_hand(self.hand, *built[:2]), built[2])
                self._scenes[built] = build_scene(
                    self._hands[built], self.obj, self._pieces, self._physics, *self._around
                )
            scene = self._scenes[built]
        if any(variant.centre_m):
            # The body's frame is at the centre of mass.
            obj = replace(self.obj, centre_of_mass=self.obj.centre_of_mass + variant.centre_m)
            scene = build_scene(self._hands[built], obj, self._pieces, self._physics, *self._around)
        return _perturbed_scene(scene, variant)

    def _lags(self, variant: Variant) -> Floats | None:
        """Return delays (J,) of joints, as shares of the closing time; None if all start at once."""
        if not any(variant.lags):
            return None
        lags = np.array([0.0, *variant.lags])
        return np.asarray(lags[self._fingers + 1])


class _DelayedFingersTest(Test):
    """A test in which fingers may start to close one after another."""

    __test__ = False
    _lags: Floats | None = None

    def _way(self, grasps: GraspSet, row: int, stages: int = STAGES) -> Iterator[tuple[Floats, Floats]]:
        if self._lags is None:
            yield from super()._way(grasps, row, stages)
            return
        parts = (grasps.pregrasp, grasps.grasp, grasps.squeeze)
        for stage in range(1, 2 * stages + 1):
            even = stage / stages
            part = int(even >= 1)
            pose, _ = interpolate_postures(parts[part], parts[part + 1], row, even - part)
            # Delayed joints move faster, so that all arrive at the same time.
            late = np.clip((even / 2 - self._lags) / (1 - self._lags.max()), 0, 1) * 2
            joints = [part.joint_positions[row] for part in parts]
            first, second = np.minimum(late, 1), np.maximum(late - 1, 0)
            closing = (1 - first) * joints[0] + first * joints[1]
            yield pose, np.where(late <= 1, closing, (1 - second) * joints[1] + second * joints[2])


class VariantTest(_DelayedFingersTest):
    __test__ = False

    def __init__(self, scene: Scene, variant: Variant, lags: Floats | None) -> None:
        super().__init__(scene)
        self._weight, self._lags = variant.mass, lags

    def _push(self, direction: int) -> None:
        super()._push(direction)
        self.data.xfrc_applied[self.scene.object_body, :3] *= self._weight


class VariantLift(_DelayedFingersTest, Lift):
    __test__ = False

    def __init__(self, scene: Scene, placed: PlacedGrasps, variant: Variant, lags: Floats | None) -> None:
        super().__init__(scene, placed)
        self._weight, self._lags = variant.mass, lags

    def _set_posture(self, hand_pose: Floats, joints: Floats) -> None:
        super()._set_posture(hand_pose, joints)
        self.data.xfrc_applied[self.scene.object_body, :3] *= self._weight


def _perturbed_scene(scene: Scene, variant: Variant) -> Scene:
    """Return the scene with a variant's numbers in a copy of its model; the same scene if nothing changes."""
    compiled = "own" if variant.coupling == "compliant" else variant.coupling
    plain = replace(
        variant, armature=None, dry_friction=None, damping=1.0, gain=1.0, friction=1.0, mass=1.0, coupling=compiled
    )
    if variant == plain:
        return scene
    model = copy.copy(scene.model)
    dofs = model.jnt_dofadr[np.searchsorted(model.jnt_qposadr, scene.joint_qpos)]
    if variant.armature is not None:
        model.dof_armature[dofs] = variant.armature
    if variant.dry_friction is not None:
        model.dof_frictionloss[dofs] = variant.dry_friction
    model.dof_damping[dofs] *= variant.damping
    model.actuator_gainprm[:, 0] *= variant.gain
    model.actuator_biasprm[:, 1] *= variant.gain
    model.geom_friction[:, :2] *= variant.friction
    model.body_mass[scene.object_body] *= variant.mass
    model.body_inertia[scene.object_body] *= variant.mass
    if variant.coupling == "compliant":
        of_joints = model.eq_type == int(mujoco.mjtEq.mjEQ_JOINT)
        model.eq_solref[of_joints], model.eq_solimp[of_joints] = COMPLIANT_SOLREF, COMPLIANT_SOLIMP
    # Contact stiffness depends on inverse inertias, which follow from masses and armature.
    mujoco.mj_setConst(model, mujoco.MjData(model))
    return replace(scene, model=model)


def displace_grasp(obj: ObjectModel, grasps: GraspSet, row: int, variant: Variant) -> GraspSet:
    """Return one grasp relative to the object, for a variant that displaces object or hand."""
    one = grasps.take(np.array([row]))
    if not (moves_object(variant) or any(variant.hand_shift_m)):
        return one
    back, off = invert(object_motion(obj, variant)), np.array([*variant.hand_shift_m, 1.0, 0, 0, 0])

    def displace(part: Posture) -> Posture:
        return Posture(compose(compose(back, part.hand_pose), off), part.joint_positions)

    way = None if one.approach is None else compose(compose(back, one.approach), off)
    return replace(
        one,
        grasp=displace(one.grasp),
        pregrasp=displace(one.pregrasp),
        squeeze=displace(one.squeeze),
        approach=way,
        lift=None,
    )


def moves_object(variant: Variant) -> bool:
    return any((*variant.object_shift_m, *variant.object_turn))


def object_motion(obj: ObjectModel, variant: Variant) -> Floats:
    """Return the motion (7,) from the nominal to the displaced object, in the object's frame."""
    turn = np.array(variant.object_turn)
    angle = float(np.linalg.norm(turn))
    turned = quat_from_axis_angle(turn / angle if angle else np.array([1.0, 0, 0]), np.array(angle))
    about = np.concatenate([obj.centre_of_mass + np.array(variant.object_shift_m), turned])
    return compose(about, np.concatenate([-obj.centre_of_mass, [1.0, 0, 0, 0]]))


def restrict_to_support(variant: Variant, up: Floats) -> Variant:
    """Keep shifts along a support and turns about the vertical `up` (3,), object frame, of a variant."""
    if not moves_object(variant):
        return variant
    shift, turn = np.array(variant.object_shift_m), np.array(variant.object_turn)
    level, about = shift - (shift @ up) * up, (turn @ up) * up
    return replace(variant, object_shift_m=tuple(level.tolist()), object_turn=tuple(about.tolist()))


def _finger_of_joint(hand: HandModel) -> NDArray[np.intp]:
    """Return the index (J,) in `hand.fingertips` of the one tip that a joint moves; -1 if several or none."""
    moved: list[set[int]] = [set() for _ in range(hand.bodies)]
    for place, tip in enumerate(hand.fingertips):
        body = tip
        while body >= 0:
            moved[body].add(place)
            body = int(hand.parent[body])
    # Joints of one dof move together, and so do the fingertips that any of them moves.
    of_dof: dict[int, set[int]] = {}
    for body in hand.joint_body.tolist():
        of_dof.setdefault(int(hand.dof[body]), set()).update(moved[body])
    found = [of_dof[int(hand.dof[body])] for body in hand.joint_body.tolist()]
    return np.array([next(iter(one)) if len(one) == 1 else -1 for one in found], np.intp)

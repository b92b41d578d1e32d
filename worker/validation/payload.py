"""Payload of grasps: heaviest mass that each lifts or holds; shake test; limit and load capacity.

Payload: the hand closes once around the object at its own mass. Then the object hangs, or is pushed, at other masses.
The search begins near the mass that the contact forces of the closed hand bear. A hanging test starts from the final
state of the heaviest mass that passed, a push from the closed hand.

Shake: a lifted object is moved to and fro, first along x of the scene, then along y. In the simulation the hand is at
rest and the inertial force acts on the object. Accelerations begin at zero; the constant velocity that this adds has no
effect (Galilean invariance).

Load capacity: the heaviest object that contact forces could bear within actuator limits and friction, by one linear
program per direction of the weight. Forces inside friction pyramids balance the weight and all torques about the centre
of mass, and no drive exceeds its effort. The result is an upper bound: maybe no controller can exert the forces, and
pyramids enclose the cones. Forces on the palm, along joint axes, or towards a joint's stop cost no effort."""

import copy
import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Final

import mujoco
import numpy as np
from numpy.typing import NDArray

from graspd.service.model.matter import ACCELERATION, MASS_KG, MOST_KG
from graspd.service.model.planning import payload_limit_text
from graspd.service.model.transforms import Floats, cross, quat_rotate
from graspd.worker.engines.mujoco_warnings import is_invalid
from graspd.worker.execution_context import DEFAULT_CONTEXT, ExecutionContext, measure_rows
from graspd.worker.grasps import GraspSet, Posture
from graspd.worker.hands.kinematics import generalized_forces
from graspd.worker.hands.model import HandModel
from graspd.worker.objects.model import ObjectModel
from graspd.worker.quality.contact import spread_contacts
from graspd.worker.quality.posed import posture_data_of
from graspd.worker.quality.wrench_space import EDGES, cone_edges
from graspd.worker.simulation.environment import PlacedGrasps
from graspd.worker.validation.decomposition import ConvexPieces
from graspd.worker.validation.model import Scene, scene_of
from graspd.worker.validation.prescreening import HANGING_CLOSING, LIFTING, FixedRootTest
from graspd.worker.validation.protocol import DIRECTIONS, LOST, Outcome, Test

TOLD: Final = 1.03  # ratio of upper to lower bound at which the search ends; the payload is the lower bound
#: First mass as a share of `_bearable_mass` (median in `benchmarks.payload`), and first ratio of masses.
FIRST: Final = 0.75
STEP: Final = math.sqrt(2)
WATCHED: Final = 10  # largest number of stages of simulation per load


class _WeightTest(Test):
    """A test with a variable mass of the object. Not thread-safe: it owns its model."""

    def __init__(self, scene: Scene, *rest: Any) -> None:
        super().__init__(replace(scene, model=copy.copy(scene.model)), *rest)
        self._own = scene.mass
        self._inertia = np.array(scene.model.body_inertia[scene.object_body])

    def _set_mass(self, mass: float) -> None:
        model, body = self.scene.model, self.scene.object_body
        self.scene = replace(self.scene, mass=mass)
        model.body_mass[body] = mass
        model.body_inertia[body] = self._inertia * (mass / self._own)
        # Contact stiffness depends on inverse inertias, which follow from the mass. The change also overwrites state in
        # `data`; the next restored state or the start of a grasp resets this state.
        mujoco.mj_setConst(model, self.data)

    def _bearable_mass(self, against: Floats) -> float:
        """Return the mass [kg] whose weight along -`against` (3,) the contacts of the closed hand bear.
        The estimate uses present normal forces and friction, which a load changes."""
        contact, model = self.data.contact, self.scene.model
        at_object = model.geom_bodyid[contact.geom] == self.scene.object_body
        rows = np.flatnonzero(
            self.scene.hand_geoms[contact.geom].any(axis=1) & at_object.any(axis=1) & (contact.efc_address >= 0)
        )
        # The contact normal points from the first geom to the second.
        along = contact.frame[rows, :3] @ against * np.where(at_object[rows, 1], 1, -1)
        slide = contact.friction[rows, 0] * np.sqrt(np.maximum(0.0, 1 - along**2))
        return float(self.data.efc_force[contact.efc_address[rows]] @ (along + slide)) / ACCELERATION

    def _heaviest(self, bears: Callable[[float], bool], first: float) -> float:
        """Return the heaviest mass [kg] for which `bears` is true; the search begins at `first`.
        It is at least the object's mass; nan if `bears` is false even for the object's own mass."""
        low, high, step, borne = self._own, math.inf, STEP, False
        mass = min(max(first, low), MOST_KG)
        while True:
            if bears(mass):
                low, borne = mass, True
            elif mass <= self._own:
                return math.nan
            else:
                high = mass
            if borne and (low >= MOST_KG or high <= TOLD * low):
                return low
            if borne and high < math.inf:
                mass = math.sqrt(low * high)
            else:
                mass = min(low * step, MOST_KG) if borne else max(high / step, low)
                step **= 2


class LiftPayload(_WeightTest, FixedRootTest):
    """Payloads of grasps in one scene."""

    def payload(self, grasps: GraspSet, row: int) -> float:
        """Return the payload [kg]; nan if the grasp does not lift the object."""
        self._set_mass(self._own)
        if not self._closed(grasps, row):
            return math.nan
        self._save()
        borne = 0.0

        def bears(mass: float) -> bool:
            nonlocal borne
            self._set_mass(mass)
            self._restore()
            self._hang(borne, mass)
            if self._extrapolate(WATCHED) >= 1.0:
                return False
            self._save()
            borne = mass
            return True

        return self._heaviest(bears, FIRST * self._bearable_mass(self._up))


class PushPayload(_WeightTest):
    """Payloads of grasps of a free object."""

    __test__ = False

    def payload(self, grasps: GraspSet, row: int) -> float:
        """Return the payload [kg]; nan if the grasp does not hold the object under the pushes."""
        self._set_mass(self._own)
        if self.set_up(grasps, row).outcomes[0] is Outcome.PENETRATION:
            return math.nan
        if not self._close(grasps, row, give_up=True, stages=HANGING_CLOSING) or is_invalid(self.data):
            return math.nan
        self._save()
        bounds = [self._bearable_mass(-np.array(direction, float)) for direction in DIRECTIONS]
        weakest_first = np.argsort(bounds).tolist()

        def bears(mass: float) -> bool:
            self._set_mass(mass)
            for direction in weakest_first:
                self._restore()
                self._push(direction)
                if self._extrapolate(WATCHED) >= 1.0:
                    # The next masses start with this direction.
                    weakest_first.remove(direction)
                    weakest_first.insert(0, direction)
                    return False
            return True

        return self._heaviest(bears, FIRST * min(bounds))


def payloads(
    hand: HandModel,
    obj: ObjectModel,
    grasps: GraspSet,
    *,
    pieces: ConvexPieces,
    placed: PlacedGrasps | None = None,
    held: NDArray[np.bool_] | None = None,
    run: ExecutionContext = DEFAULT_CONTEXT,
) -> Floats:
    """Compute payloads (N,) [kg], at least the object's mass; nan if not `held` (N,), or not lifted.
    Grasps lift in the scenes `placed`; if None, a free object is pushed in six directions."""

    def make() -> LiftPayload | PushPayload:
        around = (placed.supports, placed.neighbours) if placed is not None else ()
        scene = scene_of(hand, obj, pieces, LIFTING, *around)
        return PushPayload(scene) if placed is None else LiftPayload(scene, placed)

    return measure_rows(len(grasps), held, make, lambda test, row: test.payload(grasps, row), run=run, name="payload")


#: Fewest grasps that must lift a light object before their payload counts as the hand's limit; with fewer, the shape of
#: the grasps may be the cause. The light object has the default mass, at most the share `LIGHT` of the wanted mass.
LEAST: Final = 2
LIGHT: Final = 1 / 8
ENOUGH: Final = 8  # fewest tested grasps before a job gives up because the wanted mass is out of reach
HOPELESS: Final = 2.0  # ratio of wanted mass to best payload above which the wanted mass is out of reach


@dataclass(frozen=True)
class PayloadLimit:
    """Payload limit of some grasps of a hand."""

    hand: str
    friction: float
    grasps: int
    lifts_kg: float  # largest payload of the grasps, from simulated lifts
    bound_kg: float  # largest load capacity of the grasps, at least `lifts_kg`
    wanted_kg: float | None = None

    @property
    def is_far_exceeded(self) -> bool:
        """Whether the wanted payload is so far above the limit that no more grasps are tested."""
        return self.grasps >= ENOUGH and self.wanted_kg is not None and self.wanted_kg > HOPELESS * self.lifts_kg

    @property
    def line(self) -> str:
        return payload_limit_text(self.hand, self.friction, self.grasps, self.lifts_kg, self.bound_kg, self.wanted_kg)

    def facts(self) -> dict[str, Any]:
        """Return the values for JSON; an infinite bound becomes None."""
        bound = round(self.bound_kg, 3) if math.isfinite(self.bound_kg) else None
        return {"lifts_kg": round(self.lifts_kg, 3), "bound_kg": bound, "grasps": self.grasps, "says": self.line}


def payload_limit(
    hand: HandModel,
    obj: ObjectModel,
    grasps: GraspSet,
    *,
    pieces: ConvexPieces,
    placed: PlacedGrasps | None = None,
    wanted: float | None = None,
    least: int = LEAST,
    run: ExecutionContext = DEFAULT_CONTEXT,
) -> PayloadLimit | None:
    """Return the payload limit of N grasps.
    None if a grasp lifts the `wanted` mass [kg], or if fewer than `least` grasps lift a light object."""
    if len(grasps) < least:
        return None
    light = obj.with_mass(mass=MASS_KG if wanted is None else min(MASS_KG, LIGHT * wanted))
    found = payloads(hand, light, grasps, pieces=pieces, placed=placed, run=run)
    if np.isfinite(found).sum() < least:
        return None
    lifts = float(np.nanmax(found))
    if wanted is not None and lifts >= wanted:
        return None
    against = np.broadcast_to(-np.array(DIRECTIONS, float), (len(grasps), len(DIRECTIONS), 3))
    if placed is not None:
        against = np.array([[placed.scenes[number].up] for number in placed.index])
    bound = float(load_capacities(hand, obj, grasps.grasp, against).max())
    return PayloadLimit(hand.name, obj.friction, len(grasps), lifts, max(bound, lifts), wanted)


#: Amplitude [m], frequency [Hz] and number of periods along each axis; the acceleration is at most 7.1 m/s2.
AMPLITUDE_M: Final = 0.02
FREQUENCY_HZ: Final = 3.0
PERIODS: Final = 3
STEP_S: Final = 0.008  # the force changes in steps of this length [s]


class Shake(FixedRootTest):
    """Shake tests of grasps in one scene. Not thread-safe."""

    def margin(self, grasps: GraspSet, row: int) -> float:
        """Return the largest ratio of motion in the hand to its limit; from 1 on the object is lost."""
        if not self._closed(grasps, row):
            return LOST
        self._hang(0.0, self.scene.mass)
        turn = 2 * math.pi * FREQUENCY_HZ
        worst = 0.0
        for axis in np.eye(3)[:2]:
            along = quat_rotate(self._scene_pose[3:], axis)
            for step in range(round(PERIODS / FREQUENCY_HZ / STEP_S)):
                jerked = AMPLITUDE_M * turn**2 * math.sin(turn * step * STEP_S) * along
                force = -self.scene.mass * (ACCELERATION * self._up + jerked)
                self.data.xfrc_applied[self.scene.object_body, :3] = force
                self._run(STEP_S)
                worst = max(worst, LOST if is_invalid(self.data) else self._motion_excess())
                if worst >= 1.0:
                    return worst
        return worst


def shake_margins(
    hand: HandModel,
    obj: ObjectModel,
    grasps: GraspSet,
    placed: PlacedGrasps,
    *,
    pieces: ConvexPieces,
    held: NDArray[np.bool_] | None = None,
    run: ExecutionContext = DEFAULT_CONTEXT,
) -> Floats:
    """Return shake margins (N,): largest ratio of displacement or rotation to its limit.
    Below 1 the grasp holds; nan for grasps that are not `held` (N,)."""

    def make() -> Shake:
        return Shake(scene_of(hand, obj, pieces, LIFTING, placed.supports, placed.neighbours), placed)

    return measure_rows(len(grasps), held, make, lambda test, row: test.margin(grasps, row), run=run, name="shake")


_POINTS: Final = 600
#: Hand points within this distance of the object count as contacts [m]; at most `MOST` are used, widely spread.
WITHIN_M: Final = 0.01
MOST: Final = 32
AT_STOP: Final = 0.02  # a joint closer to its limit than this share of its range rests on its stop
_UNBOUNDED: Final = 3  # status of `linprog` for an unbounded problem


def load_capacities(hand: HandModel, obj: ObjectModel, grasp: Posture, against: Floats) -> Floats:
    """Compute load capacities (N,) [kg]; 0 without contact, inf if neither drives nor friction limit it.
    `against` (N, K, 3) are unit vectors against the weight; the least of the K capacities is returned."""
    probe = posture_data_of(hand, obj, points=_POINTS, device="cpu").probe
    found = probe.nearest_points(grasp)
    facing = (found.distance < WITHIN_M) & probe.facing_mask(found)
    spread, count = spread_contacts(facing[:, None], found.closest, found.normal, scale=obj.radius, limit=MOST)
    q = hand.reduce(grasp.joint_positions)
    out = np.zeros(len(grasp))
    for row in range(len(grasp)):
        chosen = spread[row, 0, : count[row, 0]]
        if not len(chosen):
            continue
        points = found.closest[row, chosen]
        forces = cone_edges(-found.normal[row, chosen], obj.friction / math.cos(math.pi / EDGES))
        torques = generalized_forces(hand, found.bodies[row], probe.points.body[chosen], points, -forces)
        moments = cross((points - obj.centre_of_mass)[:, None] / obj.radius, forces)
        # Torque limits of each dof, for its positive and then its negative direction; unlimited at a stop.
        near, rest = AT_STOP * hand.span, q[row]
        stops = (rest > hand.upper - near, rest < hand.lower + near)
        efforts = np.concatenate([np.where(stop, np.inf, hand.effort) for stop in stops])
        loads = [
            _largest_load(forces.reshape(-1, 3), moments.reshape(-1, 3), torques.reshape(-1, hand.dofs), efforts, along)
            for along in against[row]
        ]
        out[row] = min(loads) / ACCELERATION
    return out


def _largest_load(forces: Floats, moments: Floats, torques: Floats, efforts: Floats, along: Floats) -> float:
    """Return the largest weight [N] that edges with forces and moments (E, 3) and torques (E, D) balance."""
    from scipy.optimize import linprog

    count = len(forces)
    balance = np.column_stack([np.hstack([forces, moments]).T, -np.concatenate([along, np.zeros(3)])])
    exerted = np.column_stack([np.vstack([torques.T, -torques.T]), np.zeros(len(efforts))])
    limited = np.isfinite(efforts)
    goal, still = np.append(np.zeros(count), -1.0), np.zeros(6)
    solved = linprog(goal, exerted[limited], efforts[limited], A_eq=balance, b_eq=still, bounds=(0, None))
    if solved.status == _UNBOUNDED:
        return math.inf
    return -float(solved.fun) if solved.fun is not None else 0.0

"""GraspIt!'s annealing: one chain per grasp over eigengrasps, then autograsp from its best state.

Virtual contacts are a few points of a hand: two on each link's inner side, and some on the palm. GraspIt! reads them
from files for its own hands; here they are computed for any hand.

GraspIt! has two eigengrasps for the Barrett hand: spread, and closing of all fingers. Hands with one closing dof per
finger use these. All other hands use the two of GraspIt!'s human hand: flexion, mainly of the knuckles, and knuckles
against distal joints. The position of a joint along its finger selects its weight."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import warp as wp
from numpy.typing import NDArray
from pydantic import Field

from graspd.baselines.autograsp import kernels as closing_kernels
from graspd.baselines.autograsp.method import HandCloser
from graspd.baselines.common import cached_search, create_grasp_set, frame_along, inner_side_points, load_pair
from graspd.baselines.graspit import kernels
from graspd.baselines.graspit.kernels import FIRST_STEP
from graspd.service.model.errors import InputError
from graspd.service.model.transforms import Floats, quat_from_matrix
from graspd.worker.execution_context import ExecutionContext
from graspd.worker.grasps import GraspSet
from graspd.worker.hands.model import HandModel
from graspd.worker.objects.model import ObjectModel
from graspd.worker.planners.fast_graspd.pairs import Pair
from graspd.worker.planners.port import Method, Options, PlanRequest
from graspd.worker.planners.threads import StepCounter, run_parts, split_batch
from graspd.worker.simulation.data import Data, HandState
from graspd.worker.simulation.device import to_wxyz, to_xyzw
from graspd.worker.simulation.model import body_points
from graspd.worker.simulation.record import record_placement


class Search:
    """Simulated annealing of one hand on one object."""

    def __init__(self, pair: Pair) -> None:
        self.pair, self.hand = pair, pair.hand.model
        self.device = pair.hand.device
        self.eigen = eigengrasps(self.hand)
        with wp.ScopedDevice(self.device):
            self.problem = self._problem()

    def _problem(self) -> Any:
        hand, obj, contacts = self.hand, self.pair.fine.obj, inner_side_points(self.hand, each=EACH, on_palm=ON_PALM)
        out = kernels.Problem()
        out.tree, out.surface, out.pieces = self.pair.hand.tree, obj.surface, self.pair.hand.pieces
        out.points = body_points(self.pair.fine.points, hand.bodies)
        out.samples, out.bvh = obj.samples, obj.bvh.id
        out.contact_body = wp.array(contacts.body, dtype=wp.int32)
        out.contact_position = wp.array(contacts.position, dtype=wp.vec3)
        out.contact_normal = wp.array(contacts.normal, dtype=wp.vec3)
        bounds = np.array([*PLACE, *ANGLES, *self.eigen.limits])
        jumps = [PLACE_JUMP] * 3 + list(ANGLE_JUMPS) + list(np.ptp(self.eigen.limits, axis=1) / 4)
        out.low, out.high = kernels.vec8(*bounds[:, 0]), kernels.vec8(*bounds[:, 1])
        out.jump, out.circular = kernels.vec8(*jumps), PHI
        out.palm = wp.quat(*to_xyzw(quat_from_matrix(frame_along(hand.palm.approach))))
        out.origin = wp.array(self.eigen.origin, dtype=wp.float32)
        out.eigen = wp.array(self.eigen.directions, dtype=wp.float32)
        out.lower, out.upper = self.pair.hand.lower, self.pair.hand.upper
        out.clash = wp.array(self_collision_grid(self.pair, self.eigen), dtype=wp.int32)
        return out

    def run(self, seeds: list[list[int]], *, steps: int, keep: int, tell: StepCounter) -> HandState:
        """Return the `keep` best states of each chain, best first, grouped by chain.
        A chain has the seeds of a row of `seeds` and ends when its counter reaches `steps`. `tell` counts moves.
        Raises InputError: a chain finds no collision-free start. TaskCancelled: through `tell`."""
        chains = len(seeds)
        random = np.array([np.random.SeedSequence(seed).generate_state(1)[0] for seed in seeds], np.uint32)
        with wp.ScopedDevice(self.device):
            rng = wp.array(random, dtype=wp.uint32)
            state, energy = wp.zeros(chains, dtype=kernels.vec8), wp.zeros(chains, dtype=wp.float32)
            counter = wp.full(chains, FIRST_STEP, dtype=wp.int32)
            best = wp.zeros((chains, keep), dtype=kernels.vec8)
            best_energy = wp.full((chains, keep), NOT_YET, dtype=wp.float32)
            scratch = [wp.zeros((chains, self.hand.bodies), dtype=kind) for kind in (wp.vec3, wp.quat)]
            wp.launch(
                kernels.draw_start, chains, inputs=[self.problem, START_TRIES], outputs=[rng, state, energy, *scratch]
            )
            if (energy.numpy() < 0).any():
                obj = self.pair.fine.obj.model
                raise InputError(f"{self.hand.name} has no collision-free start around {obj.name}")
            tell(0, "starts")
            begun, done = state.numpy(), 0
            given = [self.problem, ROUNDS, steps, ALIKE]
            found = [counter, rng, state, energy, best, best_energy, *scratch]
            for _ in range(0, max(0, PATIENCE * (steps - FIRST_STEP)), ROUNDS):
                wp.launch(kernels.anneal, chains, inputs=given, outputs=found)
                now = int((counter.numpy() - FIRST_STEP).sum())
                tell(now - done, "annealing")
                done = now
                if now >= chains * (steps - FIRST_STEP):
                    break
            return self._hands(_sort_by_energy(best.numpy(), best_energy.numpy(), begun))

    def _hands(self, states: Floats) -> HandState:
        n = len(states)
        pivot, rotation = wp.zeros(n, dtype=wp.vec3), wp.zeros(n, dtype=wp.quat)
        q = wp.zeros((n, self.hand.dofs), dtype=wp.float32)
        given = wp.array(states, dtype=kernels.vec8)
        wp.launch(kernels.unpack, n, inputs=[self.problem, given], outputs=[pivot, rotation, q])
        return HandState(pivot.numpy().astype(float), to_wxyz(rotation.numpy().astype(float)), q.numpy().astype(float))


class GraspitOptions(Options):
    steps: int = Field(
        70_000, gt=FIRST_STEP, le=1_000_000, description=f"step at which annealing ends; it counts from {FIRST_STEP}"
    )
    keep: int = Field(1, ge=1, le=20, description="number of best states taken from each annealing run")


@dataclass(frozen=True)
class Graspit:
    options: GraspitOptions

    def __call__(self, hand: HandModel, obj: ObjectModel, wanted: PlanRequest, run: ExecutionContext) -> GraspSet:
        began = time.perf_counter()
        pair = load_pair(hand, obj, run.device, kernels, closing_kernels)
        search = cached_search(Search, pair)
        keep, moves = self.options.keep, self.options.steps - FIRST_STEP
        chains = -(-wanted.count // keep)
        steps = StepCounter(chains * moves, run)

        def work(indices: range) -> HandState:
            seeds = [[wanted.seed, wanted.batch, chain] for chain in indices]
            state = search.run(seeds, steps=self.options.steps, keep=keep, tell=steps)
            return HandCloser(pair, len(state.pivot)).close(state)

        states = HandState.concatenate(run_parts(split_batch(chains, run), work))
        return create_grasp_set(pair, states[: wanted.count], began, {"chains": chains, "moves": moves})


METHOD: Final = Method(
    summary="simulated annealing over eigengrasps with contact energy, then autograsp",
    source="M. T. Ciocarlie and P. K. Allen, Hand posture subspaces for dexterous robotic grasping, IJRR 2009",
    planner=Graspit,
    options=GraspitOptions,
    uses=("face_error_m",),
    quick={"steps": FIRST_STEP + 400},
)
#: Bounds of the palm's position about the centre of mass [m], and its largest jump; GraspIt! has these values in mm.
PLACE: Final = ((-0.25, 0.25), (-0.25, 0.25), (-0.25, 0.35))
PLACE_JUMP: Final = 0.15
#: Bounds of theta and phi (axis) and alpha (angle) of the rotation; phi is periodic.
ANGLES: Final = ((0.0, np.pi), (-np.pi, np.pi), (0.0, np.pi))
ANGLE_JUMPS: Final = (np.pi / 5, np.pi / 2, np.pi / 2)
PHI: Final = 4
#: Grid points per amplitude in the self-collision test, and tolerated overlap [m], since hand models overlap at rest.
CLASH_GRID: Final = 49
CLASH_M: Final = 2e-3
#: Number of uniform draws for a legal start, and of rounds between two checks for cancellation.
START_TRIES: Final = 5000
ROUNDS: Final = 500
PATIENCE: Final = 3  # limit on rounds, as a multiple of the moves; rounds without a free neighbour count
#: Difference below which two states are near-duplicates, as in GraspIt!.
ALIKE: Final = 0.2
NOT_YET: Final = 1e9
#: Number of virtual contacts on each closing link, and on the palm.
EACH: Final = 2
ON_PALM: Final = 3


def self_collision_grid(pair: Pair, eigen: Eigengrasps) -> NDArray[np.int32]:
    """Return (CLASH_GRID, CLASH_GRID): 1 for a posture whose self-overlap exceeds `CLASH_M`."""
    axes = [np.linspace(low, high, CLASH_GRID) for low, high in eigen.limits]
    amplitudes = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)
    q = eigen.posture(amplitudes, pair.hand.model)
    n = len(q)
    model = pair.model(pair.coarse)
    data = Data(model, n)
    # Far from the object only self-collisions occur.
    data.set_state(HandState(np.tile([9.0, 0, 0], (n, 1)), np.tile([1.0, 0, 0, 0], (n, 1)), q))
    record_placement(model, data).run()
    depth = data.depths.links.numpy()[:n]
    return (depth > CLASH_M).astype(np.int32).reshape(CLASH_GRID, CLASH_GRID)


def _sort_by_energy(best: Floats, energy: Floats, begun: Floats) -> Floats:
    """Return states (chains * keep, 8), best first; missing ones repeat the chain's last one or its start."""
    out = np.empty_like(best)
    for c, (states, energies) in enumerate(zip(best, energy, strict=True)):
        found = [k for k in np.argsort(energies, kind="stable") if energies[k] < NOT_YET / 2]
        rows = [states[k] for k in found] or [begun[c]]
        out[c] = [rows[min(k, len(rows) - 1)] for k in range(len(states))]
    return out.reshape(-1, best.shape[-1])


#: Weights of a finger's first, second and later closing joints in the human hand's eigengrasps.
FLEXION: Final = (1.0, 0.3, 0.15)
SECOND: Final = (-1.0, 1.0, 0.3)
#: Position of closing joints in the mean posture, as a share of their range (Barrett's origin: 0.79 of 2.44 rad).
ORIGIN: Final = 0.33
AMPLITUDE: Final = 4.0  # largest amplitude


@dataclass(frozen=True)
class Eigengrasps:
    """Postures q = origin + amplitudes @ directions, inside the joint limits."""

    origin: Floats  # (D,)
    directions: Floats  # (2, D)
    limits: Floats  # (2, 2) least and largest amplitude of each direction, beyond which no joint moves

    def posture(self, amplitudes: Floats, hand: HandModel) -> Floats:
        return np.clip(self.origin + np.asarray(amplitudes) @ self.directions, hand.lower, hand.upper)


def dof_ranks(hand: HandModel) -> NDArray[np.int32]:
    """Return (D,) numbers of closing dofs between each closing dof and the palm; -1 for other dofs."""
    first = [int(np.flatnonzero(hand.dof == d)[0]) for d in range(hand.dofs)]
    out = np.full(hand.dofs, -1, np.int32)
    for d, body in enumerate(first):
        if hand.closing[d]:
            before = {int(hand.dof[k]) for k in hand.chain(body)} - {d}
            out[d] = sum(hand.closing[e] != 0 for e in before)
    return out


def eigengrasps(hand: HandModel) -> Eigengrasps:
    """Return the two eigengrasps that the module's docstring selects for a hand."""
    place, closing = dof_ranks(hand), np.asarray(hand.closing, float)
    closes = closing != 0
    if place.max() <= 0:
        directions = np.array([(~closes).astype(float), closing])
        if not directions[0].any():  # without a spread dof, use alternating closing instead
            directions[0] = closing * np.where(np.arange(hand.dofs) % 2, -1.0, 1.0)
    else:
        row = np.clip(place, 0, 2)
        directions = np.array([closing * np.array(weights)[row] * closes for weights in (FLEXION, SECOND)])
    opened, span = np.where(closing >= 0, hand.lower, hand.upper), hand.span
    origin = np.where(closes, opened + ORIGIN * span * np.where(closing >= 0, 1, -1), (hand.lower + hand.upper) / 2)
    limits = np.zeros((2, 2))
    for i, direction in enumerate(directions):
        moving = direction != 0
        ends = np.stack([hand.lower - origin, hand.upper - origin])[:, moving] / direction[moving]
        limits[i] = np.clip([ends.min(), ends.max()], -AMPLITUDE, AMPLITUDE)
    return Eigengrasps(origin, directions, limits)

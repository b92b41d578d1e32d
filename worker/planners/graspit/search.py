"""The annealing of a batch of chains on a device, and the contacts that it wants on the object.

Virtual contacts are few places of a hand: two on each link's inside, and on the palm. GraspIt! ships them as files for
its own hands; here they are found for any hand.
"""

from __future__ import annotations

from typing import Any, Final

import numpy as np
import warp as wp
from numpy.typing import NDArray

from service.model.errors import InputError
from service.model.transforms import Floats, quat_from_matrix
from worker.hands.model import HandModel, SurfacePoints
from worker.planners.fast_graspd.pairs import Pair
from worker.planners.graspit import kernels
from worker.planners.graspit.eigengrasps import Eigengrasps, eigengrasps
from worker.planners.graspit.schedule import FIRST_STEP
from worker.planners.inner_surface import inside_points
from worker.planners.threads import Steps
from worker.simulation.data import Data, HandState
from worker.simulation.device import to_wxyz, to_xyzw
from worker.simulation.model import body_points
from worker.simulation.record import record_placement

#: Bounds of the palm's place about the object's centre of mass [m] and its largest jump (GraspIt!'s, in mm there).
PLACE: Final = ((-0.25, 0.25), (-0.25, 0.25), (-0.25, 0.35))
PLACE_JUMP: Final = 0.15
#: theta, phi, alpha: axis and angle of the rotation; phi wraps around.
ANGLES: Final = ((0.0, np.pi), (-np.pi, np.pi), (0.0, np.pi))
ANGLE_JUMPS: Final = (np.pi / 5, np.pi / 2, np.pi / 2)
PHI: Final = 4
#: Postures a side at which the hand is tested against itself, and the overlap real hand models have at rest [m].
CLASH_GRID: Final = 49
CLASH_M: Final = 2e-3
#: Uniform draws for a legal start, and rounds between two looks at cancellation.
START_TRIES: Final = 5000
ROUNDS: Final = 500
#: Rounds without a free neighbour count too, up to so many times the moves.
PATIENCE: Final = 3
#: Two states of the list are alike below this (GraspIt!).
ALIKE: Final = 0.2
NOT_YET: Final = 1e9
#: Contacts on each link that closes, and on the palm.
EACH: Final = 2
ON_PALM: Final = 3


def clash_grid(pair: Pair, eigen: Eigengrasps) -> NDArray[np.int32]:
    """(CLASH_GRID, CLASH_GRID): 1 where the posture of these amplitudes overlaps itself by more than `CLASH_M`."""
    axes = [np.linspace(low, high, CLASH_GRID) for low, high in eigen.limits]
    amplitudes = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)
    q = eigen.posture(amplitudes, pair.hand.model)
    n = len(q)
    model = pair.model(pair.coarse)
    data = Data(model, n)
    # Far from the object only the hand itself can be hit.
    data.set_state(HandState(np.tile([9.0, 0, 0], (n, 1)), np.tile([1.0, 0, 0, 0], (n, 1)), q))
    record_placement(model, data).run()
    depth = data.depths.links.numpy()[:n]
    return (depth > CLASH_M).astype(np.int32).reshape(CLASH_GRID, CLASH_GRID)


def _approach_frame(hand: HandModel) -> Floats:
    """Quaternion w x y z from the frame with z along the approach to the root frame."""
    z = hand.palm.approach
    x = np.cross(np.eye(3)[int(np.argmin(np.abs(z)))], z)
    x /= np.linalg.norm(x)
    return quat_from_matrix(np.column_stack([x, np.cross(z, x), z]))


class Search:
    """Simulated annealing of one hand on one object; chains share all but their states."""

    def __init__(self, pair: Pair) -> None:
        self.pair, self.hand = pair, pair.hand.model
        self.device = pair.hand.device
        self.eigen = eigengrasps(self.hand)
        with wp.ScopedDevice(self.device):
            self.problem = self._problem()

    def _problem(self) -> Any:
        hand, obj, contacts = self.hand, self.pair.fine.obj, virtual_contacts(self.hand)
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
        out.palm = wp.quat(*to_xyzw(_approach_frame(hand)))
        out.origin = wp.array(self.eigen.origin, dtype=wp.float32)
        out.eigen = wp.array(self.eigen.directions, dtype=wp.float32)
        out.lower, out.upper = self.pair.hand.lower, self.pair.hand.upper
        out.clash = wp.array(clash_grid(self.pair, self.eigen), dtype=wp.int32)
        return out

    def run(self, seeds: list[list[int]], *, steps: int, keep: int, tell: Steps) -> HandState:
        """The `keep` best states of each chain, best first, those of a chain side by side.

        Args:
            seeds: of the chains' random numbers.
            steps: counter of the schedule at which a chain ends.
            keep: length of the list of best states.
            tell: told one unit of work per move.

        Raises:
            InputError: no place for the hand around the object.
            TaskCancelled: through `tell`.
        """
        chains = len(seeds)
        random = np.array([np.random.SeedSequence(seed).generate_state(1)[0] for seed in seeds], np.uint32)
        with wp.ScopedDevice(self.device):
            rng = wp.array(random, dtype=wp.uint32)
            state, energy = wp.zeros(chains, dtype=kernels.vec8), wp.zeros(chains, dtype=wp.float32)
            counter = wp.full(chains, FIRST_STEP, dtype=wp.int32)
            best = wp.zeros((chains, keep), dtype=kernels.vec8)
            best_energy = wp.full((chains, keep), NOT_YET, dtype=wp.float32)
            scratch = [wp.zeros((chains, self.hand.bodies), dtype=kind) for kind in (wp.vec3, wp.quat)]
            wp.launch(kernels.begin, chains, inputs=[self.problem, START_TRIES], outputs=[rng, state, energy, *scratch])
            if (energy.numpy() < 0).any():
                raise InputError(f"{self.hand.name} finds no free place around {self.pair.fine.obj.model.name}")
            tell(0, "starts")
            begun, done = state.numpy(), 0
            for _ in range(0, max(0, PATIENCE * (steps - FIRST_STEP)), ROUNDS):
                wp.launch(
                    kernels.anneal,
                    chains,
                    inputs=[self.problem, ROUNDS, steps, ALIKE],
                    outputs=[counter, rng, state, energy, best, best_energy, *scratch],
                )
                now = int((counter.numpy() - FIRST_STEP).sum())
                tell(now - done, "annealing")
                done = now
                if now >= chains * (steps - FIRST_STEP):
                    break
            return self._hands(_sorted(best.numpy(), best_energy.numpy(), begun))

    def _hands(self, states: Floats) -> HandState:
        n = len(states)
        pivot, rotation = wp.zeros(n, dtype=wp.vec3), wp.zeros(n, dtype=wp.quat)
        q = wp.zeros((n, self.hand.dofs), dtype=wp.float32)
        given = wp.array(states, dtype=kernels.vec8)
        wp.launch(kernels.unpack, n, inputs=[self.problem, given], outputs=[pivot, rotation, q])
        return HandState(pivot.numpy().astype(float), to_wxyz(rotation.numpy().astype(float)), q.numpy().astype(float))


def _sorted(best: Floats, energy: Floats, begun: Floats) -> Floats:
    """(chains * keep, 8) best states first; what a chain did not find is its best again, or where it began."""
    out = np.empty_like(best)
    for c, (states, energies) in enumerate(zip(best, energy, strict=True)):
        found = [k for k in np.argsort(energies, kind="stable") if energies[k] < NOT_YET / 2]
        rows = [states[k] for k in found] or [begun[c]]
        out[c] = [rows[min(k, len(rows) - 1)] for k in range(len(states))]
    return out.reshape(-1, best.shape[-1])


def virtual_contacts(hand: HandModel) -> SurfacePoints:
    """Points with normals; none on links that neither close nor carry the palm."""
    return inside_points(hand, each=EACH, on_palm=ON_PALM)

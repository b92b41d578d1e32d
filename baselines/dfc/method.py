"""Differentiable force closure: DexGraspNet's starts around the convex hull, then annealed descent.

The planner returns all hands; `info["passed"]` marks those that the published code would accept."""

import time
from dataclasses import dataclass
from itertools import combinations
from typing import Any, Final

import numpy as np
import warp as wp
from numpy.typing import NDArray
from pydantic import Field

from graspd.baselines.common import create_grasp_set, frame_along, inner_side_points, load_pair
from graspd.baselines.dfc import kernels
from graspd.service.model import transforms
from graspd.worker.execution_context import ExecutionContext
from graspd.worker.grasps import GraspSet
from graspd.worker.hands.kinematics import body_poses
from graspd.worker.hands.model import HandModel
from graspd.worker.objects.distance import sample_faces
from graspd.worker.objects.model import ObjectModel
from graspd.worker.planners.fast_graspd.pairs import Pair
from graspd.worker.planners.port import Method, Options, PlanRequest
from graspd.worker.planners.threads import StepCounter, run_parts, split_batch
from graspd.worker.simulation.data import Data, HandState
from graspd.worker.simulation.kernels import optimizers
from graspd.worker.simulation.launches import Launches
from graspd.worker.simulation.model import Model
from graspd.worker.simulation.record import add_poses, add_root_gradient

PASSES: Final = (0.3, 0.005, 0.001)  # bounds of the published code on force closure, distance and penetration
#: Distance of the palm from the hull [m]. In the published code the root, one palm length behind, is at 0.2 to 0.3 m.
DISTANCE: Final = (0.1, 0.2)
TILT: Final = np.pi / 6  # largest tilt of the approach from the hull's normal [rad]
POSTURE: Final = 0.1  # standard deviation of joints about the pre-shape, as a share of their range


class DfcOptions(Options):
    steps: int = Field(6000, ge=1, le=100_000, description="annealing steps per hand")


@dataclass(frozen=True)
class Dfc:
    options: DfcOptions

    def __call__(self, hand: HandModel, obj: ObjectModel, wanted: PlanRequest, run: ExecutionContext) -> GraspSet:
        began = time.perf_counter()
        pair = load_pair(hand, obj, run.device, kernels)
        steps = StepCounter(wanted.count * (self.options.steps + 1), run)

        def work(indices: range) -> tuple[HandState, transforms.Floats]:
            starts = sample_starts(hand, obj, seed=wanted.seed, batch=wanted.batch, indices=indices)
            steps(len(indices), "starts")
            descent = Descent(pair, starts, [[wanted.seed, wanted.batch, index] for index in indices])
            descent.run(self.options.steps, steps)
            return descent.hands(), descent.energies()

        states, energies = zip(*run_parts(split_batch(wanted.count, run), work), strict=True)
        passed = (np.concatenate(energies)[:, :3] < np.array(PASSES)).all(axis=1)
        return create_grasp_set(pair, HandState.concatenate(states), began, {"passed": passed.tolist()})


METHOD: Final = Method(
    summary="annealed descent of force closure, distance and penetration energies of four contacts",
    source="R. Wang et al., DexGraspNet, ICRA 2023; T. Liu et al., Differentiable force closure, RA-L 2021",
    planner=Dfc,
    options=DfcOptions,
    uses=("face_error_m",),
    quick={"steps": 60},
)


def sample_starts(hand: HandModel, obj: ObjectModel, *, seed: int, batch: int, indices: range) -> HandState:
    """Sample a start per index; it depends only on seed, batch and its index."""
    rows = [_start(hand, obj, np.random.default_rng([seed, batch, index])) for index in indices]
    return HandState(*(np.stack([row[k] for row in rows]) for k in range(3)))


def _start(hand: HandModel, obj: ObjectModel, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    points, faces = sample_faces(obj.hull_vertices, obj.hull_faces.astype(np.int64), 1, seed=int(rng.integers(2**31)))
    a, b, c = obj.hull_vertices[obj.hull_faces[faces[0]]]
    normal = np.cross(b - a, c - a)
    normal /= np.linalg.norm(normal)
    side = np.cross(normal, rng.normal(size=3))
    axis, angle = side / np.linalg.norm(side), rng.uniform(0.0, TILT)
    normal = normal * np.cos(angle) + np.cross(axis, normal) * np.sin(angle)
    align = frame_along(-normal) @ frame_along(hand.palm.approach).T
    roll = transforms.quat_from_axis_angle(-normal, np.array(rng.uniform(0.0, 2 * np.pi)))
    q = np.clip(hand.preshape + POSTURE * hand.span * rng.normal(size=hand.dofs), hand.lower, hand.upper)
    pivot = points[0] + rng.uniform(*DISTANCE) * normal - obj.centre_of_mass
    return pivot, transforms.quat_multiply(roll, transforms.quat_from_matrix(align)), q


Ints = NDArray[np.int32]

#: Number of contact candidates on each link and on the palm.
EACH: Final = 12
ON_PALM: Final = 24
SAMPLES: Final = 2000  # number of object samples for penetration
#: Energies: force closure, distance, penetration, self-penetration, joint limits.
TERMS: Final = 5
CHUNK: Final = 50
INFINITE: Final = 1e30


def key_points(hand: HandModel) -> tuple[Ints, transforms.Floats, Ints, Ints]:
    """Return bodies (K,), centres (K, 3), and repelling pairs (two index arrays) of the hand's pieces."""
    body = np.array([piece.body for piece in hand.pieces], np.int32)
    place = np.array([piece.vertices.mean(axis=0) for piece in hand.pieces])
    rest = transforms.apply(body_poses(hand, transforms.IDENTITY_POSE, hand.expand(hand.preshape))[0][body], place)
    pairs = [
        (i, j)
        for i, j in combinations(range(len(body)), 2)
        if body[i] != body[j]
        and (min(body[i], body[j]), max(body[i], body[j])) not in hand.neighbours
        and np.linalg.norm(rest[i] - rest[j]) > kernels.GAP
    ]
    first, second = (np.array([pair[k] for pair in pairs], np.int32) for k in (0, 1))
    return body, place, first, second


class Descent:
    """Annealed descent of a batch of hands on one object."""

    def __init__(self, pair: Pair, starts: HandState, seeds: list[list[int]]) -> None:
        self.pair, self.n = pair, len(starts.pivot)
        self.obj = pair.fine.obj.with_fewer_samples(SAMPLES)
        self.candidates = inner_side_points(pair.hand.model, each=EACH, on_palm=ON_PALM)
        # Model of the proposals; only its kinematics is computed.
        self.model = Model.create(pair.hand, self.obj, pair.coarse.points, pair.coarse.own, pair.options)
        self.proposal = Data(self.model, self.n)
        self.device = self.model.device
        generators = [np.random.default_rng([*seed, 1]) for seed in seeds]
        random = np.array([g.integers(2**32, dtype=np.uint32) for g in generators], np.uint32)
        contacts = np.array([g.integers(len(self.candidates), size=kernels.N_CONTACTS) for g in generators], np.int32)
        with wp.ScopedDevice(self.device):
            self.rng = wp.array(random, dtype=wp.uint32)
            self._allocate(contacts)
        self.proposal.set_state(starts)
        self._copy_hands(self.proposed, self.present)
        self.launches = self._record()

    def _allocate(self, contacts: Ints) -> None:
        n, dofs = self.n, self.pair.hand.model.dofs
        self.present, self.proposed = kernels.Chains(), kernels.Chains()
        self.present.pivot, self.present.rotation = wp.zeros(n, dtype=wp.vec3), wp.zeros(n, dtype=wp.quat)
        self.present.q = wp.zeros((n, dofs), dtype=wp.float32)
        for name in ("pivot", "rotation", "q"):
            setattr(self.proposed, name, getattr(self.proposal, name))
        self.present.contact, self.proposed.contact = (wp.array(contacts, dtype=wp.int32) for _ in range(2))
        self.terms = wp.full((n, TERMS), INFINITE, dtype=wp.float32)
        self.new_terms = wp.zeros((n, TERMS), dtype=wp.float32)
        self.gradient = wp.zeros((n, 6 + dofs), dtype=wp.float32)
        self.moment = wp.zeros((n, 3), dtype=wp.float32)
        self.taken = wp.zeros(n, dtype=wp.int32)
        self.candidate_body = wp.array(self.candidates.body, dtype=wp.int32)
        self.candidate_position = wp.array(self.candidates.position, dtype=wp.vec3)
        body, place, first, second = key_points(self.pair.hand.model)
        self.pairs = len(first)
        self.keys = [wp.array(v, dtype=wp.int32) for v in (first, second, body)] + [wp.array(place, dtype=wp.vec3)]

    @staticmethod
    def _copy_hands(source: Any, target: Any) -> None:
        for name in ("pivot", "rotation", "q"):
            wp.copy(getattr(target, name), getattr(source, name))

    def _record(self) -> Launches:
        s, m, n, out = self.proposal, self.model, self.n, Launches(self.device)
        own = [self.new_terms, s.hands]
        given = [len(self.candidates), s.iteration, self.gradient, self.present]
        out.add(kernels.propose, n, inputs=given, outputs=[self.rng, self.moment, self.proposed, self.new_terms])
        add_poses(out, m, s)
        contacts = [self.candidate_body, self.candidate_position, self.proposed.contact]
        out.add(kernels.force_closure, n, inputs=[self.obj.surface, *contacts], outputs=own)
        samples = [m.hand.pieces, self.obj.bvh.id, self.obj.samples]
        out.add(kernels.penetration, (n, m.pieces), inputs=samples, outputs=own)
        if self.pairs:
            out.add(kernels.self_penetration, (n, self.pairs), inputs=self.keys, outputs=own)
        add_root_gradient(out, m, s)
        out.add(
            kernels.limit_violation, n, inputs=[m.hand.lower, m.hand.upper, s.q], outputs=[self.new_terms, s.gradient]
        )
        kept = [self.rng, self.terms, self.gradient, self.present, self.taken]
        out.add(kernels.accept, n, inputs=[s.iteration, self.new_terms, s.gradient, self.proposed], outputs=kept)
        out.add(optimizers.advance, 1, inputs=[], outputs=[s.iteration])
        return out

    def run(self, steps: int, tell: StepCounter) -> None:
        """Make `steps` proposals. Raises TaskCancelled: through `tell`."""
        for first in range(0, steps, CHUNK):
            count = min(CHUNK, steps - first)
            self.launches.run(count)
            tell(self.n * count, "annealing")

    def hands(self) -> HandState:
        """Return the accepted hands, with joints clipped to their limits."""
        self._copy_hands(self.present, self.proposed)
        found = self.proposal.state(self.n)
        hand = self.pair.hand.model
        return HandState(found.pivot, found.rotation, np.clip(found.q, hand.lower, hand.upper))

    def energies(self) -> transforms.Floats:
        """Return (n, 5) E_fc, E_dis, E_pen, E_spen, E_joints, unweighted."""
        return self.terms.numpy().astype(float)

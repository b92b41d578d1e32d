"""The planner: DexGraspNet's starts around the convex hull (the palm looks at it from some way off, joints near the
pre-shape), then annealed descent. All hands are given; info tells which would pass."""

from __future__ import annotations

import time
from typing import Final

import numpy as np
from pydantic import Field

from service.model.transforms import Floats, quat_from_axis_angle, quat_from_matrix, quat_multiply
from worker.grasps import GraspSet
from worker.hands.model import HandModel
from worker.objects.distance import sample_faces
from worker.objects.model import ObjectModel
from worker.planners.dfc import kernels
from worker.planners.dfc.schedule import STEPS
from worker.planners.dfc.search import Descent
from worker.planners.peers import grasp_set, ground_of, joined
from worker.planners.port import Method, Options, Planner, Wanted
from worker.planners.threads import Steps, cut, run_parts
from worker.run import Run
from worker.simulation.data import HandState

#: Force closure, distance and penetration that the source lets pass.
PASSES: Final = (0.3, 0.005, 0.001)
#: Distance of the palm from the hull [m]: the source puts the root, which is a palm's length behind, at 0.2 to 0.3.
DISTANCE: Final = (0.1, 0.2)
#: Tilt of the approach away from the hull's normal [rad], at most.
TILT: Final = np.pi / 6
#: Standard deviation of joints about the pre-shape, as a share of their range.
POSTURE: Final = 0.1


class DfcOptions(Options):
    """Options of `dfc`."""

    steps: int = Field(STEPS, ge=1, le=100_000, description="proposals of each hand")


class Dfc:
    """See `worker.planners.Planner`."""

    def __init__(self, options: DfcOptions) -> None:
        self.options = options

    def __call__(self, hand: HandModel, obj: ObjectModel, wanted: Wanted, run: Run) -> GraspSet:
        began = time.perf_counter()
        pair = ground_of(hand, obj, run.device, kernels)
        steps = Steps(wanted.count * (self.options.steps + 1), run)

        def work(indices: range) -> tuple[HandState, Floats]:
            starts = sample_starts(hand, obj, seed=wanted.seed, batch=wanted.batch, indices=indices)
            steps(len(indices), "starts")
            descent = Descent(pair, starts, [[wanted.seed, wanted.batch, index] for index in indices])
            descent.run(self.options.steps, steps)
            return descent.hands(), descent.energies()

        found = run_parts(cut(wanted.count, run), work)
        energies = np.concatenate([part[1] for part in found])
        passed = (energies[:, :3] < np.array(PASSES)).all(axis=1)
        return grasp_set(pair, joined([part[0] for part in found]), began, {"passed": passed.tolist()})


def _planner(options: DfcOptions) -> Planner:
    return Dfc(options)


METHOD: Final = Method(
    summary="annealed descent of force closure, distance and penetration energies of four contacts",
    source="R. Wang et al., DexGraspNet, ICRA 2023; T. Liu et al., Differentiable force closure, RA-L 2021",
    planner=_planner,
    options=DfcOptions,
    uses=("face_error_m",),
    quick={"steps": 60},
)


def sample_starts(hand: HandModel, obj: ObjectModel, *, seed: int, batch: int, indices: range) -> HandState:
    """One start for each grasp; each depends on its own index only."""
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
    align = _frame(-normal) @ _frame(hand.palm.approach).T
    roll = quat_from_axis_angle(-normal, np.array(rng.uniform(0.0, 2 * np.pi)))
    span = hand.upper - hand.lower
    q = np.clip(hand.preshape + POSTURE * span * rng.normal(size=hand.dofs), hand.lower, hand.upper)
    pivot = points[0] + rng.uniform(*DISTANCE) * normal - obj.centre_of_mass
    return pivot, quat_multiply(roll, quat_from_matrix(align)), q


def _frame(z: np.ndarray) -> np.ndarray:
    x = np.cross(np.eye(3)[int(np.argmin(np.abs(z)))], z)
    x /= np.linalg.norm(x)
    return np.column_stack([x, np.cross(z, x), z])

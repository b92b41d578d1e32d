"""Grasp'D: collision-free starts, descent with relaxed forces; no selection or repair, as published.

A grid of signed distances with trilinear interpolation represents the object."""

import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any, Final

import numpy as np
import warp as wp
from numpy.typing import NDArray
from pydantic import Field

from graspd.baselines.common import cached_search, collision_free_starts, create_grasp_set, load_pair
from graspd.baselines.graspd2022 import kernels
from graspd.service.model.cores import available_cores
from graspd.service.model.transforms import Floats, quat_rotate
from graspd.worker.execution_context import ExecutionContext
from graspd.worker.grasps import GraspSet
from graspd.worker.hands.model import HandModel
from graspd.worker.hands.surface import sample_surface
from graspd.worker.objects.model import ObjectModel
from graspd.worker.planners.fast_graspd.pairs import Pair
from graspd.worker.planners.port import Method, Options, PlanRequest
from graspd.worker.planners.threads import StepCounter, run_parts, split_batch
from graspd.worker.simulation.data import Data, HandState, Schedule
from graspd.worker.simulation.device import DeviceObject
from graspd.worker.simulation.kernels import surface
from graspd.worker.simulation.launches import Launches
from graspd.worker.simulation.model import MAX_DILATION, Model
from graspd.worker.simulation.record import add_poses, add_root_gradient, add_self_penalty, add_step


class Graspd2022Options(Options):
    steps: int = Field(10_000, ge=1, le=100_000, description="iterations of descent")
    grid: int = Field(128, ge=16, le=256, description="cells of the distance grid along its longest side")


class Search:
    """Grasp'D's search for one hand and object; hands run in batches."""

    def __init__(self, pair: Pair, cells: int) -> None:
        self.pair = pair
        self.grid = distance_grid(pair.fine.obj, cells)
        self.points = sample_surface(pair.hand.model, POINTS)

    def run(self, starts: HandState, *, steps: int, tell: StepCounter) -> tuple[HandState, Floats]:
        """Return hands after `steps` iterations, and their `residual` (n,).
        Raises TaskCancelled: through `tell`."""
        n = len(starts.pivot)
        back = quat_rotate(starts.rotation, self.pair.hand.model.palm.approach)
        batch = _Batch(self, replace(starts, pivot=starts.pivot - BACKOFF_M * back), steps)
        for first in range(0, steps, CHUNK):
            count = min(CHUNK, steps - first)
            batch.launches.run(count)
            tell(n * count, "descent")
        return batch.data.state(n), batch.residual()


@dataclass(frozen=True)
class Graspd2022:
    options: Graspd2022Options

    def __call__(self, hand: HandModel, obj: ObjectModel, wanted: PlanRequest, run: ExecutionContext) -> GraspSet:
        began = time.perf_counter()
        pair = load_pair(hand, obj, run.device, kernels)
        search = cached_search(Search, pair, self.options.grid)
        steps = StepCounter(wanted.count * (self.options.steps + 1), run)

        def work(indices: range) -> tuple[HandState, Floats]:
            starts = collision_free_starts(pair, seed=wanted.seed, batch=wanted.batch, indices=indices)
            steps(len(indices), "starts")
            return search.run(starts, steps=self.options.steps, tell=steps)

        states, residuals = zip(*run_parts(split_batch(wanted.count, run), work), strict=True)
        info: dict[str, object] = {"residual": np.concatenate(residuals).round(4).tolist()}
        return create_grasp_set(pair, HandState.concatenate(states), began, info)


METHOD: Final = Method(
    summary="descent on a distance grid with force-based contact, relaxed by contact-invariant forces",
    source="D. Turpin et al., Grasp'D: Differentiable Contact-rich Grasp Synthesis, ECCV 2022",
    planner=Graspd2022,
    options=Graspd2022Options,
    uses=("face_error_m",),
    quick={"steps": 60},
)
POINTS: Final = 778  # number of hand points: the published hand has 778 vertices
#: Published constants in SI units: stiffness, viscous friction, friction, time step, speed, mass.
STIFFNESS: Final = 1e5
VISCOUS: Final = 1e3
FRICTION: Final = 0.5
STEP_S: Final = 1e-5
SPEED: Final = 0.01
MASS: Final = 1.0
LEAK: Final = 0.1
MISMATCH: Final = 1e-2
TOLERANCE_N: Final = 10.0
DAMPING: Final = 1.0
FORCE_RATE: Final = 1e-2
#: Rates of Adam: root position [m], root rotation (1e-3 on a quaternion's numbers) [rad], joints [rad].
RATES: Final = (1e-3, 2e-3, 3e-3)
BETAS: Final = (0.9, 0.999)
WARMUP: Final = 200
#: Initial distance of the dilated object from the hand, and retreat of hands from their collision-free starts [m].
APART_M: Final = 0.01
BACKOFF_M: Final = 0.05
CHUNK: Final = 25
PAD_M: Final = 0.10  # margin of the grid around the object's box [m]


def schedule(steps: int) -> Schedule:
    """Return the schedule: dilation falls to 0 over the first half; rates grow for `WARMUP` iterations."""
    at = np.arange(steps)
    dilation = MAX_DILATION * np.clip(1.0 - at / max(0.5 * steps, 1.0), 0.0, 1.0)
    rates = np.minimum(at / WARMUP, 1.0)[:, None] * np.array(RATES)
    # The stiffness is squared, as in the loss of the other forces.
    own = np.full(steps, STIFFNESS**2)
    zero = np.zeros(steps)
    return Schedule(dilation, zero, zero, own, rates)


def force_model(gyration: float) -> Any:
    """Return the constants for the kernels; `gyration` [m] weighs torques."""
    out = kernels.ForceModel()
    out.stiffness, out.viscous, out.friction, out.leak = STIFFNESS, VISCOUS, FRICTION, LEAK
    out.mismatch, out.gyration, out.tolerance = MISMATCH, gyration, TOLERANCE_N
    out.damping, out.rate, out.warmup = DAMPING, FORCE_RATE, float(WARMUP)
    return out


class _Batch:
    def __init__(self, search: Search, starts: HandState, steps: int) -> None:
        pair, n = search.pair, len(starts.pivot)
        self.grid, self.n = search.grid, n
        self.model = Model.create(pair.hand, pair.fine.obj, search.points, pair.coarse.own, pair.options)
        self.data = Data(self.model, n)
        self.device = self.model.device
        self.physics = force_model(pair.fine.obj.model.gyration_radius)
        velocity = SPEED * np.array([[0.0, 0, 0], [1, 1, 1], [-1, -1, -1]])
        self.wanted = np.concatenate([MASS / STEP_S * velocity, np.zeros((3, 3))], axis=1)
        with wp.ScopedDevice(self.device):
            self.velocity = wp.array(velocity, dtype=wp.vec3)
            self.task = wp.array(self.wanted, dtype=kernels.vec6)
            shape = (n, POINTS, 3)
            self.force, self.first, self.largest = (wp.zeros(shape, dtype=wp.vec3) for _ in range(3))
            self.total, self.pull = (wp.zeros((n, 3), dtype=kernels.vec6) for _ in range(2))
            self.multiplier, self.gap = (wp.zeros((n, 3), dtype=wp.float32) for _ in range(2))
        self.data.set_schedule(schedule(steps))
        self.data.set_state(starts)
        self.data.dilation_scale.assign(self._initial_dilation_scale())
        self.launches = self._record()

    def _initial_dilation_scale(self) -> NDArray[np.float32]:
        """Return (n,) shares of `MAX_DILATION` that put the dilated object `APART_M` from each hand."""
        m, d, poses = self.model, self.data, Launches(self.device)
        add_poses(poses, m, d)
        poses.run()
        with wp.ScopedDevice(self.device):
            least = wp.full(self.n, 1e3, dtype=wp.float32)
            given = [self.grid, m.point_body, m.point_position, d.hands]
            wp.launch(kernels.nearest_distance, (self.n, POINTS), inputs=given, outputs=[least])
            return np.clip((least.numpy() - APART_M) / MAX_DILATION, 0.0, 1.0).astype(np.float32)

    def _record(self) -> Launches:
        m, d, n, out = self.model, self.data, self.n, Launches(self.device)
        add_poses(out, m, d)
        sums = [self.total, self.multiplier, self.pull, self.gap]
        out.add(kernels.multipliers, (n, 3), inputs=[self.physics, self.task, d.active], outputs=sums)
        model = [self.physics, self.grid, self.velocity, m.point_body, m.point_position]
        forces = [self.force, self.first, self.largest, self.total, d.hands]
        out.add(kernels.relax, (n, POINTS), inputs=[*model, d.schedule.dilation, self.pull], outputs=forces)
        add_self_penalty(out, m, d, 0.0)
        add_root_gradient(out, m, d)
        add_step(out, m, d, "adam", betas=BETAS)
        return out

    def residual(self) -> Floats:
        """Return (n,) force residuals over the wanted force, the larger of both; 1 without contact forces."""
        return self.gap.numpy()[:, 1:].max(axis=1).astype(float) / float(np.linalg.norm(self.wanted[1]))


def distance_grid(obj: DeviceObject, cells: int) -> Any:
    """Return a `Surface` from the mesh with `cells` cells along the longest side of the padded box.
    Distances are exact at the cells' corners; the array is on the object's device."""
    model = obj.model
    low = model.vertices.min(axis=0) - model.centre_of_mass - PAD_M
    high = model.vertices.max(axis=0) - model.centre_of_mass + PAD_M
    cell = float((high - low).max()) / cells
    shape = [int(n) for n in np.ceil((high - low) / cell).astype(int) + 1]
    reach = float(np.linalg.norm(high - low))
    out = surface.Surface()
    out.mesh, out.corner_normals, out.alpha = obj.surface.mesh, obj.surface.corner_normals, 0.0
    out.cells = obj.surface.cells
    device = obj.device
    with wp.ScopedDevice(device):
        field = wp.empty(tuple(shape), dtype=wp.float32)
        out.field = wp.zeros((0, 0, 0), dtype=wp.float32)

    def slab(first: int, last: int) -> None:
        corner, dim = low + np.array([first * cell, 0.0, 0.0]), (last - first, shape[1], shape[2])
        given = [out, wp.vec3(*corner), cell, reach]
        with wp.ScopedDevice(device):
            wp.launch(surface.sample_field, dim, inputs=given, outputs=[field[first:last]])

    threads = 1 if wp.get_device(device).is_cuda else available_cores()
    bounds = np.linspace(0, shape[0], 4 * threads + 1).astype(int)
    with ThreadPoolExecutor(threads) as pool:
        list(pool.map(lambda ends: slab(*ends), pairwise(bounds.tolist())))
    out.field, out.field_origin, out.field_cell, out.field_error = field, wp.vec3(*low), cell, 0.5 * cell
    return out

"""Levenberg-Marquardt projection of hands out of penetration that keeps contacts (kernels.projection)."""

from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import warp as wp

from graspd.service.model.transforms import Floats
from graspd.worker.simulation.data import Data, HandState, zero_schedule
from graspd.worker.simulation.device import to_wxyz, to_xyzw
from graspd.worker.simulation.kernels import obstacles, solids
from graspd.worker.simulation.kernels import projection as kernels
from graspd.worker.simulation.launches import Launches
from graspd.worker.simulation.model import Model
from graspd.worker.simulation.record import record_placement

CAPACITY: Final = 1024  # largest number of residuals per grasp and iteration
#: The same on a GPU, where the order of residuals differs between runs: all must fit, or a random part would be used. A
#: standard grasp has at most 1,934 (3 hands on a mug).
CUDA_CAPACITY: Final = 4096
CUDA_LANE: Final = 16  # residuals that one GPU thread adds to the equations
BETTER_M: Final = 1e-5  # least reduction of penetration by which a state is better than another one [m]


@dataclass(frozen=True)
class ProjectionOptions:
    """Clearances of the projection, in metres."""

    near: float = 2e-4  # hand points closer to the object than this are moved to `target`
    target: float = 3.5e-4  # distance of moved points
    hold: float = 2e-3  # points closer than this are contacts, moved to `hold_target` with weight `hold_weight`
    hold_target: float = 5e-4
    hold_weight: float = 0.02
    sample_near: float = 2.5e-4  # object samples closer to a link than this are moved to `target`
    self_near: float = 2e-4
    self_target: float = 5e-4
    obstacle_near: float = 2e-4  # hand features closer to an obstacle than their margin plus this are moved
    obstacle_target: float = 5e-4  # distance of moved features beyond their margin
    damping: float = 1e-3  # damping per residual
    scale: tuple[float, float, float] = (1.0, 12.5, 25.0)
    """Translation [m], rotation and joints [rad] that move a surface equally far: levers of 8 and 4 cm."""
    step: float = 3e-3  # largest step in units of the scaled variables [m]


class Projection:
    """Projection of a model's hands that selects the least penetrating state of each on the device."""

    def __init__(self, model: Model, data: Data, options: ProjectionOptions) -> None:
        self.model, self.data, self.options = model, data, options
        hand, B, n = model.hand.model, data.capacity, 6 + model.dofs
        is_cuda = wp.get_device(model.device).is_cuda
        each, self._lane = (CUDA_CAPACITY, CUDA_LANE) if is_cuda else (CAPACITY, CAPACITY)
        self._lanes = each // self._lane
        scale = np.repeat(options.scale, [3, 3, model.dofs])
        scale[6:] *= data.unit
        with wp.ScopedDevice(model.device):
            out = self.residuals = kernels.Residuals()
            out.count = wp.zeros(B, dtype=wp.int32)
            shape = (B, each)
            out.body, out.other = (wp.empty(shape, dtype=wp.int32) for _ in range(2))
            out.point, out.direction = (wp.empty(shape, dtype=wp.vec3) for _ in range(2))
            out.value, out.weight = (wp.empty(shape, dtype=wp.float32) for _ in range(2))
            self._row = wp.empty((B * self._lanes, n), dtype=wp.float32)
            self.matrix, self.vector = wp.zeros((B, n, n), dtype=wp.int64), wp.zeros((B, n), dtype=wp.int64)
            self._factor, self._move = wp.empty((B, n, n), dtype=wp.float64), wp.empty((B, n), dtype=wp.float64)
            self._limits = [wp.array(limit, dtype=wp.float64) for limit in (hand.lower, hand.upper)]
            self._scale = wp.array(scale, dtype=wp.float64)
            self._depth = wp.empty(B, dtype=wp.float64)

    def run(self, state: HandState, iterations: int) -> tuple[HandState, Floats]:
        """Run at most `iterations` steps; return each hand's best state, and its deepest penetration (n,) [m]."""
        data, n = self.data, len(state.pivot)
        data.set_schedule(zero_schedule())
        data.set_state(state)
        now, best = self._states(state), self._states(state)
        self._depth.fill_(np.inf)
        step = self._record_depths(now, best)
        self._add_equations(step)
        d, o = self.data, self.options
        inputs = [*self._limits, self._scale, wp.float64(o.damping), wp.float64(o.step), self.residuals]
        outputs = [self._factor, self._move, self.matrix, self.vector, now, d.hands]
        step.add(kernels.step, d.capacity, inputs=inputs, outputs=outputs)
        step.run(iterations)
        self._record_depths(now, best).run()
        pivot, rotation, q = (array.numpy()[:n].copy() for array in (best.pivot, best.rotation, best.q))
        # A hand that no step improved has its rotation as given, in single precision.
        rotation /= np.linalg.norm(rotation, axis=1, keepdims=True)
        return HandState(pivot, to_wxyz(rotation), q), self._depth.numpy()[:n].copy()

    def _record_depths(self, now: Any, best: Any) -> Launches:
        d, o = self.data, self.options
        out = record_placement(self.model, d, within=max(o.near, o.hold))
        outputs = [d.active, self.residuals.count, best, self._depth]
        out.add(kernels.keep_best, d.capacity, inputs=[d.depths, wp.float64(BETTER_M), now], outputs=outputs)
        return out

    def _states(self, state: HandState) -> Any:
        """Upload hands in double precision, padded with zeros to the capacity."""
        rest = self.data.capacity - len(state.pivot)
        out = kernels.States()
        with wp.ScopedDevice(self.model.device):
            out.pivot = wp.array(np.pad(state.pivot, ((0, rest), (0, 0))), dtype=wp.vec3d)
            out.rotation = wp.array(np.pad(to_xyzw(state.rotation), ((0, rest), (0, 0))), dtype=wp.quatd)
            out.q = wp.array(np.pad(state.q, ((0, rest), (0, 0))), dtype=wp.float64)
        return out

    def _add_equations(self, out: Launches) -> None:
        m, d, o, outputs = self.model, self.data, self.options, [self.residuals]
        inputs = [m.lane, d.hands, d.contacts, o.near, o.target, o.hold, o.hold_target, o.hold_weight]
        out.add(kernels.point_residuals, (d.capacity, m.lanes), inputs=inputs, outputs=outputs)
        over = (d.capacity, m.pieces)
        inputs = [m.hand.pieces, m.obj.sorted_samples, d.hands, o.sample_near, o.target]
        out.add(kernels.sample_residuals, over, inputs=inputs, outputs=outputs)
        inputs = [m.hand.pieces, m.body_points, d.hands, o.self_near, o.self_target]
        out.add(kernels.self_residuals, over, inputs=inputs, outputs=outputs)
        if (around := m.obstacles) is not None:
            terms = [d.hands, o.obstacle_near, o.obstacle_target]
            out.add(obstacles.residuals, over, inputs=[around.features, around.solids, *terms], outputs=outputs)
            if around.any_solid:
                inputs = [around.features, m.hand.pieces, around.solids, *terms]
                out.add(solids.residuals, over, inputs=inputs, outputs=outputs)
        inputs = [m.hand.tree, self._lane, d.hands, self.residuals]
        outputs = [self._row, self.matrix, self.vector]
        out.add(kernels.normal_equations, (d.capacity, self._lanes), inputs=inputs, outputs=outputs)

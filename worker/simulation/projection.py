"""Levenberg-Marquardt projection of hands out of penetration while contacts are held (kernels.projection)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import warp as wp
from numpy.typing import NDArray

from service.model.transforms import quat_from_axis_angle, quat_multiply
from worker.simulation.data import Data
from worker.simulation.kernels import obstacles, packing, solids
from worker.simulation.kernels import projection as kernels
from worker.simulation.model import Model
from worker.simulation.record import record_placement
from worker.simulation.state import HandState, still_schedule

Floats = NDArray[np.float64]

#: Residuals kept per grasp and iteration.
CAPACITY: Final = 1024
#: A state is better than another if it is less deep by more than this [m].
BETTER_M: Final = 1e-5


@dataclass(frozen=True)
class ProjectionOptions:
    """Clearances in metres."""

    near: float = 2e-4
    """Hand points nearer to the object than this are moved ..."""
    target: float = 3.5e-4
    """... to this distance."""
    hold: float = 2e-3
    """Points nearer than this are contacts, drawn to `hold_target` with weight `hold_weight`."""
    hold_target: float = 5e-4
    hold_weight: float = 0.02
    sample_near: float = 2.5e-4
    """Object samples nearer to a link than this are moved to `target`."""
    self_near: float = 2e-4
    self_target: float = 5e-4
    obstacle_near: float = 2e-4
    """Hand features nearer to an obstacle than their margin and this are moved ..."""
    obstacle_target: float = 5e-4
    """... to their margin and this."""
    damping: float = 1e-3
    """Times the number of residuals."""
    scale: tuple[float, float, float] = (1.0, 12.5, 25.0)
    """Translation [m], rotation and joints [rad] that move a hand's surface alike: levers of 8 and 4 cm."""
    step: float = 3e-3
    """Largest step in units of the scaled variables [m]."""


def _residuals(capacity: int) -> Any:
    out = kernels.Residuals()
    out.count = wp.zeros(capacity, dtype=wp.int32)
    for name in ("body", "other"):
        setattr(out, name, wp.zeros((capacity, CAPACITY), dtype=wp.int32))
    for name in ("point", "direction"):
        setattr(out, name, wp.zeros((capacity, CAPACITY), dtype=wp.vec3))
    for name in ("value", "weight"):
        setattr(out, name, wp.zeros((capacity, CAPACITY), dtype=wp.float32))
    out.key = wp.zeros((capacity, CAPACITY), dtype=wp.int64)
    out.order = wp.array(np.tile(np.arange(CAPACITY, dtype=np.int32), (capacity, 1)))
    return out


class Projection:
    """Moves the hands of a model; keeps of each the least penetrating state it saw."""

    def __init__(self, model: Model, data: Data, options: ProjectionOptions) -> None:
        self.model, self.data, self.options = model, data, options
        B, n = data.capacity, 6 + model.dofs
        with wp.ScopedDevice(model.device):
            self.residuals = _residuals(B)
            self.row = wp.zeros((B, n), dtype=wp.float32)
            self.matrix = wp.zeros((B, n, n), dtype=wp.float32)
            self.vector = wp.zeros((B, n), dtype=wp.float32)

    def run(self, state: HandState, iterations: int) -> tuple[HandState, Floats]:
        """At most `iterations` steps from `state`.

        Returns:
            The best state of each hand, and its deepest penetration (n,) [m].
        """
        data = self.data
        n = len(state.pivot)
        data.set_schedule(still_schedule())
        placement = record_placement(self.model, data, within=max(self.options.near, self.options.hold))
        best, depth = state, np.full(n, np.inf)
        current = state
        for step in range(iterations + 1):
            # A hand without penetration cannot become better: it costs nothing more.
            going = depth > BETTER_M
            if not going.any():
                break
            data.set_state(current, active=going)
            placement.run()
            now = np.where(going, data.deepest(n), np.inf)
            better = now < depth - BETTER_M
            best = _where(better, current, best)
            depth = np.where(better, now, depth)
            if step == iterations:
                break
            current = self._moved(current, self._step(np.flatnonzero(going), n))
        return best, depth.astype(float)

    def _step(self, rows: NDArray[np.intp], n: int) -> Floats:
        """Damped Gauss-Newton step (n, 6 + D) of some hands for the placement just evaluated; 0 for the others."""
        self._assemble()
        o = self.options
        lower = self.matrix.numpy()[rows].astype(float)
        H = lower + np.tril(lower, -1).transpose(0, 2, 1)
        g = self.vector.numpy()[rows].astype(float)
        count = np.minimum(self.residuals.count.numpy()[rows], CAPACITY)
        scale = np.repeat(o.scale, [3, 3, self.model.dofs])
        scale[6:] *= self.data.unit
        H = H * scale[:, None] * scale[None, :]
        damping = o.damping * np.maximum(count, 1)
        H[:, np.arange(len(scale)), np.arange(len(scale))] += damping[:, None]
        step = -np.linalg.solve(H, (g * scale)[..., None])[..., 0]
        length = np.linalg.norm(step, axis=1, keepdims=True)
        step *= np.minimum(1.0, o.step / np.maximum(length, 1e-12))
        out = np.zeros((n, len(scale)))
        out[rows] = step * scale
        return out

    def _assemble(self) -> None:
        m, d, o, r = self.model, self.data, self.options, self.residuals
        c, pose = d.contacts, [d.body_p, d.body_q]
        r.count.zero_()
        wp.launch(
            kernels.point_residuals, (d.capacity, m.lanes),
            inputs=[m.lane, d.active, c.count, c.body, c.point, c.normal, c.distance,
                    o.near, o.target, o.hold, o.hold_target, o.hold_weight],
            outputs=[r], device=m.device,
        )  # fmt: skip
        wp.launch(
            kernels.sample_residuals, (d.capacity, m.pieces),
            inputs=[m.hand.pieces, m.obj.sorted_samples, d.active, *pose, o.sample_near, o.target],
            outputs=[r], device=m.device,
        )  # fmt: skip
        wp.launch(
            kernels.self_residuals, (d.capacity, m.pieces),
            inputs=[m.hand.pieces, m.body_points, d.active, *pose, o.self_near, o.self_target],
            outputs=[r], device=m.device,
        )  # fmt: skip
        if m.obstacles is not None:
            wp.launch(
                obstacles.residuals, (d.capacity, m.pieces),
                inputs=[m.obstacles.features, m.obstacles.solids, d.active, d.scene, *pose, o.obstacle_near,
                        o.obstacle_target],
                outputs=[r], device=m.device,
            )  # fmt: skip
        if m.obstacles is not None and m.obstacles.any_solid:
            wp.launch(
                solids.residuals, (d.capacity, m.pieces),
                inputs=[m.obstacles.features, m.hand.pieces, m.obstacles.solids, d.active, d.scene, *pose,
                        o.obstacle_near, o.obstacle_target],
                outputs=[r], device=m.device,
            )  # fmt: skip
        if not d.serial:
            wp.launch(
                packing.order, (d.capacity, CAPACITY),
                inputs=[d.active, r.count, r.key], outputs=[r.order], device=m.device,
            )  # fmt: skip
        wp.launch(
            kernels.normal_equations, d.capacity,
            inputs=[m.hand.tree, d.active, d.pivot, d.body_p, d.axis, r],
            outputs=[self.row, self.matrix, self.vector], device=m.device,
        )  # fmt: skip

    def _moved(self, state: HandState, step: Floats) -> HandState:
        hand = self.model.hand.model
        angle = np.linalg.norm(step[:, 3:6], axis=1)
        axis = step[:, 3:6] / np.maximum(angle, 1e-12)[:, None]
        rotation = quat_multiply(quat_from_axis_angle(axis, angle), state.rotation)
        rotation /= np.linalg.norm(rotation, axis=1, keepdims=True)
        return HandState(state.pivot + step[:, :3], rotation, np.clip(state.q + step[:, 6:], hand.lower, hand.upper))


def _where(mask: NDArray[np.bool_], a: HandState, b: HandState) -> HandState:
    m = mask[:, None]
    return HandState(np.where(m, a.pivot, b.pivot), np.where(m, a.rotation, b.rotation), np.where(m, a.q, b.q))

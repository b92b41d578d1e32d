"""Levenberg-Marquardt projection of hands out of penetration while contacts are held (kernels.projection)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import warp as wp
from numpy.typing import NDArray

from service.model.transforms import quat_from_axis_angle, quat_multiply
from worker.simulation.kernels import obstacles
from worker.simulation.kernels import projection as kernels
from worker.simulation.simulation import HandState, Simulation, still_schedule

Floats = NDArray[np.float64]

#: Residuals kept per grasp and iteration.
CAPACITY: Final = 1024


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
    return out


class Projection:
    """Moves the hands of a simulation; keeps of each the least penetrating state it saw."""

    def __init__(self, simulation: Simulation, options: ProjectionOptions) -> None:
        self.simulation, self.options = simulation, options
        B, n = simulation.capacity, 6 + simulation.dofs
        with wp.ScopedDevice(simulation.device):
            self.residuals = _residuals(B)
            self.row = wp.zeros((B, n), dtype=wp.float32)
            self.matrix = wp.zeros((B, n, n), dtype=wp.float32)
            self.vector = wp.zeros((B, n), dtype=wp.float32)

    def run(self, state: HandState, iterations: int) -> tuple[HandState, Floats]:
        """At most `iterations` steps from `state`.

        Returns:
            The best state of each hand, and its deepest penetration (n,) [m].
        """
        sim = self.simulation
        n = len(state.pivot)
        sim.set_schedule(still_schedule())
        sim.record_placement()
        best, depth = state, np.full(n, np.inf)
        current = state
        for step in range(iterations + 1):
            sim.set_state(current)
            sim.run()
            now = sim.depths(n)
            better = now < depth - 1e-5
            best = _where(better, current, best)
            depth = np.where(better, now, depth)
            if step == iterations:
                break
            current = self._moved(current, self._step(n))
        return best, depth.astype(float)

    def _step(self, n: int) -> Floats:
        """Damped Gauss-Newton step (n, 6 + D) for the placement just evaluated."""
        self._assemble()
        o, sim = self.options, self.simulation
        lower = self.matrix.numpy()[:n].astype(float)
        H = lower + np.tril(lower, -1).transpose(0, 2, 1)
        g = self.vector.numpy()[:n].astype(float)
        rows = np.minimum(self.residuals.count.numpy()[:n], CAPACITY)
        scale = np.repeat(o.scale, [3, 3, sim.dofs])
        H = H * scale[:, None] * scale[None, :]
        damping = o.damping * np.maximum(rows, 1)
        H[:, np.arange(len(scale)), np.arange(len(scale))] += damping[:, None]
        step = -np.linalg.solve(H, (g * scale)[..., None])[..., 0]
        length = np.linalg.norm(step, axis=1, keepdims=True)
        step *= np.minimum(1.0, o.step / np.maximum(length, 1e-12))
        return step * scale

    def _assemble(self) -> None:
        sim, o, r = self.simulation, self.options, self.residuals
        B = sim.capacity
        r.count.zero_()
        wp.launch(
            kernels.point_residuals, (B, sim.count),
            inputs=[sim.active, sim.contacts, sim.contact_body, sim.contact_point, sim.contact_normal,
                    sim.contact_distance, o.near, o.target, o.hold, o.hold_target, o.hold_weight],
            outputs=[r], device=sim.device,
        )  # fmt: skip
        wp.launch(
            kernels.sample_residuals, (B, len(sim.hand.model.pieces)),
            inputs=[sim.hand.pieces, sim.obj.bvh.id, sim.obj.samples, sim.active, sim.body_p, sim.body_q,
                    o.sample_near, o.target],
            outputs=[r], device=sim.device,
        )  # fmt: skip
        wp.launch(
            kernels.self_residuals, (B, len(sim.hand.model.pieces)),
            inputs=[sim.hand.pieces, sim.body_points, sim.active, sim.body_p, sim.body_q, o.self_near, o.self_target],
            outputs=[r], device=sim.device,
        )  # fmt: skip
        if sim.obstacles is not None:
            wp.launch(
                obstacles.residuals, (B, sim.obstacles.count),
                inputs=[sim.obstacles.features, sim.obstacles.solids, sim.active, sim.scene, sim.body_p, sim.body_q,
                        o.obstacle_near, o.obstacle_target],
                outputs=[r], device=sim.device,
            )  # fmt: skip
        wp.launch(
            kernels.normal_equations, B,
            inputs=[sim.hand.tree, sim.active, sim.pivot, sim.body_p, sim.axis, r],
            outputs=[self.row, self.matrix, self.vector], device=sim.device,
        )  # fmt: skip

    def _moved(self, state: HandState, step: Floats) -> HandState:
        hand = self.simulation.hand.model
        angle = np.linalg.norm(step[:, 3:6], axis=1)
        axis = step[:, 3:6] / np.maximum(angle, 1e-12)[:, None]
        rotation = quat_multiply(quat_from_axis_angle(axis, angle), state.rotation)
        rotation /= np.linalg.norm(rotation, axis=1, keepdims=True)
        return HandState(state.pivot + step[:, :3], rotation, np.clip(state.q + step[:, 6:], hand.lower, hand.upper))


def _where(mask: NDArray[np.bool_], a: HandState, b: HandState) -> HandState:
    m = mask[:, None]
    return HandState(np.where(m, a.pivot, b.pivot), np.where(m, a.rotation, b.rotation), np.where(m, a.q, b.q))

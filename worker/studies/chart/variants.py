"""fast_graspd with one part exchanged, where that is no option of the planner: for comparison only."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

import warp as wp

from worker.planners.fast_graspd.pairs import Pair, Side
from worker.simulation.simulation import LossOptions, Simulation, initial_motions
from worker.studies.chart import contact64, kernels

#: Modules of kernels that only comparisons need.
MODULES: Final = (kernels, contact64)


@dataclass(frozen=True)
class VariantPair(Pair):
    """A pair whose simulations are of another kind."""

    kind: type[Simulation]

    def simulation(self, side: Side, capacity: int) -> Simulation:
        return self.kind(self.hand, side.obj, side.points, side.own, capacity=capacity, options=self.options)


class AskingEach(Simulation):
    """Every simulated velocity asks for the distances anew; the answers are the same."""

    def _record_kinematics(self) -> None:
        super()._record_kinematics()
        gather = self._commands[-1]
        for _ in range(self.options.velocities - 1):
            self._launch(kernels.forget, self.capacity, [self.active, self.contacts])
            self._commands.append(gather)


class SolvingIn64(Simulation):
    """The compliant contact step and its adjoint in float64; everything before and after is float32 as ever."""

    def _allocate(self) -> None:
        super()._allocate()
        shape = (self.capacity, self.options.velocities)
        motions = initial_motions(self.options.velocities, self.options.step, self.obj.model.gyration_radius)
        self.motions64 = wp.array(motions, dtype=contact64.vec6d)
        self.loss64 = wp.zeros(shape, dtype=wp.float64)
        self.end64 = wp.zeros(shape, dtype=contact64.vec6d)
        self.gradient64 = wp.zeros((self.capacity, self.count), dtype=wp.float64)

    def _record_contact(self) -> None:
        o = self.options
        assert o.contact_solver == "direct" and o.simulate, "only the default step has a float64 twin"
        self._launch(
            contact64.direct64, (self.capacity, o.velocities),
            [physics64(o, self.obj.model.inertia, self.obj.model.gyration_radius, radius=self.physics.radius),
             self.motions64, o.passes, self.active, self.iteration, self.dilation, self.dilation_scale, self.contacts,
             self.contact_point, self.contact_normal, self.contact_distance, self.contact_weight, self.loss64,
             self.end64, self.gradient64],
        )  # fmt: skip
        self._launch(
            contact64.narrow, (self.capacity, self.count),
            [self.active, self.contacts, self.loss64, self.gradient64, self.loss, self.contact_gradient],
        )  # fmt: skip


def physics64(options: LossOptions, inertia: Any, gyration: float, *, radius: float) -> Any:
    """Constants of the float64 step.

    Args:
        options: friction, stiffness, leak, step.
        inertia: (3, 3) of the object per unit of mass [m^2].
        gyration: radius of gyration [m].
        radius: no point taking part is farther from the centre of mass [m].
    """
    mass = [float(i == j) if min(i, j) < 3 else float(inertia[i - 3][j - 3]) for i in range(6) for j in range(6)]
    physics = contact64.Physics64()
    physics.mass = contact64.mat66d(*mass)
    physics.gyration, physics.radius = gyration, radius
    physics.friction, physics.stiffness = options.friction, options.stiffness
    physics.leak, physics.leak_length, physics.one_sided = options.leak, options.leak_length, int(options.one_sided)
    physics.step = options.step
    return physics


def asking_each(pair: Pair) -> Pair:
    """The pair with a query for each velocity."""
    return VariantPair(pair.coarse, pair.fine, pair.options, pair.hand, AskingEach)


def solving_in_64(pair: Pair) -> Pair:
    """The pair with its contact step in float64."""
    return VariantPair(pair.coarse, pair.fine, pair.options, pair.hand, SolvingIn64)

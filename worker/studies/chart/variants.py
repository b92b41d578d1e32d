"""fast_graspd with one part exchanged, where that is no option of the planner: for comparison only."""

from __future__ import annotations

from dataclasses import dataclass

from worker.planners.fast_graspd.pairs import Pair, Side
from worker.simulation.obstacles import DeviceObstacles
from worker.simulation.simulation import Simulation
from worker.studies.chart import kernels


@dataclass(frozen=True)
class VariantPair(Pair):
    """A pair whose simulations are of another kind."""

    kind: type[Simulation]

    def simulation(self, side: Side, capacity: int, obstacles: DeviceObstacles | None = None) -> Simulation:
        return self.kind(
            self.hand, side.obj, side.points, side.own, capacity=capacity, options=self.options, obstacles=obstacles
        )


class AskingEach(Simulation):
    """Every simulated velocity asks for the distances anew; the answers are the same."""

    def _record_kinematics(self) -> None:
        super()._record_kinematics()
        for _ in range(self.options.velocities - 1):
            self.launches.add(kernels.forget, self.capacity, inputs=[self.active], outputs=[self.contacts])
            self._record_gather()


def asking_each(pair: Pair) -> Pair:
    """The pair with a query for each velocity."""
    return VariantPair(pair.coarse, pair.fine, pair.options, pair.hand, AskingEach)

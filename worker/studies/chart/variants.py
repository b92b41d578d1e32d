"""fast_graspd with one part exchanged, where that is no option of the planner: for comparison only."""

from __future__ import annotations

from worker.planners.fast_graspd.pairs import Pair
from worker.simulation import record
from worker.simulation.data import Data
from worker.simulation.launches import Launches
from worker.simulation.model import Model
from worker.studies.chart import kernels


class AskingEach(Pair):
    """Every simulated velocity asks for the distances anew; the answers are the same."""

    def iteration(self, model: Model, data: Data, optimizer: str, patience: int) -> Launches:
        out = Launches(model.device)
        record.add_poses(out, model, data)
        record.add_distances(out, model, data)
        for _ in range(model.options.velocities - 1):
            counts = [data.contacts.count, data.contacts.near_count]
            out.add(kernels.forget, data.capacity, inputs=[data.active], outputs=counts)
            record.add_distances(out, model, data)
        record.add_contact(out, model, data)
        record.add_penalties(out, model, data)
        record.add_gradient(out, model, data)
        record.add_step(out, model, data, optimizer, patience=patience)
        return out


def asking_each(pair: Pair) -> Pair:
    """The pair with a query for each velocity."""
    return AskingEach(pair.coarse, pair.fine, pair.options, pair.hand)

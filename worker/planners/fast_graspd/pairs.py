"""What the batches of one (hand, object, fidelity) share on a device: made once, kept for the next batch."""

from __future__ import annotations

import threading
from collections import OrderedDict
from dataclasses import dataclass
from typing import Final

from service.domain import Fidelity
from worker.hands.model import HandModel, SurfacePoints
from worker.hands.surface import sample_surface
from worker.objects.model import ObjectModel
from worker.planners.fast_graspd.schedule import loss_options
from worker.simulation import kernels
from worker.simulation.device import DeviceHand, DeviceObject
from worker.simulation.sampling import object_samples
from worker.simulation.simulation import LossOptions, Simulation

#: Cell of the coarse distance grid [m].
FIELD_CELL: Final = 0.005
#: Hand points tested against other links.
SELF_POINTS: Final = 1000
#: Pairs kept on the device.
KEPT: Final = 4


@dataclass(frozen=True)
class Pair:
    """A hand and an object on a device with the hand's point sets for each phase."""

    hand: DeviceHand
    obj: DeviceObject
    coarse: SurfacePoints
    fine: SurfacePoints
    own: SurfacePoints
    options: LossOptions

    def simulation(self, points: SurfacePoints, capacity: int) -> Simulation:
        return Simulation(self.hand, self.obj, points, self.own, capacity=capacity, options=self.options)


_pairs: OrderedDict[tuple[str, str, str, str], Pair] = OrderedDict()
_lock = threading.Lock()


def pair_of(hand: HandModel, obj: ObjectModel, fidelity: Fidelity, device: str) -> Pair:
    """The pair, from memory where it was used lately."""
    key = (hand.digest, obj.digest, fidelity.model_dump_json(), device)
    with _lock:
        if key in _pairs:
            _pairs.move_to_end(key)
            return _pairs[key]
        kernels.load(device)
        samples = object_samples(obj, fidelity.object_points)
        pair = Pair(
            hand=DeviceHand.create(hand, device),
            obj=DeviceObject.create(obj, device, samples=samples, phong_alpha=fidelity.phong_alpha, cell=FIELD_CELL),
            coarse=sample_surface(hand, fidelity.coarse_points),
            fine=sample_surface(hand, fidelity.fine_points),
            own=sample_surface(hand, SELF_POINTS),
            options=loss_options(fidelity),
        )
        _pairs[key] = pair
        while len(_pairs) > KEPT:
            _pairs.popitem(last=False)
        return pair

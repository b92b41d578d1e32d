"""Device data that batches of one hand, object and fidelity share, cached between batches."""

from dataclasses import dataclass, replace
from typing import Final

from graspd.service.model.fidelity import Fidelity
from graspd.worker.hands.model import HandModel, SurfacePoints
from graspd.worker.hands.surface import sample_surface
from graspd.worker.objects.memory_cache import cached_by_content
from graspd.worker.objects.model import ObjectModel
from graspd.worker.planners.fast_graspd.schedule import loss_options
from graspd.worker.simulation import kernels
from graspd.worker.simulation.device import DeviceHand, DeviceObject
from graspd.worker.simulation.model import ANYWHERE, AllowedContacts, LossOptions, Model
from graspd.worker.simulation.obstacles import DeviceObstacles
from graspd.worker.simulation.sampling import object_samples

#: Cell of the coarse distance grid [m].
FIELD_CELL: Final = 0.005
#: Numbers of hand points tested against other links in the coarse and the fine phase, and of object samples (coarse).
COARSE_SELF_POINTS: Final = 400
FINE_SELF_POINTS: Final = 1000
COARSE_SAMPLES: Final = 1500
#: Factor on the fidelity's number of object samples around a free object, and largest number. Penetration between two
#: samples is not detected; with the fidelity's own number the median of such penetration is .2 mm.
DENSER, DENSEST = 3, 12_000
#: Number of pairs cached on the device.
KEPT: Final = 4


@dataclass(frozen=True)
class PhaseGeometry:
    points: SurfacePoints
    own: SurfacePoints
    """Points tested against other links."""
    obj: DeviceObject


@dataclass(frozen=True)
class Pair:
    """A hand and an object on a device, with the geometry of each phase."""

    coarse: PhaseGeometry
    fine: PhaseGeometry
    options: LossOptions
    hand: DeviceHand
    allowed: AllowedContacts = ANYWHERE

    def model(self, side: PhaseGeometry, obstacles: DeviceObstacles | None = None, *, pulled: bool = True) -> Model:
        """Return the model of a phase; among obstacles, or unless `pulled`, it has no attraction term.
        The term would pull fingers that enclose the object into the table."""
        options = self.options if obstacles is None and pulled else replace(self.options, pull=0.0)
        return Model.create(self.hand, side.obj, side.points, side.own, options, obstacles, self.allowed)


def pair_of(
    hand: HandModel,
    obj: ObjectModel,
    fidelity: Fidelity,
    device: str,
    *,
    in_scenes: bool = False,
    allowed: AllowedContacts = ANYWHERE,
) -> Pair:
    """Return the pair, cached. Projections around a free object use more samples than `fidelity` states."""
    count = fidelity.object_points
    if fidelity.polish_iterations and not in_scenes:
        count = max(count, min(DENSER * count, DENSEST))
    return _pair(hand, obj, fidelity, count, device, allowed)


@cached_by_content(KEPT)
def _pair(
    hand: HandModel, obj: ObjectModel, fidelity: Fidelity, count: int, device: str, allowed: AllowedContacts
) -> Pair:
    kernels.load(device)
    samples = object_samples(obj, count)
    whole = DeviceObject.create(obj, device, samples=samples, phong_alpha=fidelity.phong_alpha, cell=FIELD_CELL)
    return Pair(
        coarse=PhaseGeometry(
            points=sample_surface(hand, fidelity.coarse_points),
            own=sample_surface(hand, COARSE_SELF_POINTS),
            obj=whole.with_fewer_samples(COARSE_SAMPLES),
        ),
        fine=PhaseGeometry(
            points=sample_surface(hand, fidelity.fine_points), own=sample_surface(hand, FINE_SELF_POINTS), obj=whole
        ),
        options=loss_options(fidelity),
        hand=DeviceHand.create(hand, device),
        allowed=allowed,
    )

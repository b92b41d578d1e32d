"""Small simulations for tests."""

import numpy as np
import trimesh

from graspd.worker.hands.model import HandModel
from graspd.worker.hands.surface import sample_surface
from graspd.worker.objects.model import ObjectModel
from graspd.worker.simulation import kernels
from graspd.worker.simulation.data import Data, Schedule
from graspd.worker.simulation.device import DeviceHand, DeviceObject
from graspd.worker.simulation.model import ANYWHERE, AllowedContacts, LossOptions, Model
from graspd.worker.simulation.sampling import object_samples
from tests.worker.models import object_from_mesh


def ball(radius: float = 0.035, subdivisions: int = 3) -> ObjectModel:
    return object_from_mesh(trimesh.creation.icosphere(subdivisions=subdivisions, radius=radius))


def still(dilation: float = 0.0, weight: float = 0.0) -> Schedule:
    return Schedule(np.full(1, dilation), np.full(1, weight), np.full(1, weight), np.full(1, weight), np.zeros((1, 3)))


def rig(
    hand: HandModel,
    obj: ObjectModel,
    *,
    capacity: int,
    options: LossOptions | None = None,
    alpha: float = 0.5,
    allowed: AllowedContacts = ANYWHERE,
) -> tuple[Model, Data]:
    kernels.load("cpu")
    device_object = DeviceObject.create(obj, "cpu", samples=object_samples(obj, 1000), phong_alpha=alpha, cell=0.0)
    points = sample_surface(hand, 300)
    on_device = DeviceHand.create(hand, "cpu")
    model = Model.create(on_device, device_object, points, points, options or LossOptions(), allowed=allowed)
    data = Data(model, capacity)
    data.set_schedule(still())
    return model, data

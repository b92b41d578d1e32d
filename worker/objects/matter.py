"""How heavy and how slippery the object of a job is."""

from __future__ import annotations

from service.model.domain import JobOptions
from worker.objects.model import ObjectModel


def as_asked(obj: ObjectModel, request: JobOptions) -> ObjectModel:
    """The object with the mass and friction that a job says, else its own; under level letter, the protocol's.

    Raises:
        MeshError: it would weigh more than 100 kg.
    """
    if request.referee == "letter":
        return obj.published
    return obj.weighing(mass=request.mass, density=request.density, friction=request.object_friction)

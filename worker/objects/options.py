"""Options of an object: the keys of its `asset.json`, and the mass and friction of a job."""

import json
from collections.abc import Mapping
from typing import Any, Final

from pydantic import ValidationError

from graspd.service.model.base import first_error
from graspd.service.model.domain import JobOptions
from graspd.service.model.errors import AssetError, MeshError
from graspd.service.model.object_options import ObjectOptions
from graspd.worker.objects.model import ObjectModel

#: Keys for mass and friction, which do not affect the shape.
OF_MATTER: Final = ("density", "mass", "friction")
#: Metres per unit.
UNITS: Final = {"m": 1.0, "mm": 1e-3, "cm": 1e-2, "in": 0.0254}


def parse_options(files: Mapping[str, bytes], extra: Mapping[str, Any] | None = None) -> ObjectOptions:
    """Parse options of the object in `files`; `extra` (without None values) overrides its `asset.json`.
    Raises MeshError: `asset.json` is not JSON, or a key is unknown or wrong; the message names it."""
    stated = stated_options(files, MeshError)
    given = {key: value for key, value in (extra or {}).items() if value is not None}
    if given.keys() & {"mass", "density"}:
        stated = {key: value for key, value in stated.items() if key not in ("mass", "density")}
    try:
        return ObjectOptions.model_validate({**stated, **given})
    except ValidationError as error:
        raise MeshError(f"asset.json: {first_error(error)}") from None


def stated_options(files: Mapping[str, bytes], error: type[AssetError]) -> dict[str, Any]:
    """Return the keys of `asset.json` among the files; raise `error` if it is no JSON object."""
    try:
        stated = json.loads(files["asset.json"]) if "asset.json" in files else {}
    except (ValueError, RecursionError):
        stated = None
    if not isinstance(stated, dict):
        raise error('asset.json is no JSON object; write one such as {"file": "mug.stl"}')
    return stated


def apply_request(obj: ObjectModel, request: JobOptions) -> ObjectModel:
    """Return the object with a job's mass and friction; those of the protocol at level dexgraspbench.
    Raises MeshError: the mass would exceed 100 kg."""
    if request.validation == "dexgraspbench":
        return obj.for_dexgraspbench
    return obj.with_mass(mass=request.mass, density=request.density, friction=request.object_friction)

"""Options of an object: the keys of its `asset.json`."""

from typing import Annotated, Any, Final, Literal, Self

from pydantic import AliasChoices, Field, model_validator

from graspd.service.model.base import Model
from graspd.service.model.matter import FRICTION, MASS_KG, Density, Friction, Mass
from graspd.service.model.options import Option, Place

ASSET: Final[tuple[Place, ...]] = ("asset",)
_READ: Final = Option(places=("asset", "synth"))
_SIZE: Final = Option(places=("asset", "synth", "python"))
_MATTER: Final = Option(places=ASSET)
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]


class MeshOptions(Model):
    units: Annotated[Literal["m", "mm", "cm", "in"], _SIZE] = Field("m", description="unit of the mesh")
    scale_to: Annotated[Positive | None, _SIZE] = Field(None, description="longest extent after scaling [m]")
    keep_largest: Annotated[bool, _READ] = Field(False, description="keep only the largest of several components")
    # `compound` is the name in older files.
    rigid: Annotated[bool, _READ] = Field(
        False,
        validation_alias=AliasChoices("rigid", "compound"),
        description="take separate components as one rigid body",
    )
    allow_open: Annotated[bool, _READ] = Field(False, description="accept a mesh that is not watertight")


class ObjectOptions(MeshOptions):
    """Keys of an object's `asset.json`; units are SI."""

    file: str = ""
    description: str = ""
    licence: str = ""
    source: str = ""
    facts: dict[str, Any] = Field(default_factory=dict)
    density: Annotated[Density | None, _MATTER] = Field(None, description="density [kg/m^3], instead of the mass")
    mass: Annotated[Mass | None, _MATTER] = Field(None, description=f"mass of the object [kg]; default: {MASS_KG:g}")
    friction: Annotated[Friction | None, _MATTER] = Field(
        None, description=f"Coulomb coefficient of the object's contacts in simulation; default: {FRICTION:g}"
    )

    @model_validator(mode="after")
    def _check_mass_and_density(self) -> Self:
        if self.mass is not None and self.density is not None:
            raise ValueError("mass and density exclude each other: give one")
        return self

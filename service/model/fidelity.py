"""Fidelities: named sets of a planner's settings."""

from typing import Any, Final, Literal

from pydantic import Field

from graspd.service.model.base import Model
from graspd.service.model.errors import did_you_mean


class Fidelity(Model):
    """Settings of a planner that decide accuracy and cost; `graspd chart` measures both."""

    name: str = Field("custom", max_length=64)
    starts: int = Field(4, ge=1, le=64, description="starts for each grasp; half as many with rollouts")
    finalists: int = Field(2, ge=1, le=64, description="starts that enter the fine phase")
    coarse_points: int = Field(256, ge=16, le=8192, description="hand surface points in the first phase")
    fine_points: int = Field(2000, ge=16, le=32768, description="hand surface points in the second phase")
    object_points: int = Field(
        4000, ge=16, le=65536, description="object surface points tested against links; for free objects * 3, max 12000"
    )
    face_error_m: float = Field(3e-4, ge=0, le=0.01, description="error bound of the simplified object [m]")
    coarse_iterations: int = Field(100, ge=0, le=100_000)
    fine_iterations: int = Field(40, ge=0, le=100_000)
    polish_iterations: int = Field(10, ge=0, le=100, description="Gauss-Newton steps that resolve penetration")
    patience: int = Field(10, ge=0, le=100_000, description="fine iterations without improvement before a stop; 0: off")
    velocities: Literal[7, 13] = Field(7, description="number of one-step simulations, one per object velocity (M)")
    contact_solver: Literal["direct", "gauss_seidel"] = "direct"
    optimizer: Literal["adam", "gd"] = "adam"
    leak: Literal["one_sided", "two_sided"] = "one_sided"
    dilation: Literal["fixed", "touch"] = Field(
        "fixed", description="first dilation of the object. fixed: 10 mm; touch: until the object touches the hand"
    )
    simulate: bool = Field(True, description="False: control experiment, hands are only attracted to the surface")
    phong_alpha: float = Field(0.5, ge=0, le=1)


#: Settings that differ between the fidelities for users.
_VARIED: Final = (
    *("starts", "finalists", "coarse_points", "fine_points", "object_points", "face_error_m"),
    *("coarse_iterations", "fine_iterations", "polish_iterations"),
)


def _fidelity(name: str, *varied: Any) -> Fidelity:
    return Fidelity(name=name, **dict(zip(_VARIED, varied, strict=True)))


FIDELITIES: Final[dict[str, Fidelity]] = {
    "draft": _fidelity("draft", 2, 1, 200, 800, 2000, 1e-3, 60, 20, 6),
    "standard": Fidelity(name="standard"),
    "fine": _fidelity("fine", 6, 3, 400, 4000, 8000, 1e-4, 120, 60, 15),
    # Settings of the paper: gradient descent with one rate, one contact sweep, no penetration penalty, no selection.
    "paper": Fidelity(
        name="paper",
        starts=1,
        finalists=1,
        coarse_points=2000,
        coarse_iterations=200,
        fine_iterations=0,
        patience=0,
        polish_iterations=0,
        contact_solver="gauss_seidel",
        optimizer="gd",
        leak="two_sided",
        phong_alpha=0.75,
    ),
    "control": Fidelity(name="control", simulate=False),
}


#: Placeholder for the cheapest fidelity that meets the target; the stored job has the name of that fidelity.
AUTO: Final = "auto"
#: Fidelities for users; other fidelities are for comparisons.
OFFERED: Final = ("draft", "standard", "fine")


def resolve_fidelity(value: str | Fidelity) -> Fidelity:
    """Return the settings of a named fidelity; ValueError if there is none."""
    if isinstance(value, Fidelity):
        return value
    if value not in FIDELITIES:
        hint = did_you_mean(value, FIDELITIES)
        raise ValueError(f"unknown fidelity {value!r}; choose one of {', '.join(FIDELITIES)}, or give settings{hint}")
    return FIDELITIES[value]

"""Mass and friction of objects: bounds and what an object has of which nobody says more."""

from __future__ import annotations

from typing import Annotated, Final

from pydantic import Field

#: Of an object of which nobody says what it weighs [kg], and its coefficient of sliding friction: DexGraspBench's.
MASS_KG: Final = 0.1
FRICTION: Final = 0.6
#: Weight of a kilogram, and a push on it, in the protocol [m/s^2].
ACCELERATION: Final = 10.0
#: A hand lifts nothing heavier [kg].
MOST_KG: Final = 100.0

Mass = Annotated[float, Field(gt=0, le=MOST_KG, allow_inf_nan=False)]
Density = Annotated[float, Field(gt=0, le=30_000, allow_inf_nan=False)]
Friction = Annotated[float, Field(gt=0, le=3, allow_inf_nan=False)]

"""Mass and friction of objects: bounds and defaults."""

from typing import Annotated, Final

from pydantic import Field

#: Default mass [kg] and coefficient of sliding friction, as in DexGraspBench.
MASS_KG: Final = 0.1
FRICTION: Final = 0.6
#: Gravity and acceleration of pushes in DexGraspBench's protocol [m/s^2].
ACCELERATION: Final = 10.0
MOST_KG: Final = 100.0
MOST_FRICTION: Final = 3.0  # larger stated coefficients are limited to it

Mass = Annotated[float, Field(gt=0, le=MOST_KG, allow_inf_nan=False)]
Density = Annotated[float, Field(gt=0, le=30_000, allow_inf_nan=False)]
Friction = Annotated[float, Field(gt=0, le=3, allow_inf_nan=False)]

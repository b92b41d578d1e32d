"""GraspIt!'s annealing schedule with default parameters, a very fast re-annealing (Ingber 1989).

    T(k) = T0 exp(-C k^(1/D)),   C = 7, D = 8, T0 = 1e6, k from 30,000
    neighbour: x + sgn(u - 1/2) T ((1 + 1/T)^|2u - 1| - 1) jump,   u uniform
    accept with probability 1 if E' < E, else exp(1e-6 (E - E') / T)

The counter starts at `FIRST_STEP`: with 70,000 steps a planner makes 40,000 moves.
"""

from __future__ import annotations

from typing import Final

START_TEMPERATURE: Final = 1e6
COOLING: Final = 7.0
DIMENSIONS: Final = 8
FIRST_STEP: Final = 30_000
ENERGY_SCALE: Final = 1e-6
#: Most neighbours drawn for one step until one is collision-free; without one the step does not count.
ATTEMPTS: Final = 11

"""GraspIt!'s annealing schedule with default parameters, a very fast re-annealing (Ingber 1989).

    T(k) = T0 exp(-C k^(1/D)),   C = 7, D = 8, T0 = 1e6, k from 30,000
    neighbour: x + sgn(u - 1/2) T ((1 + 1/T)^|2u - 1| - 1) jump,   u uniform
    accept with probability 1 if E' < E, else exp(1e-6 (E - E') / T)

The counter starts at `FIRST_STEP`: with 70,000 steps a planner makes 40,000 moves.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from graspd.service.model.transforms import Floats

START_TEMPERATURE: Final = 1e6
COOLING: Final = 7.0
DIMENSIONS: Final = 8
FIRST_STEP: Final = 30_000
ENERGY_SCALE: Final = 1e-6
#: Most neighbours drawn for one step until one is collision-free; without one the step does not count.
ATTEMPTS: Final = 11


def temperature(step: Floats) -> Floats:
    """Return T(k)."""
    return START_TEMPERATURE * np.exp(-COOLING * np.asarray(step, float) ** (1.0 / DIMENSIONS))


def jump_share(uniform: Floats, temperature: Floats) -> Floats:
    """Return the share of the largest jump, in [-1, 1], for uniform numbers in [0, 1]."""
    u = np.asarray(uniform, float)
    size = temperature * np.expm1(np.abs(2 * u - 1) * np.log1p(1 / np.asarray(temperature, float)))
    return np.sign(u - 0.5) * size


def acceptance(rise: Floats, temperature: Floats) -> Floats:
    """Return the probability to accept a move that raises the energy by `rise` (mm of contact energy)."""
    return np.exp(-ENERGY_SCALE * np.maximum(rise, 0.0) / temperature)

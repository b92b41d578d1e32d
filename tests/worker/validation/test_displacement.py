"""The displacement test against free fall and rest."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from graspd.worker.grasps import Posture
from graspd.worker.validation.decomposition import ConvexPieces
from graspd.worker.validation.displacement import GRAVITY, STEPS, TIMESTEP_S, simulated_displacement_cm
from tests.worker.models import object_from_mesh
from tests.worker.quality.helpers import plate_hand, posture

BOX = object_from_mesh(trimesh.creation.box((0.06, 0.04, 0.05)))
WHOLE = ConvexPieces((BOX.hull_vertices,), 1.0, 0.0, "box")
HAND = plate_hand()


def test_object_without_a_hand_falls_freely() -> None:
    away = posture(((0, 0, 1.0), (0.0, 0.0)))
    # Symplectic Euler: the sum of n steps of growing velocity.
    fall = GRAVITY * TIMESTEP_S**2 * STEPS * (STEPS + 1) / 2
    assert simulated_displacement_cm(HAND, BOX, away, pieces=WHOLE)[0] == pytest.approx(100 * fall, rel=1e-6)


def test_object_on_a_plate_stays() -> None:
    # The hand turned so that its left plate's upper face lies under the box, at z = -0.025.
    turn = np.array([np.sqrt(0.5), 0, -np.sqrt(0.5), 0])
    under = Posture(np.array([[0, 0, -0.03 - 0.1, *turn]]), np.zeros((1, 2)))
    assert simulated_displacement_cm(HAND, BOX, under, pieces=WHOLE)[0] < 0.05


def test_pressed_plates_hold_better_than_none() -> None:
    rows = posture(((0, 0, 0), (0.0655, 0.0655)), ((0, 0, 0), (0.05, 0.05)))
    held, loose = simulated_displacement_cm(HAND, BOX, rows, pieces=WHOLE)
    assert held < 1.0 < 10.0 < loose

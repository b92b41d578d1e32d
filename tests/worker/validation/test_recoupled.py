"""Tendons read otherwise: drives of their own, and a fixed ratio."""

from __future__ import annotations

import dataclasses

import mujoco
import numpy as np
import pytest
import trimesh

from graspd.worker.hands.model import HandModel
from graspd.worker.hands.tendons import Tendon
from graspd.worker.validation.decomposition import ConvexPieces
from graspd.worker.validation.model import MujocoOptions
from graspd.worker.validation.variant import NOMINAL, Variant, couplings_of, nearest, recoupled
from graspd.worker.validation.varied import Models
from tests.worker.models import object_from_mesh, two_finger_hand

BOX = object_from_mesh(trimesh.creation.box((0.06, 0.04, 0.05)))
WHOLE = ConvexPieces((BOX.hull_vertices,), 1.0, 0.0, "box")


def tied(second: float = 1.0) -> HandModel:
    """Two fingers on one tendon."""
    hand = two_finger_hand()
    limits = {"lower": np.array([-0.3, -0.2]), "upper": np.array([1.2, 1.1]), "stiffness": np.array([10.0, 6.0])}
    return dataclasses.replace(hand, digest="2" * 32, tendons=(Tendon("both", (0, 1), (1.0, second)),), **limits)


def pressed(variant: Variant) -> tuple[float, float]:
    """Joints under 0.5 N m on the second one, commanded to 0.2 rad each."""
    scene = Models(tied(), BOX, WHOLE, MujocoOptions()).scene(variant)
    data = mujoco.MjData(scene.model)
    scene.place(data, np.array([0, 0, -0.5, 1.0, 0, 0, 0]), np.full(2, 0.2))
    data.qfrc_applied[scene.model.joint("joint2").dofadr[0]] = 0.5
    mujoco.mj_step(scene.model, data, nstep=1500)
    return float(data.joint("joint1").qpos[0]), float(data.joint("joint2").qpos[0])


def test_each_reading_moves_as_it_says() -> None:
    assert couplings_of(tied()) == ("separate", "ratio")
    first, second = pressed(NOMINAL)
    # A tendon holds the sum alone: the first joint runs to its limit, which gives some mrad, and the sum gives
    # 0.5 N m over 1 / (1 / 10 + 1 / 6) = 3.75 N m/rad.
    assert (first, second) == pytest.approx((-0.3, 0.4 + 0.5 / 3.75 + 0.3), abs=0.02)
    first, second = pressed(Variant(coupling="separate"))
    # Springs of 10 and 6 N m/rad of their own: 0.5 / 6 on the second.
    assert (first, second) == pytest.approx((0.2, 0.2 + 0.5 / 6), abs=2e-3)
    first, second = pressed(Variant(coupling="ratio"))
    # One joint of 16 N m/rad: both give 0.5 / 16, but for the coupling's own compliance.
    assert (first, second) == pytest.approx((0.2 + 0.5 / 16, 0.2 + 0.5 / 16), abs=5e-3)


def test_a_ratio_keeps_what_both_joints_can_do() -> None:
    hand = recoupled(tied(), "ratio")
    assert (hand.dofs, hand.tendons) == (1, ())
    assert (hand.lower[0], hand.upper[0]) == (-0.2, 1.1)
    assert hand.expand(np.array([0.4])) == pytest.approx([0.4, 0.4])
    assert nearest(hand, np.array([[0.1, 0.5]]))[0] == pytest.approx([0.3, 0.3])
    turned = recoupled(tied(-1.0), "ratio")
    assert turned.expand(np.array([0.15])) == pytest.approx([0.15, -0.15])
    assert (turned.lower[0], turned.upper[0]) == (-0.3, 0.2), "the second joint turns the other way"


def test_a_hand_without_tendons_is_itself() -> None:
    hand = two_finger_hand()
    assert recoupled(hand, "ratio") is hand is recoupled(hand, "separate")
    assert couplings_of(hand) == ()

"""BarrettHand BH8-280."""

from __future__ import annotations

import math
from typing import Any

from worker.hands.builtins.writer import UrdfWriter, Vector, box, cylinder

#: The distal joint turns one third as far as the medial one: both hang on one motor.
DISTAL_RATIO = 1 / 3
MEDIAL_MAX = 2.44


def barrett() -> tuple[str, dict[str, Any]]:
    """BarrettHand BH8-280: palm normal +z, closing negative; 8 joints on 4 motors, fingers 1 and 2 spread together."""
    hand = UrdfWriter("barrett")
    hand.link(
        "palm", 1.0,
        cylinder(0.045, 0.066, (0, 0, 0.033)),
        cylinder(0.015, 0.025, (0, -0.05, 0.0755), (0, math.pi / 2, 0)),
        box((0.026, 0.108, 0.026), (0, -0.011, 0.054)),
        box((0.076, 0.046, 0.014), (0, 0, 0.072)),
        box((0.026, 0.02, 0.01), (0, 0.032, 0.068), (-0.39, 0, 0)),
        box((0.026, 0.02, 0.01), (0, -0.035, 0.07), (-1.03, 0, 0)),
    )  # fmt: skip
    turn = (0.0, 0.0, -math.pi / 2)
    z = (0.0, 0.0, 1.0)
    for finger, x in ((1, 0.025), (2, -0.025)):
        hand.link(
            f"finger_{finger}_proximal_link", 0.1,
            cylinder(0.016, 0.026, (-0.05, 0, 0.032), (math.pi / 2, 0, 0)),
            box((0.07, 0.024, 0.026), (-0.029, 0, 0.012)),
            box((0.02, 0.026, 0.01), (-0.036, 0, 0.03), (0, 1.029, 0)),
        )  # fmt: skip
        limits = (-math.pi, 0.0) if finger == 1 else (0.0, math.pi)
        mimic = None if finger == 1 else ("finger_1_spread", -1.0)
        link = f"finger_{finger}_proximal_link"
        hand.joint(
            f"finger_{finger}_spread", "palm", link, (x, 0, 0.0415), z, limits, rpy=turn, effort=2.0, mimic=mimic
        )
        _outer_finger(hand, finger, link, (-0.05, 0, 0.0339), (math.pi / 2, 0, 0))
    _outer_finger(hand, 3, "palm", (0, -0.05, 0.0754), (math.pi / 2, 0, math.pi / 2))
    medial = [f"finger_{finger}_medial" for finger in (1, 2, 3)]
    return hand.text(), {
        "description": "BarrettHand BH8-280 of primitives: 3 fingers, 8 joints, 4 degrees of freedom.",
        "palm": {"link": "palm", "centre": [0.0, 0.0, 0.079], "approach": [0.0, 0.0, 1.0]},
        "fingertips": [f"finger_{finger}_distal_link" for finger in (1, 2, 3)],
        "preshape": {"finger_1_spread": -0.5} | dict.fromkeys(medial, -0.7),
        "closing": {"finger_1_spread": 0} | dict.fromkeys(medial, -1),
        "effort": 2.0,
        "stiffness": 5.0,
    }


def _outer_finger(hand: UrdfWriter, finger: int, parent: str, xyz: Vector, rpy: Vector) -> None:
    medial, distal = f"finger_{finger}_medial_link", f"finger_{finger}_distal_link"
    z = (0.0, 0.0, 1.0)
    hand.link(
        medial, 0.1,
        box((0.036, 0.024, 0.018), (-0.04, 0.003, 0.001)),
        box((0.032, 0.022, 0.01), (-0.006, 0.001, 0.001)),
        box((0.02, 0.022, 0.01), (-0.068, 0.003, 0.001)),
        box((0.008, 0.022, 0.018), (-0.019, 0.001, 0.001)),
    )  # fmt: skip
    hand.link(
        distal, 0.1,
        box((0.014, 0.038, 0.02), (-0.022, 0.023, 0), (0, 0, 0.899)),
        box((0.018, 0.022, 0.02), (-0.002, 0.002, 0), (0, 0, 0.777)),
        box((0.012, 0.012, 0.02), (-0.038, 0.034, 0), (0, 0, 1.614)),
    )  # fmt: skip
    # Fingers 1 and 2 end at y = 3.0 and 3.4 mm in the maker's data; one value serves all three.
    hand.joint(f"finger_{finger}_medial", parent, medial, xyz, z, (-MEDIAL_MAX, 0), rpy=rpy, effort=2.0)
    hand.joint(
        f"finger_{finger}_distal", medial, distal, (-0.069936, 0.003, 0), z, (-MEDIAL_MAX * DISTAL_RATIO, 0),
        effort=2.0, mimic=(f"finger_{finger}_medial", DISTAL_RATIO),
    )  # fmt: skip

"""Shadow Dexterous Hand E, right, from the palm on."""

from __future__ import annotations

import math
from typing import Any, Final

from worker.hands.builtins.writer import ZERO, UrdfWriter, Vector, box, capsule, cylinder, sphere

X: Final[Vector] = (1.0, 0.0, 0.0)
Y: Final[Vector] = (0.0, 1.0, 0.0)
MINUS_Y: Final[Vector] = (0.0, -1.0, 0.0)
SPREAD: Final = (-0.349065850, 0.349065850)
KNUCKLE: Final = (-0.261799388, math.pi / 2)
FLEX: Final = (0.0, math.pi / 2)
METACARPAL_TURN: Final = 0.959931089


def shadow() -> tuple[str, dict[str, Any]]:
    """Shadow Dexterous Hand E: palm normal -y, fingers +z, thumb toward +x; 22 joints, 18 drives.

    One tendon drives the two outer joints of each finger, J1 + J2; on approach they are bent alike, as a free finger's.
    """
    hand = UrdfWriter("shadow")
    hand.link(
        "palm", 0.3,
        box((0.062, 0.007, 0.090), (0.011, 0.0085, 0.042)),
        box((0.036, 0.017, 0.090), (-0.002, -0.0035, 0.042)),
        box((0.026, 0.017, 0.010), (0.029, -0.0035, 0.082)),
        box((0.026, 0.014, 0.018), (0.0265, -0.001, 0.07), (0.2, 0, 0.25)),
        box((0.021, 0.027, 0.016), (0.0315, -0.0085, 0.005)),
        box((0.022, 0.005, 0.032), (0.0125, -0.015, 0.013), (0, 0, -0.48)),
        box((0.018, 0.024, 0.004), (0.011, 0, 0.089)),
        box((0.020, 0.024, 0.032), (-0.03, 0, 0.013)),
    )  # fmt: skip
    _finger(hand, "FF", "palm", (0.033, 0, 0.095), ZERO, MINUS_Y)
    _finger(hand, "MF", "palm", (0.011, 0, 0.099), ZERO, MINUS_Y)
    _finger(hand, "RF", "palm", (-0.011, 0, 0.095), ZERO, Y)
    hand.link("LF_metacarpal", 0.03, box((0.018, 0.024, 0.040), (0.027, 0, 0.019), (0, METACARPAL_TURN, 0)))
    base = (-0.033, 0.0, 0.02071)
    hand.joint("LFJ5", "palm", "LF_metacarpal", base, X, (0.0, math.pi / 4), rpy=(0, -METACARPAL_TURN, 0), effort=2.0)
    _finger(hand, "LF", "LF_metacarpal", (0.053973, 0, 0.037795), (0, METACARPAL_TURN, 0), Y)
    _thumb(hand)
    fingers = ("FF", "MF", "RF", "LF")
    preshape = {f"{f}J3": 0.3 for f in fingers} | {f"{f}J{k}": 0.35 for f in fingers for k in (2, 1)}
    preshape |= {"THJ5": 0.3, "THJ4": 1.1, "THJ3": 0.0, "THJ2": 0.0, "THJ1": 0.25}
    closing = {f"{f}J4": 0 for f in fingers} | {f"{f}J{k}": 1 for f in fingers for k in (3, 2, 1)}
    closing |= {"LFJ5": 0, "THJ5": 0, "THJ4": 0, "THJ3": 0, "THJ2": 1, "THJ1": 1}
    return hand.text(), {
        "description": "Shadow Dexterous Hand E, right, of primitives, without wrist: 5 fingers, 22 joints, 18 drives.",
        "palm": {"link": "palm", "centre": [0.0, -0.012, 0.06], "approach": [0.0, -1.0, 0.0]},
        "fingertips": [f"{f}_distal" for f in (*fingers, "TH")],
        "tendons": {f"{f}J0": {f"{f}J2": 1.0, f"{f}J1": 1.0} for f in fingers},
        "preshape": preshape,
        "closing": closing,
        "stiffness": 5.0,
    }


def _finger(hand: UrdfWriter, name: str, parent: str, xyz: Vector, rpy: Vector, spread_axis: Vector) -> None:
    hand.link(f"{name}_knuckle", 0.008, box((0.012, 0.016, 0.016), ZERO))
    hand.link(f"{name}_proximal", 0.030, cylinder(0.007, 0.040, (0, 0, 0.025)))
    hand.link(f"{name}_middle", 0.017, capsule(0.007, 0.025, (0, 0, 0.0125)))
    hand.link(f"{name}_distal", 0.012, capsule(0.0075, 0.0185, (0, 0, 0.01525)))
    hand.joint(f"{name}J4", parent, f"{name}_knuckle", xyz, spread_axis, SPREAD, rpy=rpy, effort=2.0)
    hand.joint(f"{name}J3", f"{name}_knuckle", f"{name}_proximal", ZERO, X, KNUCKLE, effort=2.0)
    hand.joint(f"{name}J2", f"{name}_proximal", f"{name}_middle", (0, 0, 0.045), X, FLEX, effort=2.0)
    hand.joint(f"{name}J1", f"{name}_middle", f"{name}_distal", (0, 0, 0.025), X, FLEX, effort=2.0)


def _thumb(hand: UrdfWriter) -> None:
    hand.link("TH_base", 0.010, sphere(0.011, ZERO))
    hand.link("TH_proximal", 0.040, capsule(0.013, 0.016, (0, 0, 0.009)))
    hand.link("TH_hub", 0.005, sphere(0.010, ZERO))
    hand.link("TH_middle", 0.020, capsule(0.010, 0.012, (0, 0, 0.025)))
    hand.link("TH_distal", 0.016, capsule(0.0095, 0.0127, (0, 0, 0.01915)))
    turn = (-math.pi / 4, 0.0, -math.pi / 2)
    limit = 1.047197551
    hand.joint("THJ5", "palm", "TH_base", (0.034, -0.00858, 0.029), (0, 0, -1), (-limit, limit), rpy=turn, effort=4.0)
    hand.joint("THJ4", "TH_base", "TH_proximal", ZERO, Y, (0.0, 1.221730476), effort=3.0)
    hand.joint("THJ3", "TH_proximal", "TH_hub", (0, 0, 0.038), Y, (-0.209439510, 0.209439510), effort=2.0)
    hand.joint("THJ2", "TH_hub", "TH_middle", ZERO, X, (-0.698131701, 0.698131701), effort=2.0)
    hand.joint("THJ1", "TH_middle", "TH_distal", (0, 0, 0.032), X, KNUCKLE, effort=1.0)

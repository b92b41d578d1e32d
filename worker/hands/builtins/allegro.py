"""Wonik Allegro Hand, right."""

from __future__ import annotations

from typing import Any

from worker.hands.builtins.writer import UrdfWriter, Vector, box, sphere


def allegro() -> tuple[str, dict[str, Any]]:
    """Wonik Allegro Hand, right: palm normal +x, fingers +z, index toward +y; 16 joints."""
    hand = UrdfWriter("allegro")
    hand.link(
        "palm", 0.4154,
        box((0.0414, 0.112, 0.0448), (-0.009, 0, -0.023)),
        box((0.0414, 0.0538, 0.0428), (-0.009, -0.0253, -0.0667)),
        box((0.0414, 0.072, 0.013), (-0.0093, -0.00557, -0.08874)),
    )  # fmt: skip
    bases = {
        "index": ((0.0, 0.0435, -0.001542), -0.087266),
        "middle": ((0.0, 0.0, 0.0007), 0.0),
        "ring": ((0.0, -0.0435, -0.001542), 0.087266),
    }
    for finger, (xyz, roll) in bases.items():
        _allegro_finger(hand, finger, xyz, roll)
    _allegro_thumb(hand)
    fingers = (*bases, "thumb")
    flexed = {"proximal": 0.35, "middle": 0.35, "distal": 0.25}
    preshape = {f"{f}_{part}": value for f in bases for part, value in flexed.items()}
    preshape |= {"thumb_rotation": 1.2, "thumb_proximal": 0.3, "thumb_middle": 0.3, "thumb_distal": 0.3}
    closing = {f"{f}_{part}": 1 for f in fingers for part in flexed}
    closing |= {f"{f}_abduction": 0 for f in bases} | {"thumb_rotation": 0}
    return hand.text(), {
        "description": "Wonik Allegro Hand, right, of primitives: 4 fingers, 16 degrees of freedom.",
        "palm": {"link": "palm", "centre": [0.012, 0.0, -0.015], "approach": [1.0, 0.0, 0.0]},
        "fingertips": [f"{f}_tip" for f in fingers],
        "preshape": preshape,
        "closing": closing,
        "effort": 0.7,
        "stiffness": 5.0,
    }


def _allegro_finger(hand: UrdfWriter, name: str, xyz: Vector, roll: float) -> None:
    width, depth = 0.0196, 0.0275
    hand.link(f"{name}_base", 0.0119, box((width, depth, 0.0164), (0, 0, 0.0082)))
    hand.link(f"{name}_proximal_link", 0.065, box((width, depth, 0.054), (0, 0, 0.027)))
    hand.link(f"{name}_middle_link", 0.0355, box((width, depth, 0.0384), (0, 0, 0.0192)))
    hand.link(f"{name}_distal_link", 0.03, box((width, 0.0269, 0.022), (0, 0, 0.0047)))
    hand.link(f"{name}_tip", 0.0168, sphere(0.012, (0, 0, -0.012)))
    y = (0.0, 1.0, 0.0)
    hand.joint(f"{name}_abduction", "palm", f"{name}_base", xyz, (0, 0, 1), (-0.47, 0.47), rpy=(roll, 0, 0))
    hand.joint(f"{name}_proximal", f"{name}_base", f"{name}_proximal_link", (0, 0, 0.0164), y, (-0.196, 1.61))
    hand.joint(f"{name}_middle", f"{name}_proximal_link", f"{name}_middle_link", (0, 0, 0.054), y, (-0.174, 1.709))
    hand.joint(f"{name}_distal", f"{name}_middle_link", f"{name}_distal_link", (0, 0, 0.0384), y, (-0.227, 1.618))
    hand.joint(f"{name}_tip_joint", f"{name}_distal_link", f"{name}_tip", (0, 0, 0.0387))


def _allegro_thumb(hand: UrdfWriter) -> None:
    hand.link("thumb_base", 0.0176, box((0.0358, 0.034, 0.0455), (-0.0179, 0.009, 0.0145)))
    hand.link("thumb_swivel", 0.0119, box((0.0196, 0.0275, 0.0177), (0, 0, 0.00885)))
    hand.link("thumb_middle_link", 0.038, box((0.0196, 0.0275, 0.0514), (0, 0, 0.0257)))
    hand.link("thumb_distal_link", 0.0388, box((0.0196, 0.0269, 0.04), (0, 0, 0.01125)))
    hand.link("thumb_tip", 0.0168, sphere(0.012, (0, 0, -0.012)))
    turn = (0.0, -1.65806278845, -1.5707963259)
    base = (-0.0182, 0.019333, -0.045987)
    y = (0.0, 1.0, 0.0)
    hand.joint("thumb_rotation", "palm", "thumb_base", base, (-1, 0, 0), (0.263, 1.396), rpy=turn)
    hand.joint("thumb_proximal", "thumb_base", "thumb_swivel", (-0.027, 0.005, 0.0399), (0, 0, 1), (-0.105, 1.163))
    hand.joint("thumb_middle", "thumb_swivel", "thumb_middle_link", (0, 0, 0.0177), y, (-0.189, 1.644))
    hand.joint("thumb_distal", "thumb_middle_link", "thumb_distal_link", (0, 0, 0.0514), y, (-0.162, 1.719))
    hand.joint("thumb_tip_joint", "thumb_distal_link", "thumb_tip", (0, 0, 0.0543))

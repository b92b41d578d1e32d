"""The built-in hands, written from published kinematic facts as URDFs of primitives.

``python -m graspd.worker.hands.builtins`` writes them into `service/builtin/hands/`. Frames and numbers follow the
makers' data: Wonik Allegro Hand (right), Barrett BH8-280, Shadow Dexterous Hand E (right, without forearm and wrist).
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final
from xml.sax.saxutils import quoteattr


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


#: The distal joint turns one third as far as the medial one: one motor drives both.
DISTAL_RATIO = 1 / 3
MEDIAL_MAX = 2.44


def barrett() -> tuple[str, dict[str, Any]]:
    """BarrettHand BH8-280: palm normal +z, closing negative; 8 joints, 4 motors, one to spread fingers."""
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
    # Fingers 1 and 2 end at y = 3.0 and 3.4 mm in the manufacturer's data; one value serves all three.
    hand.joint(f"finger_{finger}_medial", parent, medial, xyz, z, (-MEDIAL_MAX, 0), rpy=rpy, effort=2.0)
    hand.joint(
        f"finger_{finger}_distal",
        medial,
        distal,
        (-0.069936, 0.003, 0),
        z,
        (-MEDIAL_MAX * DISTAL_RATIO, 0),
        effort=2.0,
        mimic=(f"finger_{finger}_medial", DISTAL_RATIO),
    )


Vector = tuple[float, float, float]

X: Final[Vector] = (1.0, 0.0, 0.0)
Y: Final[Vector] = (0.0, 1.0, 0.0)
MINUS_Y: Final[Vector] = (0.0, -1.0, 0.0)
SPREAD: Final = (-0.349065850, 0.349065850)
KNUCKLE: Final = (-0.261799388, math.pi / 2)
FLEX: Final = (0.0, math.pi / 2)
METACARPAL_TURN: Final = 0.959931089


def shadow() -> tuple[str, dict[str, Any]]:
    """Shadow Dexterous Hand E: palm normal -y, fingers +z, thumb toward +x; 22 joints, 18 drives.

    One tendon drives the two outer joints of each finger, J1 + J2; on approach both bend equally, as in a free finger.
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


ZERO: Final[Vector] = (0.0, 0.0, 0.0)


class UrdfWriter:
    """Writer of a URDF, link by link."""

    def __init__(self, name: str) -> None:
        self._lines = ['<?xml version="1.0"?>', f"<robot name={quoteattr(name)}>"]

    def link(self, name: str, mass: float, *shapes: str) -> None:
        """Add a link of `mass` [kg] with collision shapes made by `box`, `cylinder`, `sphere` or `capsule`."""
        self._lines.append(f"  <link name={quoteattr(name)}>")
        if mass:
            self._lines.append(
                f'    <inertial><mass value="{mass:g}"/><inertia ixx="1e-5" ixy="0" ixz="0" iyy="1e-5" iyz="0" '
                'izz="1e-5"/></inertial>'
            )
        self._lines += [f"    <collision>{shape}</collision>" for shape in shapes]
        self._lines.append("  </link>")

    def joint(
        self,
        name: str,
        parent: str,
        child: str,
        xyz: Vector,
        axis: Vector = ZERO,
        limits: tuple[float, float] = (0.0, 0.0),
        *,
        rpy: Vector = ZERO,
        effort: float = 0.7,
        mimic: tuple[str, float] | None = None,
    ) -> None:
        """Add a revolute joint, or a fixed one if no axis is given."""
        kind = "revolute" if any(axis) else "fixed"
        self._lines.append(f'  <joint name={quoteattr(name)} type="{kind}">')
        self._lines.append(f"    <parent link={quoteattr(parent)}/><child link={quoteattr(child)}/>{origin(xyz, rpy)}")
        if kind == "revolute":
            self._lines.append(
                f'    <axis xyz="{numbers(axis)}"/><limit lower="{limits[0]:.9g}" upper="{limits[1]:.9g}" '
                f'effort="{effort:g}" velocity="6"/>'
            )
        if mimic:
            self._lines.append(f'    <mimic joint={quoteattr(mimic[0])} multiplier="{mimic[1]:.9g}" offset="0"/>')
        self._lines.append("  </joint>")

    def text(self) -> str:
        """Return the whole file."""
        return "\n".join([*self._lines, "</robot>", ""])


def box(size: Vector, xyz: Vector, rpy: Vector = ZERO) -> str:
    """Return a collision box of full extents `size` [m]."""
    return f'{origin(xyz, rpy)}<geometry><box size="{numbers(size)}"/></geometry>'


def cylinder(radius: float, length: float, xyz: Vector, rpy: Vector = ZERO) -> str:
    """Return a collision cylinder along its z [m]."""
    return f'{origin(xyz, rpy)}<geometry><cylinder radius="{radius:g}" length="{length:g}"/></geometry>'


def capsule(radius: float, length: float, xyz: Vector, rpy: Vector = ZERO) -> str:
    """Return a collision capsule along its z; `length` [m] excludes the caps."""
    return f'{origin(xyz, rpy)}<geometry><capsule radius="{radius:g}" length="{length:g}"/></geometry>'


def sphere(radius: float, xyz: Vector) -> str:
    """Return a collision sphere [m]."""
    return f'{origin(xyz, ZERO)}<geometry><sphere radius="{radius:g}"/></geometry>'


def numbers(values: Vector) -> str:
    return " ".join(f"{value:.9g}" for value in values)


def origin(xyz: Vector, rpy: Vector) -> str:
    turn = f' rpy="{numbers(rpy)}"' if any(rpy) else ""
    return f'<origin xyz="{numbers(xyz)}"{turn}/>'


HANDS: Final[dict[str, Callable[[], tuple[str, dict[str, Any]]]]] = {
    "allegro": allegro,
    "barrett": barrett,
    "shadow": shadow,
}


def files_of(name: str) -> dict[str, bytes]:
    """Return the files of a built-in hand as in `service/builtin/hands/NAME/`."""
    urdf, options = HANDS[name]()
    asset = {"file": f"{name}.urdf", **options}
    return {f"{name}.urdf": urdf.encode(), "asset.json": (json.dumps(asset, indent=2) + "\n").encode()}


def write(root: Path) -> None:
    """Write every built-in hand below `root`."""
    for name in HANDS:
        (root / name).mkdir(parents=True, exist_ok=True)
        for filename, data in files_of(name).items():
            (root / name / filename).write_bytes(data)


if __name__ == "__main__":
    write(Path(__file__).parents[2] / "service" / "builtin" / "hands")

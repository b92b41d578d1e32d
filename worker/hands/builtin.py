"""The built-in hands, written from published kinematic facts as URDFs of primitives.

``python -m worker.hands.builtin`` writes them into `service/builtin/hands/`. Frames and numbers follow the makers'
data: Wonik Allegro Hand (right), Barrett BH8-280, Shadow Dexterous Hand E (right, without forearm and wrist).
"""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final
from xml.sax.saxutils import quoteattr

Vector = tuple[float, float, float]
ZERO: Final[Vector] = (0.0, 0.0, 0.0)


class UrdfWriter:
    """Lines of a URDF, link by link."""

    def __init__(self, name: str) -> None:
        self._lines = ['<?xml version="1.0"?>', f"<robot name={quoteattr(name)}>"]

    def link(self, name: str, mass: float, *shapes: str) -> None:
        """A link of `mass` [kg] with collision shapes made by `box`, `cylinder`, `sphere` or `capsule`."""
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
        """A revolute joint, or a fixed one where no axis is given."""
        kind = "revolute" if any(axis) else "fixed"
        self._lines.append(f'  <joint name={quoteattr(name)} type="{kind}">')
        self._lines.append(f"    <parent link={quoteattr(parent)}/><child link={quoteattr(child)}/>{_origin(xyz, rpy)}")
        if kind == "revolute":
            self._lines.append(
                f'    <axis xyz="{_numbers(axis)}"/><limit lower="{limits[0]:.9g}" upper="{limits[1]:.9g}" '
                f'effort="{effort:g}" velocity="6"/>'
            )
        if mimic:
            self._lines.append(f'    <mimic joint={quoteattr(mimic[0])} multiplier="{mimic[1]:.9g}" offset="0"/>')
        self._lines.append("  </joint>")

    def text(self) -> str:
        """The whole file."""
        return "\n".join([*self._lines, "</robot>", ""])


def box(size: Vector, xyz: Vector, rpy: Vector = ZERO) -> str:
    """Collision box of full extents `size` [m]."""
    return f'{_origin(xyz, rpy)}<geometry><box size="{_numbers(size)}"/></geometry>'


def cylinder(radius: float, length: float, xyz: Vector, rpy: Vector = ZERO) -> str:
    """Collision cylinder along its z [m]."""
    return f'{_origin(xyz, rpy)}<geometry><cylinder radius="{radius:g}" length="{length:g}"/></geometry>'


def capsule(radius: float, length: float, xyz: Vector, rpy: Vector = ZERO) -> str:
    """Collision capsule along its z; `length` [m] is without the caps."""
    return f'{_origin(xyz, rpy)}<geometry><capsule radius="{radius:g}" length="{length:g}"/></geometry>'


def sphere(radius: float, xyz: Vector) -> str:
    """Collision sphere [m]."""
    return f'{_origin(xyz, ZERO)}<geometry><sphere radius="{radius:g}"/></geometry>'


def _numbers(values: Vector) -> str:
    return " ".join(f"{value:.9g}" for value in values)


def _origin(xyz: Vector, rpy: Vector) -> str:
    turn = f' rpy="{_numbers(rpy)}"' if any(rpy) else ""
    return f'<origin xyz="{_numbers(xyz)}"{turn}/>'


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


HANDS: Final[dict[str, Callable[[], tuple[str, dict[str, Any]]]]] = {"allegro": allegro}


def files_of(name: str) -> dict[str, bytes]:
    """The files of a built-in hand as they stand in `service/builtin/hands/NAME/`."""
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

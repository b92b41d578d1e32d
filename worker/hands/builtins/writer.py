"""Lines of a URDF: what the built-in hands are written with."""

from __future__ import annotations

from typing import Final
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
        """The whole file."""
        return "\n".join([*self._lines, "</robot>", ""])


def box(size: Vector, xyz: Vector, rpy: Vector = ZERO) -> str:
    """Collision box of full extents `size` [m]."""
    return f'{origin(xyz, rpy)}<geometry><box size="{numbers(size)}"/></geometry>'


def cylinder(radius: float, length: float, xyz: Vector, rpy: Vector = ZERO) -> str:
    """Collision cylinder along its z [m]."""
    return f'{origin(xyz, rpy)}<geometry><cylinder radius="{radius:g}" length="{length:g}"/></geometry>'


def capsule(radius: float, length: float, xyz: Vector, rpy: Vector = ZERO) -> str:
    """Collision capsule along its z; `length` [m] is without the caps."""
    return f'{origin(xyz, rpy)}<geometry><capsule radius="{radius:g}" length="{length:g}"/></geometry>'


def sphere(radius: float, xyz: Vector) -> str:
    """Collision sphere [m]."""
    return f'{origin(xyz, ZERO)}<geometry><sphere radius="{radius:g}"/></geometry>'


def numbers(values: Vector) -> str:
    return " ".join(f"{value:.9g}" for value in values)


def origin(xyz: Vector, rpy: Vector) -> str:
    turn = f' rpy="{numbers(rpy)}"' if any(rpy) else ""
    return f'<origin xyz="{numbers(xyz)}"{turn}/>'

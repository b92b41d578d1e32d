"""A six-joint arm of cylinders and boxes, shaped like the common ones: reach 0.85 m, a spherical wrist."""

from pathlib import Path

#: Joint: parent offset [m], axis, limits [rad], velocity [rad/s]; link: radius and length of its cylinder [m].
JOINTS = [
    ("pan", (0, 0, 0.10), "0 0 1", 3.1, 2.0, 0.06, 0.10),
    ("shoulder", (0, 0, 0.15), "0 1 0", 2.2, 2.0, 0.05, 0.32),
    ("elbow", (0, 0, 0.40), "0 1 0", 2.7, 2.0, 0.045, 0.28),
    ("roll", (0, 0, 0.34), "0 0 1", 3.1, 3.0, 0.04, 0.05),
    ("bend", (0, 0, 0.05), "0 1 0", 2.2, 3.0, 0.04, 0.05),
    ("turn", (0, 0, 0.07), "0 0 1", 3.1, 3.0, 0.035, 0.02),
]


def write_arm(folder: Path, *, velocities: bool = True, scale: float = 1.0) -> Path:
    lines = ['<robot name="six">', _link("base", 0.07, 0.08, -0.04)]
    parent = "base"
    for name, offset, axis, limit, velocity, radius, length in JOINTS:
        x, y, z = (scale * part for part in offset)
        lines.append(_link(f"{name}_link", radius, scale * length, scale * length / 2))
        speed = f' velocity="{velocity}"' if velocities else ""
        lines.append(
            f'<joint name="{name}" type="revolute"><parent link="{parent}"/><child link="{name}_link"/>'
            f'<origin xyz="{x} {y} {z}"/><axis xyz="{axis}"/>'
            f'<limit lower="{-limit}" upper="{limit}" effort="50"{speed}/></joint>'
        )
        parent = f"{name}_link"
    lines.append('<link name="flange"/>')
    lines.append(
        f'<joint name="to_flange" type="fixed"><parent link="{parent}"/><child link="flange"/>'
        '<origin xyz="0 0 0.03"/></joint>'
    )
    lines.append(_link("gripper", 0.03, 0.1, 0.05))
    lines.append(
        '<joint name="grip" type="prismatic"><parent link="flange"/><child link="gripper"/><axis xyz="0 0 1"/>'
        '<limit lower="0" upper="0.02" effort="10"/></joint>'
    )
    lines.append("</robot>")
    file = folder / "six.urdf"
    file.write_text("\n".join(lines))
    return file


def _link(name: str, radius: float, length: float, middle: float) -> str:
    return (
        f'<link name="{name}"><collision><origin xyz="0 0 {middle}"/><geometry>'
        f'<cylinder radius="{radius}" length="{length}"/></geometry></collision></link>'
    )

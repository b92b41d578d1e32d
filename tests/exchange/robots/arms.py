"""A six-joint arm of cylinders and boxes, shaped like the common ones: reach 0.85 m, a spherical wrist."""

import csv
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


def write_arm(folder: Path, *, velocities: bool = True) -> Path:
    parts, parent = [_link("base", 0.07, 0.08, -0.04)], "base"
    for name, (x, y, z), axis, limit, velocity, radius, length in JOINTS:
        speed = f' velocity="{velocity}"' if velocities else ""
        limits = f'<limit lower="{-limit}" upper="{limit}" effort="50"{speed}/>'
        place = f'<origin xyz="{x} {y} {z}"/><axis xyz="{axis}"/>{limits}'
        parts += [_link(f"{name}_link", radius, length, length / 2), _joint(name, "revolute", parent, place)]
        parent = f"{name}_link"
    parts += ['<link name="flange"/>', _joint("flange", "fixed", parent, '<origin xyz="0 0 0.03"/>')]
    slides = '<axis xyz="0 0 1"/><limit lower="0" upper="0.02" effort="10"/>'
    parts += [_link("gripper", 0.03, 0.1, 0.05), _joint("gripper", "prismatic", "flange", slides)]
    file = folder / "six.urdf"
    file.write_text('<robot name="six">' + "".join(parts) + "</robot>")
    return file


def _joint(name: str, kind: str, parent: str, rest: str) -> str:
    child = name if kind != "revolute" else f"{name}_link"
    return f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>{rest}</joint>'


def _link(name: str, radius: float, length: float, middle: float) -> str:
    solid = f'<geometry><cylinder radius="{radius}" length="{length}"/></geometry>'
    return f'<link name="{name}"><collision><origin xyz="0 0 {middle}"/>{solid}</collision></link>'


def rows(folder: Path, table: str = "trajectories") -> list[dict[str, str]]:
    return list(csv.DictReader((folder / f"{table}.csv").read_text().splitlines()))

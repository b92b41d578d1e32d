"""Small hands for tests, and a parallel gripper: a housing and two box fingers that slide along x."""

from collections.abc import Mapping

from graspd.worker.hands.check import check_hand
from graspd.worker.hands.load import load_hand
from graspd.worker.hands.model import HandModel

BOX = '<collision><origin xyz="0 0 0.02"/><geometry><box size="0.02 0.02 0.04"/></geometry></collision>'
#: Opening [m], and what is left between the pads when closed.
OPENING, CLOSED = 0.080, 0.0
_HOUSING = '<collision><origin xyz="0 0 0.03"/><geometry><box size="0.14 0.06 0.06"/></geometry></collision>'
#: A finger weighs with its carriage: MuJoCo's contacts are as stiff as what they move is heavy.
_MASS = '<inertial><mass value="0.2"/></inertial>'
_FINGER = '<collision><origin xyz="{x} 0 0.05"/><geometry><box size="0.01 0.02 0.04"/></geometry></collision>'


def link(name: str, body: str = BOX) -> str:
    return f'<link name="{name}">{body}</link>'


def limits(lower: float, upper: float) -> str:
    return f'<limit lower="{lower}" upper="{upper}" effort="1" velocity="2"/>'


def joint(
    name: str,
    parent: str,
    child: str,
    *,
    kind: str = "revolute",
    extra: str = "",
    limit: str = "",
    origin: str = "0 0 0.04",
    axis: str = "0 1 0",
) -> str:
    return (
        f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
        f'<origin xyz="{origin}"/><axis xyz="{axis}"/>{limit or limits(0, 1.5)}{extra}</joint>'
    )


def robot(*parts: str) -> bytes:
    return ('<robot name="test">' + "".join(parts) + "</robot>").encode()


def load(urdf: bytes, **options) -> HandModel:
    return load_hand({"h.urdf": urdf}, name="h", digest="0" * 32, options=options)


def report(urdf: bytes, **options) -> dict:
    return check_hand({"h.urdf": urdf}, "h", options)


def chain(*joints: str, links: str = "abc") -> bytes:
    """Palm and links a, b, c with the given joints."""
    return robot(link("palm"), *(link(name) for name in links), *joints)


def gripper_urdf(*, zero_is_open: bool = False, coupled: bool = True, effort: float | None = 20.0) -> bytes:
    """Its files: joints at 0 are closed or open, one dof drives both fingers or each its own."""
    inner = 0.045 if zero_is_open else 0.005
    low, high = (-0.04, 0.0) if zero_is_open else (0.0, 0.04)
    force = f'effort="{effort}"' if effort is not None else ""
    parts = [f'<link name="palm">{_HOUSING}</link>']
    for name, side in (("right", 1), ("left", -1)):
        parts.append(f'<link name="{name}">{_MASS}{_FINGER.format(x=side * inner)}</link>')
        mimic = '<mimic joint="right_slide"/>' if coupled and name == "left" else ""
        parts.append(
            f'<joint name="{name}_slide" type="prismatic"><parent link="palm"/><child link="{name}"/>'
            f'<origin xyz="0 0 0.04"/><axis xyz="{side} 0 0"/>'
            f'<limit lower="{low}" upper="{high}" velocity="1" {force}/>{mimic}</joint>'
        )
    return f'<robot name="gripper">{"".join(parts)}</robot>'.encode()


def gripper(options: Mapping[str, object] | None = None, **kwargs: object) -> HandModel:
    files = {"gripper.urdf": gripper_urdf(**kwargs)}  # type: ignore[arg-type]
    return load_hand(files, name="gripper", digest="0" * 32, options=options)

"""Small hands for tests."""

from graspd.worker.hands.check import check_hand
from graspd.worker.hands.load import load_hand
from graspd.worker.hands.model import HandModel

BOX = '<collision><origin xyz="0 0 0.02"/><geometry><box size="0.02 0.02 0.04"/></geometry></collision>'


def link(name: str, body: str = BOX) -> str:
    return f'<link name="{name}">{body}</link>'


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
    limit = limit or '<limit lower="0" upper="1.5" effort="1" velocity="2"/>'
    return (
        f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
        f'<origin xyz="{origin}"/><axis xyz="{axis}"/>{limit}{extra}</joint>'
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

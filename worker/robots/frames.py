"""Frames that a user names: poses written as seven numbers, and the tool frame of a hand."""

from __future__ import annotations

import difflib
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from service.model.errors import InputError
from service.model.transforms import IDENTITY_POSE, Floats

#: How far a quaternion may be from length 1 before it is taken for a mistake.
_SLACK = 1e-2


@dataclass(frozen=True)
class ToolFrame:
    """A frame fixed to the hand's root link: what is steered to a pose."""

    name: str
    pose: Floats
    """(7,) in the frame of the root link."""


def parse_pose(text: str, what: str) -> Floats:
    """(7,) from `x y z qw qx qy qz`, separated by spaces or commas [m, 1].

    Raises:
        InputError: not seven finite numbers, or no unit quaternion.
    """
    try:
        values = np.array([float(part) for part in text[:400].replace(",", " ").split()])
    except ValueError:
        values = np.zeros(0)
    if values.shape != (7,) or not np.isfinite(values).all():
        raise InputError(f"{what} {text[:80]!r} is no pose; give seven numbers: x y z qw qx qy qz")
    length = float(np.linalg.norm(values[3:]))
    if abs(length - 1.0) > _SLACK:
        raise InputError(f"{what}: the quaternion qw qx qy qz has length {length:.3g}; it must be 1")
    values[3:] /= length
    return values


def tool_frame(text: str | None, root_link: str, links: Mapping[str, tuple[int, Floats]]) -> ToolFrame:
    """The tool frame that a user names: a link that does not move with a finger, or a pose in the root link's frame.

    Args:
        text: a link's name or seven numbers; None: the root link itself.
        root_link: name of the hand's root link.
        links: body and pose of each link, see `Description`.

    Raises:
        InputError: there is no such link, it moves with a finger, or the numbers are no pose.
    """
    if not text or text == root_link:
        return ToolFrame(root_link, IDENTITY_POSE.copy())
    if text in links:
        body, pose = links[text]
        if body:
            raise InputError(f"the link {text!r} moves with a finger; a tool frame is fixed to {root_link!r}")
        return ToolFrame(text, np.array(pose, float))
    if _is_pose(text):
        return ToolFrame("tool", parse_pose(text, "--tool-frame"))
    still = [name for name, (body, _) in links.items() if body == 0]
    near = difflib.get_close_matches(text, links, 1)
    hint = f"; did you mean {near[0]!r}?" if near else ";"
    raise InputError(
        f"the hand has no link {text[:80]!r}{hint} fixed links: {', '.join(still[:8])}; or give a "
        "pose x y z qw qx qy qz"
    )


def _is_pose(text: str) -> bool:
    first = text.replace(",", " ").split()[:1]
    try:
        return bool(first) and np.isfinite(float(first[0]))
    except ValueError:
        return False

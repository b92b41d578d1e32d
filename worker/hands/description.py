"""What a hand's files say that planning does not need and robots do: frames of all links, and what is coupled there."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from service.model.transforms import Floats
from worker.hands.load import main_file
from worker.hands.options import parse_options
from worker.hands.read import read_robot
from worker.hands.tree import build_tree


@dataclass(frozen=True)
class Description:
    """Facts on a hand's links and joints."""

    links: Mapping[str, tuple[int, Floats]]
    """Each link below the root: its body, and its pose (7,) in the body's frame."""
    mimics: frozenset[str]
    """Joints that the description itself couples to others: whoever reads it moves them by itself."""


def describe(files: Mapping[str, bytes], options: Mapping[str, Any] | None = None) -> Description:
    """The description of a hand's files; see `load_hand`.

    Raises:
        HandError: the files describe no usable hand.
    """
    settings = parse_options(files, options)
    robot = read_robot(files, main_file(files, settings), settings.xacro)
    tree = build_tree(robot, settings)
    return Description(
        dict(tree.links), frozenset(name for name in tree.joint_names if robot.joints[name].mimic is not None)
    )

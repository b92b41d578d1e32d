"""A robot from its description, whatever format that is in."""

from __future__ import annotations

from collections.abc import Mapping

from worker.hands.robot import Robot
from worker.hands.urdf import read_urdf


def read_robot(files: Mapping[str, bytes], main: str) -> Robot:
    """Checked contents of the description called `main` among a hand's files.

    Raises:
        HandError, LimitError: see the readers.
    """
    return read_urdf(files[main], main)

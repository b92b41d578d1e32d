"""A robot from its description, whatever format that is in."""

from __future__ import annotations

from collections.abc import Mapping

from service.model.errors import HandError
from service.store.hand_files import format_of
from worker.hands.robot import Robot
from worker.hands.urdf import read_urdf
from worker.hands.xacro import expand
from worker.objects.stand_ins import refuse_stand_in


def read_robot(files: Mapping[str, bytes], main: str, arguments: Mapping[str, str] | None = None) -> Robot:
    """Checked contents of the description called `main` among a hand's files; its root element tells the format.

    Args:
        files: all files of the hand.
        main: the description.
        arguments: values of a xacro file's arguments.

    Raises:
        HandError, LimitError: see the readers.
    """
    refuse_stand_in(main, files[main], HandError)
    match format_of(main, files[main]):
        case "mjcf":
            from worker.hands.mjcf import read_mjcf

            return read_mjcf(files, main)
        case "xacro":
            return read_urdf(expand(files, main, arguments or {}), main)
        case _:
            return read_urdf(files[main], main)

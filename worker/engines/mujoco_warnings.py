"""MuJoCo's warnings: read where they void a result, kept out of the folder that a user happens to stand in.

When numbers blow up MuJoCo resets the state and goes on: an object that is back where it began looks held. And by
default each warning is appended to MUJOCO_LOG.TXT in the working folder.
"""

from __future__ import annotations

import logging
from typing import Any, Final

import mujoco

log = logging.getLogger(__name__)

#: A state that was reset, or contacts and constraints that were left out for want of memory.
_VOIDING: Final = [
    int(kind)
    for kind in (
        mujoco.mjtWarning.mjWARN_BADQPOS,
        mujoco.mjtWarning.mjWARN_BADQVEL,
        mujoco.mjtWarning.mjWARN_BADQACC,
        mujoco.mjtWarning.mjWARN_CONTACTFULL,
        mujoco.mjtWarning.mjWARN_CNSTRFULL,
    )
]
#: Room for the constraints of a hand that is deep in an object; it is taken from the system only as it is used [bytes].
ARENA: Final = 64 * 2**20


def void(data: Any) -> bool:
    """Whether a simulation since its last `mj_resetData` says nothing about its object."""
    return bool(data.warning.number[_VOIDING].any())


mujoco.set_mju_user_warning(lambda text: log.debug("MuJoCo: %s", text))

"""MuJoCo's warnings: detection of invalid results, and no log file in the working folder.

After a numerical divergence MuJoCo resets the state and continues: an object back at its initial pose would count as
held."""

import logging
from typing import Any, Final

import mujoco

log = logging.getLogger(__name__)

#: Warnings of a state reset, or of contacts and constraints dropped for lack of memory.
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
#: Memory for the constraints of a hand deep in an object [bytes]; the system allocates it only on use.
ARENA: Final = 64 * 2**20


def is_invalid(data: Any) -> bool:
    """Check whether a simulation since its last `mj_resetData` is invalid."""
    return bool(data.warning.number[_VOIDING].any())


mujoco.set_mju_user_warning(lambda text: log.debug("MuJoCo: %s", text))

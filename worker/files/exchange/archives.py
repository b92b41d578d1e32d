"""`.npz` files of others: arrays and nothing else, and no more than a stated amount."""

from __future__ import annotations

import zipfile
import zlib
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from service.model.errors import InputError
from service.model.refusals import why

#: Most that the members of a file may unpack to [bytes]; no file of grasps of one object comes near.
LARGEST: Final = 2**30
#: Most members.
_MEMBERS: Final = 1024


def load_npz(path: Path) -> dict[str, NDArray[Any]]:
    """The arrays of a `.npz` file.

    Raises:
        InputError: no such file, objects in it, or it unpacks to more than `LARGEST`.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            members = archive.infolist()
        # A member is never unpacked further than it says here.
        if len(members) > _MEMBERS or sum(member.file_size for member in members) > LARGEST:
            raise InputError(f"{path} unpacks to more than {LARGEST >> 20} MiB or to more than {_MEMBERS} arrays")
        with np.load(path, allow_pickle=False) as found:
            return {name: found[name] for name in found.files}
    except (OSError, ValueError, EOFError, KeyError, MemoryError, zipfile.BadZipFile, zlib.error) as error:
        raise InputError(f"{path} is no .npz file that can be read safely: {why(error)}") from None

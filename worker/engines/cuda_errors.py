"""What went wrong on a GPU: no memory for a launch, which a smaller one may mend; or a device that is lost.

After an illegal access, a reset or a bus error nothing runs any more in the CUDA context of a process. Warp only writes
a line to stderr and goes on with whatever lies in memory, so the device is waited for before results leave the process.
"""

from __future__ import annotations

import re
from typing import Final

from service.model.errors import GraspdError

#: How Warp and the driver say that memory is short on a GPU.
_NO_MEMORY: Final = re.compile(r"Failed to allocate \d+ bytes.*'cuda:\d+'|CUDA error 2\b|out of memory", re.DOTALL)


class DeviceLost(GraspdError):
    """A GPU does not work in this process any more; a fresh process may find it well."""

    slug, title = "device-lost", "A GPU does not work in this process any more"


def is_out_of_memory(error: BaseException) -> bool:
    """Whether work failed because the memory of a GPU did not suffice."""
    return isinstance(error, RuntimeError) and _NO_MEMORY.search(str(error)) is not None


def check_device(device: str) -> None:
    """Wait for what was launched on a device.

    Raises:
        DeviceLost: CUDA reports an error that its context does not outlive.
    """
    if not device.startswith("cuda"):
        return
    import warp as wp

    try:
        wp.synchronize_device(device)
    except RuntimeError as error:
        if not is_out_of_memory(error):
            raise DeviceLost(f"{error}; nothing runs there any more in this process") from error

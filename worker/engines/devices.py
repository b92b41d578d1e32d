"""Warp devices: their names, the GPU that a process takes where nobody names one, and errors of a GPU.

`CUDA_VISIBLE_DEVICES` says which there are: the driver shows no others. Of these, worker number k takes the k-th, round
and round; who has no number takes the one with the fewest processes. That is told by locks that the kernel drops with
the process, however it ends: lock n of a GPU is held by the n-th process on it. They lie in the user's cache, which the
containers of one machine share.

After an illegal access, a reset or a bus error nothing runs any more in the CUDA context of a process. Warp only writes
a line to stderr and goes on with whatever lies in memory, so the device is waited for before results leave the process.
"""

from __future__ import annotations

import fcntl
import logging
import platform
import re
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Final

from graspd.service import user_cache
from graspd.service.model.errors import GraspdError, InputError

log = logging.getLogger(__name__)
#: Processes on one GPU that are counted; more make no difference.
_MOST: Final = 64
#: Locks of this process, until it ends.
_held: list[IO[bytes]] = []


class Device:
    """A device by its Warp name, or `auto`, which is found out on the side: Warp takes most of a second to import."""

    def __init__(self, wanted: str, *, number: int | None = None) -> None:
        """`number` is that of a worker among those of its machine, see `take`.

        Raises InputError for a name that is none, or a CUDA device that is not there.
        """
        if not re.fullmatch(r"auto|cpu|cuda:\d+", wanted):
            raise InputError(f"there is no device {wanted!r}; use cpu, cuda:0 (or another number), or auto")
        self.wanted, self._number = wanted, number
        self.name = cpu_name() if wanted == "cpu" else ""
        self._resolved = "cpu" if wanted == "cpu" else ""
        self._lock = threading.Lock()
        if wanted.startswith("cuda"):
            self.resolve()

    def find_out(self, then: Callable[[], None]) -> None:
        """Resolve in a thread, then call back."""

        def work() -> None:
            self.resolve()
            then()

        threading.Thread(target=work, name="device", daemon=True).start()

    def resolve(self) -> str:
        """cpu, cuda:0, ... Waits until it is known."""
        with self._lock:
            if not self._resolved:
                self._resolved, self.name = _ask_warp(self.wanted, self._number)
            return self._resolved


def cpu_name() -> str:
    """Model name of the processor."""
    try:
        text = Path("/proc/cpuinfo").read_text()
    except OSError:
        return platform.processor() or platform.machine()
    found = re.search(r"^model name\s*:\s*(.+)$", text, re.MULTILINE)
    return found.group(1) if found else platform.machine()


def _ask_warp(wanted: str, number: int | None) -> tuple[str, str]:
    gpus = visible_gpus()
    if wanted == "cpu" or (wanted == "auto" and not gpus):
        return "cpu", cpu_name()
    if wanted != "auto":
        names = [gpu.name for gpu in gpus]
        if wanted not in names:
            raise InputError(f"Warp finds no device {wanted!r}; there are: {', '.join(['cpu', *names])}")
        gpus, number = [gpus[names.index(wanted)]], None
    gpu = take(gpus, user_cache.folder("gpus"), number=number)
    return gpu.name, gpu.model


def visible_gpus() -> list[Gpu]:
    """The GPUs that CUDA shows to this process."""
    import warp as wp

    from graspd.worker.engines import backend

    backend.start()
    return [Gpu(str(device), str(device.uuid), str(device.name)) for device in wp.get_cuda_devices()]


@dataclass(frozen=True)
class Gpu:
    """A GPU that this process can see."""

    name: str
    """Of Warp: cuda:0, ..."""
    id: str
    """The same for every process and container of the machine."""
    model: str = ""


def take(gpus: Sequence[Gpu], folder: Path, *, number: int | None = None) -> Gpu:
    """One of the GPUs, at least one of which is given: that of worker `number`, else one with the fewest processes.

    It counts as taken until this process ends. Without a folder that can be written it is the first.
    """
    eligible = [gpus[number % len(gpus)]] if number is not None else list(gpus)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for place in range(_MOST):
            for gpu in eligible:
                if _lock(folder / f"{re.sub(r'[^A-Za-z0-9-]', '_', gpu.id)}.{place}.lock"):
                    if place:
                        log.info("%s (%s) is shared by %d processes", gpu.name, gpu.model, place + 1)
                    return gpu
    except OSError as error:
        log.warning("GPUs are not told apart: no locks can be kept in %s (%s)", folder, error.strerror)
    return eligible[0]


def _lock(file: Path) -> bool:
    """Whether this process got the lock of a file. Raises OSError where locks cannot be had at all."""
    opened = file.open("ab")
    try:
        fcntl.flock(opened, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        opened.close()
        return False
    except OSError:
        opened.close()
        raise
    _held.append(opened)
    return True


#: How Warp and the driver say that memory is short on a GPU.
_NO_MEMORY: Final = re.compile(r"Failed to allocate \d+ bytes.*'cuda:\d+'|CUDA error 2\b|out of memory", re.DOTALL)


#: Held by whoever launches on a GPU that another thread may use too: a graph that one captures must not have launches
#: of another.
exclusive: Final = threading.RLock()


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

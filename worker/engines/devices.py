"""Warp devices: their names, the default GPU of a process, and GPU errors.

Worker number k takes the k-th GPU that `CUDA_VISIBLE_DEVICES` shows, cyclically; a process without a number the GPU
with the fewest processes. The n-th process on a GPU holds file lock n in the user's cache, which containers of one
machine share. The kernel releases locks at the end of a process.

After an illegal access, a reset or a bus error Warp writes a line to stderr and continues with undefined memory.
Results therefore leave the process only after synchronisation of the device."""

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
_MOST: Final = 64  # largest number of processes counted per GPU; more make no difference
_held: list[IO[bytes]] = []  # locks of this process, held until it ends


class Device:
    """Device by Warp name, or `auto`, resolved in the background: Warp takes most of a second to import."""

    def __init__(self, wanted: str, *, number: int | None = None) -> None:
        """`number`: index of a worker on its machine, see `select_gpu`.
        Raises InputError for an invalid name, or a CUDA device that does not exist."""
        if not re.fullmatch(r"auto|cpu|cuda:\d+", wanted):
            raise InputError(f"there is no device {wanted!r}; use cpu, cuda:0 (or another number), or auto")
        self.wanted, self._number = wanted, number
        self.name = cpu_name() if wanted == "cpu" else ""
        self._resolved = "cpu" if wanted == "cpu" else ""
        self._lock = threading.Lock()
        if wanted.startswith("cuda"):
            self.resolve()

    def start_resolving(self, then: Callable[[], None]) -> None:
        def work() -> None:
            self.resolve()
            then()

        threading.Thread(target=work, name="device", daemon=True).start()

    def resolve(self) -> str:
        """Wait until the device is resolved; return its name: cpu, cuda:0, ..."""
        with self._lock:
            if not self._resolved:
                self._resolved, self.name = _find_device(self.wanted, self._number)
            return self._resolved


def cpu_name() -> str:
    try:
        text = Path("/proc/cpuinfo").read_text()
    except OSError:
        return platform.processor() or platform.machine()
    found = re.search(r"^model name\s*:\s*(.+)$", text, re.MULTILINE)
    return found.group(1) if found else platform.machine()


def _find_device(wanted: str, number: int | None) -> tuple[str, str]:
    gpus = visible_gpus()
    if wanted == "cpu" or (wanted == "auto" and not gpus):
        return "cpu", cpu_name()
    if wanted != "auto":
        names = [gpu.name for gpu in gpus]
        if wanted not in names:
            raise InputError(f"Warp finds no device {wanted!r}; there are: {', '.join(['cpu', *names])}")
        gpus, number = [gpus[names.index(wanted)]], None
    gpu = select_gpu(gpus, user_cache.cache_folder("gpus"), number=number)
    return gpu.name, gpu.model


def visible_gpus() -> list[Gpu]:
    import warp as wp

    from graspd.worker.engines import backend

    backend.start_warp()
    return [Gpu(str(device), str(device.uuid), str(device.name)) for device in wp.get_cuda_devices()]


@dataclass(frozen=True)
class Gpu:
    name: str  # Warp name: cuda:0, ...
    id: str  # identifier common to all processes and containers of the machine
    model: str = ""


def select_gpu(gpus: Sequence[Gpu], folder: Path, *, number: int | None = None) -> Gpu:
    """Select one of the GPUs: that of worker `number`; if it is None, one with the fewest processes.
    The GPU counts as taken until this process ends. Without a writable folder, None selects the first GPU."""
    eligible = [gpus[number % len(gpus)]] if number is not None else list(gpus)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for place in range(_MOST):
            for gpu in eligible:
                if _try_lock(folder / f"{re.sub(r'[^A-Za-z0-9-]', '_', gpu.id)}.{place}.lock"):
                    if place:
                        log.info("%s (%s) is shared by %d processes", gpu.name, gpu.model, place + 1)
                    return gpu
    except OSError as error:
        log.warning("processes per GPU are not counted: no lock files can be made in %s (%s)", folder, error.strerror)
    return eligible[0]


def _try_lock(file: Path) -> bool:
    """Try to lock a file; return success. Raises OSError if locks are unavailable."""
    opened = file.open("ab")
    try:
        fcntl.flock(opened, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        opened.close()
        if isinstance(error, BlockingIOError):
            return False
        raise
    _held.append(opened)
    return True


#: Messages of Warp and the driver about insufficient GPU memory.
_NO_MEMORY: Final = re.compile(r"Failed to allocate \d+ bytes.*'cuda:\d+'|CUDA error 2\b|out of memory", re.DOTALL)
#: Held during a launch on a GPU that another thread may use: a graph under capture must contain no other launches.
exclusive: Final = threading.RLock()


class DeviceLost(GraspdError):
    """A GPU no longer works in this process; a fresh process may be able to use it."""

    slug, title = "device-lost", "A GPU does not work in this process any more"


def is_out_of_memory(error: BaseException) -> bool:
    return isinstance(error, RuntimeError) and _NO_MEMORY.search(str(error)) is not None


def check_device(device: str) -> None:
    """Wait for all launches on a device; raise DeviceLost on an error that its context does not survive."""
    if not device.startswith("cuda"):
        return
    import warp as wp

    try:
        wp.synchronize_device(device)
    except RuntimeError as error:
        if not is_out_of_memory(error):
            raise DeviceLost(f"{error}; nothing runs on this device any more in this process") from error

"""The Warp device of a worker, and what people call it."""

from __future__ import annotations

import platform
import re
import threading
from collections.abc import Callable
from pathlib import Path

from service import user_cache
from service.model.errors import InputError
from worker.engines.gpus import Gpu, take


class Device:
    """A device by its Warp name, or `auto`, which is found out on the side: Warp takes most of a second to import."""

    def __init__(self, wanted: str, *, number: int | None = None) -> None:
        """`number` is that of a worker among those of its machine, see `worker.engines.gpus`.

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

    from worker.engines import backend

    backend.start()
    return [Gpu(str(device), str(device.uuid), str(device.name)) for device in wp.get_cuda_devices()]

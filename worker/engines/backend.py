"""Quiet initialisation of Warp, its kernel cache, and ahead-of-time compilation of kernels.

A folder of precompiled kernels has the layout of Warp's cache, VERSION/MODULE/FILE. File names contain the digest of
the module's source and options, and the architecture. Kernels that do not match a machine are compiled as usual."""

import logging
import os
import pkgutil
import sys
import tempfile
import threading
from collections.abc import Iterable, Sequence
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any, Final

import warp as wp

from graspd.service import user_cache

_HARMLESS = b"Could not find or load the NVIDIA CUDA driver"
_lock = threading.Lock()
_started = False
log = logging.getLogger(__name__)


def _set_thread_defaults() -> None:
    """Give every thread its own default device, since Warp has one for the process.
    Otherwise a `ScopedDevice` would move another thread's arrays to its device. Warp offers no public API for this."""
    from warp._src.context import Runtime, runtime  # noqa: TID251

    first, own = runtime.default_device, threading.local()

    class Threaded(Runtime):  # type: ignore[misc]
        @property
        def default_device(self) -> Any:
            return getattr(own, "device", first)

        @default_device.setter
        def default_device(self, device: Any) -> None:
            own.device = device

    runtime.__class__ = Threaded


def start_warp() -> None:
    """Initialise Warp once, with warnings only; the note on a missing driver is not printed."""
    global _started
    with _lock:
        if _started:
            return
        wp.config.log_level = 30
        if folder := kernel_cache():
            wp.config.kernel_cache_dir = str(folder)
        sys.stderr.flush()
        kept = os.dup(2)
        with tempfile.TemporaryFile() as caught:
            os.dup2(caught.fileno(), 2)
            try:
                wp.init()
            finally:
                os.dup2(kept, 2)
                os.close(kept)
            caught.seek(0)
            for line in caught:
                if _HARMLESS not in line:
                    os.write(2, line)
        _set_thread_defaults()
        copy_compiled_kernels(Path(wp.config.kernel_cache_dir))
        _started = True


def kernel_cache() -> Path | None:
    """Return a cache folder for Warp; None if Warp's own is writable (containers run as any user)."""
    named = os.environ.get("WARP_CACHE_PATH", "")
    cache = os.environ.get("XDG_CACHE_HOME") or Path(os.environ.get("HOME") or "/") / ".cache"
    wanted = Path(named) if named else Path(cache) / "warp"
    try:
        wanted.mkdir(parents=True, exist_ok=True)
        if os.access(wanted, os.W_OK | os.X_OK):
            return None
        trouble = "not writable"
    except OSError as error:
        trouble = error.strerror or str(error)
    folder = user_cache.cache_folder("warp")
    log.warning("kernels cannot be cached in %s (%s); they are cached in %s", wanted, trouble, folder)
    return folder


VARIABLE: Final = "GRASPD_KERNELS"  # environment variable with the folder of precompiled kernels
ARCHITECTURES: Final = (80, 90, 100)  # compute capabilities, times ten, of A100, H100 and H200, and B200


def kernel_modules() -> list[str]:
    """Return the names of all modules with kernels."""
    names = [
        info.name
        for package in map(import_module, ("graspd.worker", "graspd.baselines", "graspd.studies"))
        for info in pkgutil.walk_packages(package.__path__, f"{package.__name__}.")
        if not info.ispkg
    ]
    candidates = (name for name in names if "kernels" in name.split("."))
    return [name for name in candidates if any(isinstance(v, wp.Kernel) for v in vars(import_module(name)).values())]


def compile_modules(
    names: Iterable[str], *, architectures: Sequence[int] = ARCHITECTURES, cpu: bool = True
) -> list[Path]:
    """Compile modules into Warp's cache for `architectures` and this CPU, without a GPU; return all files."""
    for name in names:
        module = import_module(name)
        if architectures:
            wp.compile_aot_module(module, arch=list(architectures), use_ptx=False)
        if cpu:
            # Ahead-of-time compilation for a CPU differs in block size from a launch, and therefore in its digest.
            wp.load_module(module, device="cpu")
    return sorted(file for file in Path(wp.config.kernel_cache_dir).glob("*/*") if file.is_file())


def copy_compiled_kernels(cache: Path) -> None:
    """Copy missing kernels from `$GRASPD_KERNELS` into the cache, if the folder is readable."""
    if not (named := os.environ.get(VARIABLE, "")):
        return
    source = Path(named) / wp.config.version
    try:
        for file in sorted(source.glob("*/*")):
            if not (target := cache / file.relative_to(source)).exists():
                user_cache.write_atomically(target, [file.read_bytes()])
    except OSError as error:
        log.warning("kernels of %s are not used: %s", source, error)


def binary_identity(module: ModuleType) -> str:
    """Return the identity of a module's kernels on this CPU; equal identities mean the same code."""
    known = wp.get_module(module.__name__)
    # A launch on the CPU has blocks of one thread.
    name = known._get_compile_output_name(wp.get_device("cpu"), block_dim=1)
    return f"{wp.config.version} {known.get_module_hash(1).hex()} {name}"

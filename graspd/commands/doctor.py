"""Checks of GPUs and kernels for `graspd doctor`, each in its own process: a driver may crash it."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Final

from graspd.service.model.states import Stage
from graspd.service.run.doctor.checks import Finding, bad, good, warning
from graspd.service.settings import Settings

_GPU_S: Final = 120.0
#: Time limit for compiling all kernels from scratch, on a slow machine [s].
_KERNELS_S: Final = 900.0
_GIB: Final = 2**30
_MEMORY_LOW: Final = 2 * _GIB
_TRACES: Final = (Path("/proc/driver/nvidia/version"), Path("/dev/nvidiactl"))
Child = Callable[[Sequence[str]], "subprocess.CompletedProcess[str]"]


def run_child(arguments: Sequence[str]) -> subprocess.CompletedProcess[str]:
    limit_s = _GPU_S if arguments[0] == "gpus" else _KERNELS_S
    return subprocess.run(
        [sys.executable, "-m", "graspd.commands.doctor", *arguments],
        capture_output=True,
        text=True,
        check=False,
        timeout=limit_s,
        stdin=subprocess.DEVNULL,
    )


def check_gpu(settings: Settings, *, child: Child = run_child, has_driver: Callable[[], bool] | None = None) -> Finding:
    """Check which GPUs Warp finds, and their free memory."""
    found, wrong = _run_check(child, ["gpus"])
    if wrong:
        fix = "see nvidia-smi and dmesg; restart the driver or the machine"
        return bad(f"the GPUs cannot be queried: {wrong}", fix)
    gpus: list[dict[str, Any]] = found["gpus"]
    needed = f"the driver has CUDA {_version(found['driver'])}, Warp is built for {_version(found['toolkit'])}"
    fix = "install driver R580 or newer; containers need NVIDIA's toolkit and --gpus all; check CUDA_VISIBLE_DEVICES"
    if not gpus:
        if settings.device.startswith("cuda"):
            return bad(f"GRASPD_DEVICE is {settings.device}, but no GPU is found; {needed}", fix)
        if (has_driver or _has_driver)():
            return bad(f"this machine has an NVIDIA driver, but no GPU can be used; {needed}", fix)
        return good("none; work runs on the CPU")
    names = [one["name"] for one in gpus]
    if settings.device.startswith("cuda") and settings.device not in names:
        fix = "set it to one of these, or auto"
        return bad(f"GRASPD_DEVICE is {settings.device}, but there are {', '.join(names)}", fix)
    free = [f"{one['free'] / _GIB:.0f} of {one['total'] / _GIB:.0f} GiB free" for one in gpus]
    line = ", ".join(f"{one['name']} {one['model']} {memory}" for one, memory in zip(gpus, free, strict=True))
    if full := [one["name"] for one in gpus if one["free"] < _MEMORY_LOW]:
        fix = f"see nvidia-smi: other processes fill {', '.join(full)}; launches are halved until they fit"
        return warning(line, fix)
    return good(f"{line}; {needed}")


def check_kernels(settings: Settings, *, child: Child = run_child) -> Finding:
    """Check that the engine gives plausible results, as a worker does before its first task."""
    found, wrong = _run_check(child, ["kernels", settings.device])
    if wrong:
        fix = "pip install 'graspd[worker]'; see disk and memory; dmesg lists killed processes"
        return bad(f"the engine does not run: {wrong}", fix)
    if found["error"]:
        fix = f"see the message; for a damaged cache remove {found['cache']}"
        return bad(f"on {found['device']}: {found['error']}", fix)
    return good(f"plausible grasps, scenes and pictures of a ball on {found['device']}; kernel cache {found['cache']}")


def _run_check(child: Child, arguments: Sequence[str]) -> tuple[dict[str, Any], str]:
    try:
        done = child(arguments)
    except subprocess.TimeoutExpired as error:
        return {}, f"no answer within {error.timeout:.0f} s"
    try:
        return dict(json.loads(done.stdout.strip().splitlines()[-1])), ""
    except (ValueError, IndexError):
        tail = (done.stderr.strip().splitlines() or ["it printed nothing"])[-1][:300]
        return {}, f"ended by signal {-done.returncode}" if done.returncode < 0 else tail


def _version(version: Sequence[int] | None) -> str:
    return ".".join(map(str, version)) if version else "nothing"


def _has_driver() -> bool:
    return any(trace.exists() for trace in _TRACES) or shutil.which("nvidia-smi") is not None


def _report_gpus() -> dict[str, Any]:
    import warp as wp

    from graspd.worker.engines import backend

    backend.start_warp()
    found = [
        {"name": str(one), "model": str(one.name), "total": int(one.total_memory), "free": int(one.free_memory)}
        for one in wp.get_cuda_devices()
    ]
    return {"driver": wp.get_cuda_driver_version(), "toolkit": wp.get_cuda_toolkit_version(), "gpus": found}


def _report_kernels(wanted: str) -> dict[str, Any]:
    import warp as wp

    from graspd.worker.engines import backend
    from graspd.worker.engines.devices import Device
    from graspd.worker.process.selfcheck import EngineError, check_engine

    backend.start_warp()
    device, error = Device(wanted), ""
    try:
        check_engine(device.resolve, [stage for stage in Stage if stage is not Stage.INGEST])
    except EngineError as found:
        error = str(found)
    return {"device": f"{device.resolve()} ({device.name})", "error": error, "cache": str(wp.config.kernel_cache_dir)}


def main(arguments: Sequence[str]) -> None:
    told = _report_gpus() if arguments[0] == "gpus" else _report_kernels(arguments[1])
    sys.stdout.write(f"{json.dumps(told)}\n")
    sys.stdout.flush()
    # A regular exit of Warp takes seconds.
    os._exit(0)


if __name__ == "__main__":
    main(sys.argv[1:])

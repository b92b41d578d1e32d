"""Command line: `graspd worker` and `graspd admin kernels`."""

from __future__ import annotations

import os
import socket
import sys
import threading
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path
from typing import Annotated

import typer

from graspd.service.cli import CommandGroup, JsonFlag, load_settings, print_result, set_up_process
from graspd.service.model.errors import InputError, UnavailableError
from graspd.service.model.libraries import pause_garbage_collection
from graspd.service.model.states import Stage
from graspd.service.settings import Settings

app = CommandGroup(no_args_is_help=True)


@app.command(epilog="graspd worker --workers 4 --stages synthesize,render")
def worker(
    device: Annotated[str | None, typer.Option(help="Device: cpu, cuda:0 or auto; default: GRASPD_DEVICE.")] = None,
    stages: Annotated[str | None, typer.Option(help="Stages to serve, separated by commas; default: all.")] = None,
    workers: Annotated[int, typer.Option(min=1, help="Worker processes; with device auto, one per GPU.")] = 1,
    threads: Annotated[int | None, typer.Option(min=0, help="CPU threads; 0: all; default: GRASPD_THREADS.")] = None,
    join: Annotated[str | None, typer.Option(help="Batches per launch, or auto; default: GRASPD_JOIN.")] = None,
    processes: Annotated[int | None, typer.Option(min=0, help="Processes for validation; 0: automatic.")] = None,
    burst: Annotated[bool, typer.Option("--burst", help="Exit when no task waits.")] = False,
    idle: Annotated[int, typer.Option(min=0, help="With --burst: exit after this time without a task [s].")] = 0,
    once: Annotated[bool, typer.Option("--once", help="Exit after one task.")] = False,
    max_tasks: Annotated[int | None, typer.Option(min=1, help="Exit after this many tasks.")] = None,
    check: Annotated[bool, typer.Option("--check", help="Check for a live worker here; exit code 1: none.")] = False,
    data_dir: Annotated[Path | None, typer.Option(help="Data folder of graspd; default: GRASPD_DATA_DIR.")] = None,
) -> None:
    """Run one or several workers, each on one device, until stopped."""
    if workers > 1 and (burst or once or max_tasks is not None):
        raise InputError("--burst, --once and --max-tasks are for a single worker")
    settings = load_settings(device=device, threads=threads, join=join, processes=processes, data_dir=data_dir)
    set_up_process(settings, "worker")
    if check:
        check_worker(settings)
        return
    if workers > 1:
        from graspd.service.run.commands import stop_on_signals

        _parse_stages(stages)
        arguments = ["worker", "--device", settings.device, "--threads", str(settings.threads)]
        arguments += ["--join", settings.join, "--processes", str(settings.processes)]
        arguments += ["--data-dir", str(settings.data_dir), *(("--stages", stages) if stages else ())]
        run_workers(workers, arguments, settings, stop_on_signals())
        return
    with pause_garbage_collection():
        from graspd.worker.process.main import run_worker

    most = 1 if once else max_tasks
    served = _parse_stages(stages)
    ended_well = run_worker(settings, stages=served, burst=burst or once, idle_s=idle, max_tasks=most)
    raise typer.Exit(0 if ended_well else 1)


@app.command(epilog="graspd admin kernels ./kernels --arch 90")
def kernels(
    folder: Annotated[Path, typer.Argument(help="Folder for the kernels; set GRASPD_KERNELS to it.")],
    arch: Annotated[list[int] | None, typer.Option(help="GPU architecture, such as 90; repeatable.")] = None,
    cuda: Annotated[bool, typer.Option(help="Compile binaries for GPUs.")] = True,
    cpu: Annotated[bool, typer.Option(help="Compile objects for CPUs with this CPU's instruction set.")] = True,
    json: JsonFlag = False,
) -> None:
    """Compile all kernels ahead of time, so that new machines compile none. No GPU is needed."""
    folder.mkdir(parents=True, exist_ok=True)
    os.environ["WARP_CACHE_PATH"] = str(folder.resolve())
    from graspd.worker.engines import backend

    backend.start_warp()
    architectures = (arch or backend.ARCHITECTURES) if cuda else ()
    files = backend.compile_modules(backend.kernel_modules(), architectures=architectures, cpu=cpu)
    size = sum(file.stat().st_size for file in files)
    made = {"folder": str(folder), "files": len(files), "bytes": size, "architectures": list(architectures), "cpu": cpu}
    line = f"{len(files)} kernel files, {size / 1e6:.1f} MB, in {folder}; GRASPD_KERNELS={folder.resolve()}"
    print_result(made, line, json=json)


def run_workers(
    count: int,
    arguments: Sequence[str],
    settings: Settings,
    stop: threading.Event,
    *,
    program: Sequence[str] = (sys.executable, "-m", "graspd"),
) -> None:
    """Keep `count` processes alive until `stop`; process k takes the k-th GPU (`worker.engines.devices`)."""
    from graspd.service.run.children import Child, keep_alive, stop_children

    of_each = [{"GRASPD_WORKER_NUMBER": str(number), "GRASPD_WORKERS_HERE": str(count)} for number in range(count)]
    children = [Child(f"worker-{number}", (*program, *arguments), own, None) for number, own in enumerate(of_each)]
    try:
        keep_alive(children, stop)
    finally:
        stop_children(children, settings.stop_grace_s)


def check_worker(settings: Settings) -> None:
    """Raise UnavailableError if no worker of this host sent a heartbeat within its lease."""
    from graspd.service.queue.rq_queue import open_queue

    host = socket.gethostname()
    with closing(open_queue(settings, patience=0)) as queue:
        if not any(beat.host == host for beat in queue.workers()):
            raise UnavailableError(f"no worker on {host} sent a heartbeat lately; start `graspd worker`")


def _parse_stages(text: str | None) -> tuple[Stage, ...]:
    if text is None:
        return tuple(Stage)
    try:
        return tuple(Stage(part.strip()) for part in text.split(","))
    except ValueError:
        raise InputError(f"unknown stages {text!r}; choose from {', '.join(Stage)}") from None

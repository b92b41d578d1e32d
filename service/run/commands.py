"""Commands `graspd up`, `graspd controller` and `graspd admin index`."""

import logging
import os
import signal
import threading
from contextlib import closing
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated

import typer

from graspd.service import cli
from graspd.service.model import names
from graspd.service.model.errors import IndexDamaged, QueueUnavailable, UnavailableError, without_secrets
from graspd.service.settings import Settings
from graspd.service.telemetry import HeartbeatFile

log = logging.getLogger(__name__)

app = cli.CommandGroup(no_args_is_help=True)
index_app = cli.CommandGroup(no_args_is_help=True, help="Rebuild the index from the store or export its tables.")
app.add_typer(index_app, name="index")


@app.command(epilog="graspd up --workers 2 --port 8000")
def up(
    workers: Annotated[int, typer.Option(min=0, help="Worker processes on this machine.")] = 1,
    host: Annotated[str | None, typer.Option(help="Address of the API; GRASPD_HOST.")] = None,
    port: Annotated[int | None, typer.Option(min=0, max=65535, help="Port of the API; 0: any; GRASPD_PORT.")] = None,
    device: Annotated[str | None, typer.Option(help="Device of the workers: cpu, cuda:0, auto; GRASPD_DEVICE.")] = None,
    share: Annotated[
        Path | None, typer.Option(help="Share the queue; write the settings of workers on other machines to this file.")
    ] = None,
    share_host: Annotated[
        str | None, typer.Option(help="With --share: this machine's address; default: host name.")
    ] = None,
    redis_port: Annotated[
        int, typer.Option(min=0, max=65535, help="With --share: port of Redis for other machines; 0: any free port.")
    ] = 0,
    data_dir: cli.DataDir = None,
    json: cli.JsonFlag = False,
) -> None:
    """Run the whole service on this machine until Ctrl-C."""
    if any(find_spec(library) is None for library in ("httpx", "fastapi", *(("warp",) if workers else ()))):
        raise UnavailableError("`graspd up` is not part of this install; run pip install 'graspd[all]'")
    from graspd.service.run.address import new_listen_address
    from graspd.service.run.supervisor import Supervisor

    settings = cli.load_settings(host=host, port=port, device=device, data_dir=data_dir)
    cli.set_up_process(settings, "up")
    stop = stop_on_signals()
    console = cli.plain_console(stderr=True)
    others = new_listen_address(settings, share, host=share_host, port=redis_port) if share is not None else None
    supervisor = Supervisor(settings, workers=workers, joining=others)
    supervisor.start()
    try:
        if supervisor.wait_ready(say=lambda line: console.print(line, soft_wrap=True), stop=stop):
            where = f"{supervisor.api_url} (data in {supervisor.settings.data_dir})"
            console.print(f"graspd is up: {where}; Ctrl-C stops it", soft_wrap=True)
            if json:
                cli.print_json({"api_url": supervisor.api_url, "pid": os.getpid(), "processes": supervisor.pids})
            stop.wait()
        console.print("stopping ...")
    finally:
        supervisor.stop()


@app.command(epilog="graspd controller")
def controller(
    check: Annotated[bool, typer.Option("--check", help="Only check for a controller; exit code 1: none.")] = False,
    data_dir: cli.DataDir = None,
) -> None:
    """Run a controller (retries, index), which leads or stands by. `graspd up` starts one."""
    settings = cli.load_settings(data_dir=data_dir)
    cli.set_up_process(settings, "controller")
    if check:
        from graspd.service.pipeline.leading import PART
        from graspd.service.queue.rq_queue import open_queue

        with closing(open_queue(settings, patience=0)) as queue:
            if not queue.is_announced(PART):
                raise UnavailableError("no controller sent a heartbeat recently; start `graspd controller`")
        return
    _run_controller(settings, stop_on_signals())


def _run_controller(settings: Settings, stop: threading.Event) -> None:
    """Lead or stand by; start again after another controller has led."""
    from graspd.service.pipeline.backends import Services
    from graspd.service.pipeline.controller import Controller
    from graspd.service.pipeline.leading import Leadership
    from graspd.service.queue.rq_queue import open_queue

    alive = HeartbeatFile(settings.heartbeat_file)
    with closing(open_queue(settings, patience=0)) as queue:
        leadership = Leadership(queue, lease_s=settings.lease_s, alive=alive, name=settings.controller_name)
        # A controller of another service must not stand by here, because it could lead this service later.
        _check_identity(settings, stop, alive)
        while leadership.wait(stop):
            # A new controller again receives unfinished events of its predecessor.
            with leadership.hold(stop) as over, closing(Services.open(settings)) as services:
                Controller(services).run(over)


def _check_identity(settings: Settings, stop: threading.Event, alive: HeartbeatFile) -> None:
    """Check that store, index and Redis belong to one service (else BusyError), once Redis answers."""
    from graspd.service.pipeline.backends import Services
    from graspd.service.pipeline.identity import identify

    with closing(Services.open(settings, patience=0)) as services:
        while not stop.is_set():
            alive.touch()
            try:
                identify(services)
                return
            except QueueUnavailable as error:
                log.warning("%s", error)
            stop.wait(settings.lease_s / 3)


@index_app.command(epilog="graspd admin index rebuild --check")
def rebuild(
    check: Annotated[bool, typer.Option("--check", help="Print differences without changing anything.")] = False,
    data_dir: cli.DataDir = None,
    json: cli.JsonFlag = False,
) -> None:
    """Rebuild the index from the store with this version's tables; this service then owns the store.

    With --check, exit code 1 means: index and store differ, or a shard is damaged.
    """
    from graspd.service.index.database import read_condition
    from graspd.service.index.rebuild import differences
    from graspd.service.index.rebuild import rebuild as fill
    from graspd.service.pipeline.backends import Services
    from graspd.service.pipeline.identity import identify_if_redis_answers
    from graspd.service.pipeline.integrity import scan
    from graspd.service.store.packs import convert_packs

    settings = cli.load_settings(data_dir=data_dir)
    if check:
        read_condition(settings.resolved_index_url)  # An open index moves a damaged file aside.
    services = Services.open(settings, patience=0, make=False, anew=not check)
    store, index = services.store, services.index

    def make() -> dict[str, int]:
        identify_if_redis_answers(services, take_over=True)
        for _ in convert_packs(store):
            pass
        return fill(index, store)

    try:
        was = index.database.was
        found = [f"the index had revision {was}; its tables are replaced"] if was else differences(index, store)
        if check:
            found += [f"{wrong.key}: {wrong.what}" for _, wrong in scan(store, names.SHARDS) if wrong is not None]
        counts: dict[str, int] = {} if check else make()
    except IndexDamaged:
        found, counts = ["the index file was damaged and is replaced"], {} if check else make()
    if json:
        cli.print_json({"differences": found, "changed": bool(found) and not check, **counts})
    else:
        for line in found:
            typer.echo(line)
        typer.echo(f"{len(found)} differences" if found else "the index matches the store", err=True)
    services.close()
    if check and found:
        raise typer.Exit(1)


@index_app.command(epilog="graspd admin index export -o tables")
def export(
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder to write, with a file for each table.")],
    data_dir: cli.DataDir = None,
    json: cli.JsonFlag = False,
) -> None:
    """Write grasps, shards, jobs, tasks, assets, datasets and usage as Parquet for DuckDB or pandas."""
    from graspd.service.index.export import export as write
    from graspd.service.index.index import Index

    with closing(Index(cli.load_settings(data_dir=data_dir).resolved_index_url)) as index:
        rows = write(index.database, output)
    lines = [f"{output / name}.parquet  {count} rows" for name, count in rows.items()]
    cli.print_result(rows, "\n".join(lines), json=json)


@index_app.command(epilog="graspd admin index path")
def path(data_dir: cli.DataDir = None) -> None:
    """Print the location of the index, without the password of its URL."""
    from sqlalchemy import make_url

    url = make_url(cli.load_settings(data_dir=data_dir).resolved_index_url)
    typer.echo(without_secrets(url.render_as_string(hide_password=True)))


def stop_on_signals() -> threading.Event:
    stop = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        # A thread sets the event: the handler may interrupt a `wait` that holds the lock which `set` needs.
        signal.signal(number, lambda *_: threading.Thread(target=stop.set, daemon=True).start())
    return stop

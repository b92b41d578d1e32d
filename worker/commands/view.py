"""Command line: `graspd view`."""

from __future__ import annotations

import getpass
import os
import signal
import socket
import threading
from pathlib import Path
from typing import Annotated

import typer

from service.cli import reporting_errors
from service.model.errors import InputError
from service.store.shards import read_shard

app = typer.Typer(add_completion=False)


@app.command(epilog="graspd view grasps.h5")
@reporting_errors
def view(
    grasps: Annotated[Path, typer.Argument(help="A base shard, as `graspd synth` writes it.")],
    host: Annotated[str, typer.Option(help="Address to serve on; whoever reaches it sees the grasps.")] = "127.0.0.1",
    port: Annotated[int, typer.Option(min=0, max=65535, help="The first port tried; 0: any free one.")] = 8080,
    hand: Annotated[str | None, typer.Option(help="The hand's file; default: found by its digest.")] = None,
    object: Annotated[str | None, typer.Option(help="The object's file; default: found by its digest.")] = None,
) -> None:
    """Show grasps in 3D in the browser: hand, object, scene, contacts, and the way as a slider. Ends with Ctrl-C."""
    from worker.viewing import Shown, Viewer, missing

    if said := missing():
        raise InputError(said)
    from worker.files.of_shard import hand_of_shard, neighbours_of_shard, object_of_shard

    base = read_shard(grasps, kind="base")
    shown = Shown(base, hand_of_shard(base, hand), object_of_shard(base, object), neighbours_of_shard(base, []))
    ended = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: ended.set())
    viewer = Viewer(shown, host=host, port=port)
    try:
        typer.echo(f"{grasps}: {viewer.url}")
        typer.echo(
            f"from another machine: {forwarding(viewer.server.get_port())}, then the same address; Ctrl-C ends it"
        )
        ended.wait()
    finally:
        viewer.close()


def forwarding(port: int) -> str:
    """The command that brings a port of this machine's loopback to the machine that one sits at."""
    # sshd says the address under which it was reached.
    reached = os.environ.get("SSH_CONNECTION", "").split()
    host = reached[2] if len(reached) == 4 else socket.gethostname()
    return f"ssh -L {port}:127.0.0.1:{port} {getpass.getuser()}@{host}"

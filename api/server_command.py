"""`graspd api`: run the HTTP API and the dashboard until stopped."""

from typing import Annotated

import typer

from graspd.service.cli import CommandGroup, load_settings, set_up_process
from graspd.service.model.libraries import pause_garbage_collection

app = CommandGroup(add_completion=False)


@app.command(epilog="graspd api --port 8000")
def api(
    host: Annotated[str | None, typer.Option(help="Address to bind; default: GRASPD_HOST.")] = None,
    port: Annotated[int | None, typer.Option(min=0, max=65535, help="Port; 0: any free port.")] = None,
) -> None:
    """Run the HTTP API and the dashboard."""
    with pause_garbage_collection():
        from graspd.api.server import serve

    settings = load_settings(host=host, port=port)
    set_up_process(settings, "api")
    serve(settings)

"""Commands `graspd admin store`: check, repair and conversion of the store."""

import time
from typing import Annotated, Final

import typer

from graspd.service.cli import CommandGroup, DataDir, JsonFlag, load_settings, print_json
from graspd.service.model import names
from graspd.service.model.errors import ConflictError

app = CommandGroup(no_args_is_help=True)
store_app = CommandGroup(no_args_is_help=True, help="Verify and repair the store.")
app.add_typer(store_app, name="store")

#: Pause of the controller's integrity scan after each renewal [s].
_PAUSE_S: Final = 15.0


@store_app.command(epilog="graspd admin store verify --repair")
def verify(
    repair: Annotated[
        bool, typer.Option("--repair", help="Move damaged objects aside and queue the tasks that make them again.")
    ] = False,
    data_dir: DataDir = None,
    json: JsonFlag = False,
) -> None:
    """Verify all objects of the store and report damaged or missing ones; exit code 1 if any remain.

    The controller's integrity scan pauses meanwhile; a concurrent call fails.
    """
    from graspd.service.pipeline.backends import Services
    from graspd.service.pipeline.identity import identify_if_redis_answers
    from graspd.service.pipeline.integrity import MISSING, scan
    from graspd.service.pipeline.integrity import repair as fix

    services = Services.open(load_settings(data_dir=data_dir), make=False)
    if repair:
        identify_if_redis_answers(services)
    pause_scan, renewed = services.index.notes.pause_scan, time.monotonic()

    def renew(size: int = 0) -> None:
        nonlocal renewed
        if time.monotonic() - renewed >= _PAUSE_S / 3:
            pause_scan(_PAUSE_S)
            renewed = time.monotonic()

    if not pause_scan(_PAUSE_S, begin=True):
        services.close()
        raise ConflictError("another `graspd admin store verify` reads this store; wait until it is done")
    try:
        shards, found, unsealed = 0, [], list[str]()
        for key, wrong in scan(services.store, read=renew, unsealed=unsealed.append):
            renew()
            shards += key.startswith(f"{names.SHARDS}/") and key.endswith(".json")
            found += [wrong] if wrong is not None else []
        services.index.damage.replace(found)
        repaired, left = fix(services, found) if repair else ([], found)
    finally:
        pause_scan(0.0)
        services.close()
    if json:
        damaged = [{"shard": one.shard or one.key, "what": one.what, "key": one.key} for one in found]
        print_json(
            {
                "shards": shards,
                "without_digest": len(unsealed),
                "damaged": [one for one in damaged if one["what"] != MISSING],
                "missing": [one.shard for one in found if one.what == MISSING],
                "repaired": [one.shard or one.key for one in repaired],
                "left": [{"shard": one.shard or one.key, "what": one.what} for one in left] if repair else [],
            }
        )
    else:
        for one in repaired:
            typer.echo(f"{one.key}: {one.what}; moved aside; made again if a job needs it")
        for one in left:
            typer.echo(f"{one.key}: {one.what}")
        more = f"; {len(unsealed)} objects that graspd 0.2 wrote have no checksum of their own" if unsealed else ""
        typer.echo(f"{shards} shards, {len(found)} damaged or missing{more}", err=True)
    if left:
        raise typer.Exit(1)


@store_app.command(epilog="graspd admin store upgrade")
def upgrade(data_dir: DataDir = None, json: JsonFlag = False) -> None:
    """Replace packs of graspd 0.2 by one file per shard; a controller does the same at its start."""
    from graspd.service.store.packs import convert_packs
    from graspd.service.store.store import open_store

    store = open_store(load_settings(data_dir=data_dir).resolved_store_url, make=False)
    shards = sum(1 for _ in convert_packs(store))
    if json:
        print_json({"shards": shards})
    else:
        typer.echo(f"{shards} shards extracted from packs", err=True)

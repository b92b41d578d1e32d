"""The checks of the shared room, in the order in which they are told."""

from __future__ import annotations

from functools import partial
from typing import Final

from service.run.doctor import clocks, database, fleet, machine, object_store, redis_server
from service.run.doctor.patience import Check
from service.settings import Settings

#: A whole comparison reads every record of the store.
_FULL_S: Final = 24 * 3600.0


def checks_of(settings: Settings, *, full: bool = False) -> list[Check]:
    """What can be looked at without engine and API. `full`: compare all of the index with the store."""
    return [
        Check("disk", partial(machine.disk, settings)),
        Check("data-folder", partial(machine.data_folder, settings)),
        Check("limits", machine.limits),
        Check("versions", machine.versions),
        Check("redis", partial(redis_server.redis, settings)),
        Check("redis-persistence", partial(redis_server.persistence, settings)),
        Check("store", partial(object_store.store, settings), limit_s=120.0),
        Check("index", partial(database.index, settings)),
        Check("identity", partial(database.identity, settings)),
        Check(
            "index-is-store", partial(database.index_is_store, settings, full=full), limit_s=_FULL_S if full else 120.0
        ),
        Check("damage", partial(database.damage, settings)),
        Check("clocks", partial(clocks.clocks, settings), limit_s=120.0),
        Check("controller", partial(fleet.controller, settings)),
        Check("workers", partial(fleet.workers, settings)),
        Check("port", partial(fleet.port, settings)),
    ]

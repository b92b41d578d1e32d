"""The index: whether it answers, has this graspd's tables, and holds what the store says."""

from __future__ import annotations

import time
from contextlib import closing
from pathlib import Path
from typing import Final

from sqlalchemy import func, make_url, select

from service.index.index import Index
from service.index.rebuild import differences
from service.index.sample import IndexCondition, compare, draw, look
from service.index.tables import shards
from service.model.errors import IndexDamaged, InputError, QueueUnavailable, UnavailableError
from service.model.finding import Finding, bad, good, skipped, warning
from service.pipeline.identity import Identity, recorded, service_ids
from service.queue.rq_queue import open_queue
from service.run.doctor.machine import existing, local_store
from service.run.doctor.redis_server import is_there
from service.settings import Settings
from service.store.store import open_store

_NONE_HERE: Final = (
    "no index is here: GRASPD_INDEX_URL is unset and there is no index.sqlite; only api and controller need one"
)
_REBUILD: Final = (
    "graspd admin index rebuild --check shows all of it; graspd admin index rebuild mends it while the service runs"
)
_CROWDED: Final = 0.8
#: With more shards than this only a sample is compared.
_ALL_SHARDS: Final = 2000
#: What a controller has to take up between two looks [s].
_SETTLES_S: Final = 3.0


def index(settings: Settings) -> Finding:
    """Connection, integrity and schema; changes nothing."""
    name = "index"
    try:
        found = look(settings.resolved_index_url)
    except IndexDamaged as error:
        return bad(name, str(error), "graspd admin index rebuild: it is moved aside and made again from the store")
    except InputError as error:
        return bad(name, str(error), "see the message, and GRASPD_INDEX_URL")
    except UnavailableError as error:
        mend = "start the database; see host, user, password and database in GRASPD_INDEX_URL"
        return bad(name, str(error), mend if settings.index_url is not None else "see who may read the file")
    if found is None:
        return _absent(name, settings)
    return _judge(name, settings, found)


def _absent(name: str, settings: Settings) -> Finding:
    if settings.index_url is None:
        return skipped(name, _NONE_HERE)
    where = existing(Path(str(make_url(settings.resolved_index_url).database)).resolve())
    return good(name, f"the index is made at the first start, in {where}")


def _judge(name: str, settings: Settings, found: IndexCondition) -> Finding:
    parsed = make_url(settings.resolved_index_url)
    url = parsed.set(query={}).render_as_string(hide_password=True)
    line = f"{found.kind} at {url}, revision {found.revision or 'none'}"
    if not found.may_write:
        return bad(name, f"{line}: it cannot be written", "name the primary, and grant CREATE and USAGE on the schema")
    if found.revision and not found.is_ready and found.revision > found.newest:
        return bad(
            name,
            f"{line}: a newer graspd made it; this one knows {found.newest}",
            "install the newer version here, or graspd admin index rebuild: it is made again from the store",
        )
    if found.revision and not found.is_ready:
        return bad(
            name,
            f"{line}: this graspd has {found.newest}",
            "graspd admin index rebuild: it is made again from the store",
        )
    if not found.is_ready:
        return warning(name, line, "the next start makes its tables")
    used, most = found.connections
    if most and used > _CROWDED * most:
        return warning(
            name, f"{line}: {used} of {most} connections are used", "raise max_connections, or run fewer api processes"
        )
    return good(name, line)


def _openable(settings: Settings) -> str:
    """Why the index should not be opened; "" if opening it changes nothing."""
    try:
        found = look(settings.resolved_index_url)
    except (InputError, UnavailableError):
        return "the index does not answer, or is damaged"
    if found is None:
        return "there is no index here"
    if not found.is_ready:
        return "the tables of the index are of another version"
    folder = local_store(settings)
    return "" if folder is None or folder.exists() else "there is no store yet"


def identity(settings: Settings) -> Finding:
    """Whether store, index and Redis belong to one service; changes nothing."""
    name, folder = "identity", local_store(settings)
    if folder is not None and not folder.exists():
        return skipped(name, "there is no store yet")
    store = open_store(settings.resolved_store_url)
    said, redis = None, None
    if not _openable(settings):
        with closing(Index(settings.resolved_index_url)) as opened:
            said = opened.notes.service()
    if is_there(settings):
        try:
            with closing(open_queue(settings, patience=0)) as queue:
                redis = queue.service()
        except QueueUnavailable:
            if said is None:
                return skipped(name, "there is no index here, and Redis does not answer")
    found = Identity(service_ids(store), said, redis, recorded(settings.data_dir.resolve()), settings.store_url is None)
    if why := found.refusal(store.url):
        return bad(name, why, "see the message, and GRASPD_STORE_URL, GRASPD_INDEX_URL, GRASPD_REDIS_URL")
    if not found.chain:
        return skipped(name, "no service has worked on this store yet")
    return good(
        name, "store, index and Redis belong to one service" if said else "store and Redis belong to one service"
    )


def index_is_store(settings: Settings, *, full: bool = False, settles_s: float = _SETTLES_S) -> Finding:
    """Whether the rows are those that follow from the store. What only one of two looks finds is on its way in.

    Args:
        full: compare all rows, however many there are.
        settles_s: pause before the second look [s].
    """
    name = "index-is-store"
    if why := _openable(settings):
        return skipped(name, why)
    store = open_store(settings.resolved_store_url)
    with closing(Index(settings.resolved_index_url)) as opened:
        made = opened.notes.completeness()
        if made is None:
            return warning(
                name, "the index is new, and lacks what the store has", "start graspd controller: it fills the index"
            )
        with opened.database.reading() as connection:
            count = int(connection.scalar(select(func.count()).select_from(shards)) or 0)
        whole = full or count <= _ALL_SHARDS
        chosen = None if whole else draw(opened, store)
        found = differences(opened, store) if chosen is None else compare(opened, store, chosen)
        if found:
            time.sleep(settles_s)
            again = set(differences(opened, store) if chosen is None else compare(opened, store, chosen))
            found = [line for line in found if line in again]
    if found:
        # A shard that is missing changes rows of tasks and jobs: the cause goes first.
        found.sort(key=lambda line: not line.startswith("shards "))
        more = f", and {len(found) - 3} more" if len(found) > 3 else ""
        return bad(name, f"{'; '.join(found[:3])}{more}", _REBUILD)
    what = f"all rows of {count} shards" if whole else f"a sample of {count} shards (--full compares all)"
    return good(name, f"{what} are what the store says")


def damage(settings: Settings) -> Finding:
    """Findings of the controller's integrity scan, or of `graspd admin store verify`."""
    name = "damage"
    if why := _openable(settings):
        return skipped(name, why)
    with closing(Index(settings.resolved_index_url)) as opened:
        count, known = opened.damage.known(limit=1)
        note, made = opened.notes.scan_note(), opened.notes.completeness()
    if count:
        return bad(
            name,
            f"{count} objects of the store are damaged or missing, {known[0].key}: {known[0].what}",
            "graspd admin store verify --repair",
        )
    if made is not None and made.left_out:
        mend = "put copies in their place, then graspd admin index rebuild"
        return bad(name, f"{made.left_out} damaged records are left out of the index, {made.names[0]}", mend)
    if not settings.integrity_scan_mb_per_s:
        return warning(
            name,
            "no damage is known, and the integrity scan is off",
            "GRASPD_INTEGRITY_SCAN_MB_PER_S=1, or graspd admin store verify at times",
        )
    when = (
        f"last read through by {note.ended}"
        if note.ended
        else "not read through yet; graspd admin store verify does at once"
    )
    return good(name, f"nothing is known to be damaged; {when}")

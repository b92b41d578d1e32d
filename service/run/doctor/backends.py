"""Checks of Redis, index and store: availability, writing and persistence."""

import secrets
import time
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from pathlib import Path
from typing import Any, Final
from urllib.parse import unquote, urlsplit

from redis import Redis
from redis.exceptions import RedisError
from sqlalchemy import func, make_url, select

from graspd.service.index.database import IndexCondition, read_condition
from graspd.service.index.index import Index
from graspd.service.index.rebuild import differences, missing_names
from graspd.service.index.tables import shards
from graspd.service.model import errors
from graspd.service.model.base import first_line
from graspd.service.pipeline.identity import ServiceIdentity, recorded_service, service_ids
from graspd.service.queue.connection import connect, redis_url, socket_path
from graspd.service.queue.rq_queue import RqQueue, open_queue
from graspd.service.run.doctor.checks import Finding, bad, good, skipped, warning
from graspd.service.run.doctor.machine import existing_ancestor, local_store
from graspd.service.run.embedded import find_server
from graspd.service.settings import Settings
from graspd.service.store.store import Store, open_store

_OLDEST: Final = (6, 2)
_SLOW_REDIS_S: Final = 0.02
_FULL: Final = 0.9
_TIMEOUT_S: Final = 5.0
_LOCAL: Final = ("127.0.0.1", "localhost", "::1")
_START: Final = "start it, or set GRASPD_REDIS_URL=redis://:PASSWORD@HOST:6379/0"


def is_redis_expected(settings: Settings) -> bool:
    """Check whether a Redis is configured or may be running; False on a machine where nothing was started."""
    return settings.redis_url is not None or socket_path(settings.data_dir).exists()


def query_queue(settings: Settings, look: Callable[[RqQueue], Finding]) -> Finding:
    if not is_redis_expected(settings):
        return skipped("no service runs on this data folder")
    try:
        with closing(open_queue(settings, patience=0)) as queue:
            return look(queue)
    except (errors.QueueUnavailable, RedisError, OSError):
        return skipped("Redis does not answer")


def check_redis(settings: Settings) -> Finding:
    """Check the Redis of `GRASPD_REDIS_URL` or of the data folder."""
    if not is_redis_expected(settings):
        try:
            _, rung = find_server()
        except errors.QueueUnavailable as error:
            return bad("no service runs on this data folder, and there is no Redis to start", str(error))
        return skipped(f"no service runs on this data folder; `graspd up` starts the Redis of {rung}")
    try:
        with closing(connect(redis_url(settings), patience=0, timeout_s=_TIMEOUT_S)) as client:
            return _check_redis(settings, client, dict(client.info()))
    except (RedisError, OSError) as error:
        return bad(f"{_masked_url(settings)} does not answer: {first_line(error)}", _redis_fix(error, settings))


def _check_redis(settings: Settings, client: Redis, info: Mapping[str, Any]) -> Finding:
    version = str(info.get("redis_version", "0"))
    if int(info.get("cluster_enabled", 0)):
        return bad("it is a Redis Cluster: tasks move between keys of several nodes", "use Redis without cluster mode")
    if info.get("role") != "master":
        return bad(f"it is a {info.get('role')}: it cannot be written", "name the primary in GRASPD_REDIS_URL")
    most, policy = int(info.get("maxmemory", 0)), str(info.get("maxmemory_policy", "noeviction"))
    if most and policy != "noeviction":
        fix = "redis-cli config set maxmemory-policy noeviction, and the same line in its configuration"
        return bad(f"maxmemory-policy is {policy}: when its memory is full, Redis deletes tasks silently", fix)
    used = int(info.get("used_memory", 0))
    if most and used > _FULL * most:
        return bad(f"{used >> 20} of {most >> 20} MiB are used", "increase maxmemory, or find other users of Redis")
    seconds = _time_write(client)
    line = f"Redis {version} at {_masked_url(settings)}, {1000 * seconds:.1f} ms, {used >> 20} MiB"
    if tuple(int(part) for part in version.split(".")[:2]) < _OLDEST:
        return warning(f"{line}: older than 6.2, the oldest tested version", "install Redis 6.2 or newer, or Valkey")
    parts = urlsplit(redis_url(settings))
    if parts.scheme != "unix" and parts.hostname not in _LOCAL and not parts.password:
        fix = "set requirepass or an ACL in its configuration, and the password in GRASPD_REDIS_URL"
        return warning(f"{line}: it requires no password, so any client can start tasks", fix)
    if seconds > _SLOW_REDIS_S:
        fix = "move Redis closer to the workers, or check the network"
        return warning(f"{line}: slow, since a task takes about 109 operations", fix)
    return good(line)


def _time_write(client: Redis) -> float:
    """Return the mean duration of a write and a read [s]; RedisError if writes are refused."""
    key, value = f"graspd:doctor:{secrets.token_hex(8)}", secrets.token_bytes(8)
    start = time.perf_counter()
    client.set(key, value, ex=60)
    found = client.get(key)
    seconds = (time.perf_counter() - start) / 2
    client.delete(key)
    if found != value:
        raise RedisError("a value changed between write and read")
    return seconds


def check_persistence(settings: Settings) -> Finding:
    """Check whether Redis restores its tasks after a crash."""
    return query_queue(settings, lambda queue: _check_persistence(dict(queue.connection.info())))


def _check_persistence(info: Mapping[str, Any]) -> Finding:
    fix = "make room on the disk of Redis and see its log"
    if int(info.get("aof_enabled", 0)):
        for what in ("aof_last_write_status", "aof_last_bgrewrite_status"):
            if info.get(what, "ok") != "ok":
                return bad(f"the log of writes fails ({what}: {info[what]})", f"{fix}; then redis-cli bgrewriteaof")
        return good("the log of writes is on: a killed Redis restarts with its tasks")
    if info.get("rdb_last_bgsave_status", "ok") != "ok":
        return bad("snapshots of Redis fail, and it may refuse writes", fix)
    fix = "redis-cli config set appendonly yes, and `appendonly yes` in its configuration"
    return warning("the log of writes is off: after a crash, tasks wait until they are queued again", fix)


def _masked_url(settings: Settings) -> str:
    parts = urlsplit(redis_url(settings))
    if parts.scheme == "unix":
        return unquote(parts.path)
    return f"{parts.scheme}://{parts.hostname}{f':{parts.port}' if parts.port else ''}{parts.path}"


def _redis_fix(error: Exception, settings: Settings) -> str:
    text = str(error).upper()
    if any(word in text for word in ("NOAUTH", "WRONGPASS", "AUTHENTICATION")):
        return "put the password into GRASPD_REDIS_URL: redis://:PASSWORD@HOST:6379/0"
    if "MISCONF" in text or "OOM" in text:
        return "Redis cannot write: free disk space or memory, and see its log"
    return "the service of this data folder crashed: start `graspd up` again" if settings.redis_url is None else _START


_NONE_HERE: Final = "GRASPD_INDEX_URL is unset and there is no index.sqlite; only api and controller need an index"
_REBUILD: Final = "graspd admin index rebuild, also while the service runs; --check lists all differences"
_CROWDED: Final = 0.8
#: Number of shards above which only names are compared.
_ALL_SHARDS: Final = 2000
#: Time for the controller to process events between two comparisons [s].
_SETTLES_S: Final = 3.0


def check_index(settings: Settings) -> Finding:
    try:
        found = read_condition(settings.resolved_index_url)
    except errors.IndexDamaged as error:
        return bad(str(error), "graspd admin index rebuild: moves the index aside and fills a new one from the store")
    except errors.InputError as error:
        return bad(str(error), "see the message, and GRASPD_INDEX_URL")
    except errors.UnavailableError as error:
        fix = "start the database; see host, user, password and database in GRASPD_INDEX_URL"
        return bad(str(error), fix if settings.index_url is not None else "check the permissions of the file")
    if found is not None:
        return _check_index(settings, found)
    if settings.index_url is None:
        return skipped(_NONE_HERE)
    where = existing_ancestor(Path(str(make_url(settings.resolved_index_url).database)).resolve())
    return good(f"the index is made at the first start, in {where}")


def _check_index(settings: Settings, found: IndexCondition) -> Finding:
    parsed = make_url(settings.resolved_index_url)
    url = parsed.set(query={}).render_as_string(hide_password=True)
    line = f"{found.kind} at {url}, revision {found.revision or 'none'}"
    if not found.may_write:
        return bad(f"{line}: it cannot be written", "name the primary, and grant CREATE and USAGE on the schema")
    fix = "graspd admin index rebuild: fills a new index from the store"
    if found.revision and not found.is_ready and found.revision > found.newest:
        fix = f"install the newer version here, or {fix}"
        return bad(f"{line}: a newer graspd made it; this one knows {found.newest}", fix)
    if found.revision and not found.is_ready:
        return bad(f"{line}: this graspd has {found.newest}", fix)
    if not found.is_ready:
        return warning(line, "the next start makes its tables")
    used, most = found.connections
    if most and used > _CROWDED * most:
        fix = "raise max_connections, or run fewer api processes"
        return warning(f"{line}: {used} of {most} connections are used", fix)
    return good(line)


def _index_problem(settings: Settings) -> str:
    """Return why the index should not be opened; "" if opening it changes nothing."""
    try:
        found = read_condition(settings.resolved_index_url)
    except (errors.InputError, errors.UnavailableError):
        return "the index does not answer, or is damaged"
    if found is None:
        return "there is no index here"
    if not found.is_ready:
        return "the tables of the index are of another version"
    folder = local_store(settings)
    return "" if folder is None or folder.exists() else "there is no store yet"


def check_index_identity(settings: Settings) -> Finding:
    folder = local_store(settings)
    if folder is not None and not folder.exists():
        return skipped("there is no store yet")
    store = open_store(settings.resolved_store_url)
    index, redis = None, None
    if not _index_problem(settings):
        with closing(Index(settings.resolved_index_url)) as opened:
            index = opened.notes.service_id()
    if is_redis_expected(settings):
        try:
            with closing(open_queue(settings, patience=0)) as queue:
                redis = queue.service_id()
        except errors.QueueUnavailable:
            if index is None:
                return skipped("there is no index here, and Redis does not answer")
    recorded = recorded_service(settings.data_dir.resolve())
    found = ServiceIdentity(service_ids(store), index, redis, recorded, settings.store_url is None)
    if why := found.refusal(store.url):
        return bad(why, "see the message, and GRASPD_STORE_URL, GRASPD_INDEX_URL, GRASPD_REDIS_URL")
    if not found.chain:
        return skipped("no service has worked on this store yet")
    return good("store, index and Redis belong to one service" if index else "store and Redis belong to one service")


def compare_index_with_store(settings: Settings, *, full: bool = False, settles_s: float = _SETTLES_S) -> Finding:
    """Compare the index with the store twice: an event in progress causes only one difference."""
    if why := _index_problem(settings):
        return skipped(why)
    store = open_store(settings.resolved_store_url)
    with closing(Index(settings.resolved_index_url)) as opened:
        made = opened.notes.completeness()
        if made is None:
            return warning("the index is new and lacks records of the store", "graspd controller: fills the index")
        with opened.database.read_transaction() as connection:
            count = int(connection.scalar(select(func.count()).select_from(shards)) or 0)
        whole = full or count <= _ALL_SHARDS
        compared = differences if whole else missing_names
        if found := compared(opened, store):
            time.sleep(settles_s)
            again = set(compared(opened, store))
            found = [line for line in found if line in again]
    if found:
        # A missing shard also changes rows of tasks and jobs, so shards come first.
        found.sort(key=lambda line: not line.startswith("shards "))
        more = f", and {len(found) - 3} more" if len(found) > 3 else ""
        return bad(f"{'; '.join(found[:3])}{more}", _REBUILD)
    what = f"all rows of {count} shards" if whole else f"names of jobs and {count} shards (--full compares all rows)"
    return good(f"{what} match the store")


def check_store_damage(settings: Settings) -> Finding:
    """Report the findings of the controller's integrity scan, or of `graspd admin store verify`."""
    if why := _index_problem(settings):
        return skipped(why)
    with closing(Index(settings.resolved_index_url)) as opened:
        count, known = opened.damage.summary(limit=1)
        note, made = opened.notes.scan_note(), opened.notes.completeness()
    if count:
        example = f"{known[0].key}: {known[0].what}"
        fix = "graspd admin store verify --repair"
        return bad(f"{count} objects of the store are damaged or missing, such as {example}", fix)
    if made is not None and made.left_out:
        fix = "put copies in their place, then graspd admin index rebuild"
        return bad(f"{made.left_out} damaged records are not in the index, such as {made.names[0]}", fix)
    if not settings.integrity_scan_mb_per_s:
        fix = "set GRASPD_INTEGRITY_SCAN_MB_PER_S=1, or run graspd admin store verify regularly"
        return warning("no damage is known, and the integrity scan is off", fix)
    if not note.ended:
        return good("no damage is known; no scan has ended yet; graspd admin store verify scans at once")
    return good(f"no damage is known; the last scan ended at {note.ended}")


_FOLDER: Final = "health"
_SLOW_STORE_S: Final = 5.0
#: Number of concurrent writers of one name; only one may succeed.
_RIVALS: Final = 4
_CREDENTIALS: Final = (
    "see bucket, region and credentials (AWS_ACCESS_KEY_ID, AWS_SECRET_ACCESS_KEY, AWS_REGION, AWS_ENDPOINT_URL; "
    "GOOGLE_APPLICATION_CREDENTIALS; AZURE_STORAGE_ACCOUNT_NAME, ..._KEY): they must allow get, put, list and delete"
)


def check_configured_store(settings: Settings) -> Finding:
    """Try every operation that graspd uses, on an object with a random name."""
    folder = local_store(settings)
    if folder is not None and not folder.exists():
        return good(f"{folder} is made at the first start, below {existing_ancestor(folder)}")
    try:
        return check_store(open_store(settings.resolved_store_url, public_endpoint=settings.store_public_endpoint))
    except errors.GraspdError as error:
        fix = f"make room below {folder}, and let user and group write there" if folder else _CREDENTIALS
        return bad(str(error), fix)


def check_store(opened: Store) -> Finding:
    """Return the finding on an open store; GraspdError if an operation fails."""
    key = f"{_FOLDER}/doctor-{secrets.token_hex(8)}"
    start = time.perf_counter()
    try:
        wrong = _violated_guarantee(opened, key)
    finally:
        opened.delete(key)
    seconds = time.perf_counter() - start
    if not wrong and opened.exists(key):
        wrong = "an object that was removed is still there"
    if wrong:
        fix = "use another store: a local disk, Amazon, Google, Azure, SeaweedFS, Ceph, or a recent MinIO"
        return bad(f"{opened.url}: {wrong}", fix)
    line = f"{opened.url}: put, get, list, delete and create-only writes work ({1000 * seconds:.0f} ms)"
    if opened.url.startswith("memory:"):
        return warning(f"{opened.url} is lost when its process ends", "GRASPD_STORE_URL=file:///FOLDER or s3://BUCKET")
    if seconds > _SLOW_STORE_S:
        return warning(f"{line}: slow", "move the store closer, or check the network")
    return good(line)


def _violated_guarantee(opened: Store, key: str) -> str:
    """Return a guarantee that the store violates; "" if none."""
    contents = [secrets.token_bytes(1000) for _ in range(_RIVALS)]
    with ThreadPoolExecutor(_RIVALS) as pool:
        won = list(pool.map(lambda content: opened.put(key, content), contents))
    if sum(won) != 1:
        return f"{sum(won)} of {_RIVALS} concurrent puts of one name succeeded instead of 1: data could be overwritten"
    kept = contents[won.index(True)]
    if opened.get(key) != kept or opened.get_range(key, 100, 50) != kept[100:150]:
        return "an object or a byte range of it is read differently from how it was written"
    if opened.put(key, b"another") or opened.get(key) != kept:
        return "an object can be overwritten: create-only puts (If-None-Match: *) are not honoured"
    if (key, len(kept)) not in [(entry.key, entry.size) for entry in opened.list(_FOLDER)]:
        return "a written object is missing in the list of its folder"
    return ""

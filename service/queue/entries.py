"""Entries in Redis: lists of waiting tasks, parsing of messages, jobs restricted to graspd's own task.

Any client can write any value under any name. Unreadable entries are skipped; `remove_mistyped_keys` removes permanent
obstacles. RQ calls any function or callback that a job's hash names, and posts to its webhook URL. A worker therefore
rebuilds each job from its id and message only, and passes the message to its engine.

There is one list per priority and stage, so that workers can serve selected stages. During an upgrade, a task that only
some workers can do waits in a separate list. The name of this list ends in the requirements: `bulk-synthesize.2.10`
means schema 2 and revision 10; names of engines may follow, as in `bulk-synthesize.8.33.physx`. RQ's readers modify
data, so read-only code reads RQ's keys directly.
"""

import json
import re
import zlib
from collections.abc import Collection, Iterable, Mapping
from itertools import combinations, product
from typing import Any, Final, TypeVar, cast

from pydantic import TypeAdapter, ValidationError
from redis.exceptions import RedisError, ResponseError
from rq import Queue, Worker
from rq.exceptions import DeserializationError
from rq.executions import Execution, ExecutionRegistry
from rq.job import Job
from rq.registry import StartedJobRegistry
from rq.serializers import JSONSerializer
from rq.worker_registration import WORKERS_BY_QUEUE_KEY

from graspd.service.model.engines import ENGINES
from graspd.service.model.errors import TaskRefused
from graspd.service.model.messages import FIRST_SCHEMA, Capabilities, Requirements, WorkerHeartbeat, message_type
from graspd.service.model.renamed import convert_names
from graspd.service.model.states import Priority, Stage
from graspd.service.model.version import SCHEMA_OF_ENGINES
from graspd.service.queue.port import Event, Message, priority_order

Entry = TypeVar("Entry", WorkerHeartbeat, Event)
_ADAPTERS: Final[dict[type, TypeAdapter[Any]]] = {kind: TypeAdapter(kind) for kind in (WorkerHeartbeat, Event)}
_ATTEMPT: Final = re.compile(r"(.+)-([0-9]{1,9})")
#: Limit of an unpacked message [bytes]; real messages have a few kilobytes.
_MESSAGE_BYTES: Final = 1 << 20
#: A stream is removed if its newest id is later than now by more than this [ms]: it would reject new entries.
_FUTURE_MS: Final = 24 * 3600 * 1000


def decode_text(raw: bytes | None) -> str:
    """Decode bytes from Redis; invalid UTF-8 becomes text that matches no name."""
    return (raw or b"").decode(errors="replace")


def split_rq_id(job: str) -> tuple[str, int]:
    """Split an RQ job id into task id and attempt; a forged id counts as a task id with attempt 0."""
    match = _ATTEMPT.fullmatch(job)
    return (match[1], int(match[2])) if match else (job, 0)


def is_type_error(error: Exception) -> bool:
    return str(error).startswith("WRONGTYPE")


def parse_message(data: bytes | None) -> Message | None:
    if data is None:
        return None
    try:
        raw = convert_names(json.loads(zlib.decompressobj().decompress(data, _MESSAGE_BYTES))[2][0])
        return message_type(raw).model_validate(raw)
    except Exception:  # Forged data may raise any error.
        return None


def parse_entry(kind: type[Entry], data: bytes | None) -> Entry | None:
    """Parse a worker's report or an event; None if it is malformed or of an incompatible version."""
    try:
        return cast(Entry, _ADAPTERS[kind].validate_json(data or b""))
    except ValidationError:
        return None


def parse_events(reply: Any) -> list[tuple[str, Event | None]]:
    """Return id and event of each entry of a reply; the event is None if trimmed or malformed."""
    streams = reply.items() if isinstance(reply, dict) else reply or []
    return [
        (event_id.decode(), parse_entry(Event, fields.get(b"e")) if fields else None)
        for _, found in streams
        for entry in found
        for event_id, fields in ([entry] if isinstance(entry, tuple) else entry)
    ]


def remove_mistyped_keys(connection: Any, kinds: Mapping[str, str], stream: str) -> None:
    """Remove keys whose type differs from `kinds`, and the event stream if it rejects new entries."""
    with connection.pipeline(transaction=False) as pipe:
        for name in kinds:
            pipe.type(name)
        found = dict(zip(kinds, map(decode_text, pipe.execute()), strict=True))
    wrong = [name for name, kind in found.items() if kind not in ("none", kinds[name])]
    if found[stream] == "stream":
        newest = int(decode_text(connection.xinfo_stream(stream)["last-generated-id"]).partition("-")[0])
        wrong += [stream] if newest > connection.time()[0] * 1000 + _FUTURE_MS else []
    if wrong:
        connection.delete(*wrong)


TASK_FUNCTION: Final = "graspd.task"
#: Lifetime of the data of a broken job in Redis [s]. Results are not stored: events report them.
FAILURE_TTL_S: Final = 3600


def new_job(message: dict[str, Any], **options: Any) -> Job:
    """Make a job without timeout, results, retries, callbacks or webhooks."""
    lifetimes = {"timeout": -1, "result_ttl": 0, "failure_ttl": FAILURE_TTL_S}
    return Job.create(TASK_FUNCTION, args=(message,), **lifetimes, serializer=JSONSerializer, **options)


def sanitized_job(job: Job, queue: Queue) -> Job:
    """Return a safe copy of a job from Redis; TaskRefused if the job is not a task of graspd."""
    try:
        name, message = str(job.func_name), job.args[0]
    except (DeserializationError, LookupError, TypeError):
        name, message = "an unreadable job", None
    if name != TASK_FUNCTION or job.instance is not None or not isinstance(message, dict):
        raise TaskRefused(f"the queue contains {name[:80]!r}, which is no task of graspd")
    return new_job(message, id=job.id, origin=queue.name, connection=job.connection, description=job.description)


def is_entry_error(error: Exception) -> bool:
    """Return whether RQ removed an entry from a list but could not parse it."""
    if not hasattr(error, "job_id"):  # RQ sets job_id on errors of reading an entry's job.
        return isinstance(error, UnicodeDecodeError)
    return not isinstance(error, RedisError) or is_type_error(error)


#: Keys of RQ's sets of all lists ever used, and of all workers.
LISTS: Final[str] = Queue.redis_queues_keys
RQ_WORKERS: Final[str] = Worker.redis_workers_keys
#: Order in which a worker reads stages: later stages first, so that started batches finish before new ones start.
_STAGE_ORDER: Final = (Stage.INGEST, Stage.EPISODE, Stage.RENDER, Stage.SCENE, Stage.SYNTHESIZE)
#: Maximum number of separate lists; further names are ignored.
_MOST_APART: Final = 64
_APART: Final = re.compile(rf"(.+?)\.([0-9]{{1,4}})\.([0-9]{{1,4}})((?:\.(?:{'|'.join(ENGINES[1:])}))*)")
_COMMON: Final = tuple(f"{priority.value}-{stage.value}" for priority, stage in product(Priority, Stage))
_PLACES: Final = dict(zip(_COMMON, product(Priority, Stage), strict=True))


def queue_name(priority: Priority, stage: Stage, need: Requirements | None = None) -> str:
    """Return the name of the RQ queue of a priority and stage, or of a separate list for a requirement."""
    common = f"{priority.value}-{stage.value}"
    return common if need is None else ".".join([common, str(need.schema), str(need.revision), *need.engines])


def queue_names(stages: Collection[Stage], taken: int = 0, *, ability: Capabilities | None = None) -> list[str]:
    """Return a worker's queues in reading order after `taken` tasks, separate lists before common ones."""
    return [
        queue_name(priority, stage, need)
        for priority in priority_order(taken)
        for stage in _STAGE_ORDER
        if stage in stages
        for need in (*_served_requirements(stage, ability), None)
    ]


def list_names(connection: Any) -> list[str]:
    """Return the names of lists that may contain tasks: the common ones, and all separate ones ever used."""
    try:
        found = connection.smembers(LISTS)
    except ResponseError as error:
        if not is_type_error(error):
            raise
        found = set()
    named = (decode_text(raw).removeprefix(Queue.redis_queue_namespace_prefix) for raw in found)
    return [*_COMMON, *sorted(name for name in named if is_separate(name))[:_MOST_APART]]


def priority_and_stage_of(name: str) -> tuple[Priority, Stage]:
    return _PLACES[_common_list_name(name)]


def is_separate(name: str) -> bool:
    return name not in _PLACES and _common_list_name(name) in _PLACES


def unserved_lists(names: Iterable[str], abilities: Collection[tuple[Stage, Capabilities]]) -> list[str]:
    """Return the separate lists that no capable worker of their stage reads."""
    served = {name for stage, ability in abilities for name in queue_names([stage], ability=ability)}
    return [name for name in names if is_separate(name) and name not in served]


def _common_list_name(name: str) -> str:
    found = _APART.fullmatch(name)
    return found[1] if found else name


def _served_requirements(stage: Stage, ability: Capabilities | None) -> list[Requirements]:
    """Return the requirements of separate lists that a worker can serve."""
    if ability is None:
        return []
    revision = ability.revisions.get(stage.value, 0)
    others = [one for one in ENGINES[1:] if one in ability.engines and stage is Stage.SYNTHESIZE]
    # Messages with engines have at least the schema of this option.
    sets = [chosen for size in range(len(others) + 1) for chosen in combinations(others, size)]
    return [
        Requirements(stage, schema, schema, revision, engines)
        for schema in range(FIRST_SCHEMA, ability.schemas[1] + 1)
        for engines in (sets if schema >= SCHEMA_OF_ENGINES else [()])
    ]


def list_key(name: str) -> str:
    return f"{Queue.redis_queue_namespace_prefix}{name}"


def lease_registry_key(name: str) -> str:
    return str(StartedJobRegistry.key_template.format(name))


def job_key(job: str) -> str:
    return f"{Job.redis_job_namespace_prefix}{job}"


def rq_worker_key(name: str) -> str:
    return f"{Worker.redis_worker_namespace_prefix}{name}"


def workers_key(name: str) -> str:
    return str(WORKERS_BY_QUEUE_KEY % name)


def execution_keys(entry: str) -> tuple[str, str]:
    """Return the keys of a lease's execution, and of all executions of its task."""
    job, _, execution = entry.partition(":")
    return Execution(execution, job, connection=None).key, str(ExecutionRegistry.key_template.format(job))


def key_types(lists: list[str]) -> dict[str, str]:
    types = ((list_key, "list"), (lease_registry_key, "zset"), (workers_key, "set"))
    return {key(name): kind for name in lists for key, kind in types}

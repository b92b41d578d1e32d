"""The lists in Redis that tasks wait in: one a priority and stage, so that a worker may serve some stages only.

While workers of two versions are there, a task that only some of them can do waits apart: in a list whose name ends in
what it asks of a worker, `bulk-synthesize.2.10` for schema 2 and revision 10. Who cannot do it never looks there.

Where RQ keeps what, RQ itself says. Its own readers clean up as they read, so what only looks reads keys.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable
from itertools import product
from typing import Any, Final

from redis.exceptions import ResponseError
from rq import Queue, Worker
from rq.executions import Execution, ExecutionRegistry
from rq.job import Job
from rq.registry import StartedJobRegistry
from rq.worker_registration import WORKERS_BY_QUEUE_KEY

from graspd.service.model.states import Priority, Stage
from graspd.service.model.workers import FIRST_SCHEMA, Capabilities, Requirements
from graspd.service.queue import entries
from graspd.service.queue.port import priority_order

#: Names of all lists that a task was ever put into, and of all workers.
LISTS: Final[str] = Queue.redis_queues_keys
RQ_WORKERS: Final[str] = Worker.redis_workers_keys
#: Later stages first: a batch that was begun is finished before the next begins.
_STAGE_ORDER: Final = (Stage.INGEST, Stage.RENDER, Stage.SCENE, Stage.SYNTHESIZE)
#: Versions that can be told apart at once; a name beyond them is nobody's.
_MOST_APART: Final = 64
_APART: Final = re.compile(r"(.+)\.([0-9]{1,4})\.([0-9]{1,4})")
_COMMON: Final = tuple(f"{priority.value}-{stage.value}" for priority, stage in product(Priority, Stage))
_PLACES: Final = dict(zip(_COMMON, product(Priority, Stage), strict=True))


def queue_name(priority: Priority, stage: Stage, need: Requirements | None = None) -> str:
    """Name of the RQ queue of a priority and stage; of what waits apart, if there is a need."""
    common = f"{priority.value}-{stage.value}"
    return common if need is None else f"{common}.{need.schema}.{need.revision}"


def queue_names(stages: Collection[Stage], taken: int = 0, *, ability: Capabilities | None = None) -> list[str]:
    """Queues of a worker that serves these stages, in the order in which it takes its next task after `taken`.

    What waits apart comes first: others cannot do it.
    """
    return [
        queue_name(priority, stage, need)
        for priority in priority_order(taken)
        for stage in _STAGE_ORDER
        if stage in stages
        for need in (*_needs(stage, ability), None)
    ]


def known_lists(connection: Any) -> list[str]:
    """Names of the lists that may hold tasks: the common ones, and those apart that were ever used."""
    try:
        found = connection.smembers(LISTS)
    except ResponseError as error:
        if not entries.is_wrong_type(error):
            raise
        found = set()
    named = (entries.text(raw).removeprefix(Queue.redis_queue_namespace_prefix) for raw in found)
    return [*_COMMON, *sorted(name for name in named if is_apart(name))[:_MOST_APART]]


def place_of(name: str) -> tuple[Priority, Stage]:
    """Lane and stage of a list of `known_lists`."""
    return _PLACES[_common(name)]


def is_apart(name: str) -> bool:
    """Whether a list is for some workers of its stage only."""
    return name not in _PLACES and _common(name) in _PLACES


def without_takers(names: Iterable[str], abilities: Collection[tuple[Stage, Capabilities]]) -> list[str]:
    """Lists apart that no worker looks into: none with such an ability serves their stage."""
    served = {name for stage, ability in abilities for name in queue_names([stage], ability=ability)}
    return [name for name in names if is_apart(name) and name not in served]


def _common(name: str) -> str:
    found = _APART.fullmatch(name)
    return found[1] if found else name


def _needs(stage: Stage, ability: Capabilities | None) -> list[Requirements]:
    """What a worker can do of what may wait apart."""
    if ability is None:
        return []
    revision = ability.revisions.get(stage.value, 0)
    return [Requirements(stage, schema, schema, revision) for schema in range(FIRST_SCHEMA, ability.schemas[1] + 1)]


def list_key(name: str) -> str:
    """List of waiting tasks."""
    return f"{Queue.redis_queue_namespace_prefix}{name}"


def held_key(name: str) -> str:
    """Leases of the tasks that were taken from a list."""
    return str(StartedJobRegistry.key_template.format(name))


def job_key(job: str) -> str:
    """What is known of a task and attempt."""
    return f"{Job.redis_job_namespace_prefix}{job}"


def rq_worker_key(name: str) -> str:
    """What RQ knows of a worker."""
    return f"{Worker.redis_worker_namespace_prefix}{name}"


def workers_key(name: str) -> str:
    """Workers that look into a list."""
    return str(WORKERS_BY_QUEUE_KEY % name)


def execution_keys(entry: str) -> tuple[str, str]:
    """Of a lease: the execution that it is of, and all executions of its task."""
    job, _, execution = entry.partition(":")
    return Execution(execution, job, connection=None).key, str(ExecutionRegistry.key_template.format(job))


def kinds(lists: list[str]) -> dict[str, str]:
    """Keys of lists, each with its type in Redis."""
    of_each = ((list_key, "list"), (held_key, "zset"), (workers_key, "set"))
    return {key(name): kind for name in lists for key, kind in of_each}

"""Redis lists of waiting tasks: one per priority and stage, so that workers can serve selected stages.

During an upgrade, a task that only some workers can do waits in a separate list. Its name ends in the requirements,
`bulk-synthesize.2.10` for schema 2 and revision 10; other workers never read it.

RQ defines the names of its keys. Its readers modify data as they read, so read-only code uses keys.
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

#: Sets of all lists ever used, and of all workers.
LISTS: Final[str] = Queue.redis_queues_keys
RQ_WORKERS: Final[str] = Worker.redis_workers_keys
#: Later stages first: started batches are finished before the next one starts.
_STAGE_ORDER: Final = (Stage.INGEST, Stage.RENDER, Stage.SCENE, Stage.SYNTHESIZE)
#: Limit of separate lists by version; further names are ignored.
_MOST_APART: Final = 64
_APART: Final = re.compile(r"(.+)\.([0-9]{1,4})\.([0-9]{1,4})")
_COMMON: Final = tuple(f"{priority.value}-{stage.value}" for priority, stage in product(Priority, Stage))
_PLACES: Final = dict(zip(_COMMON, product(Priority, Stage), strict=True))


def queue_name(priority: Priority, stage: Stage, need: Requirements | None = None) -> str:
    """Return the name of the RQ queue of a priority and stage, or of a separate list for a requirement."""
    common = f"{priority.value}-{stage.value}"
    return common if need is None else f"{common}.{need.schema}.{need.revision}"


def queue_names(stages: Collection[Stage], taken: int = 0, *, ability: Capabilities | None = None) -> list[str]:
    """Return the queues of a worker for these stages, in the order of its next task after `taken` tasks.

    Separate lists come first, because other workers cannot serve them.
    """
    return [
        queue_name(priority, stage, need)
        for priority in priority_order(taken)
        for stage in _STAGE_ORDER
        if stage in stages
        for need in (*_needs(stage, ability), None)
    ]


def list_names(connection: Any) -> list[str]:
    """Return the names of lists that may contain tasks: the common ones, and all separate ones ever used."""
    try:
        found = connection.smembers(LISTS)
    except ResponseError as error:
        if not entries.is_type_error(error):
            raise
        found = set()
    named = (entries.text(raw).removeprefix(Queue.redis_queue_namespace_prefix) for raw in found)
    return [*_COMMON, *sorted(name for name in named if is_separate(name))[:_MOST_APART]]


def place_of(name: str) -> tuple[Priority, Stage]:
    return _PLACES[_common(name)]


def is_separate(name: str) -> bool:
    return name not in _PLACES and _common(name) in _PLACES


def unserved_lists(names: Iterable[str], abilities: Collection[tuple[Stage, Capabilities]]) -> list[str]:
    """Return the separate lists that no capable worker of their stage reads."""
    served = {name for stage, ability in abilities for name in queue_names([stage], ability=ability)}
    return [name for name in names if is_separate(name) and name not in served]


def _common(name: str) -> str:
    found = _APART.fullmatch(name)
    return found[1] if found else name


def _needs(stage: Stage, ability: Capabilities | None) -> list[Requirements]:
    """Return the requirements of separate lists that a worker can serve."""
    if ability is None:
        return []
    revision = ability.revisions.get(stage.value, 0)
    return [Requirements(stage, schema, schema, revision) for schema in range(FIRST_SCHEMA, ability.schemas[1] + 1)]


def list_key(name: str) -> str:
    return f"{Queue.redis_queue_namespace_prefix}{name}"


def held_key(name: str) -> str:
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


def kinds(lists: list[str]) -> dict[str, str]:
    of_each = ((list_key, "list"), (held_key, "zset"), (workers_key, "set"))
    return {key(name): kind for name in lists for key, kind in of_each}

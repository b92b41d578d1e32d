"""Actions of users on jobs (submit, cancel, retry), checks of assets, division of jobs into tasks."""

import logging
import math
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Final, Literal, TypeVar

import numpy as np
from sqlalchemy import Connection

from graspd.service.index.queries.feed import ReadyTask
from graspd.service.index.queries.overview import BatchCost
from graspd.service.index.queries.rates import Rates, expected_candidates
from graspd.service.index.views import AssetView, JobView
from graspd.service.model import names
from graspd.service.model.clock import timestamp
from graspd.service.model.digests import job_id
from graspd.service.model.domain import JobOptions, JobRequest, count_batches
from graspd.service.model.errors import ConflictError, InputError, NotFoundError, SceneError, UnavailableError
from graspd.service.model.messages import (
    Capabilities,
    Origin,
    Requirements,
    WorkerHeartbeat,
    capabilities,
    requirements_of,
)
from graspd.service.model.planning import create_task_message, priority_of
from graspd.service.model.projects import EVERYTHING, ProjectScope
from graspd.service.model.records import MOST_BATCHES, DatasetMember, JobRecord
from graspd.service.model.scene_spec import HalfSpace, Pose, Supports
from graspd.service.model.states import AssetKind, Priority, Stage, State
from graspd.service.model.transforms import quat_conjugate, quat_rotate
from graspd.service.model.version import SCHEMA_OF_RANGES
from graspd.service.pipeline.backends import Services, record_transaction
from graspd.service.pipeline.fidelity_choice import FidelityResolver
from graspd.service.queue.port import Event, EventKind, Message
from graspd.service.store.records import add_job_event, job_events, put_record, read_record, refuse_pending_deletion
from graspd.service.telemetry import bound_subject

log = logging.getLogger(__name__)
Options = TypeVar("Options", bound=JobOptions)
#: Time [s] for which a task is held back if no worker is capable of it.
HELD_S: Final = 10.0
#: Allowed depth of a centre of mass in a support [m], because the centre was measured on another mesh.
_SUNK_M: Final = 1e-3
#: Number of finished tasks from which the time of a batch is measured.
_LOOKED_AT: Final = 64
#: Assumed number of workers if none is present, because a service may start them once a task waits.
_EXPECTED: Final = 8
#: Cache lifetime of workers and costs [s].
_KNOWN_S: Final = 10.0


class TaskRanges:
    def __init__(
        self, services: Services, *, scope: ProjectScope = EVERYTHING, clock: Callable[[], float] = time.monotonic
    ) -> None:
        """`scope` limits the finished tasks whose costs are used."""
        self._services, self._scope, self._clock = services, scope, clock
        self._read_again = -math.inf
        self._workers: list[WorkerHeartbeat] = []
        self._costs: list[BatchCost] = []

    def with_span(self, job: JobRecord, *, among: int = 1) -> JobRecord:
        """Return a job with its number of batches per task, `span`; `among` jobs share the workers."""
        batches, wanted_s = count_batches(job.request.grasps), self._services.settings.task_s
        # The shard with pictures or films of a single batch already has megabytes.
        if batches == 1 or job.request.views or job.request.has_episodes or not wanted_s:
            return job
        if self._clock() >= self._read_again:
            self._workers = self._services.queue.workers()
            self._costs = self._services.index.costs.batch_costs(Stage.SYNTHESIZE, limit=_LOOKED_AT, scope=self._scope)
            self._read_again = self._clock() + _KNOWN_S
        able = [worker for worker in self._workers if Stage.SYNTHESIZE in worker.stages]
        if any(worker.capabilities.schemas[1] < SCHEMA_OF_RANGES for worker in able):
            return job
        # On CPUs, an interactive job shows its grasps batch by batch; a GPU makes them in one launch.
        if job.priority is Priority.INTERACTIVE and not (able and all(one.device.startswith("cuda") for one in able)):
            return job
        rate = Rates(self._costs, job.request, {one.device for one in able}).rate_for(
            job.request.hand, job.request.object
        )
        batch_s = rate.seconds_per_try * expected_candidates(rate, job.request) / batches
        by_time = int(wanted_s / max(1e-3, batch_s or wanted_s))
        workers = -(-(len(able) or _EXPECTED) // among)
        return job.model_copy(update={"span": span_of(batches, by_time, workers)})


def span_of(batches: int, by_time: int, workers: int) -> int:
    """Return the batches per task: at most `by_time`, fewer if workers would be idle, evenly divided."""
    most = max(1, min(by_time, MOST_BATCHES, -(-batches // max(1, workers))))
    return -(-batches // -(-batches // most))


def usable_asset(services: Services, kind: AssetKind, name: str, scope: ProjectScope = EVERYTHING) -> AssetView:
    """Return an asset by name or digest for use in a job.

    NotFoundError: it is not in scope. InputError: it failed its check. ConflictError: its check has not ended.
    """
    asset = services.index.assets.get(kind, name, scope=scope)
    if asset.verdict == "refuse":
        raise InputError(f"{kind.value} {name!r} was refused: {asset.message}")
    if asset.verdict is None:
        why = f" ({asset.message})" if asset.message else ""
        raise ConflictError(f"{kind.value} {name!r} is still being checked{why}; submit again in a moment")
    return asset


def refuse_deleted(services: Services, wanted: Sequence[tuple[AssetKind, str]], connection: Connection) -> None:
    if missing := services.index.assets.missing(wanted, within=connection):
        raise NotFoundError(f"there is no {missing[0]} any more; it was deleted just now")


def resolve_neighbours(
    services: Services, options: Options, scope: ProjectScope = EVERYTHING
) -> tuple[Options, Sequence[AssetView]]:
    """Return options with a digest for each neighbour, and the neighbours; given digests stay.

    Errors as in `usable_asset`; InputError: name and digest of a neighbour belong to two objects.
    """
    beside = [
        usable_asset(services, AssetKind.OBJECT, one.digest or one.object, scope) for one in options.all_neighbours
    ]
    found = []
    for one, asset in zip(options.all_neighbours, beside, strict=True):
        if one.object not in (asset.name, asset.digest):
            raise InputError(f"the neighbour {one.object!r} has the digest of {asset.name!r}; omit the digest")
        found.append(one.model_copy(update={"object": asset.name, "digest": asset.digest}))
    return options.replace_neighbours(found), beside


def resolve_network(
    services: Services, options: Options, hands: Sequence[AssetView | DatasetMember], scope: ProjectScope = EVERYTHING
) -> Options:
    """Return options with the digest of their network, if they have one.

    Errors as in `usable_asset`; InputError: the network proposes grasps of another hand.
    """
    if not options.network:
        return options
    network = usable_asset(services, AssetKind.NETWORK, options.network, scope)
    own = str(network.facts.get("hand_digest", ""))
    if other := next((hand for hand in hands if hand.digest != own), None):
        raise InputError(
            f"network {network.name!r} proposes grasps of {network.facts.get('hand')} ({own[:12]}), not of "
            f"{other.name} ({other.digest[:12]})"
        )
    return options.model_copy(update={"options": {**options.options, "network": network.digest}})


def submit(services: Services, request: JobRequest, *, priority: Priority | None = None) -> tuple[JobView, bool]:
    """Prepare and enter a job; return it, and whether it is new: equal requests give one job."""
    return enter_job(services, prepare_job(services, request, priority=priority))


def prepare_job(
    services: Services,
    request: JobRequest,
    *,
    priority: Priority | None = None,
    owner: str = "",
    scope: ProjectScope = EVERYTHING,
) -> JobRecord:
    """Return the job of a request; `priority` None: interactive for a small job, else bulk.

    Errors of `usable_asset`, `resolve_neighbours`, `resolve_network` and `check_scene`.
    InputError: no fidelity is good enough.
    """
    hand = usable_asset(services, AssetKind.HAND, request.hand, scope)
    obj = usable_asset(services, AssetKind.OBJECT, request.object, scope)
    request, beside = resolve_neighbours(services, request, scope)
    request = resolve_network(services, request, [hand], scope)
    check_scene(request, obj, beside)
    services.queue.ping()
    named = request.model_copy(update={"hand": hand.name, "object": obj.name})
    request, choice = FidelityResolver(services.store).choose(named)
    origin = Origin(request=bound_subject("request"), key=bound_subject("key"))
    record = JobRecord(
        id=job_id(request, hand.digest, obj.digest, scope.project),
        request=request,
        hand_digest=hand.digest,
        object_digest=obj.digest,
        priority=priority or priority_of(request),
        created=timestamp(),
        origin=origin if origin != Origin() else None,
        owner=owner,
        project=scope.project,
        choice=choice,
    )
    return TaskRanges(services, scope=scope).with_span(record)


def enter_job(services: Services, record: JobRecord, *, keeps_assets: bool = False) -> tuple[JobView, bool]:
    """Record a planned job and queue its first tasks; return the job, and whether it is new.

    The controller queues the other tasks. `keeps_assets`: a dataset protects the assets from deletion.
    NotFoundError: an asset was deleted. ConflictError: the same job was deleted, and its stored objects still exist.
    """
    key = names.job_record_key(record.id)
    # The record of a dataset's job is written before the transaction, so that the index is locked for less time.
    new = keeps_assets and put_record(services.store, key, record)
    with record_transaction(services, [key] if new else []) as (connection, put):
        new = new or (not keeps_assets and put(key, record))
        refuse_pending_deletion(services.store, "job", record.id)
        if not new:
            if not services.store.exists(key):
                raise ConflictError(f"job {record.id} was deleted just now; submit it again")
            record = read_record(JobRecord, services.store, key)
        if not keeps_assets:
            refuse_deleted(services, record.assets, connection)
        services.index.write.enter_job(record, within=connection)
    _queue_first_tasks(services, record.id)
    return services.index.jobs.get(record.id), new


def cancel(services: Services, job_id: str, *, cause: str = "") -> JobView:
    """Stop a job: waiting tasks never start, running ones stop at the next launch, finished shards stay.

    `cause` is the dataset event that caused this, if any. ConflictError: the job has ended.
    """
    with _event_transaction(services, job_id, _refuse_ended) as add:
        in_queue = services.index.feed.queued_tasks(job_id)
        add("cancelled", cause=cause)
    try:
        services.queue.discard(in_queue)
    except UnavailableError as error:
        log.warning("job %s is cancelled; its queued tasks are removed when the queue answers: %s", job_id, error)
    return _publish_state(services, job_id)


def retry(services: Services, job_id: str, *, cause: str = "") -> JobView:
    """Restart unsuccessful tasks of a failed or cancelled job, with new attempts; else ConflictError."""
    with _event_transaction(services, job_id, _require_failures) as add:
        add("retried", services.index.feed.failed_tasks(job_id), cause=cause)
    _queue_first_tasks(services, job_id)
    return _publish_state(services, job_id)


@dataclass(frozen=True)
class Route:
    apart: bool = False
    """Whether the task waits in a separate list, which only capable workers read."""
    held: str = ""
    """Reason for which the task is held back; empty if it is not."""


class Routes:
    def __init__(self, present: Sequence[WorkerHeartbeat] = ()) -> None:
        self._here: dict[Stage, list[Capabilities]] = defaultdict(list)
        for beat in present:
            for stage in beat.stages:
                if beat.capabilities not in self._here[stage]:
                    self._here[stage].append(beat.capabilities)

    def route_of(self, need: Requirements) -> Route:
        """Choose the common list if all workers of the stage are capable, a separate one if some are.

        If none is, the task is held back. Without workers, the capabilities of this version are assumed.
        """
        here = self._here.get(need.stage) or [capabilities()]
        lacking = {one.unmet_requirement(need) for one in here}
        if "" not in lacking:
            return Route(held=f"held back, because no present worker is capable: {'; '.join(sorted(lacking))}")
        return Route(apart=lacking != {""})


def queue_tasks(services: Services, ready: Sequence[ReadyTask], *, routes: Routes, again: bool = False) -> set[str]:
    """Mark tasks with a capable worker as queued and queue them; return why others are held back.

    A kill in between does no harm: the controller queues marked tasks that the queue lacks.
    """
    to_queue: dict[tuple[Priority, bool], list[Message]] = defaultdict(list)
    held: dict[str, list[str]] = defaultdict(list)
    for task in ready:
        most = task.retried_upto + services.settings.task_attempts
        message = create_task_message(task.job, task.task, attempt=task.last_attempt + 1, max_attempt=most)
        place = routes.route_of(requirements_of(message))
        if place.held:
            held[place.held].append(task.task.id)
        else:
            to_queue[task.priority, place.apart].append(message)
    for why, tasks in held.items():
        services.index.live.set_waiting(tasks, not_before=time.time() + HELD_S, message=why)
    if to_queue:
        services.index.live.set_queued([message.task_id for messages in to_queue.values() for message in messages])
    for (priority, apart), messages in sorted(to_queue.items()):
        services.queue.enqueue(messages, priority, again=again, apart=apart)
    return set(held)


def _queue_first_tasks(services: Services, job_id: str) -> None:
    """Queue tasks of a job until the queue's window is full; the controller queues the other ones."""
    try:
        room = services.settings.queue_window - sum(services.queue.depths().values())
        if room > 0:
            routes = Routes(services.queue.workers())
            queue_tasks(services, services.index.feed.ready_tasks_of_job(job_id, limit=room), routes=routes)
        _publish_state(services, job_id)
    except UnavailableError as error:
        log.warning("job %s is recorded; its tasks are queued when the queue answers: %s", job_id, error)


@contextmanager
def _event_transaction(
    services: Services, job_id: str, refuse: Callable[[JobView], None]
) -> Iterator[Callable[..., None]]:
    """Yield a function that appends an event to a job within an index transaction, unless `refuse` raises."""
    # Earlier events are read before the transaction, because the store may be slow.
    refuse(services.index.jobs.get(job_id))
    before = job_events(services.store, job_id)
    with record_transaction(services) as (connection, put):
        refuse(services.index.jobs.get(job_id))

        def add(what: Literal["cancelled", "retried"], retried: dict[str, int] | None = None, *, cause: str) -> None:
            event = add_job_event(services.store, job_id, what, retried, cause=cause, put=put)
            is_next = event.number == max((one.number for one in before), default=0) + 1
            events = [*before, event] if is_next else job_events(services.store, job_id)
            services.index.write.set_job_events(job_id, events, within=connection)

        yield add


def _refuse_ended(job: JobView) -> None:
    if job.state.is_final:
        ended = "been cancelled" if job.state is State.CANCELLED else job.state.value
        raise ConflictError(f"job {job.id} has already {ended}; there is nothing to cancel")


def _require_failures(job: JobView) -> None:
    if job.state not in (State.FAILED, State.CANCELLED):
        raise ConflictError(f"job {job.id} is {job.state}; only a failed or cancelled job can be retried")


def _publish_state(services: Services, job_id: str) -> JobView:
    job = services.index.jobs.get(job_id)
    try:
        services.queue.publish(Event(kind=EventKind.JOB, at=timestamp(), job_id=job_id, message=job.state.value))
    except UnavailableError as error:
        log.warning("the state of job %s, %s, was not announced: %s", job_id, job.state, error)
    return job


def check_scene(options: JobOptions, obj: AssetView, beside: Sequence[AssetView] = ()) -> None:
    """Raise SceneError if a centre of mass lies in a support; the first task makes further checks."""
    place = options.scene_spec
    _check_pose(obj, "target", place.target, place.supports)
    for asset, one in zip(beside, place.neighbours, strict=True):
        _check_pose(asset, "neighbour", one.pose, place.supports)


def _check_pose(obj: AssetView, word: str, pose: Pose | None, supports: Supports) -> None:
    centre = obj.facts.get("centre_of_mass_m")
    if pose is None or not isinstance(centre, list) or len(centre) != 3:
        return
    target = np.asarray(pose)
    at = quat_rotate(target[3:], np.asarray(centre, float)) + target[:3]
    for number, support in enumerate(supports):
        if isinstance(support, HalfSpace):
            normal = np.asarray(support.normal)
            depth = float(support.offset - normal @ at) / float(np.linalg.norm(normal))
        else:
            box = np.asarray(support.pose)
            inside = quat_rotate(quat_conjugate(box[3:]), at - box[:3])
            depth = float((np.asarray(support.size) / 2 - np.abs(inside)).min())
        if depth > _SUNK_M:
            raise SceneError(
                f"{obj.name} penetrates support {number} of its scene: its centre is {1e3 * depth:.0f} mm inside; move "
                f"the {word} or the support"
            )

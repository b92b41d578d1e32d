"""Jobs and their shards: submission within quotas, progress, rate, expected end, changes by owners."""

import contextlib
import logging
import threading
import time
from collections import OrderedDict
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from functools import partial
from typing import Any, Final

import numpy as np
from pydantic import ValidationError

from graspd.api.access.auth import ForeignResource, InScope, caller, caller_id, project_scope, require_ownership
from graspd.api.access.quotas import Idempotency, Quotas
from graspd.api.catalog.grasps import Grasps
from graspd.api.models import Job, JobDetail, MeanMetrics, Shard, StageStatus, stage_state
from graspd.service.index.views import JobView, Page, ShardView, StageProgress, TaskView
from graspd.service.model import errors
from graspd.service.model.domain import JobOptions, JobRequest
from graspd.service.model.records import AttemptRecord
from graspd.service.model.states import Stage, State
from graspd.service.pipeline import deletion, job_actions
from graspd.service.pipeline.backends import Services
from graspd.service.pipeline.datasets.cost import estimate
from graspd.service.pipeline.datasets.spec import Estimate, Matrix
from graspd.service.queue.port import rq_id
from graspd.service.store.integrity import CheckedObjects, read_checked
from graspd.service.store.manifests import load_manifest
from graspd.service.store.records import task_attempts
from graspd.service.store.shards import open_shard
from graspd.service.telemetry import bind_subjects

log = logging.getLogger(__name__)
_PAGE: Final = 200
#: Number of waiting tasks that are searched for a reason to wait.
_LOOKED_AT: Final = 20
_ORDER: Final = {stage: place for place, stage in enumerate(Stage)}
_SHARED: Final = Job.model_fields.keys() & JobView.model_fields.keys() - {"reason", "stages"}
_DETAILS: Final = JobDetail.model_fields.keys() & JobView.model_fields.keys() - Job.model_fields.keys() | {"note"}


class Shards:
    """Shards of the jobs in the caller's scope; they never change."""

    def __init__(self, services: Services) -> None:
        self._services = services
        self._checked = CheckedObjects(services.store)

    def page(self, **wanted: Any) -> Page[Shard]:
        """Return a page of shards; `wanted` has the filters and the paging of the index."""
        page = self._services.index.shards.page(**wanted, scope=project_scope())
        return Page[Shard](items=[_shard_model(shard) for shard in page.items], next=page.next)

    def get(self, shard_id: str) -> Shard:
        return _shard_model(self._services.index.shards.get(shard_id, scope=project_scope()))

    def get_intact(self, shard_id: str) -> Shard:
        """Return a shard, and check its file against its checksum if the file changed since the last check."""
        shard = self.get(shard_id)
        self._checked.check(shard.key, shard.sha256)
        return shard

    def signed_url(self, shard: Shard) -> str | None:
        """Return the address at which the store serves the file to GET; None if only the API serves it."""
        return self._services.store.sign(shard.key)

    def size(self, shard: Shard) -> int:
        return self._services.store.size(shard.key)

    def stream(self, shard: Shard, start: int, length: int) -> Iterator[bytes]:
        """Yield bytes of the file in chunks; DamagedShard if they changed since the check of the file."""
        return self._checked.stream(shard.key, shard.sha256, start, length)

    job_of = InScope(lambda index: index.shards.job_of)

    def film(self, shard_id: str, row: int, camera: str) -> bytes:
        """Return the video of a grasp's episode; NotFoundError if it was not executed or not filmed."""
        shard = self.get(shard_id)
        with open_shard(read_checked(self._services.store, shard.key, shard.sha256), name=shard.key) as file:
            if f"video/{camera}" in file and row in (rows := file["episode/row"][:].tolist()):
                ends, place = np.cumsum(file[f"video/{camera}_bytes"][:]), rows.index(row)
                if film := file[f"video/{camera}"][ends[place - 1] if place else 0 : ends[place]].tobytes():
                    return bytes(film)
        raise errors.NotFoundError(f"shard {shard_id} has no film of grasp {row} by a camera {camera!r}")

    def assets_of(self, ids: Collection[str]) -> dict[str, tuple[str, str]]:
        return self._services.index.shards.assets_of(ids)


def _shard_model(shard: ShardView) -> Shard:
    return Shard(**shard.model_dump(), file=f"/v1/shards/{shard.id}/file")


class Jobs:
    """Jobs in the caller's scope; changes can raise ForeignResource (another owner) and QuotaError."""

    def __init__(
        self, services: Services, quotas: Quotas, idempotency: Idempotency, grasps: Grasps, shards: Shards
    ) -> None:
        self._services = services
        self._quotas = quotas
        self._idempotency = idempotency
        self._grasps = grasps
        self._shards = shards
        self._paces = TaskRates()

    def submit(self, request: JobRequest, *, idempotency_key: str | None = None) -> JobDetail:
        """Record a job, or return the existing identical job."""
        key = caller.get()
        bound: contextlib.AbstractContextManager[None] = contextlib.nullcontext()
        if idempotency_key is not None:
            bound = self._idempotency.claim(key.name if key else "", idempotency_key, request)
        with bound:
            record = job_actions.prepare_job(self._services, request, owner=caller_id(), scope=project_scope())
            with bind_subjects(job=record.id), self._quotas.claim(key, record.id, record.request.grasps) as claim:
                job, is_new = job_actions.enter_job(self._services, record)
                claim.counts = is_new
                log.info("job submitted" if is_new else "job existed already")
        # An identical job may exist with a named fidelity; the response has the choice made for this request.
        return self._job_detail(job).model_copy(update={"choice": record.choice or job.choice})

    def cancel(self, job_id: str) -> JobDetail:
        self._get_owned(job_id)
        with bind_subjects(job=job_id):
            job = job_actions.cancel(self._services, job_id)
            log.info("job cancelled")
        return self._job_detail(job)

    def retry(self, job_id: str) -> JobDetail:
        grasps = self._get_owned(job_id).request.grasps
        with bind_subjects(job=job_id), self._quotas.claim(caller.get(), job_id, grasps, is_new=False):
            job = job_actions.retry(self._services, job_id)
            log.info("job retried")
        return self._job_detail(job)

    def delete(self, job_id: str) -> None:
        self._get_owned(job_id)
        with bind_subjects(job=job_id):
            deletion.delete_job(self._services, job_id, owner=caller_id())
            log.info("job deleted")

    def page(self, **wanted: Any) -> Page[Job]:
        """Return a page of jobs; `wanted` has the filters, the order and the paging of the index."""
        page = self._services.index.jobs.page(**wanted, scope=project_scope())
        return Page[Job](items=[self._job_model(job, ()) for job in page.items], next=page.next)

    def get(self, job_id: str) -> JobDetail:
        return self._job_detail(self._services.index.jobs.get(job_id, details=True, scope=project_scope()))

    def get_progress(self, job_id: str) -> Job:
        """Return a job with only the progress of its stages, for event streams."""
        return self._job_model(
            self._services.index.jobs.get(job_id, scope=project_scope()), self._reported_tasks(job_id)
        )

    def change(self, action: str, wanted: Iterable[Any]) -> tuple[int, list[str]]:
        """Cancel, retry, delete or submit jobs; return the number of successes and causes of refusals."""
        acts: dict[str, Callable[[Any], object]]
        acts = {"submit": self.submit, "cancel": self.cancel, "retry": self.retry, "delete": self.delete}
        changed, problems = 0, []
        for one in wanted:
            try:
                acts[action](one)
                changed += 1
            except (errors.ConflictError, errors.NotFoundError, ForeignResource, errors.LimitError) as error:
                problems.append(str(error))
        return changed, problems

    def tasks(self, job_id: str, *, limit: int = 50) -> list[TaskView]:
        """Return the first tasks of a job: running ones, then failed ones, then others by batch."""
        tasks = partial(self._services.index.jobs.tasks, job=job_id, limit=limit)
        found = [task for state in (State.RUNNING, State.FAILED, None) for task in tasks(state=state).items]
        return list({task.id: task for task in found}.values())[:limit]

    def task(self, job_id: str, task_id: str) -> tuple[TaskView, dict[str, Any], list[AttemptRecord]]:
        """Return a task, the `info` of its manifest (else only its log so far), and its failed attempts."""
        task, info = self._services.index.jobs.task(task_id, scope=project_scope()), dict[str, Any]()
        if task.job_id != job_id:
            raise errors.NotFoundError(f"job {job_id} has no task {task_id!r}")
        with contextlib.suppress(errors.UnavailableError, errors.NotFoundError, errors.DamagedError):
            info = {"log": self._services.queue.task_log(rq_id(task.id, task.attempt))}
            if task.state is State.SUCCEEDED:
                info |= load_manifest(self._services.store, task.stage, task.shard_id).info
        return task, info, task_attempts(self._services.store, task.id)[::-1]

    def estimate(self, job: JobDetail) -> Estimate | None:
        """Estimate a job's cost from the last tasks that were finished before its submission; None if unknown."""
        costs = partial(self._services.index.costs.batch_costs, limit=64, before=job.created, scope=project_scope())
        options = {name: getattr(job.request, name) for name in JobOptions.model_fields}
        with contextlib.suppress(ValidationError, errors.GraspdError):
            matrix = Matrix(hands=(job.hand,), objects=(job.object,), **options)
            return estimate(self._services.index, matrix, costs=costs, scope=project_scope())
        return None

    def _get_owned(self, job_id: str) -> JobView:
        job = self._services.index.jobs.get(job_id, scope=project_scope())
        require_ownership(job.owner, f"job {job_id}", job.project)
        return job

    def _job_detail(self, job: JobView) -> JobDetail:
        distributions, diversity = self._grasps.statistics(job)
        shards = self._shards.page(job=job.id, limit=_PAGE).items
        return JobDetail(
            **self._job_model(job, self._reported_tasks(job.id)).model_dump(),
            **{name: getattr(job, name) for name in _DETAILS},
            attempts=self._services.index.jobs.attempts(job=job.id, limit=50),
            mean=MeanMetrics(**{name: one.mean for name, one in distributions.items()}),
            diversity=diversity,
            shards=sorted(shards, key=lambda shard: (shard.batch, _ORDER[shard.stage])),
        )

    def _job_model(self, job: JobView, running: Sequence[TaskView]) -> Job:
        request = job.request
        stages = stage_statuses(job, running, self._paces)
        tasks = sum(stage.tasks for stage in job.stages)
        return Job(
            **{name: getattr(job, name) for name in _SHARED},
            **{name: getattr(request, name) for name in ("hand", "object", "method")},
            standing=request.displayed_status,
            fidelity=request.fidelity if isinstance(request.fidelity, str) else request.fidelity.name,
            requested=request.grasps,
            progress=min(1.0, sum(stage.done for stage in job.stages) / tasks) if tasks else 0.0,
            eta_s=eta_of_job(job, stages),
            reason=job.reason or job.note,
            stages=stages,
        )

    def _reported_tasks(self, job_id: str) -> list[TaskView]:
        """Return running tasks, then those of the first waiting tasks that have a reason to wait."""
        tasks = self._services.index.jobs.tasks
        running = tasks(job=job_id, state=State.RUNNING, limit=_PAGE).items
        waiting = tasks(job=job_id, state=State.QUEUED, limit=_LOOKED_AT).items
        return [*running, *(task for task in waiting if task.message)]


#: Shortest time between two observations [s]: with a shorter one, report times would dominate the rate.
_LEAST_SPAN_S: Final = 1.0
#: Least finished share of a task for a rate: before it, a task mostly loads data.
_LEAST_SHARE: Final = 0.03
_KEPT_TASKS: Final = 4096


class TaskRates:
    """Rates of running tasks, from the first and the latest observation of each in this process."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._first: OrderedDict[tuple[str, int], tuple[float, float]] = OrderedDict()
        self._lock = threading.Lock()

    def rate_of(self, task: TaskView) -> float | None:
        """Return the share of the task done per second; None while unknown."""
        share = task.done / task.total if task.total else 0.0
        now = self._clock()
        with self._lock:
            since, start = self._first.setdefault((task.id, task.attempt), (now, share))
            while len(self._first) > _KEPT_TASKS:
                self._first.popitem(last=False)
        if now - since < _LEAST_SPAN_S or share - start < _LEAST_SHARE:
            return None
        return (share - start) / (now - since)


def stage_statuses(job: JobView, tasks: Sequence[TaskView], paces: TaskRates) -> list[StageStatus]:
    """Return the stages of a job; `tasks` are its running tasks, and waiting ones with a reason to wait."""
    return [_stage_status(stage, [task for task in tasks if task.stage is stage.stage], paces) for stage in job.stages]


def eta_of_job(job: JobView, stages: Sequence[StageStatus]) -> float | None:
    """Return the expected time until a running job ends [s], summed over stages; None if unknown."""
    if job.state is not State.RUNNING:
        return None
    remaining = [stage for stage in stages if stage.progress < 1]
    if not remaining or any(stage.eta_s is None for stage in remaining):
        return None
    return sum(stage.eta_s or 0.0 for stage in remaining)


def _stage_status(stage: StageProgress, tasks: list[TaskView], paces: TaskRates) -> StageStatus:
    state = stage_state(stage)
    running = [task for task in tasks if task.state is State.RUNNING]
    rate = None if state.is_final else _stage_rate(stage, running, paces)
    left = max(0.0, stage.tasks - stage.done)
    return StageStatus(
        **stage.model_dump(),
        state=state,
        progress=min(1.0, stage.done / stage.tasks) if stage.tasks else 0.0,
        message=next((task.message for task in tasks if task.message), ""),
        rate_per_s=rate,
        eta_s=left / rate if rate else None,
    )


def _stage_rate(stage: StageProgress, running: list[TaskView], paces: TaskRates) -> float | None:
    """Return tasks per second of the running tasks; if unknown, the mean rate of the finished tasks."""
    known = [pace for task in running if (pace := paces.rate_of(task)) is not None]
    if known:
        return sum(known) * len(running) / len(known)
    if stage.succeeded > stage.reused and stage.seconds > 0:
        return (stage.succeeded - stage.reused) / stage.seconds * max(1, stage.running)
    return None

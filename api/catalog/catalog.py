"""What the routes and the pages read and do, as documents: index, store, queue and pipeline stand behind them.

Nothing is kept here between two requests but what may be lost, so any number of API processes answer alike.
"""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime, timedelta
from typing import Final, Literal

from api.access.auth import caller, must_own
from api.access.idempotency import Idempotency
from api.access.quotas import Quotas
from api.access.unfinished import unfinished
from api.catalog.grasp_files import GraspFiles
from api.catalog.health import Probes
from api.catalog.progress import Paces, eta_of_job, progress_of_job, stage_statuses
from api.metrics import Snapshot
from api.models import (
    GraspDetail,
    GraspQuery,
    Health,
    Histogram,
    Job,
    JobDetail,
    LossCurve,
    MeanMetrics,
    Part,
    Shard,
    Worker,
)
from service.index.at_scrape import read_index
from service.index.filters import GraspFilter, GraspSort, Metric
from service.index.notes import Damage
from service.index.views import (
    AssetView,
    FailureGroup,
    GraspView,
    JobView,
    Page,
    ShardView,
    Stats,
    TaskView,
)
from service.logs import bind
from service.model.digests import digest_files
from service.model.domain import AssetKind, JobRequest, Lane, Stage, State
from service.model.errors import ConflictError, NotFoundError, UnavailableError
from service.pipeline import deletion, job_actions
from service.pipeline.backends import Parts
from service.pipeline.keeper import PART as KEEPER
from service.queue.address import redis_url
from service.queue.at_scrape import QueueNow
from service.queue.connection import connect
from service.store import library
from service.store.integrity import Checked
from service.store.store import Store

log = logging.getLogger(__name__)
_PAGE: Final = 200
_ORDER: Final = {stage: place for place, stage in enumerate(Stage)}
_KEPT_HISTOGRAMS: Final = 256
_LOSS_BATCHES: Final = 8
_DAMAGE_SHOWN: Final = 5
MEAN_METRICS: Final[tuple[Metric, ...]] = (
    "epsilon",
    "contact_area_cm2",
    "intersection_volume_cm3",
    "penetration_depth_mm",
)


class Catalog:
    """The service as the front door shows it. Methods raise the errors of `service.model.errors`."""

    def __init__(self, parts: Parts) -> None:
        self._parts = parts
        redis = connect(redis_url(parts.settings), patience=1)
        self._idempotency = Idempotency(redis)
        self.quotas = Quotas(parts.settings, redis, lambda ids: unfinished(parts.index, ids))
        self._paces = Paces()
        self._histograms: dict[tuple[str, int], list[Histogram]] = {}
        self._losses: dict[str, tuple[int, list[float]] | None] = {}
        self._grasp_files = GraspFiles(parts.store)
        self._checked = Checked(parts.store)
        self._probes = Probes(parts)

    @property
    def store(self) -> Store:
        """Where the files are."""
        return self._parts.store

    @property
    def parts(self) -> Parts:
        return self._parts

    def submit(self, request: JobRequest, *, idempotency_key: str | None = None) -> JobDetail:
        """Record a job, or find the same one.

        Raises:
            InputError: the idempotency key came with another request before.
            QuotaError: the caller's key has all it may have.
        """
        key = caller.get()
        bound: contextlib.AbstractContextManager[None] = contextlib.nullcontext()
        if idempotency_key is not None:
            bound = self._idempotency.claim(key.name if key else "", idempotency_key, request)
        with bound:
            record = job_actions.prepare(self._parts, request, owner=key.id if key else "")
            with bind(job=record.id), self.quotas.claim(key, record.id, record.request.grasps) as claim:
                job, is_new = job_actions.enter(self._parts, record)
                claim.counts = is_new
                log.info("job submitted" if is_new else "job was there already")
        return self._detail(job)

    def cancel(self, job_id: str) -> JobDetail:
        """Stop a job.

        Raises:
            NotYours: another key submitted it.
        """
        must_own(self._parts.index.job(job_id).owner, f"job {job_id}")
        with bind(job=job_id):
            job = job_actions.cancel(self._parts, job_id)
            log.info("job cancelled")
        return self._detail(job)

    def delete_job(self, job_id: str) -> None:
        """Take a job away that has ended.

        Raises:
            NotYours: another key submitted it.
        """
        must_own(self._parts.index.job(job_id).owner, f"job {job_id}")
        with bind(job=job_id):
            deletion.delete_job(self._parts, job_id, owner=_caller_id())
            log.info("job deleted")

    def delete_dataset(self, name: str) -> None:
        """Take a dataset away that has ended.

        Raises:
            NotYours: another key submitted it.
        """
        must_own(self._parts.index.dataset(name).owner, f"dataset {name!r}")
        deletion.delete_dataset(self._parts, name, owner=_caller_id())
        log.info("dataset %s deleted", name)

    def delete_asset(self, kind: AssetKind, name: str) -> None:
        """Take a hand or object away that nothing needs.

        Raises:
            NotYours: another key uploaded it.
        """
        asset = self._parts.index.asset(kind, name)
        if not asset.builtin:
            must_own(asset.owner, f"{kind.value} {name!r}")
        deletion.delete_asset(self._parts, kind, asset.digest, owner=_caller_id())
        log.info("%s %s deleted", kind, asset.name)

    def retry(self, job_id: str) -> JobDetail:
        """Run again what failed or was cancelled.

        Raises:
            NotYours: another key submitted it.
            QuotaError: the caller's key has all it may have.
        """
        known = self._parts.index.job(job_id)
        must_own(known.owner, f"job {job_id}")
        with bind(job=job_id), self.quotas.claim(caller.get(), job_id, known.request.grasps, is_new=False):
            job = job_actions.retry(self._parts, job_id)
            log.info("job retried")
        return self._detail(job)

    def jobs(
        self,
        *,
        state: State | None = None,
        hand: str | None = None,
        object: str | None = None,
        limit: int = 50,
        cursor: str | None = None,
    ) -> Page[Job]:
        """Jobs, newest first."""
        page = self._parts.index.jobs(state=state, hand=hand, object=object, limit=limit, cursor=cursor)
        return Page[Job](items=[self._job(job, ()) for job in page.items], next=page.next)

    def job(self, job_id: str) -> JobDetail:
        return self._detail(self._parts.index.job(job_id))

    def job_state(self, job_id: str) -> Job:
        """A job with the progress of its stages and nothing else: what a stream of events repeats."""
        return self._job(self._parts.index.job(job_id), self._running(job_id))

    def grasps(self, query: GraspQuery, *, limit: int = 50, cursor: str | None = None) -> Page[GraspView]:
        """Grasps that pass every filter."""
        sort = GraspSort(by=query.sort, descending=query.order == "desc")
        return self._parts.index.grasps(grasp_filter(query), sort=sort, limit=limit, cursor=cursor)

    def grasp(self, shard_id: str, row: int) -> GraspDetail:
        """One grasp with all that its shard says of it."""
        index = self._parts.index
        grasp, shard = index.grasp(shard_id, row), index.shard(shard_id)
        return self._grasp_files.detail(grasp, shard)

    def shards(
        self,
        *,
        job: str | None = None,
        kind: Literal["base", "scene", "views"] | None = None,
        limit: int = 50,
        cursor: str | None = None,
    ) -> Page[Shard]:
        page = self._parts.index.shards(job=job, kind=kind, limit=limit, cursor=cursor)
        return Page[Shard](items=[_shard(shard) for shard in page.items], next=page.next)

    def shard(self, shard_id: str) -> Shard:
        return _shard(self._parts.index.shard(shard_id))

    def checked_shard(self, shard_id: str) -> Shard:
        """A shard whose file is what its checksum says; read through once, then again only where it was changed.

        Raises:
            DamagedShard: its file is gone, or has another checksum.
        """
        shard = self.shard(shard_id)
        self._checked.check(shard.key, shard.sha256)
        return shard

    def assets(self, kind: AssetKind, *, limit: int = 50, cursor: str | None = None) -> Page[AssetView]:
        return self._parts.index.assets(kind, limit=limit, cursor=cursor)

    def asset(self, kind: AssetKind, name: str) -> AssetView:
        return self._parts.index.asset(kind, name)

    def add_asset(self, kind: AssetKind, name: str, files: Mapping[str, bytes]) -> AssetView:
        """Keep an uploaded hand or object; the keeper queues its check.

        Raises:
            ConflictError: the name stands for other content, or the content has another name.
        """
        self._refuse_taken(kind, name, digest_files(kind, files))
        key, index, store = caller.get(), self._parts.index, self._parts.store
        asset = library.store_files(store, kind, name, files, owner=key.id if key else "")
        # Of two uploads at once that want one name, the later one must see the earlier one's record.
        with index.writing() as connection:
            self._refuse_taken(kind, name, asset.digest)
            asset = library.record_asset(store, asset)
            index.add_asset(asset, library.load_check(store, kind, asset.digest), within=connection)
        return self._parts.index.asset(kind, asset.digest)

    def _refuse_taken(self, kind: AssetKind, name: str, digest: str) -> None:
        with contextlib.suppress(NotFoundError):
            known = self._parts.index.asset(kind, name)
            # A refused upload holds no name: the same file with the mend must get in.
            if known.digest != digest and known.verdict != "refuse":
                raise ConflictError(f"there is another {kind.value} named {name!r}; choose a name of its own")

    def workers(self) -> list[Worker]:
        """Workers, the living first, each with the stage it does and the age of its lease."""
        known = self._parts.index.workers()
        doing = self._parts.index.outputs([worker.task_id for worker in known if worker.task_id])
        try:
            pulses = self._queue_now().workers
        except UnavailableError:
            pulses = {}
        return [
            Worker(
                **worker.model_dump(),
                stage=Stage(doing[worker.task_id][0]) if worker.task_id in doing else None,
                lease_age_s=round(pulses[worker.name].lease_age_s, 3) if worker.name in pulses else None,
            )
            for worker in known
        ]

    def stats(self) -> Stats:
        return self._parts.index.stats()

    def valid_per_minute(self, *, minutes: int = 60) -> list[int]:
        """Valid grasps made in each of the last minutes, the oldest first."""
        start = datetime.now(UTC).replace(second=0, microsecond=0) - timedelta(minutes=minutes - 1)
        made = [0] * minutes
        for bucket in self._parts.index.throughput(since=start.isoformat().replace("+00:00", "Z"), bucket_s=60):
            minute = int((datetime.fromisoformat(bucket.start) - start).total_seconds() // 60)
            made[min(max(minute, 0), minutes - 1)] += bucket.valid
        return made

    def failures(self, *, limit: int = 5) -> list[FailureGroup]:
        return self._parts.index.failures(limit=limit)

    def depths(self) -> dict[tuple[Lane, Stage], int]:
        return self._parts.queue.depths()

    def health(self) -> Health:
        """State of the three parts; asked anew at most every two seconds."""
        return self._probes.health()

    def damage(self) -> tuple[int, list[Damage]]:
        """Number of objects of the store known to be damaged or missing, and the first of them."""
        return self._parts.index.known_damage(limit=_DAMAGE_SHOWN)

    def snapshot(self) -> Snapshot:
        """The service as Prometheus sees it; a part that is away leaves its numbers out."""
        found = Snapshot()
        parts = self.health().parts
        found.add_parts({name: _seconds(part) for name, part in parts.items()})
        with contextlib.suppress(UnavailableError):
            queue = self._parts.queue
            found.add_queue(self._queue_now(), keeper_is_up=queue.announced(KEEPER))
            found.add_sums(queue.counted())
        with contextlib.suppress(UnavailableError):
            found.add_index(read_index(self._parts.index))
        return found

    def histograms(self, job: JobView | JobDetail, *, bins: int = 20) -> list[Histogram]:
        """Distribution of each metric over a job's valid grasps, or over all that it kept where nobody judged them.

        While their number stays, the answer does.
        """
        judged = job.request.referee != "none"
        key = (job.id, count := job.valid if judged else job.grasps)
        if not count:
            return []
        if (found := self._histograms.get(key)) is None:
            where = GraspFilter(job=job.id, valid=True if judged else None)
            index = self._parts.index
            found = [
                Histogram(
                    metric=metric,
                    **vars(summary),
                    counts=index.histogram(where, metric, summary.low, summary.high, bins),
                )
                for metric, summary in index.summaries(where, MEAN_METRICS).items()
            ]
            if len(self._histograms) >= _KEPT_HISTOGRAMS:
                self._histograms.clear()
            self._histograms[key] = found
        return found

    def loss_curve(self, job: JobDetail) -> LossCurve | None:
        """Mean loss of the planner over the first batches of a job; None where the planner keeps none."""
        batches = [shard.id for shard in job.shards if shard.kind == "base"][:_LOSS_BATCHES]
        kept = [self._loss(shard) for shard in batches]
        curves = [curve for curve in kept if curve is not None]
        if not curves:
            return None
        length = min(len(losses) for _, losses in curves)
        means = [sum(losses[i] for _, losses in curves) / len(curves) for i in range(length)]
        return LossCurve(iterations=[(i + 1) * curves[0][0] for i in range(length)], losses=means)

    def _loss(self, shard_id: str) -> tuple[int, list[float]] | None:
        """Iterations between two values, and the values; a shard never changes, so its answer is kept."""
        if shard_id not in self._losses:
            info = self._parts.index.shard(shard_id).manifest.get("info", {})
            curve = [value for value in info.get("loss_curve") or [] if value is not None]
            if len(self._losses) >= _KEPT_HISTOGRAMS:
                self._losses.clear()
            self._losses[shard_id] = (int(info.get("chunk", 1)), curve) if curve else None
        return self._losses[shard_id]

    def _queue_now(self) -> QueueNow:
        # A worker's registration lives for whole seconds: see `worker.process.heartbeat`.
        return self._parts.queue.now(lease_s=max(2, round(self._parts.settings.lease_s)))

    def _detail(self, job: JobView) -> JobDetail:
        mean = {data.metric: data.mean for data in self.histograms(job)}
        return JobDetail(
            **self._job(job, self._running(job.id)).model_dump(),
            request=job.request,
            note=job.note,
            audited=job.audited,
            audit_held=job.audit_held,
            hand_digest=job.hand_digest,
            object_digest=job.object_digest,
            attempts=self._parts.index.attempts(job=job.id, limit=50),
            mean=MeanMetrics(**{metric: mean.get(metric) for metric in MEAN_METRICS}),
            shards=sorted(
                self.shards(job=job.id, limit=_PAGE).items, key=lambda shard: (shard.batch, _ORDER[shard.stage])
            ),
        )

    def _job(self, job: JobView, running: Sequence[TaskView]) -> Job:
        fidelity = job.request.fidelity
        stages = stage_statuses(job, running, self._paces)
        return Job(
            id=job.id,
            state=job.state,
            hand=job.request.hand,
            object=job.request.object,
            method=job.request.method,
            fidelity=fidelity if isinstance(fidelity, str) else fidelity.name,
            requested=job.request.grasps,
            grasps=job.grasps,
            valid=job.valid,
            tried=job.tried,
            progress=progress_of_job(job),
            eta_s=eta_of_job(job, stages),
            created=job.created,
            owner=job.owner,
            finished=job.finished,
            reason=job.reason,
            stages=stages,
        )

    def _running(self, job_id: str) -> list[TaskView]:
        return self._parts.index.tasks(job=job_id, state=State.RUNNING, limit=_PAGE).items


def _caller_id() -> str:
    key = caller.get()
    return key.id if key else ""


def grasp_filter(query: GraspQuery) -> GraspFilter:
    """The index's filter behind a request's parameters."""
    bounds: dict[str, dict[Metric, float]] = {"min": {}, "max": {}}
    for end, metrics in bounds.items():
        for metric in MEAN_METRICS:
            value = getattr(query, f"{end}_{metric}", None)
            if value is not None:
                metrics[metric] = value
    return GraspFilter(
        job=query.job,
        hand=query.hand,
        object=query.object,
        valid=query.valid,
        success=query.success,
        at_least=bounds["min"],
        at_most=bounds["max"],
    )


def _shard(shard: ShardView) -> Shard:
    return Shard(**shard.model_dump(), file=f"/v1/shards/{shard.id}/file")


def _seconds(part: Part) -> float | None:
    return None if part.latency_ms is None else part.latency_ms / 1000

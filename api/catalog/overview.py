"""Overview of the service: workers, queue, statistics, health, usage of projects, and deletions."""

import contextlib
import csv
import io
import logging
import threading
import time
from collections.abc import Callable, Iterable
from datetime import UTC, date, datetime, timedelta
from typing import Final
from urllib.parse import quote

from pydantic import Field

from graspd.api.access.auth import InScope, caller, project_scope, require_ownership
from graspd.api.access.keys import KeyFile, ProjectLimits
from graspd.api.catalog.jobs import Jobs
from graspd.api.metrics import MetricsSnapshot
from graspd.api.models import STAGE_LABELS, Health, Part, Worker
from graspd.service.index.notes import Damage
from graspd.service.index.queries.overview import read_index_status
from graspd.service.index.views import FailureGroup, TaskView, UsageDay, View
from graspd.service.model import errors
from graspd.service.model.digests import digest_json
from graspd.service.model.projects import ProjectScope
from graspd.service.model.states import Stage
from graspd.service.pipeline import deletion
from graspd.service.pipeline.backends import Services
from graspd.service.pipeline.identity import check_service
from graspd.service.pipeline.leading import PART
from graspd.service.queue.port import QueueStatus
from graspd.service.store.records import Deletion, What, restorable_deletions

log = logging.getLogger(__name__)
_DAMAGE_SHOWN: Final = 5
_FAILURES_SHOWN: Final = 4
MINUTES: Final = 60
_JOBS_WATCHED: Final = 20
#: Least time between two computations of a fingerprint [s].
FINGERPRINT_S: Final = 1.0


class Overview:
    """Data of the home page, probes and Prometheus; data of jobs is limited to the caller's scope."""

    def __init__(self, services: Services, jobs: Jobs) -> None:
        self._services = services
        self._jobs = jobs
        self._probes = Probes(services)
        self._fingerprints: dict[ProjectScope, tuple[float, str]] = {}
        self._lock = threading.Lock()

    def workers(self) -> list[Worker]:
        """Return workers, live ones first, each with its present stage and the time since its heartbeat."""
        known = self._services.index.overview.workers()
        tasks = [worker.task_id for worker in known if worker.task_id]
        outputs, visible = self._services.index.feed.outputs(tasks), self._tasks_in_scope(tasks)
        try:
            heartbeats = self._queue_status().workers
        except errors.UnavailableError:
            heartbeats = {}
        return [
            Worker(
                **worker.model_dump() | ({} if worker.task_id in visible else {"task_id": None}),
                stage=Stage(outputs[worker.task_id][0]) if worker.task_id in outputs else None,
                lease_age_s=round(heartbeats[worker.name][1], 3) if worker.name in heartbeats else None,
            )
            for worker in known
        ]

    def task_of(self, worker: Worker) -> TaskView | None:
        """Return a worker's task; None if it has none, or checks an upload (no task in the index)."""
        if worker.state != "busy" or not worker.task_id:
            return None
        try:
            return self._services.index.jobs.task(worker.task_id, scope=project_scope())
        except errors.NotFoundError:
            return None

    def search(self, text: str, *, limit: int) -> list[tuple[str, str, str]]:
        """Return kind, name and page of datasets, assets and tags with a text in their names."""
        names = self._services.index.overview.names(text, limit=limit, scope=project_scope())
        pages = {"tag": "/grasps?tag=", "network": "/hands?network="}
        return [(kind, name, pages.get(kind, f"/{kind}s/") + quote(name)) for kind, name in names]

    stats = InScope(lambda index: index.overview.stats)

    def valid_per_minute(self) -> dict[str, int]:
        """Return numbers of valid grasps in each of the last `MINUTES`, by minute (UTC), oldest first."""
        start = datetime.now(UTC) - timedelta(minutes=MINUTES - 1)
        minutes = [f"{start + timedelta(minutes=minute):%Y-%m-%dT%H:%M}" for minute in range(MINUTES)]
        made = self._services.index.overview.valid_per_minute(since=minutes[0], scope=project_scope())
        return dict.fromkeys(minutes, 0) | made

    def failures(self) -> list[FailureGroup]:
        return self._services.index.overview.failures(limit=_FAILURES_SHOWN, scope=project_scope())

    def waiting(self) -> list[tuple[str, int]]:
        """Return numbers of waiting tasks by stage; empty if Redis does not answer."""
        try:
            depths = self._services.queue.depths()
        except errors.UnavailableError:
            return []
        return [(label, sum(n for (_, at), n in depths.items() if at is one)) for one, label in STAGE_LABELS.items()]

    def health(self) -> Health:
        return self._probes.health()

    def damage(self) -> tuple[int, list[Damage]]:
        """Return the number of damaged or missing stored objects, and the first ones; none without `admin`."""
        if not project_scope().everything:
            return 0, []
        return self._services.index.damage.summary(limit=_DAMAGE_SHOWN)

    def metrics_snapshot(self) -> MetricsSnapshot:
        found = MetricsSnapshot()
        latencies = {name: part.latency_ms for name, part in self.health().parts.items()}
        found.add_parts({name: None if ms is None else ms / 1000 for name, ms in latencies.items()})
        with contextlib.suppress(errors.UnavailableError):
            queue = self._services.queue
            found.add_queue(self._queue_status(), is_kept=queue.is_announced(PART))
            found.add_sums(queue.counter_sums())
        with contextlib.suppress(errors.UnavailableError):
            found.add_index(read_index_status(self._services.index.database))
        return found

    def fingerprint(self) -> str:
        """Return a text that changes with each worker, and with each job and task in scope."""
        with self._lock:
            at, digest = self._fingerprints.get(project_scope(), (0.0, ""))
            now = time.monotonic()
            if not digest or now - at >= FINGERPRINT_S:
                workers = [(worker.name, worker.state, worker.task_id) for worker in self.workers()]
                page = self._jobs.page(limit=_JOBS_WATCHED)
                jobs = [(job.id, job.state, round(job.progress, 3)) for job in page.items]
                stats = self.stats().model_dump(mode="json")
                digest = digest_json({"stats": stats, "workers": workers, "jobs": jobs})
                self._fingerprints[project_scope()] = (now, digest)
            return digest

    def _tasks_in_scope(self, tasks: Iterable[str]) -> set[str]:
        """Return the tasks that are in scope or belong to no job, such as checks of uploads."""
        wanted, scope = set(tasks), project_scope()
        return wanted if scope.everything else wanted - self._services.index.jobs.tasks_out_of_scope(wanted, scope)

    def _queue_status(self) -> QueueStatus:
        # A worker's registration expires in whole seconds: see `worker.process.heartbeat`.
        return self._services.queue.status(lease_s=max(2, round(self._services.settings.lease_s)))


KEPT_S: Final = 2.0
PATIENCE_S: Final = 2.0
_INCOMPLETE: Final = "the controller is rebuilding the index from the store; until it is complete, jobs are missing"


class Probes:
    """Probes of Redis, index and store in parallel threads; a probe that hangs is not started again."""

    def __init__(self, services: Services) -> None:
        self._services = services
        self._known: tuple[float, Health] | None = None
        self._hanging: dict[str, _Probe] = {}
        #: Service to which Redis belonged at the last probe.
        self._service: str | None = None
        self._lock = threading.Lock()

    def health(self) -> Health:
        """Return the state of Redis, index and store (all must answer), of controller and workers."""
        with self._lock:
            now = time.monotonic()
            if self._known is None or now - self._known[0] > KEPT_S:
                self._known = (now, self._probe_all())
            return self._known[1]

    def _probe_all(self) -> Health:
        questions = {"redis": self._probe_redis, "index": self._probe_index, "store": self._probe_store}
        probes = {name: self._hanging.get(name) or _Probe(name, question) for name, question in questions.items()}
        deadline = time.monotonic() + PATIENCE_S
        parts = {name: probe.part(deadline) for name, probe in probes.items()}
        self._hanging = {name: probe for name, probe in probes.items() if probe.thread.is_alive()}
        controller, workers = self._controller_and_workers() if parts["redis"].ok else (False, 0)
        return Health(ok=all(part.ok for part in parts.values()), parts=parts, controller=controller, workers=workers)

    def _probe_redis(self) -> Part:
        """Probe Redis; a Redis of another service is not ready."""
        part, service = _healthy_part(self._services.queue.ping()), self._services.queue.service_id()
        if service != self._service:
            try:
                check_service(self._services.store, service)
            except errors.BusyError as error:
                return part.model_copy(update={"ok": False, "detail": str(error)})
            except errors.StoreUnavailable:
                return part  # The probe of the store reports this error.
            self._service = service
        return part

    def _probe_index(self) -> Part:
        """Probe the index; an incomplete index is not ready."""
        part, made = _healthy_part(self._services.index.database.ping()), self._services.index.notes.completeness()
        if made is None:
            return part.model_copy(update={"ok": False, "detail": _INCOMPLETE})
        if made.left_out:
            detail = f"{made.left_out} damaged records of the store are not in the index: {', '.join(made.names[:3])}"
            return part.model_copy(update={"detail": f"{detail}; run `graspd admin store verify`"})
        return part

    def _probe_store(self) -> Part:
        return _healthy_part(self._services.store.probe())

    def _controller_and_workers(self) -> tuple[bool, int]:
        try:
            fit = [beat for beat in self._services.queue.workers() if beat.state != "quarantined"]
            return self._services.queue.is_announced(PART), len(fit)
        except errors.UnavailableError:
            return False, 0


def _healthy_part(seconds: float) -> Part:
    return Part(ok=True, latency_ms=round(1000 * seconds, 3))


class _Probe:
    def __init__(self, name: str, question: Callable[[], Part]) -> None:
        self._question = question
        self._part: Part | None = None
        self.thread = threading.Thread(target=self._run, name=f"probe-{name}", daemon=True)
        self.thread.start()

    def part(self, deadline: float) -> Part:
        self.thread.join(max(0.0, deadline - time.monotonic()))
        return self._part or Part(ok=False, detail="no answer in time; see the log of this part")

    def _run(self) -> None:
        try:
            self._part = self._question()
        except Exception as error:
            name = "" if isinstance(error, errors.GraspdError) else f"{type(error).__name__}: "
            self._part = Part(ok=False, detail=f"{name}{error}")


DAYS: Final = 31
MOST_DAYS: Final = 366
_COLUMNS: Final = tuple(UsageDay.model_fields)


class Usage:
    """Usage of the projects in the caller's scope."""

    def __init__(self, services: Services, keys: KeyFile) -> None:
        self._services = services
        self._keys = keys

    def days(self, since: date | None = None, until: date | None = None) -> list[UsageDay]:
        """Return the usage of each project on each day, newest first; by default of the last 31 days."""
        last = until or datetime.now(UTC).date()
        first = since or last - timedelta(days=min(DAYS - 1, last.toordinal() - 1))
        if first > last:
            raise errors.InputError(f"`since` {first} is after `until` {last}")
        if (last - first).days >= MOST_DAYS:
            raise errors.InputError(f"at most {MOST_DAYS} days can be listed at once; request fewer")
        return self._services.index.usage.days(first.isoformat(), last.isoformat(), scope=project_scope())

    def limits(self) -> dict[str, ProjectLimits]:
        if caller.get() is None:
            return {}
        return {name: limits for name, limits in self._keys.projects().items() if project_scope().can_see(name)}


def usage_csv(days: list[UsageDay]) -> str:
    text = io.StringIO()
    table = csv.writer(text)
    table.writerow(_COLUMNS)
    table.writerows([getattr(one, column) for column in _COLUMNS] for one in days)
    return text.getvalue()


class DeletionView(View):
    """Deleted resource that can be restored."""

    what: What
    id: str = Field(description="id of the job, tag, hand, object or network; name of the dataset")
    name: str
    at: str = Field(description="time of the deletion")
    until: str = Field(description="time until which it can be restored")
    owner: str = Field(description="id of the key that submitted it")
    project: str


class Deletions:
    """Deletions in the caller's scope; permission to delete includes permission to restore."""

    def __init__(self, services: Services) -> None:
        self._services = services

    def list_restorable(self) -> list[DeletionView]:
        return [self._view(one) for one in restorable_deletions(self._services.store) if _is_in_scope(one)]

    def restore(self, what: What, name: str) -> DeletionView:
        def permit(one: Deletion) -> None:
            require_ownership(one.submitter, f"{what} {name!r}", one.project)

        found = deletion.restore(self._services, what, name, permit=permit, among=_is_in_scope)
        log.info("%s %s restored", what, found.name or found.id)
        return self._view(found)

    def _view(self, one: Deletion) -> DeletionView:
        ends = datetime.fromisoformat(one.at) + timedelta(seconds=self._services.settings.shard_grace_s)
        until = ends.isoformat(timespec="seconds").replace("+00:00", "Z")
        whose = {"owner": one.submitter, "project": one.project}
        return DeletionView(what=one.what, id=one.id, name=one.name or one.id, at=one.at, until=until, **whose)


def _is_in_scope(one: Deletion) -> bool:
    return project_scope().can_see(one.project)

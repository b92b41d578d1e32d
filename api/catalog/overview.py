"""The service as a whole: its workers, its queue, its health, its numbers."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Iterable
from datetime import UTC, datetime, timedelta
from typing import Final

from api.access.auth import project_scope
from api.catalog.health import Probes
from api.catalog.jobs import Jobs
from api.metrics import Snapshot
from api.models import Health, Part, Worker
from service.index.notes import Damage
from service.index.queries.overview import read_index
from service.index.views import FailureGroup, Stats, TaskView
from service.model.digests import digest_json
from service.model.errors import NotFoundError, UnavailableError
from service.model.projects import ProjectScope
from service.model.states import Lane, Stage
from service.pipeline.backends import Services
from service.pipeline.leading import PART
from service.queue.port import QueueNow

_DAMAGE_SHOWN: Final = 5
_JOBS_WATCHED: Final = 20
#: The fingerprint is made anew at most this often, however many pages watch it [s].
FINGERPRINT_S: Final = 1.0


class Overview:
    """What the home page, probes and Prometheus ask for; it changes nothing.

    Workers, queue and health are everybody's; what the jobs are and made is told in the caller's scope.
    """

    def __init__(self, services: Services, jobs: Jobs) -> None:
        self._services = services
        self._jobs = jobs
        self._probes = Probes(services)
        self._fingerprints: dict[ProjectScope, tuple[float, str]] = {}
        self._lock = threading.Lock()

    def workers(self) -> list[Worker]:
        """Workers, the living first, each with the stage it does and the age of its lease."""
        known = self._services.index.overview.workers()
        doing = self._services.index.feed.outputs([worker.task_id for worker in known if worker.task_id])
        seen = self._seen(worker.task_id for worker in known if worker.task_id)
        try:
            pulses = self._queue_now().workers
        except UnavailableError:
            pulses = {}
        return [
            Worker(
                **worker.model_dump() | ({} if worker.task_id in seen else {"task_id": None}),
                stage=Stage(doing[worker.task_id][0]) if worker.task_id in doing else None,
                lease_age_s=round(pulses[worker.name].lease_age_s, 3) if worker.name in pulses else None,
            )
            for worker in known
        ]

    def task_of(self, worker: Worker) -> TaskView | None:
        """What a worker does; a check of an upload is no task of the index."""
        if worker.state != "busy" or not worker.task_id:
            return None
        try:
            return self._services.index.jobs.task(worker.task_id, scope=project_scope())
        except NotFoundError:
            return None

    def stats(self) -> Stats:
        return self._services.index.overview.stats(scope=project_scope())

    def valid_per_minute(self, *, minutes: int = 60) -> list[int]:
        """Valid grasps made in each of the last minutes, the oldest first."""
        start = datetime.now(UTC).replace(second=0, microsecond=0) - timedelta(minutes=minutes - 1)
        made = [0] * minutes
        for bucket in self._services.index.overview.throughput(
            since=start.isoformat().replace("+00:00", "Z"), bucket_s=60, scope=project_scope()
        ):
            minute = int((datetime.fromisoformat(bucket.start) - start).total_seconds() // 60)
            made[min(max(minute, 0), minutes - 1)] += bucket.valid
        return made

    def failures(self, *, limit: int = 5) -> list[FailureGroup]:
        return self._services.index.overview.failures(limit=limit, scope=project_scope())

    def depths(self) -> dict[tuple[Lane, Stage], int]:
        """Waiting tasks by lane and stage."""
        return self._services.queue.depths()

    def health(self) -> Health:
        """State of the three parts; asked anew at most every two seconds."""
        return self._probes.health()

    def damage(self) -> tuple[int, list[Damage]]:
        """Number of objects of the store known to be damaged or missing, and the first of them, if all is in scope."""
        if not project_scope().everything:
            return 0, []
        return self._services.index.damage.known(limit=_DAMAGE_SHOWN)

    def snapshot(self) -> Snapshot:
        """The service as Prometheus sees it; a part that is away leaves its numbers out."""
        found = Snapshot()
        parts = self.health().parts
        found.add_parts({name: _seconds(part) for name, part in parts.items()})
        with contextlib.suppress(UnavailableError):
            queue = self._services.queue
            found.add_queue(self._queue_now(), is_kept=queue.announced(PART))
            found.add_sums(queue.counted())
        with contextlib.suppress(UnavailableError):
            found.add_index(read_index(self._services.index.database))
        return found

    def fingerprint(self) -> str:
        """Another text whenever a job or a task in scope, or a worker, changed."""
        with self._lock:
            at, digest = self._fingerprints.get(project_scope(), (0.0, ""))
            now = time.monotonic()
            if not digest or now - at >= FINGERPRINT_S:
                digest = self._digest()
                self._fingerprints[project_scope()] = (now, digest)
            return digest

    def _digest(self) -> str:
        jobs = self._jobs.page(limit=_JOBS_WATCHED).items
        workers = [(worker.name, worker.state, worker.task_id) for worker in self.workers()]
        moving = [(job.id, job.state, round(job.progress, 3)) for job in jobs]
        return digest_json({"stats": self.stats().model_dump(mode="json"), "workers": workers, "jobs": moving})

    def _seen(self, tasks: Iterable[str]) -> set[str]:
        """Of these tasks, those in scope, and those that no job owns, such as the check of an upload."""
        wanted = set(tasks)
        return (
            wanted
            if project_scope().everything
            else wanted - self._services.index.jobs.out_of_scope(wanted, project_scope())
        )

    def _queue_now(self) -> QueueNow:
        # A worker's registration lives for whole seconds: see `worker.process.heartbeat`.
        return self._services.queue.now(lease_s=max(2, round(self._services.settings.lease_s)))


def _seconds(part: Part) -> float | None:
    return None if part.latency_ms is None else part.latency_ms / 1000

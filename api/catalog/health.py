"""Whether the parts of the service answer, and how fast. A part that hangs does not make the answer wait."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Final

from api.models import Health, Part
from service.model.errors import BusyError, GraspdError, StoreUnavailable, UnavailableError
from service.pipeline.backends import Services
from service.pipeline.identity import check_queue
from service.pipeline.leading import PART

#: The parts are asked anew at most this often [s].
KEPT_S: Final = 2.0
#: A part that has not answered by then counts as away [s].
PATIENCE_S: Final = 2.0
_INCOMPLETE: Final = "the controller makes it from the store now; until it has, jobs are missing from it"


class Probes:
    """Asks Redis, index and store at the same time, each in a thread of its own; one that hangs is not asked again."""

    def __init__(self, services: Services, *, patience_s: float = PATIENCE_S) -> None:
        self._services = services
        self._patience_s = patience_s
        self._known: tuple[float, Health] | None = None
        self._hanging: dict[str, _Probe] = {}
        self._service: str | None = None
        """Whose Redis it was when it was last asked."""
        self._lock = threading.Lock()

    def health(self) -> Health:
        """State of the parts; ready while all three answer. Controller and workers are told, and not waited for."""
        with self._lock:
            now = time.monotonic()
            if self._known is None or now - self._known[0] > KEPT_S:
                self._known = (now, self._ask())
            return self._known[1]

    def _ask(self) -> Health:
        questions: dict[str, Callable[[], Part]] = {
            "redis": self._redis,
            "index": self._index,
            "store": lambda: _answering(self._services.store.probe()),
        }
        probes = {name: self._hanging.get(name) or _Probe(name, question) for name, question in questions.items()}
        deadline = time.monotonic() + self._patience_s
        parts = {name: probe.part(deadline) for name, probe in probes.items()}
        self._hanging = {name: probe for name, probe in probes.items() if probe.thread.is_alive()}
        controller, workers = self._others() if parts["redis"].ok else (False, 0)
        return Health(ok=all(part.ok for part in parts.values()), parts=parts, controller=controller, workers=workers)

    def _redis(self) -> Part:
        """A Redis of another service is not ready: its controller and workers know nothing of this one's jobs."""
        part, service = _answering(self._services.queue.ping()), self._services.queue.service()
        if service != self._service:
            try:
                check_queue(self._services.store, self._services.queue)
            except BusyError as error:
                return part.model_copy(update={"ok": False, "detail": str(error)})
            except StoreUnavailable:
                return part  # the store's own part tells that
            self._service = service
        return part

    def _index(self) -> Part:
        """An index that may lack what the store has is not ready: jobs would seem to be gone."""
        part, made = _answering(self._services.index.database.ping()), self._services.index.notes.completeness()
        if made is None:
            return part.model_copy(update={"ok": False, "detail": _INCOMPLETE})
        if made.left_out:
            some = ", ".join(made.names[:3])
            detail = f"{made.left_out} damaged records of the store are left out: {some}; `graspd admin store verify`"
            return part.model_copy(update={"detail": detail})
        return part

    def _others(self) -> tuple[bool, int]:
        try:
            fit = [beat for beat in self._services.queue.workers() if beat.state != "quarantined"]
            return self._services.queue.announced(PART), len(fit)
        except UnavailableError:
            return False, 0


def _answering(seconds: float) -> Part:
    return Part(ok=True, latency_ms=round(1000 * seconds, 3))


class _Probe:
    """One question to one part."""

    def __init__(self, name: str, question: Callable[[], Part]) -> None:
        self._question = question
        self._part: Part | None = None
        self.thread = threading.Thread(target=self._run, name=f"probe-{name}", daemon=True)
        self.thread.start()

    def part(self, deadline: float) -> Part:
        """The answer, if it came by then."""
        start = time.monotonic()
        self.thread.join(max(0.0, deadline - start))
        return self._part or Part(ok=False, detail="it has not answered in time; see the log of the part itself")

    def _run(self) -> None:
        try:
            self._part = self._question()
        except GraspdError as error:
            self._part = Part(ok=False, detail=str(error))
        except Exception as error:
            self._part = Part(ok=False, detail=f"{type(error).__name__}: {error}")

"""Webhook dispatcher: signed reports of ends, one at a time to each address, retried with back-off.

A failed delivery pauses all deliveries to its address. Projects take turns; within a project, the least recently used
address comes first. Addresses whose last delivery failed share half of the slots, so the others are not delayed.
"""

from __future__ import annotations

import json
import logging
import math
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Final

from graspd.service.index.outbox import DueDelivery
from graspd.service.index.views import EndView
from graspd.service.model.errors import UnavailableError
from graspd.service.model.planning import interleave
from graspd.service.model.webhooks import SIGNATURE, secret_of, signature
from graspd.service.pipeline.backends import Services
from graspd.service.pipeline.http_client import Networks, Response, networks, post

log = logging.getLogger(__name__)
#: Most concurrent deliveries, and the share of addresses that failed last.
AT_ONCE: Final = 32
SLOW_AT_ONCE: Final = AT_ONCE // 2
_PAUSE_S: Final = 1.0
#: Interval of rounds [s]: the summary of a large dataset takes a while.
_DATASETS_EVERY_S: Final = 5.0
_FORGET_EVERY_S: Final = 3600.0
Post = Callable[..., Response]


class WebhookDispatcher:
    """Runs in parallel with the controller's rounds, so that a silent address delays nothing else."""

    def __init__(self, services: Services, stop: threading.Event, *, send: Post = post) -> None:
        self._services = services
        self._stop = stop
        self._send = send
        secret = services.settings.webhook_secret
        self._master = secret.get_secret_value() if secret else ""
        self._allowed: Networks = networks(services.settings.webhook_networks or "")
        self._forget_again = -math.inf
        self._lock = threading.Lock()
        self._under_way: dict[str, DueDelivery] = {}
        self._ended = threading.Event()
        #: Time of the last attempt of each webhook, and whether it failed.
        self._last: dict[str, tuple[float, bool]] = {}
        self._pool = ThreadPoolExecutor(AT_ONCE, thread_name_prefix="webhooks")

    def run(self) -> None:
        look_again = -math.inf
        while not self._stop.is_set():
            # An address gets one delivery at a time: the next starts when the last has ended.
            self._ended.wait(_PAUSE_S)
            self._ended.clear()
            try:
                if time.monotonic() > look_again:
                    self.tell_datasets()
                    look_again = time.monotonic() + _DATASETS_EVERY_S
                self.start_deliveries()
            except UnavailableError as error:
                log.warning("webhooks wait: %s", error)
            except Exception:
                log.exception("a round of webhooks failed")
        self._pool.shutdown(wait=False, cancel_futures=True)

    def start_deliveries(self, *, now: float | None = None) -> list[Future[None]]:
        """Create deliveries of new ends, and start due ones while slots are free."""
        out = self._services.index.outbox
        if time.monotonic() > self._forget_again:
            out.forget_old()
            self._forget_again = time.monotonic() + _FORGET_EVERY_S
        if not self._master:
            return []
        out.plan()
        started = []
        for due in self._fair_order(out.due(time.time() if now is None else now)):
            with self._lock:
                slow = sum(map(self._has_failed, self._under_way.values()))
                full = len(self._under_way) >= AT_ONCE or (self._has_failed(due) and slow >= SLOW_AT_ONCE)
                if full or due.hook.id in self._under_way:
                    continue
                self._under_way[due.hook.id] = due
            started.append(self._pool.submit(self._attempt, due))
        return started

    def _fair_order(self, found: list[DueDelivery]) -> list[DueDelivery]:
        """Sort by turns of projects, or of keys without a project; within each, the least recently used first."""
        of_project: dict[str, list[DueDelivery]] = {}
        for due in sorted(found, key=lambda one: self._last.get(one.hook.id, (0.0, False))):
            of_project.setdefault(due.hook.project or f"key {due.hook.owner}", []).append(due)
        return interleave(list(of_project.values()))

    def _has_failed(self, due: DueDelivery) -> bool:
        return due.attempts > 0 or self._last.get(due.hook.id, (0.0, False))[1]

    def tell_datasets(self) -> None:
        untold = dict(self._services.index.outbox.untold_datasets())
        for name in untold.keys() - self._services.index.datasets.unfinished(untold):
            dataset = self._services.index.datasets.get(name)
            row = {"kind": "dataset", "subject": name, "state": dataset.state.value}
            row |= {"project": dataset.project, "owner": dataset.owner}
            self._services.index.outbox.tell_dataset(name, untold[name], row)

    def _attempt(self, due: DueDelivery) -> None:
        is_settled = False
        try:
            self._deliver(due)
            is_settled = True
        except UnavailableError as error:
            log.warning("a webhook waits: %s", error)
        except Exception:
            log.exception("a delivery failed")
        finally:
            with self._lock:
                del self._under_way[due.hook.id]
            if is_settled:
                self._ended.set()

    def _deliver(self, due: DueDelivery) -> None:
        body = body_of(due.end)
        at = int(time.time())
        headers = {
            "Content-Type": "application/json",
            "User-Agent": "graspd-webhook",
            "X-Graspd-Delivery": f"{due.hook.id}-{due.end.seq}",
            SIGNATURE: signature(secret_of(self._master, due.hook.id), at, body),
        }
        answer = self._send(due.hook.url, body, headers, allowed=self._allowed)
        self._last[due.hook.id] = (time.monotonic(), not answer.is_taken)
        self._services.index.outbox.settle(
            due, status=answer.status, detail=answer.detail, done=answer.is_taken, final=answer.is_final
        )


def body_of(end: EndView) -> bytes:
    return json.dumps(end.model_dump(mode="json"), sort_keys=True, separators=(",", ":")).encode()

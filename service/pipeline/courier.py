"""Tells webhooks what ended: signed, tried again with longer and longer waits, one at a time to each address."""

from __future__ import annotations

import json
import logging
import math
import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Final

from service.index.outgoing import Due
from service.index.views import EndView
from service.model.errors import UnavailableError
from service.model.webhooks import SIGNATURE, WAITS_S, secret_of, signature
from service.pipeline.backends import Parts
from service.pipeline.posting import Answer, Networks, networks, post

log = logging.getLogger(__name__)
_AT_ONCE: Final = 8
_PAUSE_S: Final = 1.0
#: To sum up a large dataset takes a while.
_DATASETS_EVERY_S: Final = 5.0
_FORGET_EVERY_S: Final = 3600.0
Post = Callable[..., Answer]


class Courier:
    """Works beside the rounds of the keeper: an address that does not answer keeps nothing else waiting.

    Args:
        send: sends a body to an address; as `posting.post`.
    """

    def __init__(self, parts: Parts, stop: threading.Event, *, send: Post = post) -> None:
        self._parts = parts
        self._stop = stop
        self._send = send
        secret = parts.settings.webhook_secret
        self._master = secret.get_secret_value() if secret else ""
        self._allowed: Networks = networks(parts.settings.webhook_networks or "")
        self._forget_again = -math.inf

    def run(self) -> None:
        """Rounds until told to stop."""
        look_again = -math.inf
        while not self._stop.wait(_PAUSE_S):
            try:
                if time.monotonic() > look_again:
                    self.tell_datasets()
                    look_again = time.monotonic() + _DATASETS_EVERY_S
                self.deliver()
            except UnavailableError as error:
                log.warning("webhooks wait: %s", error)
            except Exception:
                log.exception("a round of webhooks broke off")

    def deliver(self, *, now: float | None = None) -> int:
        """Make deliveries of what is new, and try those that are due; how many were tried."""
        out = self._parts.index.outgoing
        if time.monotonic() > self._forget_again:
            out.forget_old()
            self._forget_again = time.monotonic() + _FORGET_EVERY_S
        if not self._master:
            return 0
        out.plan()
        due = out.due(time.time() if now is None else now, limit=_AT_ONCE)
        if due:
            with ThreadPoolExecutor(_AT_ONCE, thread_name_prefix="webhooks") as pool:
                list(pool.map(self._try, due))
        return len(due)

    def tell_datasets(self) -> None:
        """Put datasets that ended into the feed."""
        untold = dict(self._parts.index.outgoing.untold_datasets())
        for name in untold.keys() - self._parts.index.datasets.unfinished(untold):
            dataset = self._parts.index.datasets.get(name)
            row = {"kind": "dataset", "subject": name, "state": dataset.state.value}
            row |= {"project": dataset.project, "owner": dataset.owner}
            self._parts.index.outgoing.tell_dataset(name, untold[name], row)

    def _try(self, due: Due) -> None:
        body = body_of(due.end)
        at = int(time.time())
        headers = {
            "Content-Type": "application/json",
            "User-Agent": "graspd-webhook",
            "X-Graspd-Delivery": f"{due.hook.id}-{due.end.seq}",
            SIGNATURE: signature(secret_of(self._master, due.hook.id), at, body),
        }
        answer = self._send(due.hook.url, body, headers, allowed=self._allowed)
        wait_s = None if answer.is_taken or due.attempts >= len(WAITS_S) else WAITS_S[due.attempts]
        self._parts.index.outgoing.settle(
            due, status=answer.status, detail=answer.detail, wait_s=wait_s, done=answer.is_taken
        )


def body_of(end: EndView) -> bytes:
    """What a webhook is sent: the end as `/v1/events` tells it."""
    return json.dumps(end.model_dump(mode="json"), sort_keys=True, separators=(",", ":")).encode()

"""Idempotency-Key (IETF draft): the same key with another body is a mistake of the caller's.

The same request is the same job without any key, because its id follows from its content; so no answer needs to be
kept, only which content a key stood for. That lies in Redis for a day: losing it loses a check, never a job.
"""

from __future__ import annotations

from typing import Final

import redis

from service.digests import digest_bytes, digest_json
from service.domain import JobRequest
from service.embedded import redis_url
from service.errors import InputError, QueueUnavailable
from service.settings import Settings

KEPT_S: Final = 24 * 3600


class Idempotency:
    """Which request a key stood for."""

    def __init__(self, settings: Settings) -> None:
        self._settings = settings
        self._client: redis.Redis | None = None

    def claim(self, owner: str, key: str, request: JobRequest) -> None:
        """Bind a key to a request.

        Raises:
            InputError: the key is bound to another request.
            QueueUnavailable: Redis does not answer.
        """
        name = f"graspd:idempotency:{digest_bytes(f'{owner} {key}'.encode())}"
        content = digest_json(request.model_dump(mode="json")).encode()
        try:
            client = self._connect()
            if client.set(name, content, ex=KEPT_S, nx=True):
                return
            bound = client.get(name)
        except redis.RedisError as error:
            raise QueueUnavailable(f"Redis does not answer: {error}") from None
        if bound not in (None, content):
            raise InputError("this Idempotency-Key came with another request before; take a new key")

    def _connect(self) -> redis.Redis:
        if self._client is None:
            self._client = redis.Redis.from_url(redis_url(self._settings), socket_timeout=5)
        return self._client

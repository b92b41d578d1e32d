"""Idempotency-Key (IETF draft): the same key with a different body is an input error.

Identical requests give the same job even without a key, because its id depends on its content. So no answer is stored,
only the content of each key, in Redis for a day: its loss loses a check, never a job.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any, Final

from redis.exceptions import RedisError

from graspd.service.model.digests import digest_bytes, digest_json
from graspd.service.model.domain import JobRequest
from graspd.service.model.errors import InputError, QueueUnavailable

KEPT_S: Final = 24 * 3600
_FREE: Final = "if redis.call('GET', KEYS[1]) == ARGV[1] then redis.call('DEL', KEYS[1]) end"


class Idempotency:
    """Requests bound to idempotency keys; stored in Redis, shared by all API processes."""

    def __init__(self, connection: Any) -> None:
        self._connection = connection

    @contextmanager
    def claim(self, owner: str, key: str, request: JobRequest) -> Iterator[None]:
        """Bind a key to a request recorded in this context; a failure releases the key.

        Args:
            owner: name of the request's API key: idempotency keys of others are independent.

        Raises:
            InputError: the key is bound to another request.
            QueueUnavailable: Redis does not answer.
        """
        name = f"graspd:idempotency:{digest_bytes(f'{owner} {key}'.encode())}"
        content = digest_json(request.model_dump(mode="json")).encode()
        is_ours = self._bind(name, content)
        try:
            yield
        except BaseException:
            if is_ours:
                with suppress(RedisError):
                    self._connection.eval(_FREE, 1, name, content)
            raise
        if not is_ours:
            # The request that bound the key may have failed and released it meanwhile.
            with suppress(RedisError):
                self._connection.set(name, content, ex=KEPT_S, nx=True)

    def _bind(self, name: str, content: bytes) -> bool:
        """Bind the key to content; return whether it was free."""
        try:
            if self._connection.set(name, content, ex=KEPT_S, nx=True):
                return True
            bound = self._connection.get(name)
        except RedisError as error:
            raise QueueUnavailable(f"Redis does not answer: {error}") from None
        if bound not in (None, content):
            raise InputError("this Idempotency-Key came with another request before; take a new key")
        return False

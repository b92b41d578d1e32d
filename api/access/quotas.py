"""Quotas of keys and projects: grasps in unfinished jobs, jobs or grasps per day. Idempotency keys.

All API processes count in Redis. A lock lets the submissions of a key or project with limits pass one by one. A loss of
Redis resets the counters. From submission to end, a job counts with its requested grasps. The index is queried for
ended jobs only if the quota would be exceeded.
"""

import logging
from collections.abc import Callable, Collection, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any, Final

from redis.exceptions import RedisError

from graspd.api.access.keys import Key, ProjectLimits
from graspd.service.index.index import Index
from graspd.service.model.digests import digest_bytes, digest_json
from graspd.service.model.domain import JobRequest
from graspd.service.model.errors import InputError, QueueUnavailable, QuotaError
from graspd.service.settings import Settings

log = logging.getLogger(__name__)
#: Time without a submission [s] after which the counters of a key expire.
_KEPT_S: Final = 30 * 86400
#: Time [s] after which the lock of a dead process ends, and the longest wait for another submission.
_LOCKED_S: Final = 60
_PATIENCE_S: Final = 20


@dataclass
class SubmissionClaim:
    """Result of a submission; `counts` is False if the job existed already."""

    counts: bool = True


@dataclass(frozen=True)
class _Holder:
    """Owner of counters: a key (counts jobs per day) or a project (counts requested grasps per day)."""

    name: str
    words: str
    grasps: int
    today: int
    counts_jobs: bool

    @property
    def held_key(self) -> str:
        return f"graspd:quota:{self.name}:jobs"

    @property
    def day_key(self) -> str:
        return f"graspd:quota:{self.name}:{datetime.now(UTC):%Y-%m-%d}"

    def refusal(self, met: str, amount: int) -> QuotaError:
        if met == "grasps":
            words = f"{self.words} has {amount} grasps in unfinished jobs, and at most {self.grasps} are allowed"
            return QuotaError(f"{words}; wait for a job to end, or request fewer grasps", retry_after_s=60)
        if self.counts_jobs:
            words = f"{self.words} has submitted the {self.today} jobs allowed per day; more tomorrow (UTC)"
        else:
            words = f"{self.words} has requested {amount} of {self.today} grasps allowed per day; more tomorrow (UTC)"
        return QuotaError(words, retry_after_s=_until_midnight())


class Quotas:
    """Counters of keys and projects; `select_unfinished` selects ids of jobs that have not ended."""

    def __init__(
        self,
        settings: Settings,
        connection: Any,
        unfinished: Callable[[Collection[str]], Collection[str]],
        *,
        limits_of: Callable[[str], ProjectLimits] = lambda project: ProjectLimits(),
        gpu_seconds: Callable[[str, str], float] = lambda project, day: 0.0,
    ) -> None:
        self._limits_of = limits_of
        self._gpu_seconds = gpu_seconds
        self._settings = settings
        self._connection = connection
        self._unfinished = unfinished

    @contextmanager
    def claim(self, key: Key | None, job: str, grasps: int, *, is_new: bool = True) -> Iterator[SubmissionClaim]:
        """Count the job that the context submits (`is_new`) or retries; raise QuotaError beyond a limit."""
        claim = SubmissionClaim()
        if key is None:
            yield claim
            return
        most = self._limits_of(key.project).gpu_seconds_per_day if key.project else None
        if most and (used := self._gpu_seconds(key.project, f"{datetime.now(UTC):%Y-%m-%d}")) >= most:
            used_up = f"the project {key.project!r} has used {used:.0f} of the {most} GPU seconds allowed per day"
            raise QuotaError(f"{used_up}; submit more tomorrow (UTC)", retry_after_s=_until_midnight())
        with ExitStack() as claimed:
            for holder in self._holders(key):
                claimed.enter_context(self._count_claim(holder, claim, job, grasps, is_new=is_new))
            yield claim

    def _holders(self, key: Key) -> list[_Holder]:
        own, default = key.limits, self._settings
        grasps = default.quota_grasps_in_flight if own.grasps_in_flight is None else own.grasps_in_flight
        jobs = default.quota_jobs_per_day if own.jobs_per_day is None else own.jobs_per_day
        found = [_Holder(key.name, f"the key {key.name!r}", grasps, jobs, counts_jobs=True)]
        if key.project:
            limits = self._limits_of(key.project)
            most = limits.grasps_in_flight or 0, limits.grasps_per_day or 0
            words = f"the project {key.project!r}"
            found.append(_Holder(f"project:{key.project}", words, *most, counts_jobs=False))
        return [holder for holder in found if holder.grasps or holder.today]

    @contextmanager
    def _count_claim(
        self, holder: _Holder, claim: SubmissionClaim, job: str, grasps: int, *, is_new: bool
    ) -> Iterator[None]:
        redis, today, is_counted = self._connection, 0 if not is_new else 1 if holder.counts_jobs else grasps, False
        with ExitStack() as locked:
            with self._log_outage(holder):
                lock = redis.lock(f"{holder.held_key}:lock", _LOCKED_S, sleep=0.02, blocking_timeout=_PATIENCE_S)
                if not lock.acquire():
                    raise QuotaError(f"{holder.words} has too many submissions at once; try again in a moment")
                locked.callback(self._release, lock)
                if not redis.hexists(holder.held_key, job):
                    self._check_limits(holder, grasps, today)
                    # A process that dies now leaves an entry that is dropped like that of an ended job.
                    with redis.pipeline() as batch:
                        batch.hset(holder.held_key, job, grasps).expire(holder.held_key, _KEPT_S)
                        batch.incrby(holder.day_key, today).expire(holder.day_key, 2 * 86400).execute()
                    is_counted = True
            try:
                yield
            except BaseException:
                claim.counts = False
                raise
            finally:
                if is_counted and not claim.counts:
                    with self._log_outage(holder), redis.pipeline() as batch:
                        batch.hdel(holder.held_key, job).decrby(holder.day_key, today).execute()

    def _check_limits(self, holder: _Holder, grasps: int, today: int) -> None:
        """Raise QuotaError if a new job exceeds a limit; entries of ended jobs are dropped if space is needed."""
        entries = {job.decode(): int(size) for job, size in self._connection.hgetall(holder.held_key).items()}
        if holder.grasps and sum(entries.values()) + grasps > holder.grasps:
            unfinished = set(self._unfinished(list(entries)))
            held = sum(size for job, size in entries.items() if job in unfinished)
            if held + grasps > holder.grasps:
                raise holder.refusal("grasps", held)
            self._connection.hdel(holder.held_key, *(entries.keys() - unfinished))
        used = int(self._connection.get(holder.day_key) or 0)
        if holder.today and today and used + today > holder.today:
            raise holder.refusal("today", used)

    @staticmethod
    def _release(lock: Any) -> None:
        # The lock may have ended, or Redis may be gone; then nothing is to be released.
        with suppress(RedisError):
            lock.release()

    @contextmanager
    def _log_outage(self, holder: _Holder) -> Iterator[None]:
        try:
            yield
        except RedisError as error:
            log.warning("the quota of %s is not counted while Redis does not answer: %s", holder.words, error)


def _until_midnight() -> int:
    return int(86400 - datetime.now(UTC).timestamp() % 86400) + 1


DATASET_PREFIX: Final = "dataset:"


def select_unfinished(index: Index, ids: Collection[str]) -> set[str]:
    """Select ids of jobs and datasets (`dataset:NAME`) that have not ended."""
    names = {one.removeprefix(DATASET_PREFIX) for one in ids if one.startswith(DATASET_PREFIX)}
    found = index.jobs.unfinished([one for one in ids if not one.startswith(DATASET_PREFIX)])
    return found | {DATASET_PREFIX + name for name in index.datasets.unfinished(names)}


_KEY_KEPT_S: Final = 24 * 3600
_FREE: Final = "if redis.call('GET', KEYS[1]) == ARGV[1] then redis.call('DEL', KEYS[1]) end"


class Idempotency:
    """Idempotency-Key (IETF draft): the same key with a different body is an input error.

    Identical requests give the same job even without a key, because a job's id depends on its content. Redis stores the
    request's digest under each key for a day, but no response. If Redis loses the digest, only this check is lost.
    """

    def __init__(self, connection: Any) -> None:
        self._connection = connection

    @contextmanager
    def claim(self, owner: str, key: str, request: JobRequest) -> Iterator[None]:
        """Bind an owner's idempotency key to a request while the context runs; a failure releases the key."""
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
                self._connection.set(name, content, ex=_KEY_KEPT_S, nx=True)

    def _bind(self, name: str, content: bytes) -> bool:
        """Bind the key to content; return whether it was free."""
        try:
            if self._connection.set(name, content, ex=_KEY_KEPT_S, nx=True):
                return True
            bound = self._connection.get(name)
        except RedisError as error:
            raise QueueUnavailable(f"Redis does not answer: {error}") from None
        if bound not in (None, content):
            raise InputError("this Idempotency-Key was used for another request before; use a new key")
        return False

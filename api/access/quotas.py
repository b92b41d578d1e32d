"""Quotas of keys and projects: grasps in unfinished jobs, jobs or grasps per day. Idempotency keys.

All API processes count in Redis, each submission in one atomic step. A loss of Redis resets the counters.
From submission to end, a job counts with its requested grasps. The index is queried for ended jobs only if the quota
would be exceeded, so a submission needs one round trip.
"""

import logging
import uuid
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
_AT_ONCE: Final = 1000

#: Time [s] after which a pending submission is taken as that of a dead process.
_PENDING_S: Final = 60

# KEYS[1] holds the sum under `grasps`, and an entry under each job: its grasps, the last claim that counted them, and
# the time until which this claim is pending. The time is 0 once the job is in the index.
_CLAIM: Final = """
local job, grasps, number = ARGV[1], tonumber(ARGV[2]), ARGV[7]
local most_grasps, most_today, amount = tonumber(ARGV[3]), tonumber(ARGV[4]), tonumber(ARGV[6])
local now = tonumber(redis.call('TIME')[1])
local entry = function(size) return size .. ' ' .. number .. ' ' .. (now + tonumber(ARGV[8])) end
local known = redis.call('HGET', KEYS[1], job)
if known then
  local size, till = string.match(known, '^(%d+) %w+ (%d+)$')
  redis.call('HSET', KEYS[1], job, entry(size or known))
  return {till and tonumber(till) > now and 'shared' or 'known', '0'}
end
local held = tonumber(redis.call('HGET', KEYS[1], 'grasps') or '0')
if most_grasps > 0 and held + grasps > most_grasps then return {'grasps', tostring(held)} end
local today = tonumber(redis.call('GET', KEYS[2]) or '0')
if most_today > 0 and today + amount > most_today then return {'today', tostring(today)} end
redis.call('HSET', KEYS[1], job, entry(ARGV[2]))
redis.call('HINCRBY', KEYS[1], 'grasps', grasps)
redis.call('EXPIRE', KEYS[1], ARGV[5])
if amount > 0 then
  redis.call('INCRBY', KEYS[2], amount)
  redis.call('EXPIRE', KEYS[2], 2 * 86400)
end
return {'', '0'}
"""

#: Settles a claim once the job is in the index; another claim of the same job may already have dropped the entry.
_SETTLE: Final = """
local known = redis.call('HGET', KEYS[1], ARGV[1])
if not known then redis.call('HINCRBY', KEYS[1], 'grasps', ARGV[2]) end
redis.call('HSET', KEYS[1], ARGV[1], string.match(known or ARGV[2], '^%d+') .. ' ' .. ARGV[3] .. ' 0')
"""

#: Drops jobs whose entries are unchanged since they were read; ARGV: job, entry, job, entry, ...
_DROP: Final = """
for i = 1, #ARGV, 2 do
  local known = redis.call('HGET', KEYS[1], ARGV[i])
  if known and known == ARGV[i + 1] then
    redis.call('HDEL', KEYS[1], ARGV[i])
    redis.call('HINCRBY', KEYS[1], 'grasps', -tonumber(string.match(known, '^%d+')))
  end
end
"""

#: Entries of all jobs without a pending submission.
_ENTERED: Final = """
local now, found = tonumber(redis.call('TIME')[1]), {}
local all = redis.call('HGETALL', KEYS[1])
for i = 1, #all, 2 do
  local till = string.match(all[i + 1], '^%d+ %w+ (%d+)$')
  if all[i] ~= 'grasps' and not (till and tonumber(till) > now) then
    found[#found + 1] = all[i]
    found[#found + 1] = all[i + 1]
  end
end
return found
"""

#: Drops the entry of one claim, unless a later claim took it over.
_UNDO: Final = """
local known = redis.call('HGET', KEYS[1], ARGV[1])
if known and string.match(known, '^%d+ (%w+)') == ARGV[2] then
  redis.call('HDEL', KEYS[1], ARGV[1])
  redis.call('HINCRBY', KEYS[1], 'grasps', -tonumber(string.match(known, '^%d+')))
end
"""


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
        return f"graspd:quota:{self.name}:held"

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
        self._check_gpu_seconds(key.project)
        with ExitStack() as claimed:
            for holder in self._holders(key):
                claimed.enter_context(self._count_claim(holder, claim, job, grasps, is_new=is_new))
            yield claim

    def _check_gpu_seconds(self, project: str) -> None:
        """Raise QuotaError if a project's GPU seconds of today are used up; its earlier jobs continue."""
        most = self._limits_of(project).gpu_seconds_per_day if project else None
        if most and (used := self._gpu_seconds(project, f"{datetime.now(UTC):%Y-%m-%d}")) >= most:
            used_up = f"the project {project!r} has used {used:.0f} of the {most} GPU seconds allowed per day"
            raise QuotaError(f"{used_up}; submit more tomorrow (UTC)", retry_after_s=_until_midnight())

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
        number = uuid.uuid4().hex
        today = 0 if not is_new else 1 if holder.counts_jobs else grasps
        met = self._claim(holder, job, grasps, number, today)
        try:
            yield
        except BaseException:
            claim.counts = False
            raise
        finally:
            with self._log_outage(holder):
                if claim.counts or met == "known":
                    self._connection.eval(_SETTLE, 1, holder.held_key, job, grasps, number)
                else:
                    self._connection.eval(_UNDO, 1, holder.held_key, job, number)
                # Of two claims for one job, only the claim that created the job counts as a job of today.
                if today and met == "shared" and claim.counts:
                    self._connection.incrby(holder.day_key, today)
                if today and met == "" and not claim.counts:
                    self._connection.decrby(holder.day_key, today)

    def _claim(self, holder: _Holder, job: str, grasps: int, number: str, today: int) -> str:
        """Return `shared` (another claim is pending), `known`, `unknown` (no Redis), or "" for a new job."""
        met, amount = self._try_claim(holder, job, grasps, number, today)
        if met == "grasps":
            with self._log_outage(holder):
                self._drop_ended(holder)
            met, amount = self._try_claim(holder, job, grasps, number, today)
        if met in ("grasps", "today"):
            raise holder.refusal(met, amount)
        return met

    def _try_claim(self, holder: _Holder, job: str, grasps: int, number: str, today: int) -> tuple[str, int]:
        limits = (holder.grasps, holder.today if today else 0)
        about = (job, grasps, *limits, _KEPT_S, today, number, _PENDING_S)
        met, amount = b"unknown", b"0"
        with self._log_outage(holder):
            met, amount = self._connection.eval(_CLAIM, 2, holder.held_key, holder.day_key, *about)
        return met.decode(), int(amount)

    def _drop_ended(self, holder: _Holder) -> None:
        """Drop the entries of ended jobs, except jobs whose submission is pending."""
        found = [word.decode(errors="replace") for word in self._connection.eval(_ENTERED, 1, holder.held_key)]
        entries = dict(zip(found[::2], found[1::2], strict=True))
        ended = sorted(entries.keys() - set(self._unfinished(list(entries))))
        for start in range(0, len(ended), _AT_ONCE):
            some = [word for job in ended[start : start + _AT_ONCE] for word in (job, entries[job])]
            self._connection.eval(_DROP, 1, holder.held_key, *some)

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

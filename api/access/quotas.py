"""What one key may have in work: grasps in unfinished jobs, and new jobs a day.

Redis counts, in one step for all API processes. What it holds may be lost: then a quota is forgotten, never a job.
A job counts with the grasps that were asked for, from its submission until it ends. Whether it has ended is asked of
the index only when the quota would be passed, so a submission costs one round trip.
"""

from __future__ import annotations

import logging
import uuid
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from typing import Any, Final

from redis.exceptions import RedisError

from api.access.keys import Key
from service.model.errors import QuotaError
from service.settings import Settings

log = logging.getLogger(__name__)
#: A key that submits nothing for this long is forgotten [s].
_KEPT_S: Final = 30 * 86400
_AT_ONCE: Final = 1000

#: A submission that has not ended after this long died with its process [s].
_PENDING_S: Final = 60

# KEYS[1] holds the sum under `grasps`, and under each job: its grasps, the claim that counted them last, and until when
# that claim counts as being entered; 0 once the job is in the index.
_CLAIM: Final = """
local job, grasps, number = ARGV[1], tonumber(ARGV[2]), ARGV[7]
local most_grasps, most_jobs = tonumber(ARGV[3]), tonumber(ARGV[4])
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
local jobs = tonumber(redis.call('GET', KEYS[2]) or '0')
if most_jobs > 0 and jobs >= most_jobs then return {'jobs', tostring(jobs)} end
redis.call('HSET', KEYS[1], job, entry(ARGV[2]))
redis.call('HINCRBY', KEYS[1], 'grasps', grasps)
redis.call('EXPIRE', KEYS[1], ARGV[5])
if ARGV[6] == '1' then
  redis.call('INCR', KEYS[2])
  redis.call('EXPIRE', KEYS[2], 2 * 86400)
end
return {'', '0'}
"""

#: The job is in the index; a claim of the same job that made nothing new may have dropped it meanwhile.
_SETTLE: Final = """
local known = redis.call('HGET', KEYS[1], ARGV[1])
if not known then redis.call('HINCRBY', KEYS[1], 'grasps', ARGV[2]) end
redis.call('HSET', KEYS[1], ARGV[1], string.match(known or ARGV[2], '^%d+') .. ' ' .. ARGV[3] .. ' 0')
"""

#: Jobs whose entry is still what it was when somebody looked: `job`, `entry`, ...
_DROP: Final = """
for i = 1, #ARGV, 2 do
  local known = redis.call('HGET', KEYS[1], ARGV[i])
  if known and known == ARGV[i + 1] then
    redis.call('HDEL', KEYS[1], ARGV[i])
    redis.call('HINCRBY', KEYS[1], 'grasps', -tonumber(string.match(known, '^%d+')))
  end
end
"""

#: Entries of all jobs that no submission is entering now.
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

#: Drops the entry of one claim, unless a later one took it over.
_UNDO: Final = """
local known = redis.call('HGET', KEYS[1], ARGV[1])
if known and string.match(known, '^%d+ (%w+)') == ARGV[2] then
  redis.call('HDEL', KEYS[1], ARGV[1])
  redis.call('HINCRBY', KEYS[1], 'grasps', -tonumber(string.match(known, '^%d+')))
end
"""


@dataclass
class Claim:
    """What a submission may say of itself: False, if it found a job that was there already."""

    counts: bool = True


class Quotas:
    """The counters of all keys.

    Args:
        connection: Redis.
        unfinished: of these job ids, those whose job has not ended.
    """

    def __init__(
        self, settings: Settings, connection: Any, unfinished: Callable[[Collection[str]], Collection[str]]
    ) -> None:
        self._settings = settings
        self._connection = connection
        self._unfinished = unfinished

    @contextmanager
    def claim(self, key: Key | None, job: str, grasps: int, *, is_new: bool = True) -> Iterator[Claim]:
        """Count a job that is submitted or retried within; it is not counted if that fails or made nothing new.

        Args:
            key: whose it is; None while the service is open, which knows no quotas.
            is_new: whether it counts as one of today's jobs; one that is retried does not.

        Raises:
            QuotaError: the key has all it may have.
        """
        claim = Claim()
        if key is None or not any(self._limits(key)):
            yield claim
            return
        number = uuid.uuid4().hex
        met = self._claim(key, job, grasps, number, is_new=is_new)
        try:
            yield claim
        except BaseException:
            claim.counts = False
            raise
        finally:
            with self._forgiving(key):
                self._end(key, job, grasps, number, met, counts=claim.counts, is_new=is_new)

    def _claim(self, key: Key, job: str, grasps: int, number: str, *, is_new: bool) -> str:
        """How a job is counted: empty where this claim counts it, `shared` where another claim that has not ended did,
        `known` where it was counted before, `unknown` without Redis."""
        met, amount = self._ask(key, job, grasps, number, is_new=is_new)
        if met == "grasps":
            with self._forgiving(key):
                self._forget_ended(key)
            met, amount = self._ask(key, job, grasps, number, is_new=is_new)
        most_grasps, most_jobs = self._limits(key)
        if met == "grasps":
            raise QuotaError(
                f"the key {key.name!r} has {amount} grasps in work and may have {most_grasps}; "
                "wait for a job to end, or ask for fewer grasps",
                retry_after_s=60,
            )
        if met == "jobs":
            raise QuotaError(
                f"the key {key.name!r} has submitted its {most_jobs} jobs of today; more tomorrow (UTC)",
                retry_after_s=_until_midnight(),
            )
        return met

    def _ask(self, key: Key, job: str, grasps: int, number: str, *, is_new: bool) -> tuple[str, int]:
        most_grasps, most_jobs = self._limits(key)
        limits = (most_grasps, most_jobs if is_new else 0)
        about = (job, grasps, *limits, _KEPT_S, int(is_new), number, _PENDING_S)
        met, amount = b"unknown", b"0"
        with self._forgiving(key):
            met, amount = self._connection.eval(_CLAIM, 2, _held(key), _today(key), *about)
        return met.decode(), int(amount)

    def _forget_ended(self, key: Key) -> None:
        """Drop the jobs that have ended. One that is being entered is not in the index yet, so it is not asked for; one
        that is claimed again meanwhile has another entry, and stays."""
        found = [word.decode(errors="replace") for word in self._connection.eval(_ENTERED, 1, _held(key))]
        entries = dict(zip(found[::2], found[1::2], strict=True))
        ended = sorted(entries.keys() - set(self._unfinished(list(entries))))
        for start in range(0, len(ended), _AT_ONCE):
            some = [word for job in ended[start : start + _AT_ONCE] for word in (job, entries[job])]
            self._connection.eval(_DROP, 1, _held(key), *some)

    def _end(self, key: Key, job: str, grasps: int, number: str, met: str, *, counts: bool, is_new: bool) -> None:
        if counts or met == "known":
            self._connection.eval(_SETTLE, 1, _held(key), job, grasps, number)
        else:
            self._connection.eval(_UNDO, 1, _held(key), job, number)
        # Of two claims of one job the one that made it counts as one of today's.
        if is_new and met == "shared" and counts:
            self._connection.incr(_today(key))
        if is_new and met == "" and not counts:
            self._connection.decr(_today(key))

    @contextmanager
    def _forgiving(self, key: Key) -> Iterator[None]:
        try:
            yield
        except RedisError as error:
            log.warning("the quota of key %s is not counted while Redis does not answer: %s", key.name, error)

    def _limits(self, key: Key) -> tuple[int, int]:
        own, all_ = key.limits, self._settings
        return (
            all_.quota_grasps_in_flight if own.grasps_in_flight is None else own.grasps_in_flight,
            all_.quota_jobs_per_day if own.jobs_per_day is None else own.jobs_per_day,
        )


def _held(key: Key) -> str:
    return f"graspd:quota:{key.name}:held"


def _today(key: Key) -> str:
    return f"graspd:quota:{key.name}:{datetime.now(UTC):%Y-%m-%d}"


def _until_midnight() -> int:
    now = datetime.now(UTC)
    midnight = (now + timedelta(days=1)).replace(hour=0, minute=0, second=0, microsecond=0)
    return int((midnight - now).total_seconds()) + 1

"""What one key may have in work: grasps in unfinished jobs, and new jobs a day.

Redis counts, in one step for all API processes. What it holds may be lost: then a quota is forgotten, never a job.
A job counts with the grasps that were asked for, from its submission until it ends. Whether it has ended is asked of
the index only when the quota would be passed, so a submission costs one round trip.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from typing import Any, Final

from redis.exceptions import RedisError

from api.keys import Key
from service.errors import QuotaError
from service.settings import Settings

log = logging.getLogger(__name__)
#: A key that submits nothing for this long is forgotten [s].
_KEPT_S: Final = 30 * 86400

_CLAIM: Final = """
local job, grasps = ARGV[1], tonumber(ARGV[2])
local most_grasps, most_jobs = tonumber(ARGV[3]), tonumber(ARGV[4])
if redis.call('HEXISTS', KEYS[1], job) == 1 then return {'known', '0'} end
local held = tonumber(redis.call('HGET', KEYS[1], 'grasps') or '0')
if most_grasps > 0 and held + grasps > most_grasps then return {'grasps', tostring(held)} end
local jobs = tonumber(redis.call('GET', KEYS[2]) or '0')
if most_jobs > 0 and jobs >= most_jobs then return {'jobs', tostring(jobs)} end
redis.call('HSET', KEYS[1], job, ARGV[2])
redis.call('HINCRBY', KEYS[1], 'grasps', grasps)
redis.call('EXPIRE', KEYS[1], ARGV[5])
if ARGV[6] == '1' then
  redis.call('INCR', KEYS[2])
  redis.call('EXPIRE', KEYS[2], 2 * 86400)
end
return {'', '0'}
"""

_DROP: Final = """
for _, job in ipairs(ARGV) do
  local grasps = redis.call('HGET', KEYS[1], job)
  if grasps then
    redis.call('HDEL', KEYS[1], job)
    redis.call('HINCRBY', KEYS[1], 'grasps', -tonumber(grasps))
  end
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
        was_counted = self._claim(key, job, grasps, is_new=is_new)
        try:
            yield claim
        except BaseException:
            claim.counts = False
            raise
        finally:
            if was_counted and not claim.counts:
                self._drop(key, [job], today=is_new)

    def _claim(self, key: Key, job: str, grasps: int, *, is_new: bool) -> bool:
        met, amount = self._ask(key, job, grasps, is_new=is_new)
        if met == "grasps":
            # Some of these jobs have ended since.
            ids = [field.decode() for field in self._connection.hkeys(_held(key)) if field != b"grasps"]
            self._drop(key, sorted(set(ids) - set(self._unfinished(ids))))
            met, amount = self._ask(key, job, grasps, is_new=is_new)
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
        return met == ""

    def _ask(self, key: Key, job: str, grasps: int, *, is_new: bool) -> tuple[str, int]:
        most_grasps, most_jobs = self._limits(key)
        limits = (most_grasps, most_jobs if is_new else 0)
        try:
            met, amount = self._connection.eval(
                _CLAIM, 2, _held(key), _today(key), job, grasps, *limits, _KEPT_S, int(is_new)
            )
        except RedisError as error:
            log.warning("the quota of key %s is not counted while Redis does not answer: %s", key.name, error)
            return "unknown", 0
        return met.decode(), int(amount)

    def _drop(self, key: Key, jobs: Collection[str], *, today: bool = False) -> None:
        try:
            if jobs:
                self._connection.eval(_DROP, 1, _held(key), *jobs)
            if today:
                self._connection.decr(_today(key))
        except RedisError as error:
            log.warning("the quota of key %s counts %d jobs too many: %s", key.name, len(jobs), error)

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

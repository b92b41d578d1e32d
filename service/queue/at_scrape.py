"""What the queue says at the moment of a scrape: two round trips, whatever waits in it."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import Any

from service.model.clock import age_of
from service.queue.port import Place, QueueNow, WorkerPulse
from service.queue.rq_keys import held_key, job_key, list_key


def read_queue(
    connection: Any,
    lists: Mapping[str, Place],
    *,
    workers_key: str,
    worker_key: bytes,
    lease_s: float,
    read_beat: Callable[[bytes | None], Any],
) -> QueueNow:
    """Two round trips: lengths and heads of the lists, then the age of the heads and the beats of the workers.

    Args:
        connection: Redis.
        lists: names of the lists, each with its lane and stage.
        workers_key: set of the workers' names.
        worker_key: what stands before a name in the key that a living worker renews.
        lease_s: how long that key lives after a beat [s].
        read_beat: what a worker says of itself (`WorkerBeat`), None if that cannot be read.
    """
    with connection.pipeline(transaction=False) as pipe:
        for name in lists:
            pipe.llen(list_key(name))
            pipe.lindex(list_key(name), 0)
            pipe.zcard(held_key(name))
        pipe.smembers(workers_key)
        *found, names = pipe.execute()
    lengths, heads, running = found[0::3], found[1::3], found[2::3]
    first = {name: head for name, head in zip(lists, heads, strict=True) if head is not None}
    known = sorted(names)
    with connection.pipeline(transaction=False) as pipe:
        for head in first.values():
            pipe.hget(job_key(head.decode(errors="replace")), "enqueued_at")
        for name in known:
            pipe.get(worker_key + name)
            pipe.pttl(worker_key + name)
        # Under a name that anybody may have put there lies anything: that hides no other.
        rest = [None if isinstance(answer, Exception) else answer for answer in pipe.execute(raise_on_error=False)]
    since, beats = rest[: len(first)], rest[len(first) :]
    ages: dict[Place, float] = {}
    for name, when in zip(first, since, strict=True):
        if (age := age_of((when or b"").decode(errors="replace"))) is not None:
            ages[lists[name]] = max(age, ages.get(lists[name], 0.0))
    pulses = {}
    for i, name in enumerate(known):
        if (beat := read_beat(beats[2 * i])) is not None:
            lease_age_s = max(0.0, lease_s - (beats[2 * i + 1] or 0) / 1000)
            pulses[name.decode(errors="replace")] = WorkerPulse(beat.device, beat.state, lease_age_s)
    return QueueNow(
        depth=_by_place(lists.values(), lengths),
        oldest_s=ages,
        running=_by_place(lists.values(), running),
        workers=pulses,
    )


def _by_place(places: Iterable[Place], numbers: Iterable[int]) -> dict[Place, int]:
    found: dict[Place, int] = {}
    for place, number in zip(places, numbers, strict=True):
        found[place] = found.get(place, 0) + number
    return found

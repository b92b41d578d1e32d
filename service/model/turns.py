"""Whose turn it is: projects, and keys without one, share the queue evenly, and so do the jobs of each, whoever came
first or asks for most."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Final, TypeVar

T = TypeVar("T")
#: Jobs fed in one round; the others have their turn in the next ones.
JOBS_A_ROUND: Final = 64
#: Turns remembered: more than there are jobs with waiting tasks, or a forgotten one would come first again.
_REMEMBERED: Final = 100_000


@dataclass(frozen=True)
class WaitingJob:
    """A job with tasks that may be queued, and whose share of the queue it takes (see `share_of`)."""

    id: str
    key: str


def share_of(project: str, key: str) -> str:
    """Whose share of the queue a job takes: its project's, or without one its key's ("" where there are no keys)."""
    # No name of a key holds a space.
    return f"project {project}" if project else key


class Turns:
    """Remembers who was served last. Lost with its process, which costs nobody more than one turn."""

    def __init__(self) -> None:
        self._served: dict[str, int] = {}
        self._count = 0

    def order(self, jobs: Iterable[WaitingJob], limit: int) -> list[tuple[WaitingJob, int]]:
        """The jobs whose turn it is, and how many of their tasks may be queued, `limit` or somewhat more in all."""
        of_key: dict[str, list[WaitingJob]] = defaultdict(list)
        for job in sorted(jobs, key=lambda job: self._served.get(f"job {job.id}", 0)):
            of_key[job.key].append(job)
        keys = sorted(of_key, key=lambda key: self._served.get(f"key {key}", 0))
        chosen = interleave([of_key[key] for key in keys])[: min(JOBS_A_ROUND, limit)]
        number: dict[str, int] = defaultdict(int)
        for job in chosen:
            number[job.key] += 1
        return [(job, -(-limit // (len(number) * number[job.key]))) for job in chosen]

    def served(self, jobs: Sequence[WaitingJob]) -> None:
        """These jobs had their turn, in this order."""
        for job in jobs:
            self._count += 1
            self._served[f"job {job.id}"] = self._served[f"key {job.key}"] = self._count
        if len(self._served) > _REMEMBERED:
            self._served.clear()


def interleave(lists: Sequence[Sequence[T]]) -> list[T]:
    """One of each list, then the second of each, and so on."""
    longest = max(map(len, lists), default=0)
    return [some[place] for place in range(longest) for some in lists if place < len(some)]

"""Which keeper looks after a job: ids of jobs are hashes, and their range is cut into shards of equal width.

A shard of the keepers' work is none of the store's shards, which hold grasps.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

#: Shards that the work of all keepers may be cut into.
MOST_SHARDS: Final = 64
#: Hexadecimal digits of an id that say where it is.
_DIGITS: Final = 8
PLACES: Final = 16**_DIGITS
#: Sorts after every hexadecimal digit.
_END: Final = "g"
_HEXADECIMAL: Final = frozenset("0123456789abcdef")


def place_of(name: str) -> int:
    """Where an id is among all of them, 0 to `PLACES` - 1; what is of no job, or no hash, is at 0."""
    head = name[:_DIGITS]
    return int(head, 16) if len(head) == _DIGITS and set(head) <= _HEXADECIMAL else 0


def shard_of(name: str, number: int) -> int:
    """Shard of a job's id among so many."""
    return place_of(name) * number // PLACES


@dataclass(frozen=True)
class KeeperShards:
    """The shards that a keeper holds, of so many; by default all there is."""

    number: int = 1
    held: frozenset[int] = frozenset({0})

    @property
    def leads(self) -> bool:
        """Whether what is of no shard is this keeper's: who holds the first shard has it."""
        return 0 in self.held

    @property
    def all_held(self) -> bool:
        return len(self.held) == self.number

    def has(self, name: str) -> bool:
        """Whether an id falls into one of them."""
        return self.all_held or shard_of(name, self.number) in self.held

    def ranges(self) -> Iterator[tuple[str, str]]:
        """Ids of each, from one up to but without another."""
        for shard in sorted(self.held):
            ends = (-(-place * PLACES // self.number) for place in (shard, shard + 1))
            first, end = (f"{place:0{_DIGITS}x}" if place < PLACES else _END for place in ends)
            yield first, end

    def __str__(self) -> str:
        some = ", ".join(map(str, sorted(self.held)))
        return f"{'shard' if len(self.held) == 1 else 'shards'} {some} of {self.number}"


#: Those of a keeper that is alone.
ALL_SHARDS: Final = KeeperShards()

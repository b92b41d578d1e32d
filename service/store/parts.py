"""Where bytes lie: an object of the store, or a stretch of one, written as one text that fits wherever a key does.

`KEY` is a whole object, `KEY@START+LENGTH` so many bytes of it from an offset on. No key of an object holds `@` or `+`,
so that a version of graspd that knows no parts refuses such a text and reads nothing else in its place.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Final

_PART: Final = re.compile(r"([^@+]+)@(0|[1-9][0-9]{0,14})\+([1-9][0-9]{0,14})")


@dataclass(frozen=True)
class Part:
    """A stretch of an object."""

    key: str
    start: int
    length: int

    def __str__(self) -> str:
        return f"{self.key}@{self.start}+{self.length}"


def part_of(place: str) -> Part | None:
    """The stretch that a text names; None where it names a whole object."""
    match = _PART.fullmatch(place)
    return None if match is None else Part(match[1], int(match[2]), int(match[3]))


def is_part(place: str) -> bool:
    """Whether a text names a stretch of an object."""
    return "@" in place


def preference(place: str) -> tuple[bool, str]:
    """Of two places of one shard the one that counts sorts first: a file of its own, else the first by name."""
    return is_part(place), place

"""What a check of an installation found: one line, and where something is wrong, the mend."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum


class Condition(StrEnum):
    """How a thing stands."""

    GOOD = "good"
    WARNING = "warning"
    """It works, and will cost something."""
    BAD = "bad"
    """Something does not work, or will lose what it should keep."""
    SKIPPED = "skipped"
    """It was not looked at; the message says why."""


@dataclass(frozen=True)
class Finding:
    """What was found about one thing."""

    name: str
    condition: Condition
    message: str
    mend: str = ""
    """What to do; "" where nothing is to be done."""

    @property
    def ok(self) -> bool:
        """Whether nothing has to be mended."""
        return self.condition is not Condition.BAD


def good(name: str, message: str) -> Finding:
    return Finding(name, Condition.GOOD, message)


def warning(name: str, message: str, mend: str) -> Finding:
    return Finding(name, Condition.WARNING, message, mend)


def bad(name: str, message: str, mend: str) -> Finding:
    return Finding(name, Condition.BAD, message, mend)


def skipped(name: str, why: str) -> Finding:
    return Finding(name, Condition.SKIPPED, why)

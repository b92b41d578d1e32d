"""Checks of an installation, with fixes. Each check has a timeout, so that a hang hides no others."""

import threading
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Final

from graspd.service.model.errors import GraspdError

THREADS: Final = "doctor-"


class Condition(StrEnum):
    GOOD = "good"
    WARNING = "warning"
    BAD = "bad"
    """The part does not work, or will lose data."""
    SKIPPED = "skipped"
    """The part was not checked; the message has the reason."""


@dataclass(frozen=True)
class Finding:
    condition: Condition
    message: str
    fix: str = ""
    name: str = ""

    @property
    def ok(self) -> bool:
        return self.condition is not Condition.BAD


@dataclass(frozen=True)
class Check:
    name: str
    look: Callable[[], Finding]
    limit_s: float = 60.0
    mend_hang: str = "check the network and the log of that part; the service will hang there too"


def run_checks(checks: Sequence[Check]) -> Iterator[Finding]:
    """Run all checks at once; yield findings in the order of the checks, each as early as possible."""
    started = time.monotonic()
    runs = [_CheckRun(check) for check in checks]
    for run in runs:
        yield run.finding(started + run.check.limit_s)


class _CheckRun:
    """Check in a daemon thread, which does not delay the end of the process."""

    def __init__(self, check: Check) -> None:
        self.check = check
        self._finding: Finding | None = None
        self._thread = threading.Thread(target=self._run, name=f"{THREADS}{check.name}", daemon=True)
        self._thread.start()

    def finding(self, deadline: float) -> Finding:
        self._thread.join(max(0.0, deadline - time.monotonic()))
        hangs = bad(f"no answer within {self.check.limit_s:.0f} s", self.check.mend_hang)
        return replace(self._finding or hangs, name=self.check.name)

    def _run(self) -> None:
        try:
            self._finding = self.check.look()
        except GraspdError as error:
            self._finding = bad(str(error), "see the message")
        except Exception as error:
            line = " ".join(f"{type(error).__name__}: {error}".split())[:300]
            self._finding = bad(f"the check itself failed: {line}", "report it to the authors of graspd")


def good(message: str) -> Finding:
    return Finding(Condition.GOOD, message)


def warning(message: str, fix: str) -> Finding:
    return Finding(Condition.WARNING, message, fix)


def bad(message: str, fix: str) -> Finding:
    return Finding(Condition.BAD, message, fix)


def skipped(why: str) -> Finding:
    return Finding(Condition.SKIPPED, why)

"""Checks of an installation, with fixes. Each check has a timeout, so that a hang hides no others."""

import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from enum import StrEnum
from functools import partial
from typing import Final

from graspd.service.model.errors import GraspdError

#: Prefix of the names of threads, of which one that hangs would delay the end of the process.
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


def run_checks(checks: Sequence[Check]) -> Iterator[Finding]:
    """Run all checks at once; yield findings in the order of the checks, each as early as possible."""
    started = time.monotonic()
    pool = ThreadPoolExecutor(max(1, len(checks)), thread_name_prefix=THREADS)
    runs = [pool.submit(_finding_of, check) for check in checks]
    pool.shutdown(wait=False)
    for check, run in zip(checks, runs, strict=True):
        try:
            found = run.result(max(0.0, started + check.limit_s - time.monotonic()))
        except TimeoutError:
            fix = "check the network and the log of that part; the service will hang there too"
            found = bad(f"no answer within {check.limit_s:.0f} s", fix)
        yield replace(found, name=check.name)


def _finding_of(check: Check) -> Finding:
    try:
        return check.look()
    except GraspdError as error:
        return bad(str(error), "see the message")
    except Exception as error:
        line = " ".join(f"{type(error).__name__}: {error}".split())[:300]
        return bad(f"the check itself failed: {line}", "report it to the authors of graspd")


good = partial(Finding, Condition.GOOD)
warning = partial(Finding, Condition.WARNING)
bad = partial(Finding, Condition.BAD)
skipped = partial(Finding, Condition.SKIPPED)

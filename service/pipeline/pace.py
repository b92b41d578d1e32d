"""When to do again what need not be done in every round: what takes long with a large fleet is done less often."""

from __future__ import annotations

import math
from collections.abc import Callable


class Pace:
    """At most once in `every_s`, and no more than `share` of the time."""

    def __init__(
        self, clock: Callable[[], float], every_s: float, *, share: float = 0.2, longest_s: float = math.inf
    ) -> None:
        """`longest_s` is the longest pause, whatever the share then is [s]."""
        self._clock = clock
        self._every_s, self._share, self._longest_s = every_s, share, longest_s
        self._again = -math.inf

    @property
    def is_due(self) -> bool:
        return self._clock() >= self._again

    def run(self, work: Callable[[], object]) -> None:
        """Do it now. Where it breaks off, it is due again at once."""
        begun = self._clock()
        work()
        ended = self._clock()
        pause = max(self._every_s, (ended - begun) * (1 / self._share - 1))
        self._again = ended + min(pause, max(self._every_s, self._longest_s))

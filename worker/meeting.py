"""Where work that several threads ask for alike is done for all of them at once: tasks meet here before each launch.

Each member goes its own way and asks when it needs the device. One thread serves: it waits until as much is asked for
as one launch takes, until all members wait, or until waiting has taken as long as a launch does, then does the work of
all who ask for the same. Meanwhile the others do what needs no device, so that host and device are busy at once.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass, field
from typing import Any, Final

from graspd.service.model.errors import TaskCancelled

log = logging.getLogger(__name__)
#: Work for several at once: a result, or what became of it, for each that was asked for.
Work = Callable[[Sequence[Any]], Sequence[Any]]
#: How long one waits for others before there was a launch to compare with [s].
FIRST_WAIT_S: Final = 1.0
#: Pause between two looks at whether to stop [s].
_LOOK_S: Final = 0.1


@dataclass(eq=False)
class _Seat:
    """What a member asks for."""

    key: Hashable
    item: Any
    size: int
    work: Work
    since: float
    served: threading.Event = field(default_factory=threading.Event)
    result: Any = None


class Meeting:
    """Members that ask for work, and a thread that does it for several of them at once; a context manager.

    A result does not depend on who else is served with it: that is for `work` to see to.
    """

    def __init__(self, members: int, most: int, *, clock: Callable[[], float] = time.monotonic) -> None:
        """`members` are there until they `leave`; `most` is the size of work that is done at once."""
        self.members = members
        self._most, self._clock = most, clock
        self._changed = threading.Condition()
        self._seats: list[_Seat] = []
        self._took_s: dict[Hashable, float] = {}
        """How long the last work of each kind took."""
        self._closed = False
        self.served: list[int] = []
        """How many were served at once, each time."""
        self._thread = threading.Thread(target=self._serve, name="meeting", daemon=True)

    def __enter__(self) -> Meeting:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        with self._changed:
            self._closed = True
            self._changed.notify_all()
        self._thread.join()

    def leave(self) -> None:
        """One member asks for nothing more."""
        with self._changed:
            self.members -= 1
            self._changed.notify_all()

    def ask(self, key: Hashable, item: Any, work: Work, *, size: int, cancelled: Callable[[], bool]) -> Any:
        """The result of `work` for an item, together with others of the same key.

        Args:
            key: what is alike may be done at once; hands, objects, devices stand in it by their digests or names.
            item: of this member.
            work: takes the items of several members and gives a result, or what became of it, for each. What it raises
                became of all; where there are several, each is then tried by itself.
            size: of the item, in the unit of `most`.
            cancelled: asked often. True: this member waits no longer.

        Raises:
            TaskCancelled: `cancelled` answered True.
            Exception: what became of the item.
        """
        seat = _Seat(key, item, size, work, self._clock())
        with self._changed:
            self._seats.append(seat)
            self._changed.notify_all()
        while not seat.served.wait(_LOOK_S):
            if cancelled():
                with self._changed:
                    if seat in self._seats:
                        self._seats.remove(seat)
                raise TaskCancelled("stopped while others were waited for")
        if isinstance(seat.result, Exception):
            raise seat.result
        return seat.result

    def _serve(self) -> None:
        while (group := self._next()) is not None:
            began = self._clock()
            self._do(group)
            self._took_s[group[0].key] = self._clock() - began

    def _next(self) -> list[_Seat] | None:
        """Those who are served next, as soon as it is time; None: the meeting is over."""
        with self._changed:
            while not self._closed:
                group, left_s = self._due()
                if group:
                    for seat in group:
                        self._seats.remove(seat)
                    self.served.append(len(group))
                    return group
                self._changed.wait(left_s)
        return None

    def _due(self) -> tuple[list[_Seat], float | None]:
        """Who is served, or else for how long to wait: of what is asked for the oldest that fills a launch, or that has
        waited long enough, or whatever is the oldest where nobody else can come."""
        waiting: dict[Hashable, list[_Seat]] = {}
        for seat in self._seats:
            waiting.setdefault(seat.key, []).append(seat)
        if not waiting:
            return [], None
        groups = [self._group(seats) for seats in waiting.values()]
        if len(self._seats) >= self.members:
            return groups[0], None
        left = [self._took_s.get(group[0].key, FIRST_WAIT_S) + group[0].since - self._clock() for group in groups]
        for group, seats, left_s in zip(groups, waiting.values(), left, strict=True):
            # Rounds are not all of one size: what is left of a launch that the next one would overfill stays empty.
            if sum(seat.size for seat in seats) >= self._most or left_s <= 0:
                return group, None
        return [], min(left)

    def _group(self, seats: Sequence[_Seat]) -> list[_Seat]:
        """Of those who ask for the same as many as one launch takes, the oldest among them."""
        group, size = list[_Seat](), 0
        for seat in seats:
            if not group or size + seat.size <= self._most:
                group.append(seat)
                size += seat.size
        return group

    def _do(self, group: list[_Seat]) -> None:
        try:
            results = list(group[0].work([seat.item for seat in group]))
            if len(results) != len(group):
                raise RuntimeError(f"{len(results)} results for {len(group)}")
        except Exception as error:
            if len(group) > 1:
                log.warning("%d that were done at once are done one by one: %s", len(group), error)
                for seat in group:
                    self._do([seat])
                return
            results = [error]
        for seat, result in zip(group, results, strict=True):
            seat.result = result
            seat.served.set()

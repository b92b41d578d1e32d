"""Keeps the mark of store and index in step, and finds that one of them is an older copy.

Every record that a user makes counts a change in the index. The controller then gives store and index a new mark: an
index that was copied before has another one than the store, and is made anew.
"""

from __future__ import annotations

from service.index.notes import Marked
from service.pipeline.backends import Services
from service.store.records import newest_mark, next_mark, set_mark


class Marking:
    """What the controller does about it."""

    def __init__(self, services: Services) -> None:
        self._services = services
        self._known: str | None = None
        """The mark that the index had when it was last looked at."""

    def agrees(self) -> bool:
        """Whether the index is as old as the store, which is asked where the index has another mark than before."""
        present = self._services.index.notes.marked()
        if present.mark != self._known:
            # Killed between the two, a controller leaves the store with the mark before.
            if newest_mark(self._services.store) not in (present.mark, present.before):
                return False
            self._known = present.mark
        return True

    def advance(self, *, news: bool) -> None:
        """A new mark if anything was changed since the last one.

        Args:
            news: whether workers made something.

        Raises:
            UnavailableError: a part is away; call it again.
        """
        present, changes = self._services.index.notes.marked(), self._services.index.notes.changes()
        if changes == present.changes and not news:
            return
        fresh = next_mark(present.mark)
        self._services.index.notes.set_marked(Marked(fresh, newest_mark(self._services.store), changes))
        set_mark(self._services.store, fresh)
        self._services.index.notes.set_marked(Marked(fresh, fresh, changes))
        self._known = fresh

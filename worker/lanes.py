"""Lanes: threads that go their own ways with parts of one piece of work, and share the cores."""

from __future__ import annotations

import threading


class Lanes:
    """How many lanes share the cores; one that ends leaves its own to the others."""

    def __init__(self, members: int) -> None:
        self.members = members
        self._lock = threading.Lock()

    def leave(self) -> None:
        """One lane needs no cores any more."""
        with self._lock:
            self.members -= 1

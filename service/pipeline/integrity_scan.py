"""Integrity scan of the store by the controller: repeated, rate-limited, resumed at its last position."""

from __future__ import annotations

import heapq
import logging
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Final

from graspd.service.index.notes import Damage, ScanNote
from graspd.service.model.clock import age_of, timestamp
from graspd.service.model.errors import GraspdError
from graspd.service.pipeline.backends import Services
from graspd.service.pipeline.integrity import FOLDERS, examine, is_checked, may_await_manifest

log = logging.getLogger(__name__)
#: Least interval of rounds over a small store [s].
ROUND_S: Final = 3600.0
#: Interval of checks of known damage, so that repaired objects soon leave the list [s].
_AGAIN_S: Final = 60.0
_KNOWN: Final = 1000
#: Keys in memory at once; further keys need another listing of the folder.
_KEYS: Final = 10_000
#: Least cost of an object, so that a million small objects are not read at once [bytes].
_LEAST: Final = 16 * 2**10
#: Most backlog that is read at once after a pause [s].
_BURST_S: Final = 0.25
#: Interval of queries whether `graspd admin store verify` pauses the scan [s].
_PAUSE_S: Final = 5.0


class Interrupted(Exception):
    """The process stops, or `graspd admin store verify` reads the store."""


class IntegrityScan:
    """Read through the store; record new and repaired damage in the index."""

    def __init__(
        self, services: Services, stop: threading.Event, *, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._services, self._stop, self._clock = services, stop, clock
        self._rate = services.settings.integrity_scan_mb_per_s * 2**20
        self._asked = -_PAUSE_S
        self._paid = clock()
        self._looked = clock()

    def run(self) -> None:
        """Run until `stop` is set; wait for an unavailable backend."""
        while not self._stop.is_set():
            try:
                if self._may_read() and self.advance():
                    continue
            except Interrupted:
                pass
            except GraspdError as error:
                log.warning("%s; the integrity scan continues later", error)
            except Exception:
                log.exception("the integrity scan failed and will continue later")
            self._stop.wait(_PAUSE_S)

    def _may_read(self) -> bool:
        """Check that `store verify` does not pause the scan; queries the index every few seconds."""
        now = self._clock()
        if now - self._asked >= _PAUSE_S:
            if self._services.index.notes.is_scan_paused():
                return False
            self._asked = now
        return True

    def advance(self) -> bool:
        """Read further objects; return False while no round is due. Interrupted: `store verify` reads the store."""
        self._recheck_if_due(None)
        note = self._services.index.notes.scan_note()
        if note.folder >= len(FOLDERS):
            if (age_of(note.started) or 0.0) < ROUND_S:
                return False
            note = ScanNote()
        note = note if note.started else replace(note, started=timestamp())
        keys = self._keys(FOLDERS[note.folder], note.after)
        for key in keys:
            if is_checked(key):
                self._check(key)
            self._recheck_if_due(replace(note, after=key))
        over = len(keys) < _KEYS
        note = replace(note, folder=note.folder + over, after="" if over else keys[-1])
        if note.folder == len(FOLDERS):
            note = replace(note, ended=timestamp())
        self._services.index.notes.set_scan_note(note)
        return True

    def _recheck_if_due(self, reached: ScanNote | None) -> None:
        if self._clock() - self._looked > _AGAIN_S:
            if reached is not None:
                self._services.index.notes.set_scan_note(reached)
            self.look_again()

    def look_again(self) -> None:
        """Check known damage again; remove repaired and deleted objects from the list."""
        self._looked = self._clock()
        _, known = self._services.index.damage.known(limit=_KNOWN)
        if well := [one.key for one in known if self._is_repaired(one)]:
            self._services.index.damage.mark([], intact=well)

    def _is_repaired(self, one: Damage) -> bool:
        stem, dot, _ = one.key.rpartition(".")
        keys = [f"{stem}.json", f"{stem}.h5"] if one.shard and dot else [one.key]
        return all(examine(self._services.store, key, read=self._pace) is None for key in keys)

    def _check(self, key: str) -> None:
        self._pace(_LEAST)
        wrong = examine(self._services.store, key, read=self._pace)
        if wrong is not None and not may_await_manifest(self._services.store, wrong):
            log.warning("%s: %s", wrong.key, wrong.what)
            self._services.index.damage.mark([wrong])

    def _keys(self, folder: str, after: str) -> list[str]:
        listed = self._services.store.list(folder, offset=after or None)
        return heapq.nsmallest(_KEYS, (entry.key for entry in listed))

    def _pace(self, size: int) -> None:
        """Wait until `size` more bytes are within the rate."""
        now = self._clock()
        self._paid = max(self._paid, now - _BURST_S) + size / self._rate
        if self._stop.wait(max(0.0, self._paid - now)) or not self._may_read():
            raise Interrupted

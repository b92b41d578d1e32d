"""Integrity scan of the store by the controller: round after round, at a bounded rate, on from where it stopped."""

from __future__ import annotations

import heapq
import logging
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from typing import Final
from uuid import uuid4

from graspd.service.index.notes import Damage, ScanNote
from graspd.service.model.clock import age_of, timestamp
from graspd.service.model.errors import GraspdError
from graspd.service.pipeline.backends import Services
from graspd.service.pipeline.integrity import FOLDERS, examine, is_checked, is_on_its_way

log = logging.getLogger(__name__)
#: A small store is not read more often than this [s].
ROUND_S: Final = 3600.0
#: What is known to be damaged is looked at again this often, so that the fixed is soon forgotten [s].
_AGAIN_S: Final = 60.0
_KNOWN: Final = 1000
#: Keys held at once; the folder is listed anew for the next ones.
_KEYS: Final = 10_000
#: An object costs at least this, or a million small ones would be read in one go [bytes].
_LEAST: Final = 16 * 2**10
#: Work that is made up for at once after a pause [s].
_BURST_S: Final = 0.25
#: Whoever reads through the store says so this often [s], and is believed for three times as long.
_TURN_S: Final = 5.0
_PAUSE_S: Final = 5.0


class Interrupted(Exception):
    """The process is to stop, or somebody else reads through the store."""


class ReadPermit:
    """The right to read through the store: one has it at a time, a `store verify` before the controller."""

    def __init__(self, services: Services, *, is_controller: bool, clock: Callable[[], float] = time.monotonic) -> None:
        self._services, self._is_controller, self._clock = services, is_controller, clock
        self._holder = uuid4().hex
        self._said = -_TURN_S

    def is_mine(self) -> bool:
        """Take the turn, or keep it; asks the index every few seconds."""
        now = self._clock()
        if now - self._said >= _TURN_S:
            if not self._services.index.notes.take_scan_turn(
                self._holder, is_controller=self._is_controller, lasts_s=3 * _TURN_S
            ):
                return False
            self._said = now
        return True

    def keep(self) -> None:
        """Renew it, while there is much to read."""
        self.is_mine()

    def end(self) -> None:
        self._services.index.notes.end_scan_turn(self._holder)
        self._said = -_TURN_S


class IntegrityScan:
    """Reads through the store and notes in the index what is damaged, or no longer is."""

    def __init__(
        self, services: Services, stop: threading.Event, *, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._services, self._stop, self._clock = services, stop, clock
        self._rate = services.settings.integrity_scan_mb_per_s * 2**20
        self._turn = ReadPermit(services, is_controller=True, clock=clock)
        self._paid = clock()
        self._looked = clock()

    def run(self) -> None:
        """Until told to stop. A part that is away is waited for."""
        while not self._stop.is_set():
            try:
                if not self._turn.is_mine() or not self.advance():
                    self._stop.wait(_PAUSE_S)
            except Interrupted:
                self._stop.wait(_PAUSE_S)
            except GraspdError as error:
                log.warning("%s; the integrity scan goes on later", error)
                self._stop.wait(_PAUSE_S)
            except Exception:
                log.exception("the integrity scan broke off; it goes on later")
                self._stop.wait(_PAUSE_S)
        with suppress(GraspdError):
            self.end()

    def end(self) -> None:
        """Let others read through the store at once."""
        self._turn.end()

    def advance(self) -> bool:
        """Read some objects further. Returns whether there is more to read now.

        Raises:
            Interrupted: it is to stop, or `store verify` reads now.
            UnavailableError: a part is away; call again.
        """
        self._look_again_in_time(None)
        note = self._services.index.notes.scan_note()
        if note.folder >= len(FOLDERS):
            if (age_of(note.started) or 0.0) < ROUND_S:
                return False
            note = ScanNote()
        note = note if note.started else replace(note, started=timestamp())
        keys = self._keys(FOLDERS[note.folder], note.after)
        for key in keys:
            if is_checked(key):
                self._look(key)
            self._look_again_in_time(replace(note, after=key))
        over = len(keys) < _KEYS
        note = replace(note, folder=note.folder + over, after="" if over else keys[-1])
        if note.folder == len(FOLDERS):
            note = replace(note, ended=timestamp())
        self._services.index.notes.set_scan_note(note)
        return True

    def _look_again_in_time(self, reached: ScanNote | None) -> None:
        if self._clock() - self._looked > _AGAIN_S:
            if reached is not None:
                self._services.index.notes.set_scan_note(reached)
            self.look_again()

    def look_again(self) -> None:
        """Examine anew what is known to be damaged; forget what is well, and what was removed since."""
        self._looked = self._clock()
        _, known = self._services.index.damage.known(limit=_KNOWN)
        well = [one.key for one in known if self._is_well(one)]
        if well:
            self._services.index.damage.mark([], intact=well)

    def _is_well(self, one: Damage) -> bool:
        stem, dot, _ = one.key.rpartition(".")
        keys = [f"{stem}.json", f"{stem}.h5"] if one.shard and dot else [one.key]
        return all(examine(self._services.store, key, read=self._pace) is None for key in keys)

    def _look(self, key: str) -> None:
        self._pace(_LEAST)
        if (wrong := examine(self._services.store, key, read=self._pace)) is None:
            return
        if not is_on_its_way(self._services.store, wrong):
            log.warning("%s: %s", wrong.key, wrong.what)
            self._services.index.damage.mark([wrong])

    def _keys(self, folder: str, after: str) -> list[str]:
        listed = self._services.store.list(folder, offset=after or None)
        return heapq.nsmallest(_KEYS, (entry.key for entry in listed))

    def _pace(self, size: int) -> None:
        """Wait until so many bytes more are within the rate."""
        now = self._clock()
        self._paid = max(self._paid, now - _BURST_S) + size / self._rate
        if self._stop.wait(max(0.0, self._paid - now)) or not self._turn.is_mine():
            raise Interrupted

"""Parsing of graspd's entries in Redis.

Any client can write any value under any name. Unreadable entries are skipped; `sweep` removes permanent obstacles.
"""

from __future__ import annotations

import json
import re
import zlib
from collections.abc import Mapping
from typing import Any, Final, TypeVar

from pydantic import TypeAdapter, ValidationError

from graspd.service.model.messages import message_type
from graspd.service.model.renamed import convert_names
from graspd.service.model.workers import WorkerBeat
from graspd.service.queue.port import Event, Message

Entry = TypeVar("Entry", WorkerBeat, Event)
_ADAPTERS: Final[dict[type, TypeAdapter[Any]]] = {kind: TypeAdapter(kind) for kind in (WorkerBeat, Event)}
_ATTEMPT: Final = re.compile(r"(.+)-([0-9]{1,9})")
#: Limit of the unpacked message; a real one has a few kilobytes.
_MESSAGE_BYTES: Final = 1 << 20
#: Future time of an entry that would block a stream: a stream rejects entries older than its newest.
_FUTURE_MS: Final = 24 * 3600 * 1000


def text(raw: bytes | None) -> str:
    """Decode text that every database accepts; invalid UTF-8 becomes text that matches no name."""
    return (raw or b"").decode(errors="replace")


def task_of(job: str) -> tuple[str, int]:
    """Return task id and attempt of an RQ job id; a forged id counts as a separate task."""
    match = _ATTEMPT.fullmatch(job)
    return (match[1], int(match[2])) if match else (job, 0)


def is_type_error(error: Exception) -> bool:
    return str(error).startswith("WRONGTYPE")


def message(data: bytes | None) -> Message | None:
    if data is None:
        return None
    try:
        raw = convert_names(json.loads(zlib.decompressobj().decompress(data, _MESSAGE_BYTES))[2][0])
        return message_type(raw).model_validate(raw)
    except Exception:  # Forged data may raise any error.
        return None


def read(kind: type[Entry], data: bytes | None) -> Entry | None:
    """Parse a worker's report or an event; None if forged, or of a much newer or older version."""
    try:
        found: Entry = _ADAPTERS[kind].validate_json(data or b"")
        return found
    except ValidationError:
        return None


def events(reply: Any) -> list[tuple[str, Event | None]]:
    """Return id and event of each entry of a reply; trimmed entries have no fields."""
    streams = reply.items() if isinstance(reply, dict) else reply or []
    return [
        (event_id.decode(), read(Event, fields.get(b"e")) if fields else None)
        for _, found in streams
        for entry in found
        for event_id, fields in ([entry] if isinstance(entry, tuple) else entry)
    ]


def sweep(connection: Any, kinds: Mapping[str, str], stream: str) -> None:
    """Remove entries of another type than that in `kinds`, and the event stream if it accepts no entries."""
    with connection.pipeline(transaction=False) as pipe:
        for name in kinds:
            pipe.type(name)
        found = dict(zip(kinds, map(text, pipe.execute()), strict=True))
    wrong = [name for name, kind in found.items() if kind not in ("none", kinds[name])]
    if found[stream] == "stream":
        newest = int(text(connection.xinfo_stream(stream)["last-generated-id"]).partition("-")[0])
        wrong += [stream] if newest > connection.time()[0] * 1000 + _FUTURE_MS else []
    if wrong:
        connection.delete(*wrong)

"""What lies in Redis under graspd's names, read as what anybody may have written there.

Whoever writes to Redis may put anything under any name. What cannot be read is nobody's: it is left out, and `sweep`
takes away what would stand in the way for good.
"""

from __future__ import annotations

import json
import re
import zlib
from collections.abc import Mapping
from typing import Any, Final, TypeVar

from pydantic import TypeAdapter, ValidationError

from graspd.service.model.messages import message_type
from graspd.service.model.renamed import renamed
from graspd.service.model.workers import WorkerBeat
from graspd.service.queue.port import Event, Message

Entry = TypeVar("Entry", WorkerBeat, Event)
_ADAPTERS: Final[dict[type, TypeAdapter[Any]]] = {kind: TypeAdapter(kind) for kind in (WorkerBeat, Event)}
_ATTEMPT: Final = re.compile(r"(.+)-([0-9]{1,9})")
#: A message has a few kilobytes, whatever its few compressed bytes would unpack to.
_MESSAGE_BYTES: Final = 1 << 20
#: A stream takes no entry older than its newest: one so far in the future would shut it for good.
_FUTURE_MS: Final = 24 * 3600 * 1000


def text(raw: bytes | None) -> str:
    """Text that every database takes; what is no UTF-8 turns into text that names nothing."""
    return (raw or b"").decode(errors="replace")


def task_of(job: str) -> tuple[str, int]:
    """Task id and attempt of an RQ job id; a forged one is a task of its own."""
    match = _ATTEMPT.fullmatch(job)
    return (match[1], int(match[2])) if match else (job, 0)


def is_wrong_type(error: Exception) -> bool:
    """Whether Redis refused because another kind of value lies there."""
    return str(error).startswith("WRONGTYPE")


def message(data: bytes | None) -> Message | None:
    """What an RQ job asks of a worker."""
    if data is None:
        return None
    try:
        raw = renamed(json.loads(zlib.decompressobj().decompress(data, _MESSAGE_BYTES))[2][0])
        return message_type(raw).model_validate(raw)
    except Exception:  # forged data may fail anywhere
        return None


def read(kind: type[Entry], data: bytes | None) -> Entry | None:
    """What a worker says of itself, or an event; None if it is forged, or of a version much newer or older."""
    try:
        found: Entry = _ADAPTERS[kind].validate_json(data or b"")
        return found
    except ValidationError:
        return None


def events(reply: Any) -> list[tuple[str, Event | None]]:
    """Id and event of each entry of a reply; an entry that was trimmed has no fields."""
    streams = reply.items() if isinstance(reply, dict) else reply or []
    return [
        (event_id.decode(), read(Event, fields.get(b"e")) if fields else None)
        for _, found in streams
        for entry in found
        for event_id, fields in ([entry] if isinstance(entry, tuple) else entry)
    ]


def sweep(connection: Any, kinds: Mapping[str, str], stream: str) -> None:
    """Remove what is not of the kind that its name says, and the stream of events where it takes no more entries.

    Args:
        kinds: names with the type that Redis should tell of each.
        stream: one of them.
    """
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

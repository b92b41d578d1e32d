"""The hand and the object that a shard was made with, for commands that work on files."""

from __future__ import annotations

import json

from service.errors import ConflictError
from service.shards import Shard
from worker.hands.load import hand_from_path
from worker.hands.model import HandModel
from worker.objects.model import ObjectModel
from worker.objects.prepare import object_from_path


def hand_of_shard(shard: Shard, given: str | None) -> HandModel:
    """The hand named by `given` (a file or a built-in); by default the built-in of the name in the shard.

    Raises:
        NotFoundError: there is no such file or built-in.
        ConflictError: it is not the hand the shard was made with.
    """
    hand = hand_from_path(given or str(shard.attributes.get("hand", "")))
    _check(shard, "hand", hand.digest, given)
    return hand


def object_of_shard(shard: Shard, given: str | None) -> ObjectModel:
    """The object named by `given`, simplified as in the shard; see `hand_of_shard`."""
    knobs = json.loads(str(shard.attributes.get("fidelity") or "{}"))
    error = float(knobs["face_error_m"]) if isinstance(knobs, dict) and "face_error_m" in knobs else 3e-4
    obj = object_from_path(given or str(shard.attributes.get("object", "")), face_error_m=error)
    _check(shard, "object", obj.digest, given)
    return obj


def _check(shard: Shard, kind: str, digest: str, given: str | None) -> None:
    expected = str(shard.attributes.get(f"{kind}_digest", ""))
    if expected != digest:
        name = given or str(shard.attributes.get(kind, ""))
        raise ConflictError(
            f"the {shard.kind} shard was made with the {kind} of digest {expected[:12]}, but {name!r} has "
            f"{digest[:12]}; give the file it was made with as --{kind}"
        )

"""From the records in the store to the rows of the index."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from typing import Any, Final

from service.model.domain import Asset, JobOptions
from service.model.planning import plan, stages_of
from service.model.records import AttemptRecord, JobRecord
from service.model.states import State
from service.store.manifests import ShardManifest

Row = dict[str, Any]
#: Facts, repairs and message of a hand or object stand in every list, and follow from files of a stranger's.
_MOST_FACTS: Final = 64 << 10
_MOST_REPAIRS: Final = 100
_LONGEST_TEXT: Final = 2000


def job_row(record: JobRecord) -> Row:
    """A job as it was submitted."""
    return {
        "id": record.id,
        "state": State.QUEUED.value,
        "lane": record.lane.value,
        "hand": record.request.hand,
        "object": record.request.object,
        "hand_digest": record.hand_digest,
        "object_digest": record.object_digest,
        "request": record.request.model_dump(mode="json"),
        "revisions": dict(record.revisions),
        "origin": record.origin and record.origin.model_dump(exclude_defaults=True),
        "owner": record.owner,
        "project": record.project,
        "cancelled": False,
        "span": record.span,
        "created": record.created,
        "finished": None,
        "reason": None,
        "neighbours": beside(record.request),
        "choice": record.choice and record.choice.model_dump(),
        "network_digest": record.request.network,
    }


def beside(options: JobOptions) -> str:
    """Digests of the neighbours, with a space between."""
    return " ".join(dict.fromkeys(one.digest or "" for one in options.beside))


def task_rows(record: JobRecord, ranges: range | None = None) -> Iterator[Row]:
    """The tasks of a job, of all ranges or some, before anything happened to them."""
    order = stages_of(record.request)
    for task in plan(record, ranges):
        yield {
            "id": task.id,
            "job_id": record.id,
            "stage": task.stage.value,
            "batch": task.batch,
            "position": order.index(task.stage),
            "count": task.count,
            "lane": record.lane.value,
            "inputs": list(task.inputs),
            "shard_id": task.output,
            "state": State.QUEUED.value,
            "ready": False,
            "done": False,
            "last_attempt": 0,
            "exhausted": False,
            "retried_upto": 0,
            "reason": None,
            "worker": None,
            "device": None,
            "seconds": None,
            "finished": None,
            "created": record.created,
            "queued": False,
            "not_before": 0.0,
            "progress_done": 0.0,
            "progress_total": 0.0,
            "progress_message": None,
        }


def clean(text: str, length: int | None = None) -> str:
    """Text that every database takes: PostgreSQL knows no character of code zero, and keeps columns to their length."""
    return text.replace("\0", "")[:length]


def attempt_row(attempt: AttemptRecord) -> Row:
    """A failed attempt."""
    return {
        "task_id": attempt.task_id,
        "number": attempt.number,
        "job_id": attempt.job_id,
        "stage": attempt.stage.value,
        "kind": clean(attempt.kind, 64),
        "reason": clean(attempt.reason),
        "trace": attempt.trace and clean(attempt.trace),
        "worker": clean(attempt.worker, 128),
        "started": attempt.started,
        "ended": attempt.ended,
        "last": attempt.last,
    }


def shard_row(manifest: ShardManifest) -> Row:
    """A shard; its grasps have rows of their own."""
    return {
        "id": manifest.shard_id,
        "kind": manifest.kind,
        "stage": manifest.stage.value,
        "key": manifest.key,
        "sha256": manifest.sha256,
        "size_bytes": manifest.size_bytes,
        "count": manifest.count,
        "valid": manifest.valid,
        "tried": manifest.tried,
        "audited": manifest.audited,
        "audit_held": manifest.audit_held,
        "judged": manifest.judged,
        "hand": manifest.hand,
        "object": manifest.object,
        "hand_digest": manifest.hand_digest,
        "object_digest": manifest.object_digest,
        "batch": manifest.batch,
        "batches": manifest.batches,
        "seed": manifest.seed,
        "inputs": list(manifest.inputs),
        "device": manifest.device,
        "worker": manifest.worker,
        "seconds": manifest.seconds,
        "created": manifest.created,
        "manifest": manifest.model_dump(mode="json", exclude={"grasps"}),
    }


def grasp_rows(manifest: ShardManifest) -> list[Row]:
    """The grasps of a base shard; none for other shards."""
    of_shard = {
        "shard_id": manifest.shard_id,
        "hand": manifest.hand,
        "object": manifest.object,
        "scene_kind": manifest.request.place.kind,
        "neighbours": len(manifest.request.beside),
        "created": manifest.created,
    }
    return [of_shard | {"row": row} | grasp.model_dump() for row, grasp in enumerate(manifest.grasps)]


def asset_row(asset: Asset, check: Mapping[str, Any] | None) -> Row:
    """A hand, object or network. What comes with graspd needs no check."""
    found = check or ({"verdict": "accept"} if asset.builtin else {})
    return {
        "kind": asset.kind.value,
        "digest": asset.digest,
        "name": asset.name,
        "filename": asset.filename,
        "files": list(asset.files),
        "size_bytes": asset.size_bytes,
        "created": asset.created,
        "builtin": asset.builtin,
        "owner": asset.owner,
        "project": asset.project,
        "shared": asset.shared,
        "verdict": found.get("verdict"),
        "message": found.get("message") and clean(found["message"], _LONGEST_TEXT),
        "repairs": [clean(str(one), _LONGEST_TEXT) for one in (found.get("repairs") or [])[:_MOST_REPAIRS]],
        "facts": _short({**asset.facts, **(found.get("facts") or {})}),
        "last_attempt": 0,
        "queued": False,
        "not_before": 0.0,
    }


def _short(facts: dict[str, Any]) -> dict[str, Any]:
    """Facts whole, or where they are too long, only the numbers among them; `check.json` has the rest."""
    if len(json.dumps(facts)) <= _MOST_FACTS:
        return facts
    return {name[:100]: value for name, value in list(facts.items())[:100] if isinstance(value, int | float)}

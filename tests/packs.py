"""A store as graspd 0.2 left it: with shards in packs, written byte for byte as it wrote them."""

from __future__ import annotations

import hashlib
import json
import struct
from collections.abc import Sequence
from itertools import accumulate

from graspd.service.model.digests import digest_bytes, digest_json
from graspd.service.model.messages import TaskMessage
from graspd.service.model.planning import message_of, plan
from graspd.service.model.records import JobRecord
from graspd.service.model.states import Stage
from graspd.service.store.manifests import ShardManifest
from graspd.service.store.store import Store, open_store
from tests.fakes import job_record, make_shard, request


def batches(count: int, **changes: object) -> list[TaskMessage]:
    return tasks_of(job_record(request(grasps=32 * count, **changes)))


def tasks_of(job: JobRecord) -> list[TaskMessage]:
    tasks = [task for task in plan(job) if task.stage is Stage.SYNTHESIZE]
    return [message_of(job, task, attempt=1, max_attempt=3) for task in tasks]


def made_of(message: TaskMessage, *, worker: str = "w") -> tuple[ShardManifest, bytes]:
    """A shard that lies nowhere yet: manifest and file."""
    elsewhere = open_store("memory://")
    manifest = make_shard(elsewhere, message, worker=worker)
    return manifest, elsewhere.get(manifest.key)


def pack(store: Store, messages: Sequence[TaskMessage], *, dead: Sequence[TaskMessage] = (), worker: str = "w") -> str:
    """Do tasks and put what they make as one object, as a worker of 0.2 did; its key.

    Args:
        dead: those whose shards are gone since.
    """
    made = [made_of(message, worker=worker) for message in messages]
    manifests = [manifest.model_copy(update={"key": ""}).model_dump_json().encode() for manifest, _ in made]
    pieces = [*manifests, *(data for _, data in made)]
    starts = list(accumulate(map(len, pieces), initial=0))
    rows = [
        {
            "id": manifest.shard_id,
            "stage": manifest.stage,
            "start": starts[len(made) + row],
            "length": len(data),
            "sha256": manifest.sha256,
            "manifest_start": starts[row],
            "manifest_length": len(manifests[row]),
            "manifest_sha256": hashlib.sha256(manifests[row]).hexdigest(),
        }
        for row, (manifest, data) in enumerate(made)
    ]
    directory = json.dumps({"version": 1, "shards": rows}, separators=(",", ":")).encode()
    folder = digest_json([messages[0].hand_digest, messages[0].object_digest])
    key = f"packs/{folder}/{digest_bytes(directory)}.pack"
    store.put(key, b"".join([struct.pack("<8sQ", b"graspd\x00\x01", len(directory)), directory, *pieces]))
    if dead:
        gone = json.dumps({"version": 1, "shards": [message.output for message in dead]})
        store.put(f"{key.removesuffix('.pack')}.dead/{'d' * 32}.json", gone.encode())
    return key

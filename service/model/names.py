"""Names of things in the object store: every key graspd writes is made here (table in ARCHITECTURE.md)."""

from __future__ import annotations

import hashlib
import logging
from functools import lru_cache
from typing import Final

from graspd.service.model.errors import InputError
from graspd.service.model.states import AssetKind, Stage

ASSETS: Final = "assets"
JOBS: Final = "jobs"
TASKS: Final = "tasks"
SHARDS: Final = "shards"
DATASETS: Final = "datasets"
OBJECT_SETS: Final = "object_sets"
DELETIONS: Final = "deletions"
RELEASED: Final = "released"
REMOVED: Final = "removed"
WEBHOOKS: Final = "webhooks"
TAGS: Final = "tags"
SERVICE: Final = "service"
MARKS: Final = "marks"

#: Folder under `shards/` and HDF5 kind of what each stage makes.
SHARD_KINDS: Final[dict[Stage, str]] = {Stage.SYNTHESIZE: "base", Stage.SCENE: "scene", Stage.RENDER: "views"}


def asset_files(kind: AssetKind, digest: str) -> str:
    """ZIP of all files of a hand or object."""
    return f"{ASSETS}/{kind.value}/{digest}/files.zip"


def asset_record(kind: AssetKind, digest: str) -> str:
    """`Asset` as JSON, put after the files."""
    return f"{ASSETS}/{kind.value}/{digest}/asset.json"


def asset_check(kind: AssetKind, digest: str) -> str:
    """What ingest found."""
    return f"{ASSETS}/{kind.value}/{digest}/check.json"


def hand_expanded(digest: str) -> str:
    """The URDF that a hand's xacro file expanded to when it was first read."""
    return f"{ASSETS}/{AssetKind.HAND.value}/{digest}/expanded.json"


def asset_model(kind: AssetKind, digest: str) -> str:
    """The prepared hand or object as binary glTF, for viewers."""
    return f"{ASSETS}/{kind.value}/{digest}/model.glb"


def object_prepared(digest: str, key: str) -> str:
    """An object repaired and simplified; `key` is a digest of how."""
    return f"{ASSETS}/{AssetKind.OBJECT.value}/{digest}/prepared/{key}.npz"


def object_pieces(digest: str, key: str) -> str:
    """Convex pieces of an object as the validator knows it; `key` is a digest of how they were made."""
    return f"{ASSETS}/{AssetKind.OBJECT.value}/{digest}/pieces/{key}.npz"


def job_record(job: str) -> str:
    """The request with the digests of hand and object."""
    return f"{JOBS}/{job}/job.json"


def job_events(job: str) -> str:
    """Prefix of what a user did to the job later."""
    return f"{JOBS}/{job}/events"


def job_event(job: str, number: int, what: str) -> str:
    """One of `job_events`; numbers start at 1."""
    return f"{job_events(job)}/{number:06}-{what}.json"


def attempts(task: str) -> str:
    """Prefix of a task's failed attempts."""
    return f"{TASKS}/{task}/attempts"


def attempt(task: str, number: int) -> str:
    """A failed attempt; numbers start at 1."""
    return f"{attempts(task)}/{number}.json"


def shard_file(stage: Stage, shard: str) -> str:
    """HDF5 bytes of a shard."""
    return f"{SHARDS}/{SHARD_KINDS[stage]}/{shard}.h5"


def shard_manifest(stage: Stage, shard: str) -> str:
    """Manifest of a shard: the shard exists for its readers once this does."""
    return f"{SHARDS}/{SHARD_KINDS[stage]}/{shard}.json"


def dataset_record(dataset: str) -> str:
    """Hands, objects and options of a dataset with the jobs that follow from them."""
    return f"{DATASETS}/{dataset}/dataset.json"


def dataset_events(dataset: str) -> str:
    """Prefix of what a user did to the dataset later."""
    return f"{DATASETS}/{dataset}/events"


def dataset_event(dataset: str, number: int, what: str) -> str:
    """One of `dataset_events`; numbers start at 1."""
    return f"{dataset_events(dataset)}/{number:06}-{what}.json"


def dataset_snapshots(dataset: str) -> str:
    """Prefix of a dataset's snapshots."""
    return f"{DATASETS}/{dataset}/snapshots"


def dataset_snapshot(dataset: str, digest: str) -> str:
    """An immutable list of shards."""
    return f"{dataset_snapshots(dataset)}/{digest}.json"


def object_set(name: str, digest: str) -> str:
    """One version of a named set of objects."""
    return f"{OBJECT_SETS}/{name}/{digest}.json"


def webhook(webhook: str) -> str:
    """An address that is told of ends; removed when its owner takes it away."""
    return f"{WEBHOOKS}/{webhook}.json"


def tag_versions(tag: str) -> str:
    """Prefix of what became of a tag with each change."""
    return f"{TAGS}/{tag}"


def tag_version(tag: str, number: int) -> str:
    """One of `tag_versions`; numbers start at 1, the last one counts, and those before it go."""
    return f"{tag_versions(tag)}/{number:06}.json"


def service(number: int) -> str:
    """Identity of the service that works on the store; numbers start at 1, and the last one counts."""
    return f"{SERVICE}/{number:06}.json"


def mark(mark: str) -> str:
    """What tells whether the index is as old as the store."""
    return f"{MARKS}/{mark}.json"


def deletion(what: str, name: str) -> str:
    """What a user took away, until nothing of it is left: a hand or object by its digest, a job, a dataset."""
    return f"{DELETIONS}/{what}/{name}.json"


MOST: Final = 64
log = logging.getLogger(__name__)


def refuse_long(name: str) -> str:
    """The name; InputError if it is too long for a thing that a user can name otherwise."""
    if len(name) > MOST:
        raise InputError(f"the name {name} has {len(name)} characters, at most {MOST} are taken; give a shorter one")
    return name


@lru_cache(maxsize=4096)
def fitted(name: str, most: int = MOST) -> str:
    """The name; of one that is too long the beginning and a digest, so that no two become one, told once in the log."""
    if len(name) <= most:
        return name
    short = f"{name[: most - 9]}-{hashlib.sha256(name.encode()).hexdigest()[:8]}"
    log.warning("the name %s has more than %d characters; it becomes %s", name, most, short)
    return short

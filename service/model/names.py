"""Keys of all objects that graspd writes to the store; ARCHITECTURE.md has a table."""

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

#: Kind of the shards of each stage: folder below `shards/` and HDF5 kind.
SHARD_KINDS: Final[dict[Stage, str]] = {
    Stage.SYNTHESIZE: "base",
    Stage.SCENE: "scene",
    Stage.RENDER: "views",
    Stage.EPISODE: "episodes",
}
STAGES: Final = {kind: stage for stage, kind in SHARD_KINDS.items()}


def asset_key(kind: AssetKind, digest: str, file: str) -> str:
    """Return the key of a file of an asset, as `asset.json` (its record), `files.zip` or `check.json`."""
    return f"{ASSETS}/{kind.value}/{digest}/{file}"


def job_record_key(job: str) -> str:
    return f"{JOBS}/{job}/job.json"


def job_events_folder(job: str) -> str:
    return f"{JOBS}/{job}/events"


def attempts_folder(task: str) -> str:
    return f"{TASKS}/{task}/attempts"


def attempt_key(task: str, number: int) -> str:
    return f"{attempts_folder(task)}/{number}.json"


def shard_file_key(stage: Stage, shard: str) -> str:
    return f"{SHARDS}/{SHARD_KINDS[stage]}/{shard}.h5"


def shard_manifest_key(stage: Stage, shard: str) -> str:
    return f"{SHARDS}/{SHARD_KINDS[stage]}/{shard}.json"


def dataset_record_key(dataset: str) -> str:
    return f"{DATASETS}/{dataset}/dataset.json"


def dataset_events_folder(dataset: str) -> str:
    return f"{DATASETS}/{dataset}/events"


def dataset_snapshots_folder(dataset: str) -> str:
    return f"{DATASETS}/{dataset}/snapshots"


def dataset_snapshot_key(dataset: str, digest: str) -> str:
    return f"{dataset_snapshots_folder(dataset)}/{digest}.json"


def object_set_key(name: str, digest: str) -> str:
    return f"{OBJECT_SETS}/{name}/{digest}.json"


def webhook_key(webhook: str) -> str:
    return f"{WEBHOOKS}/{webhook}.json"


def tag_versions_folder(tag: str) -> str:
    return f"{TAGS}/{tag}"


def tag_version_key(tag: str, number: int) -> str:
    return f"{tag_versions_folder(tag)}/{number:06}.json"


def mark_key(mark: str) -> str:
    return f"{MARKS}/{mark}.json"


def deletion_key(what: str, name: str) -> str:
    return f"{DELETIONS}/{what}/{name}.json"


MOST: Final = 64
log = logging.getLogger(__name__)


def check_name_length(name: str) -> str:
    """Return a name that a user chose; InputError if it is too long."""
    if len(name) > MOST:
        raise InputError(f"the name {name} has {len(name)} characters, more than {MOST}; give a shorter one")
    return name


@lru_cache(maxsize=4096)
def shorten_name(name: str, most: int = MOST) -> str:
    """Return the name; replace a long name by its beginning and a digest, and log this once."""
    if len(name) <= most:
        return name
    short = f"{name[: most - 9]}-{hashlib.sha256(name.encode()).hexdigest()[:8]}"
    log.warning("the name %s has more than %d characters; it becomes %s", name, most, short)
    return short

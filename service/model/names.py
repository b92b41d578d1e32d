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

#: Formats of keys and folders; each takes ids, names and numbers in the order of its places.
job_record_key: Final = "jobs/{}/job.json".format
job_events_folder: Final = "jobs/{}/events".format
attempts_folder: Final = "tasks/{}/attempts".format
attempt_key: Final = "tasks/{}/attempts/{}.json".format
dataset_record_key: Final = "datasets/{}/dataset.json".format
dataset_events_folder: Final = "datasets/{}/events".format
dataset_snapshots_folder: Final = "datasets/{}/snapshots".format
dataset_snapshot_key: Final = "datasets/{}/snapshots/{}.json".format
object_set_key: Final = "object_sets/{}/{}.json".format
webhook_key: Final = "webhooks/{}.json".format
tag_versions_folder: Final = "tags/{}".format
tag_version_key: Final = "tags/{}/{:06}.json".format
mark_key: Final = "marks/{}.json".format
deletion_key: Final = "deletions/{}/{}.json".format


def asset_key(kind: AssetKind, digest: str, file: str) -> str:
    """Return the key of a file of an asset, as `asset.json` (its record), `files.zip` or `check.json`."""
    return f"{ASSETS}/{kind.value}/{digest}/{file}"


def shard_file_key(stage: Stage, shard: str) -> str:
    return f"{SHARDS}/{SHARD_KINDS[stage]}/{shard}.h5"


def shard_manifest_key(stage: Stage, shard: str) -> str:
    return f"{SHARDS}/{SHARD_KINDS[stage]}/{shard}.json"


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

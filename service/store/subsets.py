"""Some of the grasps of a base shard as a shard of their own, and where it lies in a folder."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import PurePosixPath

import numpy as np
from numpy.typing import NDArray

from service.model.digests import digest_json
from service.store.attributes import Attribute
from service.store.columns import SCHEMAS
from service.store.shards import Shard, write_shard


def carried(shard: Shard) -> dict[str, Attribute]:
    """What a copy of a shard says at its root: all but what `write_shard` says itself."""
    return {name: value for name, value in shard.attributes.items() if name != "schema"}


def part_of_shard(shard: Shard, mask: NDArray[np.bool_]) -> bytes:
    """A base shard of the rows of a mask (N,): what each grasp says, its scene too, is as it was."""
    schema = SCHEMAS["base"]
    arrays = {
        path: array[mask] if schema[path].shape.split()[0] == "N" else array for path, array in shard.arrays.items()
    }
    attributes = carried(shard)
    if "shard_id" in attributes:
        attributes["shard_id"] = digest_json([attributes["shard_id"], np.flatnonzero(mask).tolist()])
    return write_shard("base", arrays, attributes)


def place_of(shard: Shard, taken: Collection[PurePosixPath]) -> PurePosixPath:
    """`HAND/OBJECT/base-BATCH.h5`, or a name beside it: two jobs may have a batch of one number."""
    said = shard.attributes
    names = [str(said.get(name, "")).replace("/", "-").strip(".") or "unnamed" for name in ("hand", "object")]
    path = PurePosixPath(*names) / f"base-{int(said.get('batch', 0)):05}.h5"  # type: ignore[arg-type]
    found, number = path, 1
    while found in taken:
        found, number = path.with_stem(f"{path.stem}-{number}"), number + 1
    return found

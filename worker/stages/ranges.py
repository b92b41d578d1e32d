"""Tasks of several batches: each batch is made as if alone, and a shard concatenates their rows."""

import json
from collections.abc import Sequence
from itertools import accumulate
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from graspd.service.model.domain import BATCH_SIZE
from graspd.service.model.errors import DamagedShard
from graspd.service.model.messages import TaskMessage
from graspd.service.model.names import SHARD_KINDS
from graspd.service.store.columns import SCHEMAS
from graspd.service.store.shards import Shard, json_attribute
from graspd.worker.stages.context import Output

#: Axes along which the rows of batches are concatenated; columns with another axis are common to all.
_ROWS: Final = ("N", "S", "K")
#: Columns that only some batches of a job have, each with the fill value for the other batches.
_OF_SOME: Final = {"quality/recheck": np.int8(-1)}


def sizes_of(message: TaskMessage) -> list[int]:
    """Return the number of grasps of each batch of a task."""
    return [min(BATCH_SIZE, message.count - first) for first in range(0, message.count, BATCH_SIZE)]


def split_into_batches(message: TaskMessage) -> list[TaskMessage]:
    """Split a task into tasks of one batch each."""
    return [
        message.model_copy(update={"batch": message.batch + number, "count": size})
        for number, size in enumerate(sizes_of(message))
    ]


def join_outputs(message: TaskMessage, made: Sequence[Output], *, base_rows: Sequence[range] = ()) -> Output:
    """Join the outputs of batches; their columns are equal except for rechecks. One output is unchanged.
    Columns that refer to rows of the base shard follow `base_rows`, the rows of each batch in it."""
    if len(made) == 1:
        return made[0]
    kind = SHARD_KINDS[message.stage]
    schema, parts = SCHEMAS[kind], [output.arrays for output in made]  # type: ignore[index]
    firsts = {"grasp/base_index": [rows.start for rows in base_rows]}
    if "scene/object_pose" in parts[0]:
        firsts["grasp/scene_index"] = _start_offsets([len(part["scene/object_pose"]) for part in parts])
    columns: dict[str, NDArray[Any]] = {}
    for path in dict.fromkeys(path for part in parts for path in part):
        if schema[path].shape.split()[0] not in _ROWS:
            columns[path] = parts[0][path]
            continue
        rows: list[NDArray[Any]] = [
            part[path] if path in part else np.full(len(part["grasp/hand_pose"]), _OF_SOME[path]) for part in parts
        ]
        if first := firsts.get(path):
            rows = [numbers + start for numbers, start in zip(rows, first, strict=True)]
        columns[path] = np.concatenate(rows)
    attributes = {**made[0].attributes}
    if kind == "base":
        attributes["batch_rows"] = json_attribute([len(part["grasp/hand_pose"]) for part in parts])
    records = [output.info for output in made]
    found = dict(records[0])
    planned = [record.get("planned", 0) for record in records]
    for name, value in records[0].items():
        values = [record[name] for record in records if name in record]
        if name == "planned" or name.endswith("_seconds"):
            found[name] = round(sum(values), 4)
        elif name.endswith("_share"):
            found[name] = round(float(np.average(values, weights=np.maximum(planned, 1e-9))), 4)
        elif isinstance(value, dict) and all(isinstance(count, int) for count in value.values()):
            keys = dict.fromkeys(key for counts in values for key in counts)
            found[name] = {key: sum(counts.get(key, 0) for counts in values) for key in keys}
    return Output(columns, attributes, found)


def base_rows(base: Shard, message: TaskMessage) -> list[range]:
    """Return each batch's rows in a task's base shard. Raises DamagedShard: the shard has other batches."""
    stored = base.attributes.get("batch_rows")
    counts = [len(base.arrays["grasp/hand_pose"])] if stored is None else json.loads(str(stored))
    if len(counts) != len(sizes_of(message)):
        raise DamagedShard(f"shard {message.inputs[0]} has {len(counts)} batches, not {len(sizes_of(message))}")
    return [range(start, start + count) for start, count in zip(_start_offsets(counts), counts, strict=True)]


def _start_offsets(counts: Sequence[int]) -> list[int]:
    return list(accumulate(counts, initial=0))[:-1]

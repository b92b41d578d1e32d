"""A task of several batches: each is made as if by itself, and their rows go into one shard, one after the other."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
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

#: Axes whose rows are those of one batch after the other; what has another axis is common to all.
_ROWS: Final = ("N", "S", "K")
#: Columns that only some batches of a job have, with what stands in the rows of the others.
_OF_SOME: Final = {"quality/recheck": np.int8(-1)}


def sizes_of(message: TaskMessage) -> list[int]:
    """Grasps wanted of each batch of a task."""
    return [min(BATCH_SIZE, message.count - first) for first in range(0, message.count, BATCH_SIZE)]


def batches_of(message: TaskMessage) -> list[TaskMessage]:
    """The batches of a task, as tasks of one batch each."""
    return [
        message.model_copy(update={"batch": message.batch + number, "count": size})
        for number, size in enumerate(sizes_of(message))
    ]


def joined(message: TaskMessage, made: Sequence[Output], *, base_rows: Sequence[range] = ()) -> Output:
    """What was made of each batch as one shard; of a single batch what was made of it.

    Args:
        message: the task.
        made: of each of its batches, with the same columns but for rechecks.
        base_rows: rows of each batch in the base shard, where columns number these.
    """
    if len(made) == 1:
        return made[0]
    kind = SHARD_KINDS[message.stage]
    schema, parts = SCHEMAS[kind], [output.arrays for output in made]  # type: ignore[index]
    firsts = {"grasp/base_index": [rows.start for rows in base_rows]}
    if "scene/object_pose" in parts[0]:
        firsts["grasp/scene_index"] = _starts([len(part["scene/object_pose"]) for part in parts])
    columns: dict[str, NDArray[Any]] = {}
    for path in dict.fromkeys(path for part in parts for path in part):
        if schema[path].shape.split()[0] not in _ROWS:
            columns[path] = parts[0][path]
            continue
        rows: list[NDArray[Any]] = [part[path] if path in part else _without(path, part) for part in parts]
        if first := firsts.get(path):
            rows = [numbers + start for numbers, start in zip(rows, first, strict=True)]
        columns[path] = np.concatenate(rows)
    said = {**made[0].attributes}
    if kind == "base":
        said["batch_rows"] = json_attribute([len(part["grasp/hand_pose"]) for part in parts])
    return Output(columns, said, _summed([output.info for output in made]))


def base_rows(base: Shard, message: TaskMessage) -> list[range]:
    """Rows of each batch of a task in its base shard.

    Raises:
        DamagedShard: it has other batches.
    """
    said = base.attributes.get("batch_rows")
    counts = [len(base.arrays["grasp/hand_pose"])] if said is None else json.loads(str(said))
    if len(counts) != len(sizes_of(message)):
        raise DamagedShard(f"shard {message.inputs[0]} has {len(counts)} batches, not {len(sizes_of(message))}")
    return [range(start, start + count) for start, count in zip(_starts(counts), counts, strict=True)]


def _without(path: str, part: Mapping[str, NDArray[Any]]) -> NDArray[Any]:
    return np.full(len(part["grasp/hand_pose"]), _OF_SOME[path])


def _summed(told: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Remarks on several batches as one: counts and seconds are sums, shares are means over what was planned, and of
    the planner's own remarks those on the first batch stay."""
    found = dict(told[0])
    planned = [one.get("planned", 0) for one in told]
    for name, value in told[0].items():
        values = [one[name] for one in told if name in one]
        if name == "planned" or name.endswith("_seconds"):
            found[name] = round(sum(values), 4)
        elif name.endswith("_share"):
            found[name] = round(float(np.average(values, weights=np.maximum(planned, 1e-9))), 4)
        elif isinstance(value, dict) and all(isinstance(count, int) for count in value.values()):
            found[name] = {key: sum(one.get(key, 0) for one in values) for key in {k: 0 for one in values for k in one}}
    return found


def _starts(counts: Sequence[int]) -> list[int]:
    return list(accumulate(counts, initial=0))[:-1]

"""What two datasets do not have in common: cells, shards, grasps, and how they were made."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np
from pydantic_core import from_json

from service.readers import Shards
from service.store import validity
from service.store.shards import Shard
from worker.files.subsets import base_shards

Row = dict[str, Any]
#: Root attributes of base shards that are compared.
_SETTINGS: Final = (
    "method",
    "fidelity",
    "seed",
    "want",
    "mu",
    "verdict_level",
    "verdict_key",
    "scene",
    "code_version",
    "hand_digest",
    "object_digest",
)
#: Grasps that agree in pose and joints to so many digits (metres, radians) are one.
_DIGITS: Final = 6


@dataclass
class _Side:
    """One of the two."""

    grasps: dict[tuple[str, str], Counter[bytes]] = field(default_factory=dict)
    valid: Counter[tuple[str, str]] = field(default_factory=Counter)
    settings: dict[str, set[str]] = field(default_factory=dict)

    @classmethod
    def of(cls, shards: Shards) -> _Side:
        side = cls()
        for together in base_shards(shards):
            for shard in together:
                side._add(shard)
        return side

    def _add(self, shard: Shard) -> None:
        said = shard.attributes
        pair = (str(said.get("hand", "")), str(said.get("object", "")))
        rows = np.hstack([shard["grasp/hand_pose"], shard["grasp/joint_positions"]]).astype(float)
        rounded = np.round(rows, _DIGITS) + 0.0  # no minus zero
        self.grasps.setdefault(pair, Counter()).update(row.tobytes() for row in rounded)
        self.valid[pair] += int(validity.valid(shard.arrays).sum())
        for name in _SETTINGS:
            if (value := said.get(name)) not in (None, ""):
                self.settings.setdefault(name, set()).add(_short(name, value))


def _short(name: str, value: object) -> str:
    if name == "fidelity":
        try:
            return str(from_json(str(value))["name"])
        except (ValueError, KeyError, TypeError):
            return str(value)
    return str(value)


def difference(first: Shards, second: Shards) -> Row:
    """What differs, as JSON values.

    Keys: shards {first, second, common}; cells[] {hand, object, first, second: grasps, valid_first, valid_second,
    common: grasps that both have}, of those that differ; same_cells, how many do not; settings {name: {first, second}}
    of those that differ.
    """
    a, b = _Side.of(first), _Side.of(second)
    ids = [{file.id for file in shards} for shards in (first, second)]
    rows = []
    same = 0
    for pair in sorted({*a.grasps, *b.grasps}):
        mine, theirs = a.grasps.get(pair, Counter()), b.grasps.get(pair, Counter())
        if mine == theirs and a.valid[pair] == b.valid[pair]:
            same += 1
            continue
        rows.append(
            {
                "hand": pair[0],
                "object": pair[1],
                "first": mine.total(),
                "second": theirs.total(),
                "valid_first": a.valid[pair],
                "valid_second": b.valid[pair],
                "common": (mine & theirs).total(),
            }
        )
    settings = {
        name: {"first": sorted(a.settings.get(name, ())), "second": sorted(b.settings.get(name, ()))}
        for name in _SETTINGS
        if a.settings.get(name) != b.settings.get(name)
    }
    return {
        "shards": {"first": len(first), "second": len(second), "common": len(ids[0] & ids[1])},
        "same_cells": same,
        "cells": rows,
        "settings": settings,
    }

"""Which grasps of a base shard a command takes: valid ones, unless somebody says otherwise."""

from __future__ import annotations

from typing import Annotated

import numpy as np
import typer
from numpy.typing import NDArray

from service.model.errors import InputError
from service.store import validity
from service.store.shards import Shard

UnjudgedOption = Annotated[
    bool, typer.Option("--unjudged", help="Instead of valid grasps those that are sound and that nobody judged.")
]
EveryOption = Annotated[bool, typer.Option("--all", help="All grasps, also those that failed.")]


def choose(base: Shard, *, unjudged: bool = False, every: bool = False) -> tuple[NDArray[np.bool_], str]:
    """(N,) the grasps that are taken, and what they are called.

    Raises:
        InputError: both wishes at once, or there is no such grasp; tells what there is.
    """
    if unjudged and every:
        raise InputError("--unjudged and --all exclude each other")
    count = len(base["quality/valid"])
    if every:
        mask, word = np.ones(count, bool), "grasps of any kind"
    else:
        mask = validity.chosen(base.arrays, unjudged=unjudged)
        word = "sound grasps that nobody judged" if unjudged else "valid grasps"
    if not mask.any():
        raise InputError(f"{base.path or 'the shard'} holds no {word}; {_there_are(base, count)}")
    return mask, word


def _there_are(base: Shard, count: int) -> str:
    waiting = int(validity.chosen(base.arrays, unjudged=True).sum())
    valid = int(validity.valid(base.arrays).sum())
    if waiting:
        return f"{waiting} of its {count} are sound and were judged by nobody: take them with --unjudged"
    if valid:
        return f"{valid} of its {count} are valid: leave out --unjudged"
    return f"all {count} failed: take them with --all" if count else "it has no grasp at all"

"""Which grasps a command takes of a file, and what it says where there are none of that kind."""

from __future__ import annotations

import numpy as np
import pytest

from graspd.service.model.errors import InputError
from graspd.service.store.shards import Shard
from graspd.worker.files.subsets import choose


def shard(valid: list[int], feasible: list[int], success: list[int] | None) -> Shard:
    arrays = {"quality/valid": np.array(valid, np.uint8), "quality/feasible": np.array(feasible, np.uint8)}
    return Shard("base", {}, arrays | ({} if success is None else {"quality/success": np.array(success, np.int8)}))


VALIDATED = shard([1, 0, 0], [1, 1, 0], [1, 0, 1])
UNVALIDATED = shard([0, 0], [1, 0], None)


def test_valid_grasps_are_taken_unless_others_are_asked_for() -> None:
    assert choose(VALIDATED)[0].tolist() == [True, False, False]
    assert choose(VALIDATED, every=True)[0].all()
    assert choose(UNVALIDATED, unvalidated=True)[0].tolist() == [True, False]


def test_the_kinds_have_their_own_words() -> None:
    words = [choose(VALIDATED)[1], choose(UNVALIDATED, unvalidated=True)[1], choose(VALIDATED, every=True)[1]]
    assert words == ["valid grasps", "feasible grasps that are not validated", "grasps of any kind"]


@pytest.mark.parametrize(
    "base, wish, fix",
    [
        (UNVALIDATED, {}, "take them with --unvalidated"),
        (VALIDATED, {"unvalidated": True}, "leave out --unvalidated"),
        (shard([0], [1], [0]), {}, "take them with --all"),
        (shard([], [], []), {"every": True}, "no grasp at all"),
        (VALIDATED, {"unvalidated": True, "every": True}, "exclude each other"),
    ],
)
def test_none_of_that_kind_is_told_with_the_mend(base: Shard, wish: dict[str, bool], fix: str) -> None:
    with pytest.raises(InputError, match=fix):
        choose(base, **wish)

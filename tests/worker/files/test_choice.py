"""Which grasps a command takes of a file, and what it says where there are none of that kind."""

from __future__ import annotations

import numpy as np
import pytest

from graspd.service.model.errors import InputError
from graspd.service.store.shards import Shard
from graspd.worker.files.subsets import choose


def shard(valid: list[int], sound: list[int], success: list[int] | None) -> Shard:
    arrays = {"quality/valid": np.array(valid, np.uint8), "quality/sound": np.array(sound, np.uint8)}
    return Shard("base", {}, arrays | ({} if success is None else {"quality/success": np.array(success, np.int8)}))


JUDGED = shard([1, 0, 0], [1, 1, 0], [1, 0, 1])
UNJUDGED = shard([0, 0], [1, 0], None)


def test_valid_grasps_are_taken_unless_others_are_asked_for() -> None:
    assert choose(JUDGED)[0].tolist() == [True, False, False]
    assert choose(JUDGED, every=True)[0].all()
    assert choose(UNJUDGED, unjudged=True)[0].tolist() == [True, False]


def test_the_kinds_have_their_own_words() -> None:
    words = [choose(JUDGED)[1], choose(UNJUDGED, unjudged=True)[1], choose(JUDGED, every=True)[1]]
    assert words == ["valid grasps", "sound grasps that nobody judged", "grasps of any kind"]


@pytest.mark.parametrize(
    "base, wish, mend",
    [
        (UNJUDGED, {}, "take them with --unjudged"),
        (JUDGED, {"unjudged": True}, "leave out --unjudged"),
        (shard([0], [1], [0]), {}, "take them with --all"),
        (shard([], [], []), {"every": True}, "no grasp at all"),
        (JUDGED, {"unjudged": True, "every": True}, "exclude each other"),
    ],
)
def test_none_of_that_kind_is_told_with_the_mend(base: Shard, wish: dict[str, bool], mend: str) -> None:
    with pytest.raises(InputError, match=mend):
        choose(base, **wish)

"""Reading ahead: the same samples in the same order, no more of them held than allowed, errors in their turn."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from graspd.service.model.errors import InputError
from graspd.service.readers import Pictures, open_shards, prefetched
from tests.service.readers import box_scenes


class Counted(Sequence[dict[str, Any]]):
    """Numbers as samples; number `bad` cannot be read."""

    def __init__(self, bad: int = -1) -> None:
        self.bad, self.asked, self._lock = bad, 0, threading.Lock()

    def __len__(self) -> int:
        return 30

    def __getitem__(self, index: Any) -> Any:
        with self._lock:
            self.asked += 1
        if index == self.bad:
            raise InputError("no such number")
        return {"number": index}


def test_samples_come_in_order_and_none_is_left_out() -> None:
    assert [sample["number"] for sample in prefetched(Counted(), workers=3, ahead=4)] == list(range(30))
    order = [7, 3, 3, 29]
    assert [sample["number"] for sample in prefetched(Counted(), order, workers=2, ahead=50)] == order


def test_no_more_are_read_than_may_be_held() -> None:
    source = Counted()
    found = prefetched(source, workers=2, ahead=5)
    for _ in range(3):
        next(found)
    assert source.asked <= 3 + 5
    found.close()
    assert not [thread for thread in threading.enumerate() if thread.name.startswith("prefetch")]


def test_an_error_comes_when_it_is_its_turn() -> None:
    found = prefetched(Counted(bad=4), workers=2, ahead=10)
    assert [next(found)["number"] for _ in range(4)] == [0, 1, 2, 3]
    with pytest.raises(InputError, match="no such number"):
        next(found)


@pytest.mark.parametrize("options", [{"workers": 0}, {"ahead": 0}])
def test_numbers_below_one_are_refused_at_once(options: dict[str, int]) -> None:
    with pytest.raises(InputError, match="at least one"):
        prefetched(Counted(), **options)


def test_pictures_and_clouds_are_the_same_ahead(tmp_path: Path) -> None:
    pictures = Pictures(open_shards(box_scenes.write(tmp_path / "box")))
    for source in (pictures, pictures.clouds(64, noise="tof")):
        for index, sample in enumerate(prefetched(source, workers=3)):
            for name, value in source[index].items():
                np.testing.assert_array_equal(sample[name], value)

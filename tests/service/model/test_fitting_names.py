"""A name that is too long is refused, or cut so that nothing is lost without a word."""

from __future__ import annotations

import pytest

from graspd.api.uploads import name_of_upload
from graspd.exchange.plan import plain_name
from graspd.service.model.errors import InputError
from graspd.service.model.names import fitted

LONG = "mujoco-Office_Depot_Canon_CL211XL_Remanufactured_Ink_Cartridge_TriColor"


def test_the_file_of_a_thing_with_a_long_name_is_refused() -> None:
    with pytest.raises(InputError, match=f"the name {LONG} has 71 characters, at most 64 are taken; give a shorter"):
        name_of_upload(f"{LONG}.stl")


def test_a_long_name_of_others_is_cut_told_and_stays_one_of_its_own(caplog: pytest.LogCaptureFixture) -> None:
    fitted.cache_clear()
    first, second = plain_name(LONG), plain_name(f"{LONG}2")
    assert first != second and len(first) == len(second) == 64
    assert plain_name(LONG) == first
    assert [record.getMessage() for record in caplog.records] == [
        f"the name {name} has more than 64 characters; it becomes {short}"
        for name, short in ((LONG, first), (f"{LONG}2", second))
    ]


def test_a_short_name_stays_as_it_is() -> None:
    assert plain_name("sem-Bottle a86d") == "sem-Bottle-a86d" and name_of_upload("mug.stl") == "mug"

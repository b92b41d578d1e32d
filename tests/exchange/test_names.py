"""Names that go into formats are names that the formats' own libraries take."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from graspd.exchange.plan import prim_name, prim_names

Sdf = pytest.importorskip("pxr.Sdf")


@given(st.text(max_size=30))
def test_any_name_becomes_one_that_usd_takes_for_a_prim(name: str) -> None:
    assert Sdf.Path.IsValidIdentifier(prim_name(name))


@pytest.mark.parametrize(
    ("name", "prim"),
    [("003_cracker_box", "_003_cracker_box"), ("mug.v2.final", "mug_v2_final"), ("tasse-caf-1", "tasse_caf_1")],
)
def test_a_prim_keeps_what_it_can_of_the_name(name: str, prim: str) -> None:
    assert prim_name(name) == prim


def test_siblings_whose_names_become_the_same_are_told_apart() -> None:
    assert prim_names(["a-b", "a_b", "a.b", "a_b_2"]) == ["a_b", "a_b_2", "a_b_3", "a_b_2_2"]

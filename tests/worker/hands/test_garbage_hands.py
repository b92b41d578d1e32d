"""Whatever bytes come, the hand reader answers with a hand or one of graspd's own errors, soon."""

from __future__ import annotations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from graspd.service.model.errors import InputError
from graspd.service.model.states import AssetKind
from graspd.service.store.assets import builtin_files
from graspd.worker.hands.load import load_hand

SOURCE = builtin_files(AssetKind.HAND, "barrett")
WORDS = [
    b"nan",
    b"-1e308",
    b"inf",
    b"0",
    b"",
    b"<",
    b'"',
    b"&x;",
    b"../../",
    b"palm",
    b"finger_1_medial",
    b"\xff\xfe",
    b"1e-320",
]


@st.composite
def mutated(draw: st.DrawFn, source: bytes) -> bytes:
    """A file with a few spans replaced, dropped or repeated."""
    data = source
    for _ in range(draw(st.integers(1, 4))):
        start = draw(st.integers(0, len(data)))
        end = min(len(data), start + draw(st.integers(0, 60)))
        data = data[:start] + draw(st.sampled_from(WORDS) | st.binary(max_size=12)) + data[end:]
    return data


def answers(urdf: bytes, asset: bytes) -> None:
    try:
        hand = load_hand({"barrett.urdf": urdf, "asset.json": asset}, name="h", digest="0" * 32)
    except InputError as error:
        assert "\n" not in str(error)
        return
    assert hand.dofs >= 1


@settings(max_examples=120)
@given(mutated(SOURCE["barrett.urdf"]))
def test_a_damaged_urdf_loads_or_is_refused(urdf: bytes) -> None:
    answers(urdf, SOURCE["asset.json"])


@settings(max_examples=120)
@given(mutated(SOURCE["asset.json"]))
def test_a_damaged_asset_json_loads_or_is_refused(asset: bytes) -> None:
    answers(SOURCE["barrett.urdf"], asset)


@pytest.mark.slow
@settings(derandomize=False, max_examples=10_000)
@given(mutated(SOURCE["barrett.urdf"]), mutated(SOURCE["asset.json"]) | st.just(SOURCE["asset.json"]))
def test_ten_thousand_damaged_hands_load_or_are_refused(urdf: bytes, asset: bytes) -> None:
    answers(urdf, asset)

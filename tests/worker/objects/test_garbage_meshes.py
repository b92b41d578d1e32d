"""Whatever bytes come, the mesh readers answer with a mesh or one of graspd's own errors, soon."""

from __future__ import annotations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from graspd.worker.objects.check import check_object
from tests.worker.objects.test_formats import FILES

WORDS = [
    b"nan",
    b"1e999",
    b"-1",
    b"0",
    b"999999999",
    b"\n",
    b"f 1 2 3\n",
    b"\xff\xff\xff\xff",
    b"\x7f\x7f\x80\x00",
    b"{",
    b"[",
]


@st.composite
def mutated(draw: st.DrawFn) -> tuple[str, bytes]:
    """A file of any format with a few spans replaced, dropped or repeated."""
    name = draw(st.sampled_from(sorted(FILES)))
    data = FILES[name]
    for _ in range(draw(st.integers(1, 5))):
        start = draw(st.integers(0, len(data)))
        end = min(len(data), start + draw(st.integers(0, 40)))
        data = data[:start] + draw(st.sampled_from(WORDS) | st.binary(max_size=16)) + data[end:]
    return name, data


def answers(name: str, data: bytes, allow_open: bool) -> None:
    report = check_object({name: data}, "m", allow_open=allow_open)
    assert report["verdict"] in ("accept", "repair", "refuse")
    assert report["message"] and "\n" not in report["message"]
    if report["verdict"] != "refuse":
        assert report["facts"]["volume_m3"] > 0


@settings(max_examples=250)
@given(mutated(), st.booleans())
def test_a_damaged_mesh_loads_or_is_refused(file: tuple[str, bytes], allow_open: bool) -> None:
    answers(*file, allow_open)


@settings(max_examples=100)
@given(st.sampled_from(["m.stl", "m.obj", "m.ply", "m.off", "m.glb"]), st.binary(max_size=400))
def test_noise_is_refused(name: str, data: bytes) -> None:
    assert check_object({name: data}, "m")["verdict"] == "refuse"


@pytest.mark.slow
@settings(derandomize=False, max_examples=10_000)
@given(mutated(), st.booleans())
def test_ten_thousand_damaged_meshes_load_or_are_refused(file: tuple[str, bytes], allow_open: bool) -> None:
    answers(*file, allow_open)

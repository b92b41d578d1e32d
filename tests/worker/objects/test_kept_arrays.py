"""Arrays that are kept on the machine: read bit for bit, made anew when anything they follow from changes."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from graspd.service import user_cache
from graspd.worker.hands import surface
from graspd.worker.hands.load import hand_from_path
from graspd.worker.objects import disk_cache
from graspd.worker.objects.disk_cache import arrays_kept_or_made, recalled, recalling
from graspd.worker.objects.prepare import load_object
from graspd.worker.simulation import sampling
from tests.worker.models import two_finger_hand
from tests.worker.objects.shapes import sphere, stl


@pytest.fixture(autouse=True)
def own_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    return tmp_path / "graspd"


def made(number: float) -> dict[str, np.ndarray]:
    return {"a": np.full((2, 3), number), "b": np.arange(4)}


def never() -> dict[str, np.ndarray]:
    raise AssertionError("it is there already")


def test_what_was_made_is_read_bit_for_bit(own_cache: Path) -> None:
    first = arrays_kept_or_made("things", ("x", 1), (disk_cache,), lambda: made(1 / 3))
    again = arrays_kept_or_made("things", ("x", 1), (disk_cache,), never)
    assert all(np.array_equal(first[name], again[name]) and first[name].dtype == again[name].dtype for name in first)
    assert [file.suffix for file in (own_cache / "things").iterdir()] == [".npz"]


def test_other_terms_or_other_code_are_another_entry() -> None:
    arrays_kept_or_made("things", ("x", 1), (disk_cache,), lambda: made(1))
    assert arrays_kept_or_made("things", ("x", 2), (disk_cache,), lambda: made(2))["a"][0, 0] == 2
    assert arrays_kept_or_made("things", ("x", 1), (surface,), lambda: made(3))["a"][0, 0] == 3


def test_a_damaged_entry_is_made_again(own_cache: Path) -> None:
    arrays_kept_or_made("things", ("x",), (disk_cache,), lambda: made(1))
    (file,) = (own_cache / "things").iterdir()
    user_cache.keep(file, b"no arrays")
    assert arrays_kept_or_made("things", ("x",), (disk_cache,), lambda: made(2))["a"][0, 0] == 2


def test_samples_of_hand_and_object_are_those_of_a_process_without_a_cache() -> None:
    hand = two_finger_hand()
    ball = load_object(stl(sphere(segments=24)), name="ball", digest="", face_error_m=0.0)
    for _ in range(2):
        surface._samples.clear()
        found, fresh = surface.sample_surface(hand, 120, seed=2), surface._sample(hand, 120, 2)
        assert all(np.array_equal(getattr(found, name), array) for name, array in vars(fresh).items())
        assert np.array_equal(sampling.object_samples(ball, 90, seed=1), sampling._sampled(ball, 90, 1))


def test_small_steps_are_kept_together_and_each_follows_from_what_it_was_given(own_cache: Path) -> None:
    def halves(array: np.ndarray) -> np.ndarray:
        return recalled("half", [array], lambda: [array / 2])["0"]

    for _ in range(2):
        with recalling("steps", ("one thing",), (disk_cache,)):
            assert halves(np.arange(3.0)).tolist() == [0, 0.5, 1]
            assert halves(np.arange(2.0)).tolist() == [0, 0.5]
    assert len(list((own_cache / "steps").iterdir())) == 1
    with recalling("steps", ("one thing",), (disk_cache,)):
        step = recalled("half", [np.arange(3.0)], lambda: list(never().values()))["0"]
        step += 1
        assert halves(np.arange(3.0)).tolist() == [0, 0.5, 1], "nobody writes into what is kept"
        assert halves(np.arange(3)).dtype == float, "another type is another step"
    assert halves(np.arange(2.0)).tolist() == [0, 0.5]


def test_a_hand_is_the_same_from_kept_shapes_and_needs_no_scipy(tmp_path: Path) -> None:
    first, again = hand_from_path("barrett"), hand_from_path("barrett")
    assert first.content == again.content
    code = (
        "import sys; from graspd.worker.hands.load import hand_from_path; import graspd.worker.generation; "
        "print(hand_from_path('barrett').content, *{'scipy', 'trimesh', 'pydantic_settings'} & set(sys.modules))"
    )
    told = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert told.split() == [first.content]

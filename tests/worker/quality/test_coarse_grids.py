"""The grid that tells which points are beyond reach is kept on the machine, and distances are the same with it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from graspd.worker.objects import disk_cache
from graspd.worker.quality import probe
from graspd.worker.quality.probe import Probe
from tests.worker.models import two_finger_hand
from tests.worker.simulation.rigs import ball

HAND, BALL = two_finger_hand(), ball(subdivisions=2)


@pytest.fixture(autouse=True)
def own_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    return tmp_path / "graspd" / "coarse_grids"


def distances(found: Probe) -> tuple[np.ndarray, ...]:
    points = np.random.default_rng(0).uniform(-0.05, 0.05, (500, 3))
    return (found.skin.coarse.numpy(), *found.signed_distance(points))


def same(one: tuple[np.ndarray, ...], other: tuple[np.ndarray, ...]) -> bool:
    return all(np.array_equal(a, b) and a.dtype == b.dtype for a, b in zip(one, other, strict=True))


def test_a_later_process_measures_with_what_the_first_one_computed(
    own_cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    first = distances(Probe(HAND, BALL, hand_points=100, object_points=64))
    assert len(list(own_cache.iterdir())) == 1

    def never(self: Any, points: Any, reach: float = 0.0) -> Any:
        raise AssertionError("it is there already")

    with monkeypatch.context() as patched:
        patched.setattr(Probe, "_query", never)
        again = Probe(HAND, BALL, hand_points=200, object_points=64)
    assert same(distances(again), first)


@pytest.mark.parametrize("harm", ["cut", "shape", "kind", "name"])
def test_an_entry_that_is_not_sound_is_made_again(own_cache: Path, harm: str) -> None:
    first = distances(Probe(HAND, BALL, hand_points=100, object_points=64))
    (file,) = own_cache.iterdir()
    whole, grid = file.read_bytes(), first[0]
    harms = {"shape": {"coarse": grid[1:]}, "kind": {"coarse": grid.astype(float)}, "name": {"other": grid}}
    if harm == "cut":
        file.write_bytes(whole[:-1])
    else:
        disk_cache._write(file, harms[harm])
    assert same(distances(Probe(HAND, BALL, hand_points=100, object_points=64)), first)
    assert file.read_bytes() == whole


def test_kernels_of_another_processor_are_another_entry(own_cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    Probe(HAND, BALL, hand_points=100, object_points=64)
    monkeypatch.setattr(probe, "binary_name", lambda module: "that of another processor")
    Probe(HAND, BALL, hand_points=100, object_points=64)
    assert len(list(own_cache.iterdir())) == 2

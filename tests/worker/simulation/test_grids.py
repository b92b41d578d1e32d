"""Distance grids are kept on the machine: what is read is what was computed, and what is not feasible is made anew."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from graspd.worker.objects import disk_cache
from graspd.worker.simulation import grids, kernels
from graspd.worker.simulation.device import DeviceObject
from graspd.worker.simulation.sampling import object_samples
from tests.worker.simulation.rigs import ball

Grid = dict[str, np.ndarray]
BALL = ball(subdivisions=2)


@pytest.fixture(autouse=True)
def own_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    return tmp_path / "graspd" / "object_grids"


@pytest.fixture
def computed(monkeypatch: pytest.MonkeyPatch) -> list[tuple[int, ...]]:
    """The shapes of the grids that were computed, not read."""
    shapes: list[tuple[int, ...]] = []
    sampled = grids._sampled

    def watched(skin: Any, shape: tuple[int, ...]) -> Any:
        shapes.append(shape)
        return sampled(skin, shape)

    monkeypatch.setattr(grids, "_sampled", watched)
    return shapes


def grid(cell: float = 0.005, alpha: float = 0.0) -> Grid:
    """The grid of a ball, as a process that begins has it."""
    kernels.load("cpu")
    skin = DeviceObject.create(BALL, "cpu", samples=object_samples(BALL, 50), phong_alpha=alpha, cell=cell).surface
    cells = skin.cells
    arrays = {"field": skin.field, "first": cells.first, "face": cells.face, "key": cells.key}
    place = {"low": skin.field_origin, "cell": skin.field_cell, "error": skin.field_error}
    return {name: array.numpy() for name, array in arrays.items()} | {k: np.array(v) for k, v in place.items()}


def same(one: Grid, other: Grid) -> bool:
    return all(one[name].dtype == other[name].dtype and np.array_equal(one[name], other[name]) for name in one)


def test_a_later_process_reads_what_the_first_one_computed(computed: list[Any], own_cache: Path) -> None:
    first, second = grid(), grid()
    assert same(first, second) and len(first["face"]) > 0
    assert len(computed) == 1 and len(list(own_cache.iterdir())) == 1


def test_another_cell_faces_or_binary_is_another_grid(computed: list[Any], monkeypatch: pytest.MonkeyPatch) -> None:
    grid()
    coarse = grid(cell=0.01)
    grid(alpha=1.0)
    monkeypatch.setattr(grids, "binary_name", lambda module: "that of another processor")
    grid()
    assert len(computed) == 4 and coarse["field"].size < grid()["field"].size


@pytest.mark.parametrize(
    "harm",
    [
        {"face": lambda a: a + len(BALL.faces)},
        {"face": lambda a: -1 - a},
        {"face": lambda a: a[:-1]},
        {"key": lambda a: a[:-1]},
        {"key": lambda a: a.astype(float)},
        {"first": lambda a: a[::-1].copy()},
        {"first": lambda a: np.zeros(0, np.int32)},
        {"first": lambda a: np.append(a[:-1], 10**6).astype(np.int32)},
        {"field": lambda a: a[1:]},
        {"field": None},
    ],
)
def test_an_entry_that_would_lead_kernels_astray_is_made_again(
    computed: list[Any], own_cache: Path, harm: dict[str, Any]
) -> None:
    first = grid()
    (file,) = own_cache.iterdir()
    arrays = dict(disk_cache._read(file) or {})
    for name, change in harm.items():
        if change is None:
            del arrays[name]
        else:
            arrays[name] = change(arrays[name])
    disk_cache._write(file, arrays)
    assert same(grid(), first) and len(computed) == 2
    assert same(grid(), first) and len(computed) == 2, "the entry is whole again"

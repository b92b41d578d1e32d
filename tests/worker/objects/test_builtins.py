"""The built-in objects: generated, closed, of a size that a hand can hold."""

from __future__ import annotations

import numpy as np
import pytest

from graspd.service.model.states import AssetKind
from graspd.service.store.assets import builtin_files, builtin_names
from graspd.worker.objects.builtin import OBJECTS, files_of
from graspd.worker.objects.check import check_object
from graspd.worker.objects.distance import deviation
from graspd.worker.objects.prepare import load_object, object_from_path
from graspd.worker.objects.topology import is_closed


def test_all_objects_are_there() -> None:
    assert set(builtin_names(AssetKind.OBJECT)) >= set(OBJECTS) == {"mug", "bottle", "block"}


@pytest.mark.parametrize("name", sorted(OBJECTS))
def test_the_committed_mesh_is_the_one_the_generator_makes(name: str) -> None:
    """Not bit for bit: another version of the boolean kernel may order its triangles otherwise."""
    committed = object_from_path(name, 0.0)
    made = load_object(files_of(name), name=name, digest="", face_error_m=0.0)
    assert made.volume == pytest.approx(committed.volume, rel=1e-6)
    apart = deviation((made.vertices, made.faces.astype(int)), (committed.vertices, committed.faces.astype(int)))
    assert apart < 1e-6


@pytest.mark.parametrize("name", sorted(OBJECTS))
def test_a_built_in_object_needs_no_repair(name: str) -> None:
    report = check_object(builtin_files(AssetKind.OBJECT, name), name)
    assert report["verdict"] == "accept" and report["facts"]["mass_kg"] > 0.05


@pytest.mark.parametrize(("name", "holes"), [("mug", 1), ("bottle", 0), ("block", 0)])
def test_topology(name: str, holes: int) -> None:
    """Euler: V - E + F = 2 - 2 g; only the mug's handle makes a hole."""
    model = object_from_path(name, 0.0)
    assert is_closed(model.faces.astype(np.int64))
    assert len(np.unique(model.faces)) - len(model.faces) // 2 == 2 - 2 * holes


def test_the_mug_is_hollow() -> None:
    model = object_from_path("mug", 0.0)
    # Outer cylinder of 40 mm less the inner of 35.5 mm, plus floor and handle.
    assert 95e-6 < model.volume < 0.35 * np.pi * 0.04**2 * 0.095


def test_the_block_has_the_volume_of_a_chamfered_box() -> None:
    x, y, z, c = 0.060, 0.045, 0.090, 0.003
    # Twelve edge prisms of c^2 / 2, and at each corner what three of them and the box leave beyond the hull: each
    # corner loses c^3 in its cube, of which three half prisms overlap; a corner keeps no triangle of its own.
    lengths = 4 * ((x - 2 * c) + (y - 2 * c) + (z - 2 * c))
    corner = c**3 * (1 - 1 / 6)
    assert object_from_path("block", 0.0).volume == pytest.approx(
        x * y * z - lengths * c * c / 2 - 8 * corner, rel=1e-6
    )

"""Prepared objects are kept on the machine: read by every later process, bit for bit, and made anew when in doubt."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from graspd.service import user_cache
from graspd.service.model.errors import MeshError
from graspd.worker.objects import prepare
from graspd.worker.objects.model import ObjectModel
from graspd.worker.objects.prepare import load_object
from tests.worker.objects.shapes import box, join, sphere, stl

#: Two balls in one another: a repair to remember.
BALLS = stl(join(sphere(segments=24), sphere(segments=24, at=(0.02, 0.0, 0.0))))


@pytest.fixture(autouse=True)
def own_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    return tmp_path / "graspd" / "objects"


def load(files: dict[str, bytes] = BALLS, error: float = 3e-4, **options: Any) -> ObjectModel:
    """As a process that begins."""
    prepare._prepared.cache_clear()
    prepare._repaired.cache_clear()
    return load_object(files, name="balls", digest="d", face_error_m=error, options=options)


@pytest.fixture
def made(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """The bounds to which objects were prepared, not read."""
    bounds: list[float] = []

    def build(mesh: Any, error: float) -> ObjectModel:
        bounds.append(error)
        return prepare_build(mesh, error)

    prepare_build = prepare.build
    monkeypatch.setattr(prepare, "build", build)
    return bounds


def same(one: ObjectModel, two: ObjectModel) -> bool:
    return all(np.array_equal(getattr(one, field.name), getattr(two, field.name)) for field in fields(one))


def test_the_second_process_reads_what_the_first_has_made(made: list[float]) -> None:
    first, second = load(), load()
    assert made == [3e-4]
    assert first.repairs and same(first, second) and first.content == second.content


def test_whatever_it_follows_from_makes_another_entry(made: list[float], monkeypatch: pytest.MonkeyPatch) -> None:
    load(stl(box()))
    load(stl(box()), error=1e-3)
    load(stl(box()), scale_to=0.08)
    load(stl(sphere(segments=24)))
    monkeypatch.setattr(prepare, "revision", lambda: "another")
    load(stl(box()))
    assert len(made) == 5


def test_the_revision_follows_the_code_and_the_libraries(monkeypatch: pytest.MonkeyPatch) -> None:
    plain = prepare.revision.__wrapped__()
    monkeypatch.setattr(prepare, "version_of", lambda name: f"0 of {name}")
    libraries = prepare.revision.__wrapped__()
    read = Path.read_bytes
    monkeypatch.setattr(Path, "read_bytes", lambda file: read(file) + b"#" * (file.name == "repair.py"))
    assert len({plain, libraries, prepare.revision.__wrapped__()}) == 3


@pytest.mark.parametrize("harm", ["damaged", "another format"])
def test_an_entry_that_is_none_is_made_again_and_replaced(own_cache: Path, made: list[float], harm: str) -> None:
    fresh = load()
    (entry,) = own_cache.iterdir()
    if harm == "damaged":
        entry.write_bytes(entry.read_bytes()[:-9])
    else:
        user_cache.keep(entry, b"whole, but no object")
    assert same(load(), fresh) and same(load(), fresh)
    assert len(made) == 2


def test_what_was_refused_is_refused_again_and_not_kept(own_cache: Path) -> None:
    open_box = stl((box()[0], box()[1][:-1]))
    for _ in range(2):
        with pytest.raises(MeshError, match="not watertight"):
            load(open_box)
    assert not own_cache.is_dir() or not list(own_cache.iterdir())


def test_a_command_that_comes_later_prepares_nothing(own_cache: Path) -> None:
    script = (
        "import sys; from graspd.worker.objects import prepare\n"
        "prepare.object_from_path('block', 1e-3)\n"
        "prepare.build = None\n"
        "prepare._prepared.cache_clear()\n"
        "print(len(prepare.object_from_path('block', 1e-3).faces))\n"
    )
    shown = [subprocess.run([sys.executable, "-c", script], capture_output=True, check=True).stdout for _ in range(2)]
    assert shown[0] == shown[1] and len(list(own_cache.iterdir())) == 1

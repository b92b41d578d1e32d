"""Arrays that are kept on the machine: read bit for bit, made anew when anything they follow from changes."""

import dataclasses
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest
import trimesh

from graspd.service import user_cache
from graspd.service.model.errors import MeshError
from graspd.service.model.transforms import IDENTITY_POSE
from graspd.worker.hands import surface
from graspd.worker.hands.kinematics import body_poses
from graspd.worker.hands.surface import sample_surface
from graspd.worker.objects import disk_cache, prepare
from graspd.worker.objects.disk_cache import arrays_kept_or_made, content_of
from graspd.worker.objects.model import ObjectModel
from graspd.worker.objects.prepare import load_object
from graspd.worker.quality.probe import probe_of
from graspd.worker.rendering.scene_setup import CameraPlan, Setting
from graspd.worker.scenes.simulate import rest_probability
from graspd.worker.simulation import sampling
from tests.worker.models import object_from_mesh, two_finger_hand
from tests.worker.objects.shapes import box, join, sphere, stl


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


def test_entries_differ_with_terms_and_code_bad_ones_are_remade(own_cache: Path) -> None:
    arrays_kept_or_made("things", ("x", 1), (disk_cache,), lambda: made(1))
    assert arrays_kept_or_made("things", ("x", 2), (disk_cache,), lambda: made(2))["a"][0, 0] == 2
    assert arrays_kept_or_made("things", ("x", 1), (surface,), lambda: made(3))["a"][0, 0] == 3
    for file in (own_cache / "things").iterdir():
        user_cache.keep(file, b"no arrays")
    assert arrays_kept_or_made("things", ("x", 1), (disk_cache,), lambda: made(4))["a"][0, 0] == 4


def test_samples_are_those_of_a_process_without_a_cache() -> None:
    hand = two_finger_hand()
    ball = load_object(stl(sphere(segments=24)), name="ball", digest="", face_error_m=0.0)
    shapes = surface._Shapes(hand.pieces, body_poses(hand, IDENTITY_POSE, hand.expand(hand.preshape))[0])
    for _ in range(2):
        found, fresh = surface._kept.__wrapped__(shapes, 120, 2), surface._sample(shapes, 120, 2)
        assert all(np.array_equal(getattr(found, name), array) for name, array in vars(fresh).items())
        assert np.array_equal(sampling.object_samples(ball, 90, seed=1), sampling._sampled(ball, 90, 1))


#: Two balls in one another: a repair to remember.
BALLS = stl(join(sphere(segments=24), sphere(segments=24, at=(0.02, 0.0, 0.0))))


def load_balls(files: dict[str, bytes] = BALLS, error: float = 3e-4, **options) -> ObjectModel:
    """As a process that begins."""
    prepare._prepared.cache_clear()
    prepare._repaired.cache_clear()
    return load_object(files, name="balls", digest="d", face_error_m=error, options=options)


@pytest.fixture
def built(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """The bounds to which objects were prepared, not read."""
    bounds: list[float] = []
    build = prepare.build
    monkeypatch.setattr(prepare, "build", lambda mesh, error: bounds.append(error) or build(mesh, error))
    return bounds


def same(one: ObjectModel, two: ObjectModel) -> bool:
    return all(np.array_equal(getattr(one, field.name), getattr(two, field.name)) for field in fields(one))


def test_a_second_process_reads_what_the_first_made_not_refusals(built: list[float], own_cache: Path) -> None:
    open_box = stl((box()[0], box()[1][:-1]))
    for _ in range(2):
        with pytest.raises(MeshError, match="not watertight"):
            load_balls(open_box)
    assert not (own_cache / "objects").is_dir() or not list((own_cache / "objects").iterdir())
    built.clear()
    first, second = load_balls(), load_balls()
    assert built == [3e-4]
    assert first.repairs and same(first, second) and first.content == second.content


def test_whatever_it_follows_from_makes_another_entry(built: list[float], monkeypatch: pytest.MonkeyPatch) -> None:
    load_balls(stl(box()))
    load_balls(stl(box()), error=1e-3)
    load_balls(stl(box()), scale_to=0.08)
    load_balls(stl(sphere(segments=24)))
    monkeypatch.setattr(prepare, "revision", lambda: "another")
    load_balls(stl(box()))
    assert len(built) == 5


def test_the_revision_follows_the_code_and_the_libraries(monkeypatch: pytest.MonkeyPatch) -> None:
    plain = prepare.revision.__wrapped__()
    monkeypatch.setattr(prepare, "version_of", lambda name: f"0 of {name}")
    libraries = prepare.revision.__wrapped__()
    read = Path.read_bytes
    monkeypatch.setattr(Path, "read_bytes", lambda file: read(file) + b"#" * (file.name == "repair.py"))
    assert len({plain, libraries, prepare.revision.__wrapped__()}) == 3


@pytest.mark.parametrize("harm", ["damaged", "another format"])
def test_an_entry_that_is_none_is_made_again_and_replaced(own_cache: Path, built: list[float], harm: str) -> None:
    fresh = load_balls()
    (entry,) = (own_cache / "objects").iterdir()
    if harm == "damaged":
        entry.write_bytes(entry.read_bytes()[:-9])
    else:
        user_cache.keep(entry, b"whole, but no object")
    assert same(load_balls(), fresh) and same(load_balls(), fresh)
    assert len(built) == 2


BRICK = object_from_mesh(trimesh.creation.box((0.06, 0.04, 0.05)))
HAND = two_finger_hand()


@pytest.mark.parametrize("model", [BRICK, HAND], ids=["object", "hand"])
def test_whatever_differs_in_a_model_changes_its_content(model) -> None:
    for field in dataclasses.fields(model):
        changed = dataclasses.replace(model, **{field.name: np.array([7])})
        assert (changed.content == model.content) == (field.name in ("name", "digest")), field.name
    assert dataclasses.replace(BRICK, vertices=BRICK.vertices.ravel()).content != BRICK.content
    with pytest.raises(TypeError, match="object"):
        content_of(dataclasses.replace(BRICK, repairs=object()))  # type: ignore[arg-type]


def test_no_cache_gives_one_mesh_of_a_file_for_another() -> None:
    # As many corners and faces, the same digest of the file: only what was prepared differs.
    other = dataclasses.replace(object_from_mesh(trimesh.creation.box((0.02, 0.04, 0.05))), digest=BRICK.digest)
    one, two = (probe_of(HAND, obj, hand_points=64, object_points=64) for obj in (BRICK, other))
    assert not np.array_equal(one.samples, two.samples)
    plan, pose = CameraPlan(1, 16, 16, None), np.array([[[0.0, 0, 0, 1, 0, 0, 0]]])
    first, second = (Setting([obj], pose, plan, seed=0, samples=1) for obj in (BRICK, other))
    assert first._key() != second._key()
    # The fingers stand elsewhere on the same palm: the same pieces bury other points.
    origin = HAND.origin.copy()
    origin[1:, 2] = -0.06
    moved = dataclasses.replace(HAND, origin=origin)
    assert not np.array_equal(sample_surface(HAND, 200).position, sample_surface(moved, 200).position)
    # A tall plate and a cube of one volume and digest, and as many corners.
    boxes = (object_from_mesh(trimesh.creation.box(size)) for size in ((0.05, 0.05, 0.05), (0.1, 0.1, 0.0125)))
    cube, plate = (dataclasses.replace(one, digest=BRICK.digest, volume=BRICK.volume) for one in boxes)
    assert rest_probability(cube, [0]) != rest_probability(plate, [0])
    again = probe_of(two_finger_hand(), dataclasses.replace(BRICK), hand_points=64, object_points=64)
    assert again is one, "an equal model that was loaded again"

"""Arrays kept on the machine and in the store: read bit for bit, made anew when what they follow from changes."""

import dataclasses
import io
import subprocess
import sys
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest
import trimesh

from graspd.service import user_cache
from graspd.service.model import names
from graspd.service.model.digests import digest_files
from graspd.service.model.errors import MeshError
from graspd.service.model.messages import TaskMessage
from graspd.service.model.states import AssetKind, Stage
from graspd.service.model.transforms import IDENTITY_POSE, apply
from graspd.service.store.assets import builtin_files, builtin_model, builtin_names
from graspd.service.store.integrity import add_seal
from graspd.service.store.library import publish_asset
from graspd.service.store.store import Store, open_store
from graspd.worker.hands import surface
from graspd.worker.hands.kinematics import body_poses
from graspd.worker.hands.load import hand_from_path
from graspd.worker.hands.surface import sample_surface
from graspd.worker.objects import disk_cache, prepare
from graspd.worker.objects.disk_cache import cached_arrays, cached_step, caching_steps, content_digest
from graspd.worker.objects.model import ObjectModel
from graspd.worker.objects.prepare import load_object, object_from_path
from graspd.worker.quality.probe import probe_of
from graspd.worker.rendering.hands import without_visuals
from graspd.worker.rendering.scene_setup import CameraPlan, SceneSetup
from graspd.worker.scenes.simulate import rest_probability
from graspd.worker.simulation import sampling
from graspd.worker.stages import assets
from graspd.worker.stages.assets import prepared_object
from graspd.worker.stages.context import batch_seed
from graspd.worker.stages.models import hand_glb, model_glb, object_glb, publish_model
from tests.fakes import message_for, request
from tests.worker.models import object_from_mesh, two_finger_hand
from tests.worker.objects.shapes import box, join, sphere, stl

#: Two balls in one another: a repair to remember.
BALLS = stl(join(sphere(segments=24), sphere(segments=24, at=(0.02, 0.0, 0.0))))
BRICK = object_from_mesh(trimesh.creation.box((0.06, 0.04, 0.05)))
HAND = two_finger_hand()
FILES = {"asset.json": b'{"file": "m.stl"}', **BALLS}
DIGEST = digest_files(AssetKind.OBJECT, FILES)
TOLERANCE_M = 5e-7  # positions are single precision: half a micrometre at half a metre
OTHERS = [{"batch": 1}, {"stage": Stage.SCENE}, {"hand_digest": "d" * 32}, {"object_digest": "d" * 32}]


def made(number: float) -> dict[str, np.ndarray]:
    return {"a": np.full((2, 3), number), "b": np.arange(4)}


def test_what_was_made_is_read_bit_for_bit(own_cache: Path) -> None:
    first = cached_arrays("things", ("x", 1), (disk_cache,), lambda: made(1 / 3))
    again = cached_arrays("things", ("x", 1), (disk_cache,), lambda: pytest.fail("it is there already"))
    assert all(np.array_equal(first[name], again[name]) and first[name].dtype == again[name].dtype for name in first)
    assert [file.suffix for file in (own_cache / "things").iterdir()] == [".npz"]


def test_entries_differ_with_terms_and_code_bad_ones_are_remade(own_cache: Path) -> None:
    cached_arrays("things", ("x", 1), (disk_cache,), lambda: made(1))
    assert cached_arrays("things", ("x", 2), (disk_cache,), lambda: made(2))["a"][0, 0] == 2
    assert cached_arrays("things", ("x", 1), (surface,), lambda: made(3))["a"][0, 0] == 3
    for file in (own_cache / "things").iterdir():
        user_cache.store(file, b"no arrays")
    assert cached_arrays("things", ("x", 1), (disk_cache,), lambda: made(4))["a"][0, 0] == 4


def test_samples_are_those_of_a_process_without_a_cache(own_cache: Path) -> None:
    hand = two_finger_hand()
    ball = load_object(stl(sphere(segments=24)), name="ball", digest="", face_error_m=0.0)
    shapes = surface._Shapes(hand.pieces, body_poses(hand, IDENTITY_POSE, hand.expand(hand.preshape))[0])
    for _ in range(2):
        found, fresh = surface._cached_samples.__wrapped__(shapes, 120, 2), surface._sample(shapes, 120, 2)
        assert all(np.array_equal(getattr(found, name), array) for name, array in vars(fresh).items())
        assert np.array_equal(sampling.object_samples(ball, 90, seed=1), sampling._sample_surface(ball, 90, 1))


def test_small_steps_are_kept_together_each_by_what_it_is_given(own_cache: Path) -> None:
    def halves(array: np.ndarray) -> np.ndarray:
        return cached_step("half", [array], lambda: [array / 2])["0"]

    for _ in range(2):
        with caching_steps("steps", ("one thing",), (disk_cache,)):
            assert halves(np.arange(3.0)).tolist() == [0, 0.5, 1]
            assert halves(np.arange(2.0)).tolist() == [0, 0.5]
    assert len(list((own_cache / "steps").iterdir())) == 1
    with caching_steps("steps", ("one thing",), (disk_cache,)):
        step = cached_step("half", [np.arange(3.0)], lambda: pytest.fail("it is cached"))["0"]
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


def load_balls(files: dict[str, bytes] = BALLS, error: float = 3e-4, **options) -> ObjectModel:
    prepare._prepare.cache_clear()
    prepare._repair_file.cache_clear()
    return load_object(files, name="balls", digest="d", face_error_m=error, options=options)


@pytest.fixture
def built(own_cache: Path, monkeypatch: pytest.MonkeyPatch) -> list[float]:
    bounds: list[float] = []
    build = prepare.build_model
    monkeypatch.setattr(prepare, "build_model", lambda mesh, error: bounds.append(error) or build(mesh, error))
    return bounds


def same(one: ObjectModel, two: ObjectModel) -> bool:
    pairs = [(np.asarray(getattr(one, field.name)), np.asarray(getattr(two, field.name))) for field in fields(one)]
    return all(np.array_equal(a, b) and a.dtype == b.dtype for a, b in pairs)


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
    monkeypatch.setattr(disk_cache, "code_revision", disk_cache.code_revision.__wrapped__)
    plain = prepare.revision.__wrapped__()
    monkeypatch.setattr(disk_cache, "version_of", lambda name: f"0 of {name}")
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
        user_cache.store(entry, b"whole, but no object")
    assert same(load_balls(), fresh) and same(load_balls(), fresh)
    assert len(built) == 2


@pytest.mark.parametrize("model", [BRICK, HAND], ids=["object", "hand"])
def test_whatever_differs_in_a_model_changes_its_content(model) -> None:
    for field in dataclasses.fields(model):
        changed = dataclasses.replace(model, **{field.name: np.array([7])})
        assert (changed.content == model.content) == (field.name in ("name", "digest", "parts")), field.name
    assert dataclasses.replace(BRICK, vertices=BRICK.vertices.ravel()).content != BRICK.content
    with pytest.raises(TypeError, match="object"):
        content_digest(dataclasses.replace(BRICK, repairs=object()))  # type: ignore[arg-type]


def test_no_cache_gives_one_mesh_of_a_file_for_another(own_cache: Path) -> None:
    # As many corners and faces, the same digest of the file: only what was prepared differs.
    other = dataclasses.replace(object_from_mesh(trimesh.creation.box((0.02, 0.04, 0.05))), digest=BRICK.digest)
    one, two = (probe_of(HAND, obj, hand_points=64, object_points=64) for obj in (BRICK, other))
    assert not np.array_equal(one.samples, two.samples)
    plan, pose = CameraPlan(1, 16, 16, None), np.array([[[0.0, 0, 0, 1, 0, 0, 0]]])
    first, second = (SceneSetup([obj], pose, plan, seed=0, samples=1) for obj in (BRICK, other))
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


@pytest.fixture
def store() -> Store:
    opened = open_store("memory://")
    publish_asset(opened, AssetKind.OBJECT, "balls", FILES)
    return opened


def test_the_second_worker_finds_what_the_first_has_made(store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    fresh = load_object(FILES, name="balls", digest=DIGEST, face_error_m=3e-4)
    assert same(prepared_object(store, DIGEST, name="balls", face_error_m=3e-4), fresh)
    monkeypatch.delattr(assets, "load_object")
    assert same(prepared_object(store, DIGEST, name="balls", face_error_m=3e-4), fresh)
    assert fresh.repairs


def test_another_bound_is_another_object(store: Store) -> None:
    fine, coarse = (prepared_object(store, DIGEST, name="balls", face_error_m=bound) for bound in (1e-4, 3e-3))
    assert prepared_object(store, DIGEST, name="other", face_error_m=1e-4).name == "other"
    assert len(fine.faces) > len(coarse.faces)
    assert len(list(store.list(f"assets/object/{DIGEST}/prepared"))) == 2


@pytest.mark.parametrize("data", [b"", b"noise" * 100, b"PK\x03\x04" + bytes(60)])
def test_what_cannot_be_read_is_made_again(store: Store, data: bytes) -> None:
    prepared_object(store, DIGEST, name="balls", face_error_m=3e-4)
    (entry,) = store.list(f"assets/object/{DIGEST}/prepared")
    spoilt = open_store("memory://")
    publish_asset(spoilt, AssetKind.OBJECT, "balls", FILES)
    spoilt.put(entry.key, data)
    fresh = load_object(FILES, name="balls", digest=DIGEST, face_error_m=3e-4)
    assert same(prepared_object(spoilt, DIGEST, name="balls", face_error_m=3e-4), fresh)


@pytest.mark.parametrize("name", builtin_names(AssetKind.HAND))
def test_a_hands_nodes_stand_where_kinematics_puts_its_bodies(name: str) -> None:
    hand = without_visuals(hand_from_path(name))
    scene = trimesh.load(io.BytesIO(hand_glb(hand)), file_type="glb", force="scene")
    poses = body_poses(hand, IDENTITY_POSE, np.zeros(len(hand.joint_names)))[0]
    expected = np.concatenate([apply(poses[piece.body], piece.vertices) for piece in hand.pieces])
    found = np.concatenate([mesh.bounds for mesh in scene.dump() if isinstance(mesh, trimesh.Trimesh)])
    for end in (np.min, np.max):
        np.testing.assert_allclose(end(found, axis=0), end(expected, axis=0), atol=TOLERANCE_M)


@pytest.mark.parametrize("kind", list(AssetKind))
def test_models_that_come_with_graspd_are_those_of_its_assets(kind: AssetKind) -> None:
    for name in builtin_names(kind):
        made = model_glb(kind, name, builtin_files(kind, name))
        assert made == builtin_model(kind, name), "python -m graspd.worker.stages.models"


def test_a_model_is_published_once(tmp_path) -> None:
    store = open_store(tmp_path.as_uri())
    obj = object_from_path("block")
    publish_model(store, AssetKind.OBJECT, obj)
    key = names.asset_key(AssetKind.OBJECT, obj.digest, "model.glb")
    assert store.get(key)[:4] == b"glTF"
    publish_model(store, AssetKind.OBJECT, obj)
    assert store.get(key) == add_seal(key, object_glb(obj))


def message(**changes) -> TaskMessage:
    return message_for(Stage.RENDER, scenes=1, views=1).model_copy(update=changes)


@pytest.mark.parametrize("changes", [*OTHERS, {"request": request(seed=7)}])
def test_batches_stages_hands_objects_and_seeds_draw_anew(changes: dict) -> None:
    assert batch_seed(message(**changes)) != batch_seed(message())
    other = message(request=request(method="graspit"), output="e" * 32)
    assert batch_seed(other) == batch_seed(message()), "two methods show their grasps in the same pictures"

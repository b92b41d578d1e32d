"""Prepared objects and models in the store: made once, those of the engine; and what batches draw."""

import io
from dataclasses import fields

import numpy as np
import pytest
import trimesh

from graspd.service.model import names
from graspd.service.model.digests import digest_files
from graspd.service.model.messages import TaskMessage
from graspd.service.model.states import AssetKind, Stage
from graspd.service.model.transforms import IDENTITY_POSE, apply
from graspd.service.store.assets import builtin_files, builtin_model, builtin_names
from graspd.service.store.integrity import sealed
from graspd.service.store.library import publish_asset
from graspd.service.store.store import Store, open_store
from graspd.worker.hands.kinematics import body_poses
from graspd.worker.hands.load import hand_from_path
from graspd.worker.objects.model import ObjectModel
from graspd.worker.objects.prepare import load_object, object_from_path
from graspd.worker.stages import assets
from graspd.worker.stages.assets import prepared_object
from graspd.worker.stages.context import batch_seed
from graspd.worker.stages.models import hand_glb, model_of, object_glb, publish_model
from tests.fakes import message_for, request
from tests.worker.objects.shapes import join, sphere, stl

#: Two balls in one another: a repair to remember.
FILES = {"asset.json": b'{"file": "m.stl"}', **stl(join(sphere(segments=32), sphere(segments=32, at=(0.02, 0.0, 0.0))))}
DIGEST = digest_files(AssetKind.OBJECT, FILES)


@pytest.fixture
def store() -> Store:
    opened = open_store("memory://")
    publish_asset(opened, AssetKind.OBJECT, "balls", FILES)
    return opened


def same(one: ObjectModel, two: ObjectModel) -> None:
    for field in fields(one):
        mine, other = getattr(one, field.name), getattr(two, field.name)
        if isinstance(mine, np.ndarray):
            assert mine.dtype == other.dtype
            np.testing.assert_array_equal(mine, other, err_msg=field.name)
        else:
            assert mine == other, field.name


def test_the_second_worker_finds_what_the_first_has_made(store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    fresh = load_object(FILES, name="balls", digest=DIGEST, face_error_m=3e-4)
    same(prepared_object(store, DIGEST, name="balls", face_error_m=3e-4), fresh)
    monkeypatch.delattr(assets, "load_object")
    same(prepared_object(store, DIGEST, name="balls", face_error_m=3e-4), fresh)
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
    same(prepared_object(spoilt, DIGEST, name="balls", face_error_m=3e-4), fresh)


TOLERANCE_M = 5e-7  # positions are single precision: half a micrometre at half a metre


def scene_of(data: bytes) -> trimesh.Scene:
    return trimesh.load(io.BytesIO(data), file_type="glb", force="scene")


@pytest.mark.parametrize("name", builtin_names(AssetKind.HAND))
def test_a_hands_nodes_stand_where_kinematics_puts_its_bodies(name: str) -> None:
    hand = hand_from_path(name)
    scene = scene_of(hand_glb(hand))
    poses = body_poses(hand, IDENTITY_POSE, np.zeros(len(hand.joint_names)))[0]
    expected = np.concatenate([apply(poses[piece.body], piece.vertices) for piece in hand.pieces])
    found = np.concatenate([mesh.bounds for mesh in scene.dump() if isinstance(mesh, trimesh.Trimesh)])
    for end in (np.min, np.max):
        np.testing.assert_allclose(end(found, axis=0), end(expected, axis=0), atol=TOLERANCE_M)


@pytest.mark.parametrize("kind", list(AssetKind))
def test_models_that_come_with_graspd_are_those_of_its_assets(kind: AssetKind) -> None:
    for name in builtin_names(kind):
        made = model_of(kind, name, builtin_files(kind, name))
        assert made == builtin_model(kind, name), "python -m graspd.worker.stages.models"


def test_a_model_is_published_once(tmp_path) -> None:
    store = open_store(tmp_path.as_uri())
    obj = object_from_path("block")
    publish_model(store, AssetKind.OBJECT, obj)
    key = names.asset_model(AssetKind.OBJECT, obj.digest)
    assert store.get(key)[:4] == b"glTF"
    publish_model(store, AssetKind.OBJECT, obj)
    assert store.get(key) == sealed(key, object_glb(obj))


def message(**changes) -> TaskMessage:
    return message_for(Stage.RENDER, scenes=1, views=1).model_copy(update=changes)


OTHERS = [{"batch": 1}, {"stage": Stage.SCENE}, {"hand_digest": "d" * 32}, {"object_digest": "d" * 32}]


@pytest.mark.parametrize("changes", [*OTHERS, {"request": request(seed=7)}])
def test_batches_stages_hands_objects_and_seeds_draw_anew(changes: dict) -> None:
    assert batch_seed(message(**changes)) != batch_seed(message())
    other = message(request=request(method="graspit"), output="e" * 32)
    assert batch_seed(other) == batch_seed(message()), "two methods show their grasps in the same pictures"

"""The models that viewers show are the hand and the object that the engine uses."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
import pytest
import trimesh

from graspd.service.model import names
from graspd.service.model.states import AssetKind
from graspd.service.model.transforms import IDENTITY_POSE, apply
from graspd.service.store.assets import builtin_files, builtin_model, builtin_names
from graspd.service.store.integrity import sealed
from graspd.service.store.store import open_store
from graspd.worker.hands.kinematics import body_poses
from graspd.worker.hands.load import hand_from_path
from graspd.worker.objects.prepare import object_from_path
from graspd.worker.stages.models import hand_glb, model_of, object_glb, publish_model

#: Positions are single precision: half a micrometre at half a metre.
TOLERANCE_M = 5e-7


def scene_of(data: bytes) -> trimesh.Scene:
    return trimesh.load(io.BytesIO(data), file_type="glb", force="scene")


@pytest.mark.parametrize("name", builtin_names(AssetKind.HAND))
def test_a_hands_nodes_stand_where_kinematics_puts_its_bodies(name: str) -> None:
    hand = hand_from_path(name)
    scene = scene_of(hand_glb(hand))
    poses = body_poses(hand, IDENTITY_POSE, np.zeros(len(hand.joint_names)))[0]
    expected = np.concatenate([apply(poses[piece.body], piece.vertices) for piece in hand.pieces])
    solid = [geometry for geometry in scene.dump() if isinstance(geometry, trimesh.Trimesh)]
    found = np.concatenate([mesh.bounds for mesh in solid])
    np.testing.assert_allclose(
        [found.min(axis=0), found.max(axis=0)], [expected.min(axis=0), expected.max(axis=0)], atol=TOLERANCE_M
    )


def test_an_objects_model_is_its_prepared_mesh() -> None:
    obj = object_from_path("mug")
    (mesh,) = scene_of(object_glb(obj)).dump()
    assert len(mesh.faces) == len(obj.faces)
    assert mesh.volume == pytest.approx(obj.volume, rel=1e-5)  # single precision


@pytest.mark.parametrize("kind", list(AssetKind))
def test_the_models_that_come_with_graspd_are_those_of_its_assets(kind: AssetKind) -> None:
    for name in builtin_names(kind):
        assert model_of(kind, name, builtin_files(kind, name)) == builtin_model(kind, name), (
            "python -m graspd.worker.stages.models"
        )


def test_a_model_is_published_once(tmp_path: Path) -> None:
    store = open_store(tmp_path.as_uri())
    obj = object_from_path("block")
    publish_model(store, AssetKind.OBJECT, obj)
    key = names.asset_model(AssetKind.OBJECT, obj.digest)
    assert store.get(key)[:4] == b"glTF"
    publish_model(store, AssetKind.OBJECT, obj)
    assert store.get(key) == sealed(key, object_glb(obj))

"""Prepared objects are kept in the store: made once, bit for bit the same, and never trusted when damaged."""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np
import pytest

from graspd.service.model.digests import digest_files
from graspd.service.model.states import AssetKind
from graspd.service.store.library import publish_asset
from graspd.service.store.store import Store, open_store
from graspd.worker.objects.model import ObjectModel
from graspd.worker.objects.prepare import from_bytes, load_object, to_bytes
from graspd.worker.stages import assets
from graspd.worker.stages.assets import prepared_object
from tests.worker.objects.shapes import box, join, sphere, stl

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
    assert len(fine.faces) > len(coarse.faces)
    assert len(list(store.list(f"assets/object/{DIGEST}/prepared"))) == 2


def test_the_name_is_that_of_the_task(store: Store) -> None:
    prepared_object(store, DIGEST, name="balls", face_error_m=3e-4)
    assert prepared_object(store, DIGEST, name="other", face_error_m=3e-4).name == "other"


@pytest.mark.parametrize("data", [b"", b"noise" * 100, b"PK\x03\x04" + bytes(60)])
def test_what_cannot_be_read_is_made_again(store: Store, data: bytes) -> None:
    prepared_object(store, DIGEST, name="balls", face_error_m=3e-4)
    (entry,) = store.list(f"assets/object/{DIGEST}/prepared")
    spoilt = open_store("memory://")
    publish_asset(spoilt, AssetKind.OBJECT, "balls", FILES)
    spoilt.put(entry.key, data)
    fresh = load_object(FILES, name="balls", digest=DIGEST, face_error_m=3e-4)
    same(prepared_object(spoilt, DIGEST, name="balls", face_error_m=3e-4), fresh)


def test_every_field_survives() -> None:
    obj = load_object(stl(box()), name="box", digest="d" * 32, face_error_m=0.0)
    odd = replace(obj, watertight=False, deviation_m=1.5e-5, repairs=("a", "b"), volume=1 / 3)
    same(from_bytes(to_bytes(odd), name="box", digest="d" * 32), odd)

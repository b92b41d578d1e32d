"""Prepared objects in the store: repaired and simplified once, by the worker that meets the object first."""

from __future__ import annotations

import zipfile

from service.model import names
from service.model.digests import digest_json
from service.model.errors import DamagedError, NotFoundError
from service.model.states import AssetKind
from service.model.version import STAGE_REVISIONS
from service.store.library import load_asset_files
from service.store.seals import get_sealed, put_sealed
from service.store.store import Store
from worker.objects.model import ObjectModel
from worker.objects.packed import from_bytes, to_bytes
from worker.objects.prepare import load_object


def prepared_object(store: Store, digest: str, *, name: str, face_error_m: float) -> ObjectModel:
    """An object as `load_object` makes it, from the store if it was prepared to this bound before.

    Raises:
        MeshError: the mesh cannot be used.
        StoreUnavailable: the store does not answer.
    """
    key = names.object_prepared(digest, _address(face_error_m))
    try:
        return from_bytes(get_sealed(store, key), name=name, digest=digest)
    except NotFoundError:
        pass
    except (DamagedError, ValueError, KeyError, OSError, EOFError, zipfile.BadZipFile):
        # What cannot be read is made again; it cannot be replaced, and costs no more than it did without a store.
        return _load(store, digest, name=name, face_error_m=face_error_m)
    obj = _load(store, digest, name=name, face_error_m=face_error_m)
    put_sealed(store, key, to_bytes(obj))
    return obj


def _address(face_error_m: float) -> str:
    # Whatever changes a prepared mesh changes the grasps on it, and with them the revision of their stage.
    return digest_json({"face_error_m": face_error_m, "revision": STAGE_REVISIONS["synthesize"]})


def _load(store: Store, digest: str, *, name: str, face_error_m: float) -> ObjectModel:
    files = load_asset_files(store, AssetKind.OBJECT, digest)
    return load_object(files, name=name, digest=digest, face_error_m=face_error_m)

"""Inputs of tasks from the store: hands, objects, networks, convex pieces and shards, cached.
The first worker that needs an object repairs and simplifies it, and stores the result."""

import threading
import zipfile
from collections.abc import Callable, Hashable, Mapping
from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from cachetools import LRUCache
from numpy.typing import NDArray

from graspd.service.model import names
from graspd.service.model.contact_region import parse_region
from graspd.service.model.digests import digest_json
from graspd.service.model.errors import DamagedError, MeshError, NotFoundError
from graspd.service.model.messages import TaskMessage
from graspd.service.model.states import AssetKind, Stage
from graspd.service.model.version import STAGE_REVISIONS
from graspd.service.store.columns import Attribute
from graspd.service.store.hand_files import format_of
from graspd.service.store.integrity import get_document, get_sealed, put_document, put_sealed
from graspd.service.store.library import load_asset_files
from graspd.service.store.manifests import ShardManifest, load_shard
from graspd.service.store.network_file import ProposalNetwork, from_bytes, network_bytes
from graspd.service.store.shards import Shard
from graspd.service.store.store import Store
from graspd.service.user_cache import write_atomically
from graspd.worker.files.provenance import NEIGHBOUR_FACE_ERROR_M
from graspd.worker.hands.load import load_hand, main_file
from graspd.worker.hands.model import HandModel
from graspd.worker.hands.options import parse_options
from graspd.worker.hands.xacro import expand_xacro
from graspd.worker.objects import prepare
from graspd.worker.objects.model import ObjectModel
from graspd.worker.objects.options import apply_request
from graspd.worker.objects.prepare import load_object
from graspd.worker.planners.network_cache import store_network
from graspd.worker.scenes.kinds import supports_of
from graspd.worker.scenes.placement import neighbour_of
from graspd.worker.simulation.environment import Scenes
from graspd.worker.stages.context import TaskContext
from graspd.worker.stages.models import SHOWN_ERROR_M, publish_model
from graspd.worker.validation.decomposition import ConvexPieces, decompose, piece_file

#: Number of cached assets: a worker in a hands x objects dataset alternates between a few.
_cache: LRUCache[Hashable, object] = LRUCache(16)
_lock = threading.RLock()


def hand_of(store: Store, message: TaskMessage | ShardManifest) -> HandModel:
    name, digest = message.request.hand, message.hand_digest

    def load() -> HandModel:
        hand = load_hand(load_hand_files(store, digest), name=name, digest=digest)
        publish_model(store, AssetKind.HAND, hand)
        return hand

    return _cached((store.url, AssetKind.HAND, name, digest), load)


def object_of(store: Store, message: TaskMessage | ShardManifest) -> ObjectModel:
    """Load the object of a task, simplified within the tolerance of its fidelity."""
    request, digest = message.request, message.object_digest
    name, error = request.object, request.resolved_fidelity.face_error_m
    regions = (request.touch_region, request.avoid_region)
    terms = (error, regions, request.validation == "dexgraspbench", *request.object_properties.items())

    def load() -> ObjectModel:
        obj = prepared_object(store, digest, name=name, face_error_m=error)
        if obj.parts is None and any(text and not parse_region(text).planes for text in regions):
            # Objects that were stored by earlier versions have no parts.
            obj = _load(store, digest, name=name, face_error_m=error)
        if not store.exists(names.asset_key(AssetKind.OBJECT, digest, "model.glb")):
            # The model does not depend on which fidelity comes first.
            shown = prepared_object(store, digest, name=name, face_error_m=SHOWN_ERROR_M)
            publish_model(store, AssetKind.OBJECT, shown)
        return apply_request(obj, request)

    return _cached((store.url, AssetKind.OBJECT, name, digest, *terms), load)


def neighbours_of(store: Store, message: TaskMessage | ShardManifest) -> list[ObjectModel]:
    """Load the other objects in the scenes of a task, in the order of its request."""

    def load(name: str, digest: str) -> ObjectModel:
        obj = prepared_object(store, digest, name=name, face_error_m=NEIGHBOUR_FACE_ERROR_M)
        publish_model(store, AssetKind.OBJECT, obj)
        with suppress(MeshError):  # without pieces, the object's hull is the obstacle
            load_pieces(store, obj)
        return obj

    beside = [(one.object, one.digest or "") for one in message.request.all_neighbours]
    return [_cached((store.url, "neighbour", *key), partial(load, *key)) for key in beside]


def scenes_of(store: Store, message: TaskMessage | ShardManifest, columns: Mapping[str, NDArray[np.generic]]) -> Scenes:
    """Return the scenes in which the grasps of a task are planned, by the columns of a shard."""
    scenes = Scenes(supports_of(message.request.scene_spec), np.asarray(columns["scene/object_pose"], float))
    if beside := tuple(neighbour_of(other) for other in neighbours_of(store, message)):
        at = np.asarray(columns["scene/neighbour_pose"], float)
        scenes = replace(scenes, neighbours=beside, neighbour_pose=at)
    return scenes


def cache_network(store: Store, message: TaskMessage) -> None:
    """Cache the network that a task's method uses, if any, under the digest in the method's options.
    Raises NotFoundError, InputError: it is not in the store, or does not match its digest."""
    if not (digest := message.request.network):
        return

    def load() -> ProposalNetwork:
        files = load_asset_files(store, AssetKind.NETWORK, digest)
        return from_bytes(network_bytes(files, f"network {digest[:12]}"), f"network {digest[:12]}")

    store_network(digest, _cached((store.url, AssetKind.NETWORK, digest), load))


def neighbour_attributes(message: TaskMessage) -> dict[str, Attribute]:
    """Return a shard's attributes for the neighbours of its object; empty if there are none."""
    beside = message.request.all_neighbours
    if not beside:
        return {}
    return {"neighbours": [one.object for one in beside], "neighbour_digests": [one.digest or "" for one in beside]}


def _cached(key: Hashable, load: Callable[[], Any]) -> Any:
    # Tasks of one pair start at the same time; one of them loads the asset.
    with _lock:
        if key not in _cache:
            _cache[key] = load()
        return _cache[key]


def prepared_object(store: Store, digest: str, *, name: str, face_error_m: float) -> ObjectModel:
    """Load an object as `load_object` does; reuse a stored one with the same `face_error_m`.
    Raises MeshError: the mesh cannot be used. StoreUnavailable."""
    # A change of a prepared mesh changes its grasps, and with them the revision of their stage.
    terms = {"face_error_m": face_error_m, "revision": STAGE_REVISIONS["synthesize"]}
    key = names.asset_key(AssetKind.OBJECT, digest, f"prepared/{digest_json(terms)}.npz")
    try:
        return prepare.from_bytes(get_sealed(store, key), name=name, digest=digest)
    except NotFoundError:
        pass
    except (DamagedError, ValueError, KeyError, OSError, EOFError, zipfile.BadZipFile):
        # An unreadable entry cannot be replaced. Preparing the object again costs as much as without a store.
        return _load(store, digest, name=name, face_error_m=face_error_m)
    obj = _load(store, digest, name=name, face_error_m=face_error_m)
    put_sealed(store, key, prepare.to_bytes(obj))
    return obj


def _load(store: Store, digest: str, *, name: str, face_error_m: float) -> ObjectModel:
    files = load_asset_files(store, AssetKind.OBJECT, digest)
    return load_object(files, name=name, digest=digest, face_error_m=face_error_m)


_pieces_lock = threading.Lock()


def load_pieces(store: Store, obj: ObjectModel) -> ConvexPieces:
    """Return an object's pieces from this machine's cache or the store, else compute and store them.
    Raises MeshError: the object has no usable pieces. StoreUnavailable."""
    file = piece_file(obj)
    key = names.asset_key(AssetKind.OBJECT, obj.digest, f"pieces/{file.stem}.npz")
    with _pieces_lock:  # tasks of one object start at once: one of them makes the pieces
        if not file.is_file():
            _fetch_pieces(store, key, file)
        pieces = decompose(obj)
        if file.is_file() and not store.exists(key):
            put_sealed(store, key, file.read_bytes())
        return pieces


def _fetch_pieces(store: Store, key: str, file: Path) -> None:
    try:
        data = get_sealed(store, key)
    except (NotFoundError, DamagedError):
        return
    # Without a writable folder, the pieces are computed again at the next use.
    with suppress(OSError):
        write_atomically(file, [data])


def load_input(message: TaskMessage, context: TaskContext, stage: Stage) -> Shard:
    """Load the shard that `stage` made for a task; raises the errors of `load_shard`."""
    return load_shard(context.store, stage, message.inputs[0])


def load_hand_files(store: Store, digest: str) -> dict[str, bytes]:
    """Load all files of a hand; a xacro file is replaced by the URDF from its first expansion.
    Raises HandError: the options or the xacro file cannot be used; and the errors of `load_asset_files`."""
    files = load_asset_files(store, AssetKind.HAND, digest)
    settings = parse_options(files)
    main = main_file(files, settings)
    if format_of(main, files[main]) != "xacro":
        return files
    key = names.asset_key(AssetKind.HAND, digest, "expanded.json")
    if not store.exists(key):
        put_document(store, key, {"urdf": expand_xacro(files, main, settings.xacro).decode()})
    return {**files, main: str(get_document(store, key)["urdf"]).encode()}

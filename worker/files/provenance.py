"""Provenance of a shard: attributes that identify hand, object and grasps; search for their files.

Files are identified by digest, so a modified or different file is never used instead."""

import hashlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import islice, zip_longest
from pathlib import Path
from types import MappingProxyType
from typing import Any, Final

import numpy as np
from pydantic_core import from_json

from graspd.service.model.digests import digest_files, digest_variant
from graspd.service.model.domain import JobOptions
from graspd.service.model.errors import ConflictError, GraspdError, InputError, NotFoundError
from graspd.service.model.matter import FRICTION, MASS_KG
from graspd.service.model.states import AssetKind
from graspd.service.readers.trajectories import scene_spec_of
from graspd.service.store.assets import builtin_files, builtin_names
from graspd.service.store.columns import Attribute
from graspd.service.store.library import load_asset_files
from graspd.service.store.shards import Shard, json_attribute
from graspd.service.store.store import Store, open_store
from graspd.service.store.usd_layers import SUFFIXES as USD
from graspd.worker.grasps import Columns
from graspd.worker.hands.load import files_from_path as hand_files
from graspd.worker.hands.load import hand_from_path, load_hand
from graspd.worker.hands.model import HandModel
from graspd.worker.objects.formats import READERS
from graspd.worker.objects.model import ObjectModel
from graspd.worker.objects.prepare import files_from_path as object_files
from graspd.worker.objects.prepare import load_object, object_from_path
from graspd.worker.scenes.kinds import supports_of
from graspd.worker.scenes.neighbours import Neighbours
from graspd.worker.scenes.placement import neighbour_of
from graspd.worker.simulation.environment import PlacedGrasps, Scenes

SUFFIXES: Final = {AssetKind.HAND: (".urdf", ".xml", *USD, ".zip"), AssetKind.OBJECT: (*READERS, ".zip")}
#: Largest number of files searched in the shard's folder and its subfolders.
LOOKED_AT: Final = 200
_FILES: Final[dict[AssetKind, Callable[[Path], tuple[str, dict[str, bytes], dict[str, Any]]]]] = {
    AssetKind.HAND: hand_files,
    AssetKind.OBJECT: object_files,
}


@dataclass(frozen=True)
class AssetReference:
    kind: AssetKind
    name: str
    digest: str
    source: str = ""  # path of the original file
    options: Mapping[str, Any] | None = None  # further options, such as `keep_largest`
    folder: Path | None = None  # folder of the shard


@dataclass(frozen=True)
class AssetFiles:
    """Files of a hand or object, and the options to load them with."""

    files: dict[str, bytes]
    options: dict[str, Any]


def path_attributes(hand: str, obj: str, options: Mapping[str, Any]) -> dict[str, Attribute]:
    """Return root attributes with the paths of hand and object; built-in ones need none."""
    paths = {"hand_source": Path(hand), "object_source": Path(obj)}
    found: dict[str, Attribute] = {name: str(path.resolve()) for name, path in paths.items() if path.is_file()}
    return found | ({"object_options": json_attribute(dict(options))} if options else {})


def find_files(sought: AssetReference, store: Store | None = None) -> AssetFiles:
    """Find the files of a hand or object: built in, at the recorded path, in the store, near the shard.
    The store is by default that of the settings.
    Raises NotFoundError: they are in none of these places; the message lists the places."""
    if sought.name in builtin_names(sought.kind):
        files = builtin_files(sought.kind, sought.name)
        if digest_files(sought.kind, files) == sought.digest:
            return AssetFiles(files, {})
    looked: list[str] = []
    if sought.source:
        looked.append(f"at {sought.source}, where the shard was made")
        if (found := files_at(sought, Path(sought.source))) is not None:
            return found
    if (found := _files_in_store(sought, looked, store)) is not None:
        return found
    for path in _nearby_paths(sought, looked):
        if (found := files_at(sought, path)) is not None:
            return found
    raise NotFoundError(
        f"the {sought.kind} {sought.name!r} of digest {sought.digest[:12]} is not {', not '.join(looked)}; "
        f"name its file: --{sought.kind}"
    )


def _files_in_store(sought: AssetReference, looked: list[str], store: Store | None) -> AssetFiles | None:
    from graspd.service.settings import Settings

    url = store.url if store else Settings().resolved_store_url
    looked.append(f"in the store {url}")
    try:
        return AssetFiles(load_asset_files(store or open_store(url, make=False), sought.kind, sought.digest), {})
    except GraspdError:
        return None


def _nearby_paths(sought: AssetReference, looked: list[str]) -> Iterator[Path]:
    if sought.folder is None:
        return
    looked.append(f"in {sought.folder}")
    near = (path for pattern in ("*", "*/*") for path in sorted(sought.folder.glob(pattern)))
    fitting = (path for path in near if path.suffix.lower() in SUFFIXES[sought.kind])
    yield from islice(fitting, LOOKED_AT)


def files_at(sought: AssetReference, path: Path) -> AssetFiles | None:
    """Return the files at a path if they match the reference."""
    try:
        if not path.is_file():
            return None
        _, files, stated = _FILES[sought.kind](path)
        digest = digest_files(sought.kind, files)
    except (GraspdError, OSError):
        return None
    for options in ({}, dict(sought.options or {})):
        if digest_variant(digest, options) == sought.digest:
            return AssetFiles(files, {**stated, **options})
    return None


def parse_options_attribute(attribute: object) -> dict[str, Any]:
    """Parse an attribute with a JSON object; empty if the attribute is absent or invalid."""
    try:
        said = from_json(str(attribute or "{}"))
    except ValueError:
        return {}
    return said if isinstance(said, dict) else {}


#: `face_error_m` of neighbours [m]; neighbours are obstacles and are not grasped.
NEIGHBOUR_FACE_ERROR_M: Final = 3e-4
_MATTER: Final = {"object_mass_kg": MASS_KG, "object_friction": FRICTION}


def hand_of_shard(shard: Shard, given: str | None) -> HandModel:
    """Load the hand `given` (a file or a built-in), by default the shard's own hand, see `find_files`.
    Raises NotFoundError: no such hand. ConflictError: the given hand is not the shard's."""
    if given:
        hand = hand_from_path(given)
        _check_digest(shard, "hand", hand.digest, given)
        return hand
    wanted = _reference_of(shard, AssetKind.HAND)
    found = find_files(wanted)
    return load_hand(found.files, name=wanted.name, digest=wanted.digest, options=found.options)


def hand_files_of_shard(shard: Shard, given: str | None) -> AssetFiles:
    """Load the files of the hand `given`, by default of the shard's own hand, see `find_files`."""
    if given:
        _, files, stated = hand_files(given)
        return AssetFiles(files, stated)
    return find_files(_reference_of(shard, AssetKind.HAND))


def object_of_shard(shard: Shard, given: str | None, store: Store | None = None) -> ObjectModel:
    """Load the object `given`, with the shard's simplification, mass and friction; see `hand_of_shard`."""
    said = shard.attributes
    # Older shards lack these attributes: the values were the same for all objects.
    mass, friction = (float(said.get(key, default)) for key, default in _MATTER.items())  # type: ignore[arg-type]
    stated = parse_options_attribute(said.get("fidelity")).get("face_error_m")
    error = float(stated) if isinstance(stated, int | float) else 3e-4
    wanted = _reference_of(shard, AssetKind.OBJECT)
    if not given:
        obj = _load_object(wanted, find_files(wanted, store), error)
    elif (found := files_at(wanted, Path(given))) is not None:
        obj = _load_object(wanted, found, error)
    else:
        obj = object_from_path(given, face_error_m=error)
        _check_digest(shard, "object", obj.digest, given)
    return obj.with_mass(mass=mass, friction=friction)


def _load_object(wanted: AssetReference, found: AssetFiles, face_error_m: float) -> ObjectModel:
    name, digest, options = wanted.name, wanted.digest, found.options
    return load_object(found.files, name=name, digest=digest, face_error_m=face_error_m, options=options)


def _reference_of(shard: Shard, kind: AssetKind) -> AssetReference:
    said = shard.attributes
    name, digest, source = (str(said.get(f"{kind.value}{part}", "")) for part in ("", "_digest", "_source"))
    options = parse_options_attribute(said.get(f"{kind.value}_options"))
    return AssetReference(kind, name, digest, source, options, _folder_of(shard))


def _folder_of(shard: Shard) -> Path | None:
    return None if shard.path is None else shard.path.resolve().parent


def neighbours_of_shard(shard: Shard, given: Sequence[str]) -> Neighbours | None:
    """Load the other objects of a scene shard with their poses; None if the object is alone.
    Raises NotFoundError: `find_files` fails. ConflictError: the given objects are not those of the shard."""
    names, digests = (shard.attributes.get(key, []) for key in ("neighbours", "neighbour_digests"))
    if "scene/neighbour_pose" not in shard.arrays or not isinstance(names, list) or not isinstance(digests, list):
        return None
    if given and len(given) != len(names):
        raise ConflictError(f"the scene shard has {len(names)} neighbours; give each of them as --with, in their order")
    said = shard.attributes.get("neighbour_sources", [])
    sources = said if isinstance(said, list) else []
    objects = [object_from_path(name, face_error_m=NEIGHBOUR_FACE_ERROR_M) for name in given] or [
        _load_neighbour(shard, *one) for one in zip_longest(names, digests, sources, fillvalue="")
    ]
    for obj, name, digest in zip(objects, names, digests, strict=True):
        if obj.digest != digest:
            raise ConflictError(
                f"the scene shard's neighbour {name!r} has digest {digest[:12]}, but {obj.name!r} has "
                f"{obj.digest[:12]}; give the files it was made with as --with"
            )
    return Neighbours(objects, np.asarray(shard["scene/neighbour_pose"], float))


def neighbour_attributes(others: Sequence[ObjectModel], given: Sequence[str]) -> dict[str, Attribute]:
    """Return a shard's attributes for other objects, given as files or names; empty if there are none."""
    if not others:
        return {}
    return {
        "neighbours": [other.name for other in others],
        "neighbour_digests": [other.digest for other in others],
        "neighbour_sources": [str(Path(name).resolve()) if Path(name).is_file() else "" for name in given],
    }


def _load_neighbour(shard: Shard, name: str, digest: str, source: str) -> ObjectModel:
    wanted = AssetReference(AssetKind.OBJECT, name, digest, source, folder=_folder_of(shard))
    return _load_object(wanted, find_files(wanted), NEIGHBOUR_FACE_ERROR_M)


def scenes_of_shard(shard: Shard) -> PlacedGrasps | None:
    """Return the scenes of a base shard's grasps or of episodes; None if planned around a free object.
    Raises InputError: the shard's scene attribute is invalid."""
    index = shard.arrays.get("grasp/scene_index", shard.arrays.get("episode/scene_index"))
    if "scene/object_pose" not in shard.arrays or index is None:
        return None
    if (spec := scene_spec_of(shard)) is None:
        raise InputError("the shard has grasps in scenes, but its attribute scene does not say which")
    scenes = Scenes(supports_of(spec), np.asarray(shard["scene/object_pose"], float))
    if (beside := neighbours_of_shard(shard, [])) is not None:
        neighbours = tuple(neighbour_of(other) for other in beside.objects)
        scenes = replace(scenes, neighbours=neighbours, neighbour_pose=beside.poses)
    return scenes.placed(np.asarray(index, np.intp))


def check_wrist_poses(shard: Shard, hand: str, obj: str, options: Mapping[str, Any]) -> None:
    """Check that wrist poses of a shard hold for a hand and an object with mesh options, by digest.
    Raises InputError: another object, or a hand of another name and digest."""
    said, file = shard.attributes, shard.path
    name, files, _ = object_files(Path(obj))
    digest = digest_variant(digest_files(AssetKind.OBJECT, files), options)
    if said.get("object_digest", digest) != digest:
        raise InputError(
            f"the grasps in {file} are of another object ({said['object']}) than {name}, or of other mesh options: a "
            "wrist pose is in the object's frame"
        )
    name, files, _ = hand_files(Path(hand))
    if said.get("hand", name) != name and said.get("hand_digest") != digest_files(AssetKind.HAND, files):
        raise InputError(
            f"the grasps in {file} are of {said['hand']}, and wrist frames of hands differ: use graspd transfer {file} "
            f"--hand {name}"
        )


def _check_digest(shard: Shard, kind: str, digest: str, given: str) -> None:
    expected = str(shard.attributes.get(f"{kind}_digest", ""))
    if expected != digest:
        raise ConflictError(
            f"the {shard.kind} shard was made with the {kind} of digest {expected[:12]}, but {given!r} has "
            f"{digest[:12]}; give the file it was made with as --{kind}"
        )


def id_of_columns(columns: Columns) -> str:
    """Return the id by which other shards name a shard that no job made: a digest of its columns."""
    found = hashlib.sha256()
    for name in sorted(columns):
        array = np.ascontiguousarray(columns[name])
        found.update(f"{name} {array.dtype.str} {array.shape} ".encode())
        found.update(array.tobytes())
    return found.hexdigest()


def source_attributes(source: Shard) -> dict[str, Attribute]:
    """Return the attribute by which a shard names `source`, the shard of its scenes or grasps."""
    return {f"{source.kind}_shard": str(source.attributes.get("shard_id") or id_of_columns(source.arrays))}


#: Attributes of the job that every later shard inherits.
INHERITED: Final = (
    *("hand", "hand_digest", "hand_source", "object", "object_digest", "object_source", "object_options"),
    *("method", "fidelity", "batch", "root_link"),
)


def base_attributes(
    hand: HandModel,
    obj: ObjectModel,
    request: JobOptions,
    *,
    candidates: int,
    verdict_key: str | None,
    outcomes: Mapping[str, int] = MappingProxyType({}),
) -> dict[str, Attribute]:
    """Return the attributes of a base shard: joints, request, scene, candidates, settings of validation.
    `candidates` is the number of candidates up to the last selected one. `verdict_key` is the digest of all settings
    that affect verdicts; None without validation. `outcomes` are the numbers of rejected candidates by reason."""
    said: dict[str, Attribute] = {
        "joint_names": list(hand.joint_names),
        "mu": request.friction,
        "root_link": hand.root_link,
        "object_mass_kg": obj.mass,
        "object_friction": obj.friction,
        "want": request.want,
        "candidates": candidates,
    }
    if outcomes:
        said["outcomes"] = json_attribute(dict(outcomes))
    if request.in_scene:
        said |= {"scene": json_attribute(request.scene_spec.to_attribute())} | wrist_attributes(hand)
    if request.requirements:
        said["requirements"] = json_attribute(request.requirements)
    if request.model_count:
        said["robust"] = json_attribute({"models": request.model_count, "wanted": request.robust})
    if request.second_engines:
        said["engines"] = ",".join(("mujoco", *request.second_engines))
    if verdict_key is None:
        return said | {"verdict_level": "none"}
    return said | {"verdict_level": request.validation, "verdict_key": verdict_key}


def wrist_attributes(hand: HandModel) -> dict[str, Attribute]:
    """Return the attributes that name the columns of `grasp/wrist_positions`, for grasps in scenes."""
    wrist = () if hand.mounting is None else hand.mounting.joint_names
    return {"wrist_joint_names": list(wrist)} if wrist else {}

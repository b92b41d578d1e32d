"""Files of proposal networks: `.npz` of schema `graspd/proposals@1`, arrays and a JSON text, no code.

The architecture is fixed: the number of joints decides the shapes of all arrays. `baselines.learned.network` evaluates
the network.
"""

from __future__ import annotations

import io
import zipfile
import zlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any, Final, Literal

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from graspd.service.model.base import Digest, Name, first_error
from graspd.service.model.digests import digest_bytes
from graspd.service.model.errors import InputError, LimitError
from graspd.service.store.assets import asset_json
from graspd.service.store.descriptions import parse_description, parse_json_object

SCHEMA: Final = "graspd/proposals@1"
#: Size limit of a file [bytes], packed or unpacked; a network of 22 joints takes 5.4 MB.
MAX_BYTES: Final = 64 << 20
#: Number of point features, and widths of the encoder's layers before the maximum over points.
ENCODER: Final = (7, 64, 128, 256)
FEATURE: Final = 256
#: Size of the condition: feature of the cloud, its height above the table, and the label.
CONDITION: Final = FEATURE + 2
TIME_FEATURES: Final = 8
HIDDEN: Final = 512
BLOCKS: Final = 2
#: Number of values of a grasp besides its joints: position, two columns of the rotation, approach direction.
POSE: Final = 12
_META: Final = "meta"
_SHARED: Final = ("hand", "hand_digest", "joint_names", "points", "steps", "about")
#: Exceptions of the readers for bytes that are no archive of arrays.
_BROKEN: Final = (OSError, ValueError, EOFError, KeyError, MemoryError, RuntimeError, zipfile.BadZipFile, zlib.error)
#: Size limits of the text array (four bytes per character) and of the header of an array [bytes].
_MOST_META: Final = 4 * (64 << 10)
_HEADER: Final = 4096
Floats32 = NDArray[np.float32]


class _Meta(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", protected_namespaces=())

    schema_: Literal["graspd/proposals@1"] = Field(alias="schema")
    hand: Name
    hand_digest: Digest
    joint_names: tuple[Annotated[str, Field(min_length=1, max_length=200)], ...] = Field(min_length=1, max_length=128)
    points: int = Field(ge=16, le=16384)
    steps: int = Field(ge=1, le=256)
    sizes: dict[str, tuple[int, ...]]
    about: str = Field("", max_length=4000)

    @model_validator(mode="after")
    def _check_joints(self) -> _Meta:
        if len(set(self.joint_names)) != len(self.joint_names):
            raise ValueError("a joint is named twice")
        if self.sizes != layer_sizes(len(self.joint_names)):
            raise ValueError(f"sizes of this schema are {layer_sizes(len(self.joint_names))}")
        return self


@dataclass(frozen=True)
class ProposalNetwork:
    """Conditional flow that proposes grasps from a point cloud; J joints, D = 12 + 3 J values per grasp."""

    hand: str
    hand_digest: str
    joint_names: tuple[str, ...]
    """(J,) all moving joints, as in `HandModel.joint_names`."""
    weights: Mapping[str, Floats32]
    """Arrays with the names of `weight_shapes`; `.weight` (out, in) and `.bias` (out,), as in torch's `Linear`."""
    mean: Floats32
    """(D,) mean of the training grasps."""
    std: Floats32
    """(D,) standard deviation of the training grasps, positive."""
    points: int = 512
    steps: int = 16
    about: str = field(default="", kw_only=True)

    @property
    def row_size(self) -> int:
        return row_size(len(self.joint_names))


def row_size(joints: int) -> int:
    return POSE + 3 * joints


def layer_sizes(joints: int) -> dict[str, tuple[int, ...]]:
    return {
        "encoder": (*ENCODER, FEATURE),
        "condition": (CONDITION,),
        "flow": (row_size(joints) + TIME_FEATURES + CONDITION, *(HIDDEN,) * (1 + BLOCKS), row_size(joints)),
    }


def weight_shapes(joints: int) -> dict[str, tuple[int, ...]]:
    count = row_size(joints)
    layers = {f"encoder.{i}": (out, into) for i, (into, out) in enumerate(pairwise(ENCODER))}
    layers["encoder.out"] = (FEATURE, ENCODER[-1])
    layers["flow.in"] = (HIDDEN, count + TIME_FEATURES + CONDITION)
    layers |= {f"flow.{i}.{part}": (HIDDEN, HIDDEN) for i in range(BLOCKS) for part in "ab"}
    layers["flow.out"] = (count, HIDDEN)
    shapes: dict[str, tuple[int, ...]] = {}
    for name, shape in layers.items():
        shapes |= {f"{name}.weight": shape, f"{name}.bias": shape[:1]}
    return shapes


def to_bytes(network: ProposalNetwork) -> bytes:
    """Serialise a network; InputError if `from_bytes` would reject it."""
    joints = len(network.joint_names)
    try:
        meta = _Meta(schema=SCHEMA, sizes=layer_sizes(joints), **{name: getattr(network, name) for name in _SHARED})
    except ValidationError as error:
        raise InputError(f"the network cannot be written: {first_error(error)}") from None
    found = {"mean": network.mean, "std": network.std, **network.weights}
    arrays = {name: np.asarray(array, np.float32) for name, array in found.items()}
    _check_arrays(arrays, joints, "the network cannot be written")
    buffer = io.BytesIO()
    members: dict[str, Any] = {_META: np.array(meta.model_dump_json(by_alias=True)), **arrays}
    np.savez(buffer, **members)
    return buffer.getvalue()


def read_file(path: Path) -> bytes:
    """Read a file; InputError if it is unreadable, LimitError if it is too large for a network."""
    try:
        with Path(path).open("rb") as file:
            data = file.read(MAX_BYTES + 1)
    except OSError as error:
        raise InputError(f"the network {path} cannot be read: {error.strerror}") from None
    check_size(len(data), str(path))
    return data


def from_bytes(data: bytes, what: str) -> ProposalNetwork:
    """Parse a network file, named `what` in messages; LimitError if too large, InputError if invalid."""
    check_size(len(data), what)
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            meta = _read_meta(archive, what)
            joints = len(meta.joint_names)
            expected = _expected_shapes(joints)
            found = sorted(info.filename for info in archive.infolist())
            if found != sorted(f"{name}.npy" for name in [_META, *expected]):
                raise InputError(f"{what}: its arrays differ from {SCHEMA}: {_difference_text(found, expected)}")
            arrays = {name: _read_array(archive, name, shape, what) for name, shape in expected.items()}
    except _BROKEN as error:
        raise InputError(f"{what} is no .npz file of {SCHEMA}: {error}") from None
    _check_arrays(arrays, joints, what)
    for array in arrays.values():
        array.flags.writeable = False
    mean, std = arrays.pop("mean"), arrays.pop("std")
    return ProposalNetwork(weights=arrays, mean=mean, std=std, **{name: getattr(meta, name) for name in _SHARED})


def check_size(size: int, what: str) -> None:
    if size > MAX_BYTES:
        raise LimitError(f"{what} has more than {MAX_BYTES >> 20} MiB; a proposal network is smaller")


def _expected_shapes(joints: int) -> dict[str, tuple[int, ...]]:
    return {"mean": (row_size(joints),), "std": (row_size(joints),), **weight_shapes(joints)}


def _read_meta(archive: zipfile.ZipFile, what: str) -> _Meta:
    data = _read_member(archive, _META, _MOST_META + _HEADER)
    shape, dtype = _read_header(data)
    if shape != () or dtype.kind != "U":
        raise InputError(f"{what}: {_META} must be one text")
    text = str(npy.read_array(io.BytesIO(data), allow_pickle=False)[()])
    try:
        return _Meta.model_validate(parse_json_object(text, f"{what}: {_META}"))
    except ValidationError as error:
        raise InputError(f"{what}: {_META}: {first_error(error)}") from None


def _read_array(archive: zipfile.ZipFile, name: str, shape: tuple[int, ...], what: str) -> Floats32:
    """Read an array whose header matches the schema."""
    data = _read_member(archive, name, 4 * int(np.prod(shape)) + _HEADER)
    found, dtype = _read_header(data)
    if found != shape or dtype != np.dtype("<f4"):
        raise InputError(f"{what}: {name} is {dtype.name} {found}; {SCHEMA} has float32 {shape}")
    return np.asarray(npy.read_array(io.BytesIO(data), allow_pickle=False), np.float32)


def _read_member(archive: zipfile.ZipFile, name: str, limit: int) -> bytes:
    member = archive.getinfo(f"{name}.npy")
    if member.file_size > limit:
        raise ValueError(f"{name} unpacks to {member.file_size} bytes")
    return archive.read(member)


def _read_header(data: bytes) -> tuple[tuple[int, ...], np.dtype[Any]]:
    file = io.BytesIO(data)
    version = npy.read_magic(file)
    if version not in ((1, 0), (2, 0)):
        raise ValueError(f"version {version} of NumPy's format")
    shape, _, dtype = (npy.read_array_header_1_0 if version == (1, 0) else npy.read_array_header_2_0)(file)
    return shape, dtype


def _check_arrays(arrays: Mapping[str, Floats32], joints: int, what: str) -> None:
    expected = _expected_shapes(joints)
    if set(arrays) != set(expected):
        raise InputError(f"{what}: {_difference_text([f'{name}.npy' for name in arrays], expected)}")
    for name, shape in expected.items():
        if arrays[name].shape != shape:
            raise InputError(f"{what}: {name} has shape {arrays[name].shape}; {joints} joints need {shape}")
        if not np.isfinite(arrays[name]).all():
            raise InputError(f"{what}: {name} has a number that is not finite")
    if not (arrays["std"] > 0).all():
        raise InputError(f"{what}: std must be positive")


def _difference_text(found: list[str], expected: Mapping[str, object]) -> str:
    wanted = {f"{name}.npy" for name in [_META, *expected]}
    missing, foreign = sorted(wanted - {*found, f"{_META}.npy"}), sorted(set(found) - wanted)
    parts = [f"{word} {', '.join(names[:4])}" for word, names in (("without", missing), ("besides", foreign)) if names]
    return "; ".join(parts) or "a name occurs twice"


#: Name of the file in its archive, independent of the upload: equal networks are equal assets.
NETWORK_FILE: Final = "network.npz"


def network_bytes(files: Mapping[str, bytes], what: str) -> bytes:
    """Return the network in an asset; InputError if it is missing, or if `asset.json` has unknown keys."""
    description = parse_description(asset_json(files), what)
    if description.file not in files:
        raise InputError(f"{what}: the main file {description.file!r} is not among its files")
    if extra := sorted(description.model_extra or {}):
        raise InputError(f"{what}: a network has no {extra[0]!r}; it may have a description, a licence and a source")
    return files[description.file]


def network_report(files: Mapping[str, bytes], name: str) -> dict[str, Any]:
    """Return the report of the check of a network; InputError if it is refused."""
    data = network_bytes(files, name)
    network = from_bytes(data, name)
    joints = len(network.joint_names)
    facts = {
        "hand": network.hand,
        "hand_digest": network.hand_digest,
        "joints": joints,
        "points": network.points,
        "steps": network.steps,
        "about": "".join(letter for letter in " ".join(network.about.split()) if letter.isprintable()),
        "file_digest": digest_bytes(data),  # Also in shards of `graspd synth`.
    }
    message = f"{name}: proposes grasps of {network.hand} ({network.hand_digest[:12]}), {joints} joints"
    return {"verdict": "accept", "message": message, "repairs": [], "facts": facts}


def check_network(files: Mapping[str, bytes], name: str) -> dict[str, Any]:
    try:
        return network_report(files, name)
    except InputError as error:
        return {"verdict": "refuse", "message": str(error), "repairs": [], "facts": {}}

"""The HDF5 schema of shards: every dataset's shape, unit and meaning. Written and read here only."""

from __future__ import annotations

import hashlib
import io
import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Literal

import h5py
import numpy as np
from numpy.typing import NDArray

from service.model.clock import timestamp
from service.model.errors import DamagedShard, InputError
from service.model.metrics import GRASP_METRICS
from service.model.robust import MEANINGS
from service.model.version import PACKAGE_VERSION
from service.store.attributes import Attribute, check_attributes
from service.store.integrity import check_file

ShardKind = Literal["base", "scene", "views"]
Arrays = Mapping[str, NDArray[np.generic]]
#: Attribute of each dataset: SHA-256 of its values, so that a file that left the store still shows damage.
_DIGEST: Final = "sha256"
#: What h5py and the filters of HDF5 raise where they meet bytes that make no sense.
_UNREADABLE: Final = (OSError, KeyError, ValueError, TypeError, RuntimeError, OverflowError, MemoryError)


@dataclass(frozen=True)
class Column:
    """One dataset of a shard. Letters of `shape` that repeat must have one length throughout the shard."""

    shape: str
    dtype: str
    units: str
    frame: str
    description: str
    optional: bool = False


_POSE = "position x y z [m] and unit quaternion w x y z of the hand's root link"


def _posture(prefix: str, what: str) -> dict[str, Column]:
    return {
        f"{prefix}/hand_pose": Column("N 7", "f8", "m, 1", "object", f"{what}: {_POSE}"),
        f"{prefix}/joint_positions": Column(
            "N J", "f8", "rad or m", "joint", f"{what}: all moving joints, order in attribute joint_names"
        ),
    }


def _measured(*, optional: bool) -> dict[str, Column]:
    return {
        metric.path: Column(
            "N T" if metric.swept else "N",
            "i4" if metric.whole else "f8",
            metric.units,
            "none",
            metric.meaning,
            optional,
        )
        for metric in GRASP_METRICS
        if metric.optional == optional
    }


SCHEMAS: Final[dict[ShardKind, dict[str, Column]]] = {
    "base": {
        **_posture("grasp", "posture at contact"),
        **_posture("pregrasp", "posture before contact, fingers clear of the object"),
        **_posture("squeeze", "commanded posture that presses on the object"),
        "quality/thresholds_m": Column("T", "f8", "m", "none", "contact thresholds of the sweep"),
        **_measured(optional=False),
        "quality/valid": Column(
            "N", "u1", "bool", "none", "1: sound, and the referee judged that it holds; 0 where nobody judged"
        ),
        "quality/sound": Column("N", "u1", "bool", "none", "1: passed the geometric gate", optional=True),
        "quality/success": Column(
            "N",
            "i1",
            "bool",
            "none",
            "verdict of the referee at the level of attribute verdict_level: 1 held, 0 dropped, -1 not tested",
            optional=True,
        ),
        "quality/verdict_outcome": Column(
            "N D",
            "u1",
            "enum",
            "none",
            "of each push +x -x +y -y +z -z: 0 not tried, 1 held, 2 penetration, 3 lost while closing, 4 displaced, "
            "5 rotated, 6 diverged",
            optional=True,
        ),
        "quality/verdict_margin": Column(
            "N",
            "f8",
            "1",
            "none",
            "worst displacement or rotation of the pushes over its limit; below 1: held",
            optional=True,
        ),
        "quality/judged_by": Column(
            "N",
            "u1",
            "enum",
            "none",
            "whose verdict success is: 0 MuJoCo on the CPU, which alone certifies, 1 MuJoCo Warp, the first judge",
            optional=True,
        ),
        "quality/audit": Column(
            "N",
            "i1",
            "bool",
            "none",
            "verdict by the letter of the protocol: 1 held, 0 dropped, -1 not audited",
            optional=True,
        ),
        "quality/published": Column(
            "N", "i1", "bool", "none", "imported grasps: verdict that came with them: 1 held, 0 dropped, -1 none", True
        ),
        **_measured(optional=True),
        "quality/robust_weakest": Column(
            "N",
            "u1",
            "enum",
            "none",
            "what differed in the first model around the nominal one in which it does not hold: 0 none, "
            + ", ".join(f"{axis:d} {words}" for axis, words in MEANINGS.items()),
            optional=True,
        ),
        # Grasps that were planned for a scene say which, and how they are reached and lifted there.
        "scene/object_pose": Column(
            "S 7", "f8", "m, 1", "scene", "object frame at rest in each scene; z is up", optional=True
        ),
        "scene/rest_probability": Column(
            "S",
            "f8",
            "1",
            "none",
            "share of drops that come to rest on the same face of the convex hull",
            optional=True,
        ),
        "scene/neighbour_pose": Column(
            "S M 7",
            "f8",
            "m, 1",
            "scene",
            "frames of the other objects in each scene; names in attribute neighbours",
            optional=True,
        ),
        "grasp/scene_index": Column("N", "i4", "1", "none", "row of the grasp's scene in /scene", optional=True),
        "grasp/approach": Column(
            "N W 7",
            "f8",
            "m, 1",
            "object",
            f"way in from the standoff to the pregrasp, in the joints of approach_joint_positions: {_POSE}",
            optional=True,
        ),
        "grasp/approach_joint_positions": Column(
            "N J", "f8", "rad or m", "joint", "joints of the open hand that comes, order in joint_names", optional=True
        ),
        "grasp/lift": Column("N 7", "f8", "m, 1", "object", f"squeeze posture raised by 10 cm: {_POSE}", optional=True),
        "quality/lift_outcome": Column(
            "N",
            "u1",
            "enum",
            "none",
            "lift test: 0 not tried, 1 lifted, 2 penetration, 3 touched on the way, 4 lost while closing, 5 not lifted,"
            " 6 turned, 7 diverged, 8 neighbour moved",
            optional=True,
        ),
        "quality/lift_hard": Column(
            "N", "i1", "bool", "none", "lift test at half the friction: 1 lifted, 0 not, -1 not tested", optional=True
        ),
        "quality/pushes": Column(
            "N", "i1", "bool", "none", "six pushes without the scene: 1 held, 0 dropped, -1 not tested", optional=True
        ),
    },
    "scene": {
        "scene/object_pose": Column("S 7", "f8", "m, 1", "table", "object frame at rest; table top is z = 0"),
        "scene/rest_probability": Column(
            "S", "f8", "1", "none", "share of drops that come to rest on the same face of the convex hull"
        ),
        "scene/drop_seconds": Column("S", "f8", "s", "none", "simulated time until rest"),
        "grasp/base_index": Column("K", "i4", "1", "none", "row of the grasp in the base shard"),
        "grasp/scene_index": Column("K", "i4", "1", "none", "row of the scene in /scene"),
        "grasp/hand_pose": Column("K 7", "f8", "m, 1", "table", f"posture at contact: {_POSE}"),
        "grasp/table_clearance_m": Column(
            "K", "f8", "m", "table", "lowest point of the hand above the table at contact and on the way in"
        ),
        "grasp/valid": Column("K", "u1", "bool", "none", "1: hand clear of what is around, at contact and before"),
        "grasp/rejection": Column(
            "K",
            "u1",
            "enum",
            "none",
            "0 kept; too near to: 1 the table at contact, 2 the table on approach, 3 a neighbour at contact, "
            "4 a neighbour on approach",
            optional=True,
        ),
        "grasp/contact_table_clearance_m": Column(
            "K", "f8", "m", "table", "lowest point of the hand above the table at contact", optional=True
        ),
        "grasp/neighbour_clearance_m": Column(
            "K",
            "f8",
            "m",
            "table",
            "signed distance of the hand from the neighbours' convex hulls at contact and on the way in, at most 0.1",
            optional=True,
        ),
        "scene/neighbour_pose": Column(
            "S M 7",
            "f8",
            "m, 1",
            "table",
            "frames of the other objects at rest; names in attribute neighbours",
            optional=True,
        ),
    },
    "views": {
        "camera/intrinsics": Column("V 3 3", "f8", "px", "image", "pinhole K; pixel centres at +0.5"),
        "camera/extrinsics": Column(
            "V 4 4",
            "f8",
            "m, 1",
            "table -> camera",
            "x_camera = E x_table; camera x right, y down, z forward",
        ),
        "camera/scene_index": Column("V", "i4", "1", "none", "row of the scene in the scene shard"),
        "camera/eye": Column("V", "u1", "enum", "none", "0 mono, 1 left, 2 right"),
        "camera/stereo_baseline_m": Column(
            "V", "f8", "m", "camera", "distance of the right eye from the left; 0: mono"
        ),
        "image/rgb": Column("V H W 3", "u1", "sRGB", "image", "colour"),
        "image/depth": Column("V H W", "f4", "m", "camera", "distance along the optical axis; inf: nothing there"),
        "image/segmentation": Column(
            "V H W", "u1", "enum", "image", "0 background, 1 table, 2 object, 3 + m: neighbour m"
        ),
        "box/bounding_box_2d_tight": Column(
            "V 4",
            "f4",
            "px",
            "image",
            "x_min y_min x_max y_max of the visible object pixels; nan: not visible",
        ),
        "box/bounding_box_2d_loose": Column(
            "V 4", "f4", "px", "image", "x_min y_min x_max y_max of the projected object, occluded or not"
        ),
        "box/bounding_box_3d": Column("V 8 3", "f4", "m", "camera", "corners of the object-aligned box"),
        "box/occlusion_ratio": Column(
            "V", "f4", "1", "image", "share of the object's pixels that is hidden; nan: not in view", optional=True
        ),
        "image/distance": Column(
            "V H W", "f4", "m", "camera", "distance from the optical centre; inf: nothing there", optional=True
        ),
        "image/normals": Column(
            "V H W 3", "f2", "1", "table", "unit shading normal, outward; 0 0 0: nothing there", optional=True
        ),
        "image/rgb_hand": Column(
            "V H W 3", "u1", "sRGB", "image", "colour with the hand in its grasp pose, for people", optional=True
        ),
        "camera/hand_grasp": Column(
            "V", "i4", "1", "none", "row of the grasp that rgb_hand shows in the scene shard; -1: none", optional=True
        ),
    },
}


def write_shard(kind: ShardKind, arrays: Arrays, attributes: Mapping[str, Attribute]) -> bytes:
    """HDF5 bytes of a shard.

    Args:
        kind: base, scene or views.
        arrays: one array for each column of `SCHEMAS[kind]`; optional columns may be absent.
        attributes: root attributes besides `schema`; `created` and `code_version` where they are not those of now;
            `joint_names` also goes to the joint datasets.

    Raises:
        InputError: a column is missing, unknown, of the wrong rank, or lengths clash; or an attribute is unknown.
    """
    check_columns(kind, arrays)
    check_attributes(kind, attributes)
    buffer = io.BytesIO()
    with h5py.File(buffer, "w", libver="v110") as file:
        # Each is written once: HDF5 keeps the bytes of a text that was written over.
        said = {"schema": f"graspd/{kind}@1", "code_version": PACKAGE_VERSION, "created": timestamp(), **attributes}
        for name, value in said.items():
            file.attrs[name] = value
        for path, array in arrays.items():
            column = SCHEMAS[kind][path]
            data = np.ascontiguousarray(array, dtype=column.dtype)
            # Pictures compress well; shuffling bytes first makes float depth compress at all.
            options: dict[str, Any] = {}
            if data.ndim >= 3 and data.nbytes > 65536:
                # One row is one picture: a reader that wants it unpacks nothing else.
                options = {
                    "compression": "gzip",
                    "compression_opts": 1,
                    "shuffle": True,
                    "chunks": (1, *data.shape[1:]),
                }
            dataset = file.create_dataset(path, data=data, track_times=False, **options)
            dataset.attrs["units"] = column.units
            dataset.attrs["frame"] = column.frame
            dataset.attrs["description"] = column.description
            dataset.attrs[_DIGEST] = _digest(data)
            if path.endswith("joint_positions") and "joint_names" in attributes:
                dataset.attrs["joint_names"] = attributes["joint_names"]
    return buffer.getvalue()


def check_columns(kind: ShardKind, arrays: Arrays) -> dict[str, int]:
    """Lengths of the shape letters (N, T, S, ...); raises InputError where the arrays do not fit the schema."""
    schema = SCHEMAS[kind]
    if unknown := set(arrays) - set(schema):
        raise InputError(f"a {kind} shard has no dataset {sorted(unknown)[0]!r}")
    if missing := [path for path, column in schema.items() if not column.optional and path not in arrays]:
        raise InputError(f"a {kind} shard needs the dataset {missing[0]!r}")
    lengths: dict[str, int] = {}
    for path, array in arrays.items():
        letters = schema[path].shape.split()
        if len(letters) != array.ndim:
            raise InputError(f"{path} has {array.ndim} axes; the schema says ({', '.join(letters)})")
        for letter, length in zip(letters, array.shape, strict=True):
            expected = int(letter) if letter.isdigit() else lengths.setdefault(letter, length)
            if expected != length:
                raise InputError(f"{path}: axis {letter} has length {length}, expected {expected}")
    return lengths


@dataclass(frozen=True)
class Shard:
    """A shard in memory."""

    kind: ShardKind
    attributes: dict[str, Attribute]
    arrays: dict[str, NDArray[np.generic]]
    path: Path | None = None
    """The file it was read from."""

    def __getitem__(self, path: str) -> NDArray[np.generic]:
        return self.arrays[path]


def read_shard(
    source: bytes | Path, *, kind: ShardKind | None = None, without: tuple[str, ...] = (), name: str = ""
) -> Shard:
    """Read a shard whole, except the datasets named in `without`.

    Args:
        name: what errors call a shard that is given as bytes.

    Raises:
        InputError: not HDF5, not a graspd shard, or not of the wanted kind.
        DamagedShard: it is not what its checksums say, or cannot be read to its end.
    """
    name = name or ("shard" if isinstance(source, bytes) else str(source))
    with open_shard(source, name=name) as file:
        found = kind_of(file, name)
        if kind is not None and found != kind:
            raise InputError(f"{name} is a {found} shard; a {kind} shard is needed here")
        arrays = {p: read_column(file, p, name) for p in SCHEMAS[found] if p in file and p not in without}
        attributes = {k: _attribute(v) for k, v in file.attrs.items()}
    return Shard(found, attributes, arrays, None if isinstance(source, bytes) else source)


@contextmanager
def open_shard(source: bytes | Path | io.RawIOBase, *, name: str = "") -> Iterator[h5py.File]:
    """The HDF5 file of a shard, for reading what is needed of it; one in a folder is checked first: `check_file`.

    Raises:
        InputError: not HDF5.
        DamagedShard: it is not what its checksum says, or cannot be read, here or in the body.
    """
    name = name or (str(source) if isinstance(source, Path) else "shard")
    if isinstance(source, Path) and source.is_file():
        check_file(source)
    try:
        file = h5py.File(io.BytesIO(source) if isinstance(source, bytes) else source, "r")
    except OSError as error:
        raise InputError(f"{name} is not a readable HDF5 file: {error}") from None
    with file:
        try:
            yield file
        except _UNREADABLE as error:
            raise DamagedShard(f"{name} is damaged and cannot be read: {_line(error)}") from error


def kind_of(file: h5py.File, name: str) -> ShardKind:
    """Kind of an open shard; InputError if it is none of graspd's."""
    schema = str(file.attrs.get("schema", ""))
    found = schema.removeprefix("graspd/").partition("@")[0]
    if not schema.startswith("graspd/") or found not in SCHEMAS:
        raise InputError(f"{name} is no graspd shard (attribute schema is {schema!r})")
    return found


def read_column(file: h5py.File, path: str, name: str) -> NDArray[Any]:
    """A dataset whole; DamagedShard if its values are not those that were written."""
    dataset = file[path]
    data = np.asarray(dataset)
    if (expected := dataset.attrs.get(_DIGEST)) is not None and _digest(data) != expected:
        raise DamagedShard(f"{name} is damaged: the values of {path} are not those that were written")
    return data


def _digest(data: NDArray[Any]) -> str:
    return hashlib.sha256(np.ascontiguousarray(data).data).hexdigest()


def _line(error: BaseException) -> str:
    return (str(error).strip().splitlines() or [type(error).__name__])[0]


def _attribute(value: object) -> Attribute:
    if isinstance(value, np.ndarray):
        return [str(v) for v in value]
    if isinstance(value, np.generic):
        return value.item()
    return value if isinstance(value, int | float) else str(value)


def json_attribute(value: object) -> str:
    """A JSON text fit for an HDF5 attribute."""
    return json.dumps(value, sort_keys=True)

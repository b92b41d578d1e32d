"""Reading and writing of shards as HDF5 files; `columns` has the schema."""

import hashlib
import io
import json
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any, Final

import h5py
import numpy as np
from numpy.typing import NDArray

from graspd.service.model.base import first_line
from graspd.service.model.clock import timestamp
from graspd.service.model.digests import digest_json
from graspd.service.model.errors import DamagedShard, InputError, NotFoundError
from graspd.service.model.renamed import COLUMNS, convert_names
from graspd.service.model.version import PACKAGE_VERSION
from graspd.service.store.columns import SCHEMAS, Attribute, ShardKind, check_attributes, schema_name
from graspd.service.store.integrity import check_file

Arrays = Mapping[str, NDArray[np.generic]]
#: Attribute of each dataset with the SHA-256 of its values, to detect damage outside the store.
_DIGEST: Final = "sha256"
#: Maximum number of datasets and groups in a file; a shard has about fifty.
_MOST_ITEMS: Final = 1000
#: Limit of a dataset: largest expansion factor of deflate, plus a size without stored data [bytes].
_MOST_DEFLATED: Final = 1032
_FREE_BYTES: Final = 1 << 16
#: Limit of a file's unpacked size: a constant [bytes] plus a multiple of the stored size. Masks compress by a factor of
#: a thousand, but no shard consists of masks alone.
_FREE_IN_ALL: Final = 1 << 28
_MOST_IN_ALL: Final = 64
_UNREADABLE: Final = (OSError, KeyError, ValueError, TypeError, RuntimeError, OverflowError, MemoryError)


def write_shard(kind: ShardKind, arrays: Arrays, attributes: Mapping[str, Attribute]) -> bytes:
    """Return the HDF5 bytes of a shard; InputError if a column or attribute does not fit the schema.

    Given `created` and `code_version` replace the current values. Joint datasets also have the attribute `joint_names`.
    """
    check_columns(kind, arrays)
    check_attributes(kind, attributes)
    buffer = io.BytesIO()
    with h5py.File(buffer, "w", libver="v110") as file:
        # Each attribute is written only once, because HDF5 files keep overwritten text.
        own = {"schema": schema_name(kind), "code_version": PACKAGE_VERSION, "created": timestamp()}
        for name, value in {**own, **attributes}.items():
            file.attrs[name] = value
        for path, array in arrays.items():
            column = SCHEMAS[kind][path]
            data = np.ascontiguousarray(array, dtype=column.dtype)
            layout: dict[str, Any] = {}
            if data.ndim >= 3 and data.nbytes > 65536:
                # One chunk per picture, so that readers unpack single pictures; shuffled bytes compress better.
                layout = {"compression": "gzip", "compression_opts": 1, "shuffle": True, "chunks": (1, *data.shape[1:])}
            dataset = file.create_dataset(path, data=data, track_times=False, **layout)
            for name in ("units", "frame", "description"):
                dataset.attrs[name] = getattr(column, name)
            dataset.attrs[_DIGEST] = _array_digest(data)
            if path.endswith("joint_positions") and "joint_names" in attributes:
                dataset.attrs["joint_names"] = attributes["joint_names"]
    return buffer.getvalue()


def check_columns(kind: ShardKind, arrays: Arrays) -> dict[str, int]:
    """Return the length of each axis; InputError if names or shapes do not fit the schema."""
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
            if expected != length and letter != "*":
                raise InputError(f"{path}: axis {letter} has length {length}, expected {expected}")
    return lengths


@dataclass(frozen=True)
class Shard:
    kind: ShardKind
    attributes: dict[str, Attribute]
    arrays: dict[str, NDArray[np.generic]]
    path: Path | None = None

    def __getitem__(self, path: str) -> NDArray[np.generic]:
        return self.arrays[path]


def read_shard(
    source: bytes | Path, *, kind: ShardKind | None = None, without: tuple[str, ...] = (), name: str = ""
) -> Shard:
    """Read a shard, but not the datasets `without`; InputError for another kind, DamagedShard for damage."""
    name = name or ("shard" if isinstance(source, bytes) else str(source))
    with open_shard(source, name=name) as file:
        found = shard_kind(file, name)
        if kind is not None and found != kind:
            raise InputError(
                f"{name} is a {found} shard; a {kind} shard is needed here".replace("a episodes", "an episodes")
            )
        arrays = {p: read_column(file, p, name) for p in SCHEMAS[found] if p in file and p not in without}
        attributes = {k: _decode_attribute(v) for k, v in file.attrs.items()}
    return Shard(found, attributes, arrays, None if isinstance(source, bytes) else source)


class ShardH5(h5py.File):  # type: ignore[misc]
    """HDF5 file of a shard. Columns and attributes of graspd 0.2 have their present names."""

    def __contains__(self, path: object) -> bool:
        return super().__contains__(path) or (path in COLUMNS and super().__contains__(COLUMNS[str(path)]))

    def __getitem__(self, path: Any) -> Any:
        return super().__getitem__(COLUMNS[path] if path in COLUMNS and not super().__contains__(path) else path)

    @property
    def attrs(self) -> dict[str, Any]:
        return dict(convert_names(dict(super().attrs)))


@contextmanager
def open_shard(source: bytes | Path, *, name: str = "") -> Iterator[h5py.File]:
    """Open a shard for partial reads; DamagedShard, also in the `with` block, for damage."""
    name = name or (str(source) if isinstance(source, Path) else "shard")
    if isinstance(source, Path) and source.is_file():
        check_file(source)
    try:
        file = ShardH5(io.BytesIO(source) if isinstance(source, bytes) else source, "r")
    except OSError:
        if isinstance(source, Path) and not source.is_file():
            raise NotFoundError(f"{name} does not exist, or is no file") from None
        raise InputError(f"{name} is not a readable HDF5 file; give a shard of graspd (.h5)") from None
    with file:
        try:
            _check_contents(file, name)
            yield file
        except _UNREADABLE as error:
            raise DamagedShard(f"{name} is damaged and cannot be read: {first_line(error)}") from error


def _check_contents(file: h5py.File, name: str) -> None:
    """Raise InputError for links and external data, which HDF5 would follow, and for impossible sizes."""
    claimed = held = 0
    seen, waiting = {h5py.h5o.get_info(file["/"].id).addr}, [(file, "")]
    while waiting:
        group, place = waiting.pop()
        for key in group:
            path = f"{place}{key}"
            if len(seen) > _MOST_ITEMS:
                raise InputError(f"{name} holds more than {_MOST_ITEMS} datasets and groups, too many for a shard")
            is_hard = isinstance(group.get(key, getlink=True), h5py.HardLink)
            if not is_hard or (address := h5py.h5o.get_info(group[key].id).addr) in seen:
                raise InputError(f"{name}: {path} is a link; a shard contains no links")
            item = group[key]
            seen.add(address)
            if isinstance(item, h5py.Group):
                waiting.append((item, f"{path}/"))
            elif not isinstance(item, h5py.Dataset) or item.is_virtual or item.external:
                raise InputError(f"{name}: {path} has its values in another file; a shard holds its own")
            else:
                size = item.id.get_storage_size()
                claimed, held = claimed + item.nbytes, held + size
                if item.nbytes > _MOST_DEFLATED * size + _FREE_BYTES:
                    raise InputError(f"{name}: {path} claims {item.nbytes} bytes, which the file cannot contain")
    if claimed > _MOST_IN_ALL * held + _FREE_IN_ALL:
        raise InputError(f"{name} claims {claimed} bytes, {claimed // held} times its content, too much for a shard")


def shard_kind(file: h5py.File, name: str) -> ShardKind:
    schema = str(file.attrs.get("schema", ""))
    found = schema.removeprefix("graspd/").partition("@")[0]
    if not schema.startswith("graspd/") or found not in SCHEMAS:
        raise InputError(f"{name} is no graspd shard (attribute schema is {schema!r})")
    return found


def read_column(file: h5py.File, path: str, name: str) -> NDArray[Any]:
    dataset = file[path]
    data = np.asarray(dataset)
    if (expected := dataset.attrs.get(_DIGEST)) is not None and _array_digest(data) != expected:
        raise DamagedShard(f"{name} is damaged: the values of {path} changed since they were written")
    return data


def _array_digest(data: NDArray[Any]) -> str:
    return hashlib.sha256(np.ascontiguousarray(data).data).hexdigest()


def _decode_attribute(value: object) -> Attribute:
    if isinstance(value, np.ndarray):
        return [*map(str, value)]
    if isinstance(value, np.generic):
        return value.item()
    return value if isinstance(value, int | float) else str(value)


def json_attribute(value: object) -> str:
    return json.dumps(value, sort_keys=True)


def inherited_attributes(shard: Shard) -> dict[str, Attribute]:
    return {name: value for name, value in shard.attributes.items() if name != "schema"}


def shard_bytes_of_rows(shard: Shard, mask: NDArray[np.bool_]) -> bytes:
    """Return the bytes of a base shard with the rows in a mask (N,); values and scenes are unchanged."""
    axes = {path: column.shape.split()[0] for path, column in SCHEMAS["base"].items()}
    arrays = {path: array[mask] if axes[path] == "N" else array for path, array in shard.arrays.items()}
    attributes = inherited_attributes(shard)
    if "shard_id" in attributes:
        attributes["shard_id"] = digest_json([attributes["shard_id"], np.flatnonzero(mask).tolist()])
    return write_shard("base", arrays, attributes)


def relative_path_of(shard: Shard, taken: Collection[PurePosixPath]) -> PurePosixPath:
    """Return `HAND/OBJECT/base-BATCH.h5`, numbered if taken: two jobs may have equal batch numbers."""
    given = shard.attributes
    names = [str(given.get(name, "")).replace("/", "-").strip(".") or "unnamed" for name in ("hand", "object")]
    path = PurePosixPath(*names) / f"base-{int(given.get('batch', 0)):05}.h5"  # type: ignore[arg-type]
    found, number = path, 1
    while found in taken:
        found, number = path.with_stem(f"{path.stem}-{number}"), number + 1
    return found

"""Files of hands and objects: reproducible ZIPs (sorted names, fixed times), and built-in files."""

import hashlib
import io
import shutil
import zipfile
import zlib
from collections.abc import Iterator, Mapping, MutableMapping
from contextlib import contextmanager
from importlib import resources
from pathlib import Path, PurePosixPath
from typing import IO, Final, Literal, Self, TypeVar

from graspd.service.model.digests import digest_bytes, digest_files
from graspd.service.model.domain import Asset
from graspd.service.model.errors import InputError, LimitError, NotFoundError
from graspd.service.model.states import AssetKind
from graspd.service.store.descriptions import MAX_BYTES, parse_description

_EPOCH: Final = (1980, 1, 1, 0, 0, 0)
#: Creation date of built-in assets: the date of the release, so that repeated publication writes equal records.
BUILTIN_LICENCE: Final = "Apache-2.0"
_BUILTIN_CREATED: Final = "2026-11-21T00:00:00Z"
MAX_FILES: Final = 2000
#: Prefix of zlib's message about lack of memory; other messages mean damage.
_NO_MEMORY: Final = "Error -4 "
#: Limits on one file name and on all names together [characters]; every list of hands or objects contains them.
MAX_NAME: Final = 255
MAX_NAMES: Final = 128 << 10
#: Limit on the ratio of unpacked to packed size, exceeded only by ZIP bombs; robot meshes have about 4.
UNPACK_FACTOR: Final = 8
_PIECE_BYTES: Final = 1 << 16
_T = TypeVar("_T")


def pack(files: Mapping[str, bytes]) -> bytes:
    """Return a ZIP of files; equal files give equal bytes."""
    buffer = io.BytesIO()
    pack_into(files, buffer)
    return buffer.getvalue()


def pack_into(files: Mapping[str, bytes], target: IO[bytes]) -> None:
    with zipfile.ZipFile(target, "w", zipfile.ZIP_DEFLATED, compresslevel=6) as archive:
        for name in sorted(files):
            entry = zipfile.ZipInfo(check_path(name), _EPOCH)
            entry.compress_type = zipfile.ZIP_DEFLATED
            if isinstance(files, ZipFiles):
                with files.open(name) as source, archive.open(entry, "w") as packed:
                    shutil.copyfileobj(source, packed, _PIECE_BYTES)
            else:
                archive.writestr(entry, files[name])


def unpack(data: bytes, *, limit_bytes: int) -> dict[str, bytes]:
    """Unpack a ZIP; InputError for a bad archive or name, LimitError above `limit_bytes` or `MAX_FILES`."""
    return dict(ZipFiles(io.BytesIO(data), limit_bytes=limit_bytes))


def unpack_file(path: Path) -> dict[str, bytes]:
    from graspd.service.settings import Settings

    try:
        return unpack(path.read_bytes(), limit_bytes=UNPACK_FACTOR * Settings().max_upload_bytes)
    except InputError as error:
        raise type(error)(f"{path}: {error}") from None


def strip_common_folder(files: dict[str, _T]) -> dict[str, _T]:
    """Remove the first folder from all names, if all files are in that folder."""
    tops = {name.partition("/")[0] for name in files}
    if len(tops) == 1 and all("/" in name for name in files):
        return {name.partition("/")[2]: entry for name, entry in files.items()}
    return files


class ZipFiles(MutableMapping[str, bytes]):
    """Files of a ZIP on disk, unpacked in pieces on demand, and added files; with digests of the contents."""

    def __init__(self, file: IO[bytes], *, limit_bytes: int) -> None:
        self._archive = _open_zip(file)
        self._found = _checked_entries(self._archive)
        self._added: dict[str, bytes] = {}
        self._known: dict[str, tuple[int, str]] = {}
        left = limit_bytes
        for name, entry in self._found.items():
            self._known[name] = _measure_entry(self._archive, entry, left + 1)
            left -= self._known[name][0]
            if left < 0:
                raise LimitError(f"the archive unpacks to more than {limit_bytes} bytes")

    def strip_common_folder(self) -> Self:
        self._found = strip_common_folder(self._found)
        self._known = strip_common_folder(self._known)
        return self

    def digest(self, name: str) -> str:
        return digest_bytes(self._added[name]) if name in self._added else self._known[name][1]

    def size(self, name: str) -> int:
        return len(self._added[name]) if name in self._added else self._known[name][0]

    @contextmanager
    def open(self, name: str) -> Iterator[IO[bytes]]:
        if name in self._added:
            yield io.BytesIO(self._added[name])
            return
        with _convert_errors(self._found[name]), self._archive.open(self._found[name]) as stream:
            yield stream

    def __getitem__(self, name: str) -> bytes:
        with self.open(name) as stream:
            return stream.read()

    def __setitem__(self, name: str, data: bytes) -> None:
        self._added[name] = data

    def __delitem__(self, name: str) -> None:
        del self._added[name]

    def __iter__(self) -> Iterator[str]:
        return iter({**self._found, **self._added})

    def __len__(self) -> int:
        return len(self._found.keys() | self._added.keys())


def _open_zip(file: IO[bytes]) -> zipfile.ZipFile:
    try:
        return zipfile.ZipFile(file)
    except (zipfile.BadZipFile, OSError, ValueError, NotImplementedError):
        raise InputError("the archive is not a readable ZIP file; zip the folder again") from None


def _checked_entries(archive: zipfile.ZipFile) -> dict[str, zipfile.ZipInfo]:
    entries = [entry for entry in archive.infolist() if not entry.is_dir()]
    if len(entries) > MAX_FILES:
        raise LimitError(f"the archive holds {len(entries)} files; at most {MAX_FILES} are allowed")
    found = {}
    for entry in entries:
        name = check_path(entry.filename)
        if (entry.external_attr >> 16) & 0o170000 == 0o120000:
            raise InputError(f"the archive entry {name!r} is a symbolic link; pack the file itself")
        if entry.flag_bits & 1:
            raise InputError(f"the archive entry {name!r} is encrypted; pack it without a password")
        if entry.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
            # Other compression methods can allocate gigabytes of memory before the first byte.
            raise InputError(f"the archive entry {name!r} is compressed in an unusual way; use plain deflate")
        found[name] = entry
    if sum(map(len, found)) > MAX_NAMES:
        raise LimitError(f"the names of the files in the archive take more than {MAX_NAMES} characters")
    return found


def _measure_entry(archive: zipfile.ZipFile, entry: zipfile.ZipInfo, limit: int) -> tuple[int, str]:
    count, digest = 0, hashlib.sha256()
    with _convert_errors(entry), archive.open(entry) as stream:
        while count < limit and (piece := stream.read(min(_PIECE_BYTES, limit - count))):
            count += len(piece)
            digest.update(piece)
    return count, digest.hexdigest()[:32]


@contextmanager
def _convert_errors(entry: zipfile.ZipInfo) -> Iterator[None]:
    try:
        yield
    except (zipfile.BadZipFile, zlib.error, EOFError, OSError, ValueError, NotImplementedError, RuntimeError) as error:
        if isinstance(error, zlib.error) and _NO_MEMORY in str(error):
            raise MemoryError(str(error)) from None
        raise InputError(f"the archive entry {entry.filename!r} is damaged; zip the folder again") from None


def check_path(name: str) -> str:
    """Return the name if it stays inside its folder; InputError otherwise."""
    path = PurePosixPath(name.replace("\\", "/"))
    if len(name) > MAX_NAME:
        raise InputError(f"the file name {name[:40]!r}... is longer than {MAX_NAME} characters; take a shorter one")
    if not name or path.is_absolute() or ".." in path.parts or ":" in name or "\0" in name:
        raise InputError(f"the file name {name!r} leaves its folder; use plain relative names")
    return str(path)


def _builtin_folder(kind: AssetKind | Literal["model"]) -> Path:
    return Path(str(resources.files("graspd.service"))) / "builtin" / f"{kind}s"


def builtin_files(kind: AssetKind, name: str) -> dict[str, bytes]:
    """Load a built-in hand or object: `asset.json` with URDF or mesh; NotFoundError if there is none."""
    folder = _builtin_folder(kind) / name
    if not (folder / "asset.json").is_file():
        raise NotFoundError(f"there is no built-in {kind.value} {name!r}; there are: {', '.join(builtin_names(kind))}")
    files = (path for path in sorted(folder.rglob("*")) if path.is_file())
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in files}


def builtin_model(kind: AssetKind, name: str) -> bytes:
    """Load the binary glTF of a built-in hand or object, made by `python -m graspd.worker.stages.models`."""
    return (_builtin_folder("model") / f"{kind.value}-{name}.glb").read_bytes()


def builtin_names(kind: AssetKind) -> tuple[str, ...]:
    return tuple(sorted(path.parent.name for path in _builtin_folder(kind).glob("*/asset.json")))


def create_asset(
    kind: AssetKind, name: str, files: Mapping[str, bytes], *, created: str, builtin: bool = False
) -> Asset:
    """Create the asset record of files; the key `file` of their `asset.json` names the main file."""
    description = parse_description(asset_json(files), f"{kind.value} {name!r}")
    if description.file not in files:
        raise InputError(f"{kind.value} {name!r}: the main file {description.file!r} is not among its files")
    return Asset(
        kind=kind,
        name=name,
        digest=digest_files(kind, files),
        filename=description.file,
        files=tuple(sorted(files)),
        size_bytes=sum(files.size(name) if isinstance(files, ZipFiles) else len(files[name]) for name in files),
        created=created,
        builtin=builtin,
        facts={"licence": description.licence, **description.facts} if description.licence else description.facts,
    )


def asset_json(files: Mapping[str, bytes]) -> bytes:
    if isinstance(files, ZipFiles) and files.size("asset.json") > MAX_BYTES:
        raise InputError(f"asset.json has more than {MAX_BYTES} bytes; leave out what is not needed")
    return files["asset.json"]


def builtin_asset(kind: AssetKind, name: str) -> tuple[Asset, dict[str, bytes]]:
    files = builtin_files(kind, name)
    return create_asset(kind, name, files, created=_BUILTIN_CREATED, builtin=True), files

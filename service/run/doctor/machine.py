"""Checks of the machine: disk space, data folder, limits of the process."""

import os
import re
import resource
import shutil
import stat
import tempfile
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Final

from graspd.service import user_cache
from graspd.service.model.cores import available_cores, available_memory
from graspd.service.run.doctor.checks import Finding, bad, good, warning
from graspd.service.settings import Settings
from graspd.service.store.store import local_folder

_GIB: Final = 2**30
#: Least free space, for the scratch files of a worker, a shard and the log of Redis [bytes].
_DISK_BAD: Final = 1 * _GIB
_DISK_LOW: Final = 5 * _GIB
_FEW_INODES: Final = 10_000
_MEMORY_LOW: Final = 2 * _GIB
_FILES_LOW: Final = 1024
#: Types of network file systems, on which sockets and locks of SQLite may fail.
_NETWORK: Final = re.compile(
    r"nfs4?|cifs|smb3|smbfs|lustre|gpfs|beegfs|ceph|glusterfs|9p|afs|wekafs|panfs|orangefs|"
    r"fuse\.(sshfs|s3fs|glusterfs|ceph-fuse)"
)


def local_store(settings: Settings) -> Path | None:
    return local_folder(settings.resolved_store_url)


def check_disk(settings: Settings, *, usage: Callable[[Path], tuple[int, int, int]] = shutil.disk_usage) -> Finding:
    found = []
    for what, folder, variable in _checked_folders(settings):
        there = existing_ancestor(folder)
        free = usage(there)[2]
        facts = os.statvfs(there)
        if facts.f_files and facts.f_favail < _FEW_INODES:
            return bad(f"{what} ({folder}): only {facts.f_favail} more files fit", f"remove files below {there}")
        found.append((free, what, folder, variable))
    free, what, folder, variable = min(found, key=lambda one: one[0] // _GIB)
    line = f"{free / _GIB:.1f} GiB free for {what} ({folder})"
    if free < _DISK_BAD:
        return bad(f"only {line}", f"make room below {existing_ancestor(folder)}, or move it: {variable}")
    if free < _DISK_LOW:
        return warning(f"only {line}", f"make room soon, or move it: {variable}")
    return good(f"at least {line}")


def _checked_folders(settings: Settings) -> Iterable[tuple[str, Path, str]]:
    """Yield name and path of each folder, and the variable that sets its path."""
    yield "the data folder", settings.data_dir.resolve(), "GRASPD_DATA_DIR"
    if (store := local_store(settings)) is not None:
        yield "the store", store, "GRASPD_STORE_URL"
    yield "caches", user_cache.cache_folder("doctor").parent, "XDG_CACHE_HOME"
    yield "scratch files", Path(tempfile.gettempdir()), "TMPDIR"


def existing_ancestor(folder: Path) -> Path:
    return next(one for one in (folder, *folder.parents) if one.exists())


def check_data_folder(settings: Settings, *, mounts: Path = Path("/proc/self/mounts")) -> Finding:
    """Check whether the data folder is writable, private to its user, and on a local disk."""
    folder = settings.data_dir.resolve()
    there = existing_ancestor(folder)
    if not os.access(there, os.W_OK | os.X_OK):
        return bad(f"{there} cannot be written by user {os.getuid()}", f"chown it, or set GRASPD_DATA_DIR ({folder})")
    parts = {"the index (SQLite)": settings.index_url, "Redis": settings.redis_url}
    kept_here = [part for part, url in parts.items() if url is None]
    kind = filesystem_type(there, mounts)
    if _NETWORK.fullmatch(kind) and kept_here:
        return warning(
            f"{folder} is a network folder ({kind}) and would contain {' and '.join(kept_here)}: locks may fail",
            "set GRASPD_DATA_DIR to a local disk and GRASPD_STORE_URL=file:///SHARED/FOLDER; or set GRASPD_INDEX_URL "
            "(PostgreSQL) and GRASPD_REDIS_URL",
        )
    if there != folder:
        return good(f"{folder} is made at the first start")
    if stat.S_IMODE(folder.stat().st_mode) & 0o077:
        return warning(f"others can read {folder}, with requests, results and key hashes", f"chmod 700 {folder}")
    return good(f"{folder}, {kind or 'a file system of unknown kind'}, private to its user")


def filesystem_type(folder: Path, mounts: Path = Path("/proc/self/mounts")) -> str:
    try:
        lines = [line.split() for line in mounts.read_text().splitlines()]
    except OSError:
        return ""
    # Of mounts on the longest path, only the last one is visible. The file has \040 for blanks.
    found = [
        (len(at.parts), number, kind)
        for number, (_, where, kind, *_) in enumerate(lines)
        if folder.is_relative_to(at := Path(where.replace("\\040", " ")))
    ]
    return max(found)[2] if found else ""


def check_limits(*, files: int | None = None, memory: int | None = None) -> Finding:
    """Report cores, memory and open files available to this process."""
    files = resource.getrlimit(resource.RLIMIT_NOFILE)[0] if files is None else files
    files = 2**31 if files == resource.RLIM_INFINITY else files
    memory = available_memory() if memory is None else memory
    line = f"{available_cores()} cores, {memory / _GIB:.1f} GiB of memory, {files} open files"
    if memory < _MEMORY_LOW:
        return warning(f"{line}: a worker takes up to 2 GiB", "give the container, job or machine more memory")
    if files < _FILES_LOW:
        return warning(f"{line}: each stream or upload needs one", "ulimit -n 4096, or LimitNOFILE=4096 of systemd")
    return good(line)

"""Build wheel and sdist of the files that git tracks, with identical bytes on every machine.

usage: python docker/dist.py [FOLDER]      (default: dist)

In the archives, times are that of the last commit, modes and owners are fixed, and entries are sorted.
"""

from __future__ import annotations

import gzip
import hashlib
import io
import os
import shutil
import subprocess
import sys
import tarfile
import tempfile
from pathlib import Path
from typing import Final

REPOSITORY: Final = Path(__file__).resolve().parent.parent
#: Top-level folders that are packages of graspd: symbolic links in the repository, copies in a distribution.
_PACKAGES: Final = ("service", "worker", "api", "baselines", "exchange", "studies")
#: Files of the distributions; tests and benchmarks are omitted.
_PARTS: Final = ("pyproject.toml", "README.md", "LICENSE", "graspd", *_PACKAGES)


def build(folder: Path) -> list[Path]:
    """Build wheel and sdist in a folder; return their paths."""
    epoch = int(_git("log", "-1", "--format=%ct"))
    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix="graspd-dist-") as place:
        sources, made = Path(place) / "graspd", Path(place) / "made"
        _copy(sources)
        subprocess.run(
            [sys.executable, "-m", "build", "--outdir", str(made), str(sources)],
            check=True,
            env={**os.environ, "SOURCE_DATE_EPOCH": str(epoch)},
            stdout=subprocess.DEVNULL,
            umask=0o022,
        )
        for archive in made.glob("*.tar.gz"):
            archive.write_bytes(_plain(archive.read_bytes(), epoch))
        return [Path(shutil.copy(file, folder)) for file in sorted(made.iterdir())]


def _copy(sources: Path) -> None:
    for name in _git("ls-files", "--", *_PARTS).splitlines():
        file = REPOSITORY / name
        if file.is_file():
            target = sources / ("graspd" if Path(name).parts[0] in _PACKAGES else "") / name
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(file, target)
            target.chmod(0o644)


def _plain(data: bytes, epoch: int) -> bytes:
    """Return the .tar.gz with times, owners, modes, headers and order that are equal in every build."""
    packed = io.BytesIO()
    with tarfile.open(fileobj=io.BytesIO(data)) as old, tarfile.open(fileobj=packed, mode="w") as new:
        for member in sorted(old.getmembers(), key=lambda member: member.name):
            member.mtime, member.uid, member.gid, member.uname, member.gname = epoch, 0, 0, "", ""
            member.mode, member.pax_headers = (0o755 if member.isdir() else 0o644), {}
            new.addfile(member, old.extractfile(member) if member.isfile() else None)
    return gzip.compress(packed.getvalue(), mtime=epoch)


def _git(*command: str) -> str:
    done = subprocess.run(["git", *command], cwd=REPOSITORY, check=True, capture_output=True, text=True)
    return done.stdout.strip()


if __name__ == "__main__":
    for made in build(Path(sys.argv[1] if len(sys.argv) > 1 else "dist")):
        sys.stdout.write(f"{hashlib.sha256(made.read_bytes()).hexdigest()}  {made}\n")

"""Wheel and sdist of what git knows of the working tree: the same bytes from the same sources, wherever they are built.

usage: python docker/dist.py [FOLDER]      (default: dist)

Times in the archives are those of the last commit, modes are plain, owners are nobody's, entries are in order.
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
#: What the packages are made of; tests and benchmarks stay in the repository.
#: Folders that are packages of graspd: graspd/ links to them, a distribution has them there.
_PACKAGES: Final = ("service", "worker", "api", "baselines", "exchange", "studies")
_PARTS: Final = ("pyproject.toml", "README.md", "LICENSE", "graspd", *_PACKAGES)


def build(folder: Path) -> list[Path]:
    """Make both in a folder; returns their paths."""
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
    """A .tar.gz again, with what differs between two builds made equal."""
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

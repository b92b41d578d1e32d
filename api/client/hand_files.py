"""A hand on the user's disk as one upload: a folder, or a description with what belongs to it, packed into a ZIP."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

from service.store.assets import pack
from service.store.hand_files import files_of_hand
from service.store.hand_main import SUFFIXES, hand_name


@contextmanager
def upload_of(path: Path) -> Iterator[tuple[Path, str]]:
    """The file to send, and the name of the hand's description in it (empty: told from the file).

    The file is the path itself, or a ZIP of what belongs to it, removed afterwards.

    Raises:
        InputError, LimitError: see `files_of_hand`.
    """
    alone = not path.is_dir() and (path.suffix.lower() not in SUFFIXES or not path.is_file())
    files, main = ({}, "") if alone else files_of_hand(path)
    if len(files) <= 1 and not path.is_dir():
        yield path, ""
        return
    with TemporaryDirectory(prefix="graspd-hand-") as folder:
        # The file's name is the hand's, unless the user says another.
        archive = Path(folder) / f"{hand_name(path.resolve().name)}.zip"
        archive.write_bytes(pack({name: file.read_bytes() for name, file in files.items()}))
        yield archive, main

"""Files beside a mesh that say how it looks: what an OBJ calls its material library, and that or a DAE its pictures."""

from __future__ import annotations

import posixpath
import re
from collections.abc import Callable, Mapping
from pathlib import PurePosixPath
from typing import Final

#: Names that one file may give: more is no material library.
MAX_NAMES: Final = 64
#: How much of a file is looked at for such names, which stand at its top [bytes].
HEAD_BYTES: Final = 2**20
_SPACES: Final = rb"[ \t]+"
_NAMED_BY: Final = {
    ".obj": re.compile(rb"^mtllib" + _SPACES + rb"([^\r\n]+)", re.MULTILINE),
    ".mtl": re.compile(rb"^[ \t]*map_Kd" + _SPACES + rb"([^\r\n]+)", re.MULTILINE | re.IGNORECASE),
    ".dae": re.compile(rb"<init_from>\s*(?:<ref>)?\s*([^<>\r\n]+?)\s*<"),
}
#: Meshes that may name such files.
MESHES: Final = (".obj", ".dae")
_PICTURES: Final = (".png", ".jpg", ".jpeg")
_TAKEN: Final = (".mtl", *_PICTURES)


def named_by(name: str, data: bytes) -> list[str]:
    """What a mesh or a material library calls the files of its looks, as it writes them; a few at most."""
    pattern = _NAMED_BY.get(PurePosixPath(name).suffix.lower())
    if pattern is None:
        return []
    said = pattern.findall(data[:HEAD_BYTES])[:MAX_NAMES]
    return [reference_of(text) for text in said]


def reference_of(text: bytes) -> str:
    """The file that a line names: options such as `-s 1 1 1` stand before it."""
    words = text.decode(errors="replace").strip()
    return words.split()[-1] if words.startswith("-") else words


def beside(name: str, reference: str, there: Callable[[str], bool]) -> str | None:
    """The file that a mesh means: seen from its folder, or of that name in its folder. None: it is not there, or is
    neither picture nor library.

    Args:
        name: of the mesh or library, among a hand's files.
        reference: as it names the other one; a place on somebody's disk counts by its last part.
        there: whether the hand's files have that name.
    """
    folder = posixpath.dirname(name)
    said = reference.replace("\\", "/").partition("://")[2] or reference.replace("\\", "/")
    if not said.lower().endswith(_TAKEN) or "\0" in said:
        return None
    tries = [] if said.startswith("/") else [posixpath.normpath(posixpath.join(folder, said))]
    tries.append(posixpath.join(folder, posixpath.basename(said)))
    return next((one for one in tries if not one.startswith(("..", "/")) and there(one)), None)


def looks_of(name: str, files: Mapping[str, bytes]) -> list[str]:
    """Names of the files that a mesh's looks follow from, libraries before their pictures."""
    found: list[str] = []
    for reference in named_by(name, files[name]):
        one = beside(name, reference, files.__contains__)
        if one and one not in found:
            found.append(one)
            if one.lower().endswith(".mtl"):
                found += [inner for inner in looks_of(one, files) if inner not in found]
    return found[:MAX_NAMES]

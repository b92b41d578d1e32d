"""Names of mesh files as descriptions write them, and of the files beside a mesh that colour it."""

from __future__ import annotations

import posixpath
import re
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import PurePosixPath
from typing import Final
from urllib.parse import unquote

from graspd.service.model.errors import InputError
from graspd.service.store.assets import check_path

_SCHEME: Final = re.compile(r"([A-Za-z][A-Za-z0-9+.-]+):(/*)")
#: Of them the rest is a path; what comes first in it, a package or folders of another machine, may be left out.
_OURS: Final = frozenset({"package", "model", "file"})


@dataclass(frozen=True)
class Reference:
    """What a description means by a name."""

    names: tuple[str, ...]
    """Names in the upload that it may be, the first one goes first."""
    scheme: str = ""
    """Of `package://...`, `model://...` and `file://...`."""
    tails: tuple[str, ...] = ()
    """With a scheme, what may lie below any folder: all of them but a bare file name."""


def read_reference(written: str, base: str) -> Reference:
    """What a name may mean, in either spelling of slashes, with spaces or `%20`.

    The folder of a ROS package may be packed with or without its name and those above it, and beside other packages:
    `package://NAME/a/b.stl` is NAME/a/b.stl, a/b.stl or b.stl, from the description's folder or from the top.

    Args:
        written: the name.
        base: folder of the description.

    Raises:
        InputError: it leads out of the upload, or names no file; the message goes on from the name.
    """
    text = written.strip().replace("\\", "/")
    found = _SCHEME.match(text)
    scheme = found[1].lower() if found else ""
    if found and scheme not in _OURS:
        raise InputError("is no file of this hand; put it beside the URDF")
    rest = text[found.end() :] if found else text
    # A package is no folder of the description's: dots in its path count from the package.
    paths = [_inside(rest, "" if scheme else base)]
    with suppress(InputError):
        paths += [_inside(unquote(rest), "" if scheme else base)]
    tails = [tail for path in dict.fromkeys(paths) for tail in (_tails(path) if scheme else [path])]
    names = [str(PurePosixPath(folder) / tail) for tail in tails for folder in (base, "")]
    return Reference(tuple(dict.fromkeys(names)), scheme, tuple(tail for tail in tails if scheme and "/" in tail))


def one_like(name: str, files: Iterable[str]) -> str:
    """The only file that is called so but for capitals, else nothing."""
    wanted = name.lower()
    like = [file for file in files if file.lower() == wanted]
    return like[0] if len(like) == 1 else ""


def _tails(path: str) -> list[str]:
    parts = PurePosixPath(path).parts
    return [str(PurePosixPath(*parts[start:])) for start in range(len(parts))]


def _inside(path: str, base: str) -> str:
    """`../meshes/x` resolved against a folder, if that stays inside the upload."""
    dots = ".." in path and not path.startswith("/")
    try:
        return check_path(posixpath.normpath(posixpath.join(base, path)) if dots else path)
    except InputError:
        raise InputError("lies outside the hand's folder; put it inside") from None


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

"""Resolution of mesh file names in descriptions, and of the texture and material files of meshes."""

import posixpath
import re
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import PurePosixPath
from typing import Final
from urllib.parse import unquote

from graspd.service.model.errors import HandError, InputError
from graspd.service.store.assets import check_path

_SCHEME: Final = re.compile(r"([A-Za-z][A-Za-z0-9+.-]+):(/*)")
#: Schemes of names whose first folders are optional: a package, or folders of another machine.
_OURS: Final = frozenset({"package", "model", "file"})


@dataclass(frozen=True)
class Reference:
    names: tuple[str, ...]
    scheme: str = ""
    tails: tuple[str, ...] = ()
    """For names with a scheme: tails of the path, longer than the file name, to find below any folder."""


def resolve_mesh_reference(written: str, base: str) -> Reference:
    """Resolve a name with slashes, backslashes, spaces or `%20`; the text of InputError lacks the name.

    A ROS package may be packed with or without its folder and parent folders: `package://NAME/a/b.stl` is NAME/a/b.stl,
    a/b.stl or b.stl, relative to the folder of the description or to the top.
    """
    text = written.strip().replace("\\", "/")
    found = _SCHEME.match(text)
    scheme = found[1].lower() if found else ""
    if found and scheme not in _OURS:
        raise InputError("is no file of the upload; put it beside the URDF")
    rest = text[found.end() :] if found else text
    # `..` in a name with a scheme is relative to the package, otherwise to the folder of the description.
    paths = [_resolve_inside(rest, "" if scheme else base)]
    with suppress(InputError):
        paths += [_resolve_inside(unquote(rest), "" if scheme else base)]
    tails = [tail for path in dict.fromkeys(paths) for tail in (_path_suffixes(path) if scheme else [path])]
    names = [str(PurePosixPath(folder) / tail) for tail in tails for folder in (base, "")]
    return Reference(tuple(dict.fromkeys(names)), scheme, tuple(tail for tail in tails if scheme and "/" in tail))


def match_name(name: str, files: Iterable[str]) -> str:
    """Return the only one of the files with this name in any case; "" if there are none or several."""
    like = [file for file in files if file.lower() == name.lower()]
    return like[0] if len(like) == 1 else ""


def find_mesh(filename: str, files: Mapping[str, bytes], base: str, link: str) -> str:
    """Return the name in `files` of a mesh that a URDF references; see `resolve_mesh_reference`.
    Without an exact match, return the only file whose path has the same end, else one whose path differs in case.
    Raises HandError: the mesh is missing, or lies outside the upload."""
    try:
        reference = resolve_mesh_reference(filename, base)
    except InputError as error:
        raise HandError(f"mesh {filename!r} of link {link!r} {error}") from None
    for name in reference.names:
        if name in files:
            return name
    for tail in reference.tails:
        below = [file for file in files if file.endswith("/" + tail)]
        if len(below) == 1:
            return below[0]
    for name in reference.names:
        if like := match_name(name, files):
            return like
    hint = "unknown package: " if reference.scheme == "package" else ""
    sought = (reference.tails or reference.names)[-1]
    raise HandError(f"mesh {filename!r} of link {link!r} is not there ({hint}looked for {sought!r}); add the file")


def _path_suffixes(path: str) -> list[str]:
    parts = PurePosixPath(path).parts
    return [str(PurePosixPath(*parts[start:])) for start in range(len(parts))]


def _resolve_inside(path: str, base: str) -> str:
    """Resolve `../meshes/x` relative to a folder; InputError if the result is outside the upload."""
    dots = ".." in path and not path.startswith("/")
    try:
        return check_path(posixpath.normpath(posixpath.join(base, path)) if dots else path)
    except InputError:
        raise InputError("lies outside its folder; put it inside") from None


#: Maximum number of names read from one file; material libraries have fewer.
MAX_NAMES: Final = 64
HEAD_BYTES: Final = 2**20
_SPACES: Final = rb"[ \t]+"
_NAMED_BY: Final = {
    ".obj": re.compile(rb"^mtllib" + _SPACES + rb"([^\r\n]+)", re.MULTILINE),
    ".mtl": re.compile(rb"^[ \t]*map_Kd" + _SPACES + rb"([^\r\n]+)", re.MULTILINE | re.IGNORECASE),
    ".dae": re.compile(rb"<init_from>\s*(?:<ref>)?\s*([^<>\r\n]+?)\s*<"),
}
MESHES: Final = (".obj", ".dae")
_PICTURES: Final = (".png", ".jpg", ".jpeg")
_TAKEN: Final = (".mtl", *_PICTURES)


def file_references(name: str, data: bytes) -> list[str]:
    """Return at most `MAX_NAMES` names of textures and materials, as written in a mesh or a library."""
    pattern = _NAMED_BY.get(PurePosixPath(name).suffix.lower())
    return [parse_reference(text) for text in pattern.findall(data[:HEAD_BYTES])[:MAX_NAMES]] if pattern else []


def parse_reference(text: bytes) -> str:
    words = text.decode(errors="replace").strip()
    return words.split()[-1] if words.startswith("-") else words


def resolve_appearance_file(name: str, reference: str, there: Callable[[str], bool]) -> str | None:
    """Resolve a reference of mesh `name` by path, or by name in its folder; None if no file is `there`."""
    folder, path = posixpath.dirname(name), reference.replace("\\", "/")
    path = path.partition("://")[2] or path
    if not path.lower().endswith(_TAKEN) or "\0" in path:
        return None
    tries = [] if path.startswith("/") else [posixpath.normpath(posixpath.join(folder, path))]
    tries.append(posixpath.join(folder, posixpath.basename(path)))
    return next((one for one in tries if not one.startswith(("..", "/")) and there(one)), None)


def appearance_files(name: str, files: Mapping[str, bytes]) -> list[str]:
    """Return the names of the files that define the appearance of a mesh: libraries, then pictures."""
    found: list[str] = []
    for reference in file_references(name, files[name]):
        one = resolve_appearance_file(name, reference, files.__contains__)
        if one and one not in found:
            found.append(one)
            if one.lower().endswith(".mtl"):
                found += [inner for inner in appearance_files(one, files) if inner not in found]
    return found[:MAX_NAMES]

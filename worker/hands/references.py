"""From a mesh as a URDF names it to a file of the upload: relative paths, and ROS packages wherever they lie."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import PurePosixPath

from service.model.errors import HandError, InputError
from service.store.assets import check_path


def find_mesh(filename: str, files: Mapping[str, bytes], base: str, link: str) -> str:
    """Name in `files` of a mesh as the URDF writes it.

    The folder of a ROS package may be packed with or without its name and those above it, and beside other packages:
    of `package://NAME/a/b.stl` are sought NAME/a/b.stl, a/b.stl and b.stl, from the URDF's folder, from the top, and
    last below any folder, where only one file is called so.

    Raises:
        HandError: it is not there, or lies outside the upload.
    """
    scheme, separator, rest = filename.replace("\\", "/").partition("://")
    path = rest if separator else scheme
    if separator and scheme not in ("package", "model", "file"):
        raise HandError(f"mesh {filename!r} of link {link!r} is no file of this hand; put it beside the URDF")
    path = path.lstrip("/") if scheme == "file" else path
    try:
        # A package is no folder of the URDF's: dots in its path count from the package.
        path = _inside(path, "" if separator else base) if ".." in path else check_path(path)
    except InputError:
        raise HandError(f"mesh {filename!r} of link {link!r} lies outside the hand's folder; put it inside") from None
    tries = [path]
    if separator:
        parts = PurePosixPath(path).parts
        tries += [str(PurePosixPath(*parts[start:])) for start in range(1, len(parts))]
    for name in tries:
        for folder in (base, ""):
            full = str(PurePosixPath(folder) / name) if folder else name
            if full in files:
                return full
    if separator:
        for name in tries[:-1]:
            below = [file for file in files if file.endswith("/" + name)]
            if len(below) == 1:
                return below[0]
    hint = "unknown package: " if scheme == "package" else ""
    raise HandError(
        f"mesh {filename!r} of link {link!r} is not there ({hint}looked for {tries[:2][-1]!r}); add the file"
    )


def _inside(path: str, base: str) -> str:
    """`../meshes/x` resolved against the URDF's folder, if that stays inside the upload."""
    parts = list(PurePosixPath(base).parts)
    for part in PurePosixPath(path).parts:
        if part == "..":
            if not parts:
                raise InputError("outside")
            parts.pop()
        else:
            parts.append(part)
    return check_path("/".join(parts))

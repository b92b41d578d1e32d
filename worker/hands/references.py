"""From a mesh as a URDF names it to a file of the upload."""

from __future__ import annotations

from collections.abc import Mapping

from service.model.errors import HandError, InputError
from service.store.mesh_files import one_like, read_reference


def find_mesh(filename: str, files: Mapping[str, bytes], base: str, link: str) -> str:
    """Name in `files` of a mesh as the URDF writes it: see `read_reference`; last, where only one file is called so,
    below any folder, or in other capitals.

    Raises:
        HandError: it is not there, or lies outside the upload.
    """
    try:
        reference = read_reference(filename, base)
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
        if like := one_like(name, files):
            return like
    hint = "unknown package: " if reference.scheme == "package" else ""
    sought = (reference.tails or reference.names)[-1]
    raise HandError(f"mesh {filename!r} of link {link!r} is not there ({hint}looked for {sought!r}); add the file")

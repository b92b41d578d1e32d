"""Mesh files from bytes: STL, OBJ, PLY, OFF, GLB, DAE, USD. No header of the input is trusted."""

import codecs
import re
import struct
from collections.abc import Callable
from pathlib import PurePosixPath
from typing import Final

import numpy as np

from graspd.service.model.errors import GraspdError, MeshError
from graspd.worker.objects.format_check import check_format, format_hint
from graspd.worker.objects.formats import bare, dae, glb, obj, usd
from graspd.worker.objects.formats.obj import Nearby, no_files
from graspd.worker.objects.formats.soup import MAX_FACES, Soup, check_soup

__all__ = ["MAX_FACES", "READERS", "Nearby", "Soup", "read_mesh"]

READERS: Final[dict[str, Callable[..., Soup]]] = {
    ".stl": bare.read_stl,
    ".obj": obj.read,
    ".ply": bare.read_ply,
    ".off": bare.read_off,
    ".glb": glb.read,
    ".dae": dae.read,
    **dict.fromkeys(usd.SUFFIXES, usd.read),
}
#: Python's quotation of text that it cannot parse as a number.
_NO_NUMBER: Final = re.compile(r": (?:np\.bytes_\()?b?'(.{1,40}?)'")
#: Formats whose readers take colours from other files, which the mesh names.
_WITH_LOOKS: Final = (".obj", ".dae")


def read_mesh(filename: str, data: bytes, nearby: Nearby = no_files) -> Soup:
    """Read vertices and triangles of a mesh file; the extension determines the format.
    `nearby` returns material libraries and pictures by their names in the file. Raises MeshError: unknown format,
    unreadable, no faces, a bad index or a coordinate that is not finite. LimitError: more than `MAX_FACES` faces."""
    suffix = PurePosixPath(filename).suffix.lower()
    reader = READERS.get(suffix)
    if reader is None:
        known = ", ".join(READERS)
        raise MeshError(f"{filename}: meshes of type {suffix or '(none)'} are not read; convert to one of {known}")
    if not data:
        raise MeshError(f"{filename}: the file is empty; export the mesh again")
    text = _strip_byte_order_mark(data)
    if suffix not in usd.SUFFIXES or not text.startswith(usd.MAGIC):
        check_format(filename, text, MeshError)
    try:
        # The check below finds invalid numbers, so NumPy's warnings are not needed.
        with np.errstate(all="ignore"):
            return check_soup(reader(text, nearby) if suffix in _WITH_LOOKS else reader(text))
    except GraspdError as error:
        raise type(error)(f"{filename}: {format_hint(filename, text) or error}") from None
    except (ValueError, LookupError, TypeError, AttributeError, ArithmeticError, RecursionError, struct.error) as error:
        # Readers rely on NumPy and json for malformed input: any of their errors is due to the file.
        kind = suffix[1:].upper()
        word = _NO_NUMBER.search(str(error))
        what = f"{word[1]!r} is no number" if word else f"a number or word in it is not valid {kind}"
        raise MeshError(f"{filename}: not a readable {kind} file: {what}; export the mesh again") from None


def _strip_byte_order_mark(data: bytes) -> bytes:
    """Return text data without its byte order mark, which editors write and formats exclude."""
    if data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        return data.decode("utf-16", errors="replace").encode()
    return data.removeprefix(codecs.BOM_UTF8)

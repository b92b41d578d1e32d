"""Wavefront OBJ: positions, polygons, and colours from vertices, materials or the mean of textures."""

from __future__ import annotations

import io
import warnings
from collections.abc import Callable, Iterable
from itertools import chain
from typing import Final

import numpy as np

from graspd.service.model.errors import MeshError
from graspd.service.model.transforms import Floats
from graspd.service.store.mesh_files import MAX_NAMES, parse_reference
from graspd.worker.objects.formats.soup import FaceNames, Soup, check_face_count, triangulate

_SHADES = 8
_MOST_GROUPS = 16
_NO_COLOUR = [b"nan", b"nan", b"nan"]


def no_files(reference: str) -> bytes | None:
    """Return None, as the resolver of a mesh without other files."""
    return None


def read(data: bytes, nearby: Nearby = no_files) -> Soup:
    """Read triangles of the polygons; negative indices count from the latest vertex.
    The colour of a face is its corners' mean colour, or else that of its material."""
    vertices, shades = list[list[bytes]](), list[list[bytes]]()
    corners, counts = list[int](), list[int]()
    libraries, used = list[bytes](), list[tuple[int, bytes]]()
    named, names = list[tuple[int, tuple[str, ...]]](), dict[bytes, list[str]]()
    for line in _logical_lines(data):
        if line.startswith(b"v "):
            numbers = line.split(None, 7)[1:7]
            vertices.append(numbers[:3])
            shades.append(numbers[3:] if len(numbers) == 6 else _NO_COLOUR)
            if len(numbers) < 3:
                raise MeshError(f"vertex {len(vertices)} has fewer than three coordinates")
        elif line.startswith(b"f "):
            # OBJ counts from 1, backwards from the end for negative indices.
            face = [_parse_index(part.partition(b"/")[0], len(vertices)) for part in line.split()[1:]]
            corners += face
            counts.append(len(face))
            if len(counts) % 65536 == 0:
                check_face_count(len(corners) - 2 * len(counts))
        elif line.startswith((b"usemtl ", b"g ", b"o ")) or line == b"g":
            kind, _, rest = line.partition(b" ")
            text = rest.strip().decode(errors="replace")
            # A face may be in several groups.
            names[kind] = text.split()[:_MOST_GROUPS] if kind == b"g" else [text]
            named.append((len(counts), tuple(chain(*names.values()))))
            if kind == b"usemtl":
                used.append((len(counts), rest.strip()))
        elif line.startswith(b"mtllib ") and len(libraries) < MAX_NAMES:
            libraries.append(line[7:].strip())
    points = np.array(vertices, dtype="S40").astype(float).reshape(-1, 3)
    faces = triangulate(points, np.array(counts, dtype=np.int64), np.array(corners, dtype=np.int64))
    shown = _face_colours(shades, faces)
    if used and libraries:
        shown = _material_colours(used, libraries, nearby, np.array(counts, np.int64), shown)
    triangles = np.concatenate([[0], np.cumsum(np.maximum(np.array(counts, np.int64) - 2, 0))])
    bounds = triangles[[0, *(first for first, _ in named), len(counts)]]
    found = FaceNames.of(zip(np.diff(bounds).tolist(), [(), *(some for _, some in named)], strict=True))
    return Soup(points, faces, shown, names=found)


def _material_colours(
    used: list[tuple[int, bytes]], libraries: list[bytes], nearby: Nearby, counts: np.ndarray, shown: np.ndarray | None
) -> np.ndarray | None:
    """Return `shown` (F, 3), with material colours for faces without a colour; None if no face has one."""
    known: dict[bytes, np.ndarray] = {}
    for name in libraries:
        data = nearby(name.decode(errors="replace"))
        known |= read_materials(data, nearby) if data is not None else {}
    if not known:
        return shown
    unknown = np.full(3, np.nan)
    names = dict.fromkeys(name for _, name in used)
    row = {name: 1 + number for number, name in enumerate(names)}
    palette = np.array([unknown, *(known.get(name, unknown) for name in names)])
    starts = np.array([first for first, _ in used])
    # Polygons before the first `usemtl` have no material; each gives as many triangles as in `triangulate`.
    material = np.array([0, *(row[name] for _, name in used)])
    of_polygon = material[np.searchsorted(starts, np.arange(len(counts)), side="right")]
    colours = palette[np.repeat(of_polygon, np.maximum(counts - 2, 0))]
    return colours if shown is None else np.where(np.isnan(shown), colours, shown)


def _face_colours(shades: list[list[bytes]], faces: np.ndarray) -> np.ndarray | None:
    """Return colours (F, 3), NaN if unknown; quantised coarsely, since each is drawn as a part."""
    if all(shade is _NO_COLOUR for shade in shades) or (faces >= len(shades)).any() or (faces < 0).any():
        return None
    known = np.array(shades, dtype="S40").astype(float).reshape(-1, 3)
    mean = known[faces].mean(axis=1)
    return np.where(np.isfinite(mean), np.clip(np.round(_SHADES * mean) / _SHADES, 0, 1), np.nan)


def _parse_index(text: bytes, count: int) -> int:
    index = int(text)
    if index == 0 or abs(index) > 2**40:
        raise MeshError(f"a face has the index {index}; OBJ indices count from 1")
    return index - 1 if index > 0 else count + index


def _logical_lines(data: bytes) -> Iterable[bytes]:
    pending = b""
    for raw in data.splitlines():
        line = raw.strip()
        if not line.startswith((b"usemtl", b"mtllib")):
            # A comment that ends in a backslash, such as a path, does not continue on the next line.
            line = line.partition(b"#")[0].rstrip()
        line = pending + line
        if line.endswith(b"\\"):
            pending = line[:-1] + b" "
            if len(pending) > 2**20:
                raise MeshError("a continued line is longer than 1 MiB")
            continue
        pending = b""
        yield line.replace(b"\t", b" ")


#: Largest number of materials in a library.
MAX_MATERIALS: Final = 1024
#: Function that returns the bytes of a file by its name in a mesh; None if there is no such file.
Nearby = Callable[[str], bytes | None]


def read_materials(data: bytes, nearby: Nearby) -> dict[bytes, Floats]:
    """Read each material's sRGB colour (3,), 0 .. 1; readable pictures override numbers."""
    found: dict[bytes, Floats] = {}
    name: bytes | None = None
    pictures = 0
    for line in data.splitlines():
        key, _, rest = line.strip().partition(b" ")
        if key == b"newmtl" and len(found) < MAX_MATERIALS:
            name = rest.strip()
        elif key == b"Kd" and name is not None:
            colour = _parse_colour(rest)
            if colour is not None:
                found.setdefault(name, colour)
        elif key.lower() == b"map_kd" and name is not None and pictures < MAX_NAMES:
            pictures += 1
            picture = colour_of(parse_reference(rest), nearby)
            if picture is not None:
                found[name] = picture
    return found


def colour_of(reference: str, nearby: Nearby) -> Floats | None:
    """Return the mean colour of a picture that a mesh names; None if it is missing or unreadable."""
    try:
        data = nearby(reference)
        return None if data is None else mean_colour(data)
    except UNREADABLE:
        return None


def _parse_colour(text: bytes) -> Floats | None:
    try:
        values = np.array(text.split()[:3], dtype="S40").astype(float)
    except ValueError:
        return None
    return np.clip(values, 0, 1) if len(values) == 3 and np.isfinite(values).all() else None


#: Largest texture that is read [pixels].
MAX_PIXELS: Final = 2**24
_PICTURES: Final = ("PNG", "JPEG")
#: Errors of unreadable pictures.
UNREADABLE: Final = (ValueError, OSError, SyntaxError)


def mean_colour(data: bytes) -> Floats:
    """Compute the sRGB mean (3,) of a PNG or JPEG, 0 .. 1.
    Raises ValueError, OSError, SyntaxError: too large, or not such a picture (`UNREADABLE`)."""
    from PIL import Image  # loaded late: few meshes have pictures

    quiet = warnings.catch_warnings(action="ignore", category=Image.DecompressionBombWarning)
    try:
        with quiet, Image.open(io.BytesIO(data), formats=_PICTURES) as image:
            if image.width * image.height > MAX_PIXELS:
                raise ValueError("the image is too large")
            return np.asarray(image.convert("RGB").resize((1, 1), Image.Resampling.BOX), float)[0, 0] / 255
    except Image.DecompressionBombError as error:
        raise ValueError(str(error)) from error

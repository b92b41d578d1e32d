"""Detection of files that are not what their suffix says: pointers, error pages, archives."""

import io
import re
import zipfile
from pathlib import PurePosixPath
from typing import Final

from graspd.service.model.errors import InputError

_XML: Final = rb"(?:<\?xml[^>]*>\s*)?(?:<!--.*?-->\s*)*"
_MESH: Final = "export a mesh: STL, OBJ, PLY, OFF or GLB"
_SERVER: Final = (
    rb"(HTTP/[\d.]+ )?([45]\d\d:? )?((file )?not found|access (is )?denied|forbidden|unauthorized|too many requests|"
    rb"bad gateway|service unavailable|internal server error)\b"
)
_GLTF: Final = rb'\{\s*"(asset|accessors|buffers|bufferViews|scenes?|nodes|meshes|extensions\w*)"'
#: Beginning of a text, its kind, and the fix. White space and byte order marks before it are skipped.
_TEXTS: Final = (
    (rb"version https://(git-lfs|hawser)\.github\.com/", "a Git LFS pointer", "git lfs pull"),
    (rb"(\.\./|/)*\.git/annex/objects/|/annex/objects/", "a git-annex pointer", "git annex get"),
    (_XML + rb"<(!doctype html|html|head|body|script)\b", "a web page", "download the file itself"),
    (_XML + rb"<(Error|ListBucketResult)\b", "an error message of a storage server", "download it again"),
    (_SERVER, "an error message of a server", "download it again"),
    (_GLTF, "glTF in text", "export one GLB"),
    (rb'\{\s*"(error|message|errors|detail|status)"\s*:', "an error message in JSON", "download it again"),
    (rb'\{\s*"', "a JSON document", "download the file itself"),
    (rb"ISO-10303-21", "a STEP file", _MESH),
    (rb"#VRML", "a VRML file", _MESH),
    (rb"#usda", "a USD file", "name it .usd"),
)
#: The same for binary files.
_BINARIES: Final = (
    (rb"\x1f\x8b|BZh|\xfd7zXZ|7z\xbc\xaf|Rar!|\x28\xb5\x2f\xfd|.{257}ustar", "a compressed archive", "unpack it"),
    (rb"%PDF-", "a PDF document", "give the file itself"),
    (rb"\x89PNG|\xff\xd8\xff|GIF8", "a picture", "give the file itself"),
    (rb"Kaydara FBX", "an FBX file", _MESH),
    (rb"BLENDER[-_v]", "a Blender file", _MESH),
    (rb"PXR-USDC", "a USD file", "name it .usd"),
)
#: Git's text for a link on a file system without links: a path without a line end.
_LINK: Final = re.compile(rb"[\w.~ /\\-]*[/\\][\w.~ -]+\.\w{1,5}")
#: Beginning of meshes, by suffix.
_MESHES: Final = {
    ".ply": re.compile(rb"ply\s"),
    ".glb": re.compile(rb"glTF"),
    ".off": re.compile(rb"(ST)?C?N?OFF(?![A-Z])", re.IGNORECASE),
    ".dae": re.compile(_XML + rb"<COLLADA\b", re.DOTALL),
    ".stl": re.compile(rb"solid\b.*?\sfacet\s", re.IGNORECASE | re.DOTALL),
    ".obj": re.compile(rb"(#[^\n]*\s+|(mtllib|o|g)\s[^\n]*\s+)*v\s+[-\d.]"),
}


def check_format(name: str, data: bytes, error: type[InputError]) -> None:
    """Raise `error` if a file does not match its suffix; the message names its kind and the fix."""
    head = data[:1024].removeprefix(b"\xef\xbb\xbf").lstrip()
    # The 80 bytes at the beginning of a binary STL may be any text.
    for pattern, what, fix in _BINARIES if b"\0" in head else _TEXTS + _BINARIES:
        if re.match(pattern, head, re.IGNORECASE | re.DOTALL):
            raise error(f"{name} is {what}, not the file itself: {fix}")
    if len(data) < 300 and _LINK.fullmatch(data):
        raise error(f"{name} is the text of a symbolic link, not the file itself: give the file that it names")
    if not head.strip(b"\0"):
        raise error(f"{name} contains nothing but spaces or zeros: export or download it again")
    if head.startswith(b"PK\x03\x04") and zipfile.is_zipfile(io.BytesIO(data)):
        raise error(f"{name} is a ZIP archive, not the file itself: unpack it, or name it .zip")


def format_hint(name: str, data: bytes) -> str | None:
    """Return the true mesh format of a file that its reader refuses, and the fix; None if unknown."""
    own, head = PurePosixPath(name).suffix.lower(), data[:4096].lstrip()
    for suffix, pattern in _MESHES.items():
        if suffix != own and pattern.match(head):
            return f"it is a mesh of type {suffix}: rename it"
    return None

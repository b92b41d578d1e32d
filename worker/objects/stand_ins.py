"""Files that stand where another should be: pointers, pages of errors, archives under a mesh's name."""

from __future__ import annotations

import io
import re
import zipfile
from typing import Final

from service.model.errors import InputError

#: What a file begins with, what it is, and the fix. White space and byte order marks before it are passed over.
_KNOWN: Final[tuple[tuple[re.Pattern[bytes], str, str], ...]] = (
    (re.compile(rb"version https://git-lfs\.github\.com/spec/"), "a Git LFS pointer", "git lfs pull"),
    (re.compile(rb"(\.\./|/)*\.git/annex/objects/|/annex/objects/"), "a git-annex pointer", "git annex get"),
    (re.compile(rb"<!doctype html|<html", re.I), "a web page", "download the file itself"),
    (re.compile(rb"(<\?xml[^>]*>\s*)?<Error>\s*<Code>"), "an error message of a storage server", "download it again"),
    (re.compile(rb'\{\s*"(error|message|errors|detail|status)"\s*:'), "an error message in JSON", "download it again"),
    (re.compile(rb"\x1f\x8b|BZh|\xfd7zXZ|7z\xbc\xaf|Rar!"), "a compressed archive", "unpack it"),
    (re.compile(rb"%PDF-"), "a PDF document", "give the file itself"),
)


def refuse_stand_in(name: str, data: bytes, error: type[InputError]) -> None:
    """Raise `error` where a file is known not to be what its name says: the message tells what it is, and the fix."""
    head = data[:1024].removeprefix(b"\xef\xbb\xbf").lstrip()
    for pattern, what, fix in _KNOWN:
        if pattern.match(head):
            raise error(f"{name} is {what}, not the file itself: {fix}")
    if head.startswith(b"PK\x03\x04") and zipfile.is_zipfile(io.BytesIO(data)):
        raise error(f"{name} is a ZIP archive, not the file itself: unpack it, or name it .zip")

"""Which of a hand's files describes it, and in which format: the suffix proposes, the root element decides."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import PurePosixPath
from typing import Final, Literal

from service.model.digests import StreamedFiles
from service.model.errors import InputError

Format = Literal["urdf", "xacro", "mjcf"]

#: What the name of a description may end with; which of them it is, its root element tells.
SUFFIXES: Final = (".urdf", ".xacro", ".xml", ".mjcf")
#: A root element that begins later than this is none that a tool wrote [bytes].
_HEAD_BYTES: Final = 1 << 16
_PROLOG: Final = re.compile(r"\s*(?:<\?.*?\?>|<!--.*?-->|<!DOCTYPE(?:[^\[>]|\[.*?\])*>)", re.DOTALL)
_ROOT: Final = re.compile(r"\s*<([A-Za-z_][\w:.-]*)")
_COMMENT: Final = re.compile(r"<!--.*?-->", re.DOTALL)
_MACROS: Final = ("<xacro:", "${", "$(")
_FORMATS_OF: Final[dict[str, Format]] = {"robot": "urdf", "mujoco": "mjcf"}
#: What a file in an encoding begins with, its mark of byte order or that of `<`; a longer one goes first.
_MARKS: Final = (
    (b"\xff\xfe\0\0", "utf-32"),
    (b"\0\0\xfe\xff", "utf-32"),
    (b"\xff\xfe", "utf-16"),
    (b"\xfe\xff", "utf-16"),
    (b"<\0\0\0", "utf-32-le"),
    (b"\0\0\0<", "utf-32-be"),
    (b"<\0", "utf-16-le"),
    (b"\0<", "utf-16-be"),
)
_DECLARED: Final = re.compile(rb"""\s*<\?xml[^>]{0,100}encoding\s*=\s*["']([\w.:-]{1,40})""")
_DECLARATION: Final = re.compile(r"<\?xml\s[^>]{0,200}\?>")
#: Encodings that a file may name; all else is UTF-8, whatever it says.
_NAMED: Final = re.compile(r"iso-?8859|latin|windows-12|cp12|gb|big5|shift|euc|koi8", re.IGNORECASE)


def format_of(name: str, data: bytes) -> Format | None:
    """Format of a file; None: it describes no robot."""
    suffix = PurePosixPath(name).suffix.lower()
    if suffix not in SUFFIXES:
        return None
    text = text_of(data)
    found = _FORMATS_OF.get(_root_element(text[:_HEAD_BYTES]))
    if found == "urdf" and any(sign in _COMMENT.sub("", text) for sign in _MACROS):
        return "xacro"
    # A file that calls itself a URDF is taken at its word, so that its reader says what is wrong with it.
    return found or {".urdf": "urdf", ".xacro": "xacro", ".mjcf": "mjcf"}.get(suffix)  # type: ignore[return-value]


def text_of(data: bytes) -> str:
    """The text of an XML or YAML file in the encoding that its byte order or its declaration says, without the
    declaration and white space around it; what claims to be UTF-8 and is not, is read as Latin 1."""
    coding = next((name for mark, name in _MARKS if data.startswith(mark)), "")
    if not coding:
        declared = _DECLARED.match(data)
        said = declared[1].decode() if declared else ""
        coding = said if _NAMED.match(said) else "utf-8-sig"
    try:
        text = data.decode(coding)
    except (UnicodeError, LookupError):
        text = data.decode("latin-1")
    # It may only stand at the very beginning, and a licence often does.
    return _DECLARATION.sub("", text, count=1).strip("\ufeff\0 \t\r\n")


def main_of(files: Mapping[str, bytes], wanted: str = "", *, where: str = "the hand") -> str:
    """Name of the file that describes the hand.

    Args:
        files: all files of the hand.
        wanted: the file as the user calls it: its name, the end of its path, or its name without suffix.
        where: what holds the files, for messages.

    Raises:
        InputError: there is none, several and none is wanted, or what is wanted is not there or fits several.
    """
    known = {name: kind for name in sorted(files) if (kind := format_of(name, _head(files, name)))}
    if wanted:
        return _named(wanted, [name for name in sorted(files) if name in known or name == wanted], where)
    # A part of a xacro file may hold no macro itself.
    kinds_of = {name: "xacro" if name.lower().endswith(".xacro") else kind for name, kind in known.items()}
    for chosen in ("urdf", "xacro", "mjcf"):
        found = [name for name, kind in kinds_of.items() if kind == chosen]
        if chosen == "urdf" and any(name.lower().endswith(".urdf") for name in found):
            found = [name for name in found if name.lower().endswith(".urdf")]
        if len(found) > 1 and chosen != "urdf":
            found = _outermost(files, found) or found
        if len(found) == 1:
            return found[0]
        if found:
            names = ", ".join(found[:8]) + (", ..." if len(found) > 8 else "")
            raise InputError(
                f"{where} holds {len(found)} hand files ({names}); name one: --urdf {_short(found)}, or in a ZIP an "
                f'asset.json with {{"file": "{_short(found)}"}}'
            )
    raise InputError(f"{where} holds no hand file; a URDF, xacro or MJCF is needed, or the folder or ZIP it lies in")


def _named(wanted: str, known: list[str], where: str) -> str:
    path = wanted.replace("\\", "/").removeprefix("./")
    for fits in (
        [name for name in known if name == path],
        [name for name in known if name.endswith("/" + path)],
        [name for name in known if _stem(name) == path],
    ):
        if len(fits) == 1:
            return fits[0]
        if fits:
            raise InputError(f"{where} holds {len(fits)} files called {wanted!r} ({', '.join(fits[:5])}); say which")
    others = ", ".join(known[:8]) or "none"
    raise InputError(f"{where} names the file {wanted!r}, which is not there; hand files are: {others}")


def _outermost(files: Mapping[str, bytes], found: list[str]) -> list[str]:
    """Those that no other includes."""
    contents = {name: text_of(files[name]).lower() for name in found}
    return [
        name
        for name in found
        if not any(PurePosixPath(name).name.lower() in text for other, text in contents.items() if other != name)
    ]


def _short(names: list[str]) -> str:
    """The first name, as short as it can be said."""
    leaves = [PurePosixPath(name).name for name in names]
    return leaves[0] if leaves.count(leaves[0]) == 1 else names[0]


def _stem(name: str) -> str:
    return hand_name(PurePosixPath(name).name)


def hand_name(leaf: str) -> str:
    """A file's name without what says its format: `claw.urdf.xacro` is `claw`."""
    path = PurePosixPath(leaf)
    while path.suffix.lower() in (*SUFFIXES, ".zip"):
        path = path.with_suffix("")
    return path.name


def _head(files: Mapping[str, bytes], name: str) -> bytes:
    """Enough of a file to tell its format; all of a robot's, whose macros may stand anywhere."""
    if PurePosixPath(name).suffix.lower() not in SUFFIXES:
        return b""
    if isinstance(files, StreamedFiles) and files.size(name) > 1 << 23:
        with files.open(name) as stream:
            return stream.read(_HEAD_BYTES)
    return files[name]


def _root_element(head: str) -> str:
    at = 0
    while prolog := _PROLOG.match(head, at):
        at = prolog.end()
    root = _ROOT.match(head, at)
    return root[1] if root else ""

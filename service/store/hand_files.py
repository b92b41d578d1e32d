"""Files of a hand on the user's disk: selection, main file and format."""

import json
import posixpath
import re
from collections.abc import Iterator, Mapping
from contextlib import suppress
from html import unescape
from itertools import product
from pathlib import Path, PurePosixPath
from typing import Final, Literal

from graspd.service.model.errors import InputError, LimitError
from graspd.service.store import mesh_files, usd_layers
from graspd.service.store.assets import MAX_FILES, ZipFiles

#: Names of a file that describes the hand besides its URDF; the first name takes precedence.
DESCRIPTIONS: Final = ("asset.json", "hand.json")
#: Suffixes of a hand's main file in XML, whose root element decides the format; and of every main file.
XML: Final = (".urdf", ".xacro", ".xml", ".mjcf")
SUFFIXES: Final = (*XML, *usd_layers.SUFFIXES)
#: Suffixes of the files taken from a folder besides its descriptions.
_TAKEN: Final = (*SUFFIXES, ".yaml", ".yml", ".stl", ".obj", ".ply", ".off", ".glb", ".dae", ".msh")
REFERENCE: Final = re.compile(r"""(?:file(?:name)?\s*=\s*["']|<uri>\s*)([^"'<]+)["'<]""")
FOLDER: Final = re.compile(r"""(?:mesh|asset)dir\s*=\s*["']([^"']*)["']""")
_MAX_INCLUDED: Final = 32
#: Folders of main files in a ROS package; the meshes are in sibling folders.
_OF_PACKAGES: Final = ("urdf", "robots", "xacro", "mjcf")
_ABOVE: Final = 4


def find_hand_files(path: Path) -> tuple[dict[str, Path], str]:
    """Find the files of a hand, by name, and the name of its main file ("" for a folder).

    Names are relative to the ROS package of the main file, else to its folder. Links to files outside are ignored.
    """
    files, main = (_files_of_folder(path), "") if path.is_dir() else _files_of_description(path)
    return files | _appearance_files(files, path.resolve() if path.is_dir() else _package_folder(path.resolve())), main


def _appearance_files(files: Mapping[str, Path], root: Path) -> dict[str, Path]:
    found: dict[str, Path] = {}
    waiting = [name for name in files if name.lower().endswith(mesh_files.MESHES)]
    while waiting and len(files) + len(found) < MAX_FILES:
        mesh = waiting.pop()
        with (root / mesh).open("rb") as file:
            head = file.read(mesh_files.HEAD_BYTES)
        for reference in mesh_files.file_references(mesh, head):
            name = mesh_files.resolve_appearance_file(mesh, reference, lambda one: _is_inside(root / one, root))
            if name and name not in files and name not in found:
                found[name] = root / name
                waiting += [name] if name.lower().endswith(".mtl") else []
    return found


def _files_of_folder(folder: Path) -> dict[str, Path]:
    root = folder.resolve()
    files = _files_below(root, root)
    if not any(name.lower().endswith(SUFFIXES) for name in files):
        raise InputError(f"{folder} holds no URDF, xacro, MJCF or USD; give the folder of one hand")
    return files


def _files_below(folder: Path, root: Path) -> dict[str, Path]:
    files: dict[str, Path] = {}
    for file in sorted(folder.rglob("*")):
        if (file.suffix.lower() in _TAKEN or file.name in DESCRIPTIONS) and _is_inside(file, root):
            files[file.relative_to(root).as_posix()] = file
            if len(files) > MAX_FILES:
                raise LimitError(f"{folder} holds more than {MAX_FILES} files; give the folder of one hand")
    return files


def _files_of_description(path: Path) -> tuple[dict[str, Path], str]:
    path = path.resolve() if path.is_file() else path
    root = _package_folder(path)
    main = path.relative_to(root).as_posix()
    if path.is_file() and path.name.lower().endswith(usd_layers.SUFFIXES):
        beside = main.removesuffix(path.name)
        files = {f"{beside}{name}": file for name, file in usd_layers.layer_files(path).items()}
    elif path.is_file() and format_of(path.name, path.read_bytes()) == "xacro":
        # The files that a xacro includes are unknown until its expansion.
        files = _files_below(root if (root / "package.xml").is_file() else path.parent, root)
    else:
        files = {name: root / name for name in sorted(_referenced_files(path, root))}
    for note in DESCRIPTIONS:
        for folder in (root, path.parent):
            if _is_inside(folder / note, root):
                files[note] = folder / note
    return {main: path, **files}, main


def _package_folder(path: Path) -> Path:
    for folder in list(path.parents)[:_ABOVE]:
        if (folder / "package.xml").is_file():
            return folder
    return path.parents[1] if path.parent.name in _OF_PACKAGES else path.parent


def _referenced_files(path: Path, root: Path) -> set[str]:
    """Return the names of files below the root to which a description and its includes may refer."""
    seen, waiting, found = {path}, [path], set[str]()
    bases, folders, references = set(), {""}, set()
    while waiting:
        file = waiting.pop()
        text = decode_text(file.read_bytes())
        bases.add(file.parent.relative_to(root).as_posix())
        folders |= {unescape(folder) for folder in FOLDER.findall(text)}
        references |= {unescape(reference) for reference in REFERENCE.findall(text)}
        # Names in an included file are relative to its own folder or to the description's, depending on the reader.
        found = {name for parts in product(references, bases, folders) for name in _resolve_names(*parts, root)}
        for name in sorted(found):
            inner = (root / name).resolve()
            if inner.suffix.lower() in SUFFIXES and inner not in seen and len(seen) < _MAX_INCLUDED:
                seen.add(inner)
                waiting.append(inner)
    return found


def _resolve_names(written: str, base: str, folder: str, root: Path) -> Iterator[str]:
    with suppress(InputError):
        reference = mesh_files.resolve_mesh_reference(posixpath.join(folder, written), base)
        if not reference.scheme or not folder:
            for name in reference.names:
                if there := _actual_name(name, root):
                    yield there


def _actual_name(name: str, root: Path) -> str:
    """Return the name of a file below the root in its actual case; "" if there is no such file."""
    if _is_inside(root / name, root):
        return posixpath.normpath(name)
    at = root
    for part in PurePosixPath(name).parts:
        entry = part if (at / part).exists() else ""
        with suppress(OSError):
            entry = entry or mesh_files.match_name(part, [other.name for other in at.iterdir()])
        if not entry:
            return ""
        at /= entry
    return at.relative_to(root).as_posix() if _is_inside(at, root) else ""


def _is_inside(file: Path, root: Path) -> bool:
    return file.is_file() and file.resolve().is_relative_to(root.resolve())


Format = Literal["urdf", "xacro", "mjcf", "usd"]
#: Size of the head that is searched for the root element [bytes].
_HEAD_BYTES: Final = 1 << 16
_PROLOG: Final = re.compile(r"\s*(?:<\?.*?\?>|<!--.*?-->|<!DOCTYPE(?:[^\[>]|\[.*?\])*>)", re.DOTALL)
_ROOT: Final = re.compile(r"\s*<([A-Za-z_][\w:.-]*)")
_COMMENT: Final = re.compile(r"<!--.*?-->", re.DOTALL)
_MACROS: Final = ("<xacro:", "${", "$(")
_FORMATS_OF: Final[dict[str, Format]] = {"robot": "urdf", "mujoco": "mjcf"}
_DECLARED: Final = re.compile(rb"""\s*<\?xml[^>]{0,100}encoding\s*=\s*["']([\w.:-]{1,40})""")
_DECLARATION: Final = re.compile(r"<\?xml\s[^>]{0,200}\?>")
#: Encodings accepted from a declaration; other declarations are ignored.
_NAMED: Final = re.compile(r"iso-?8859|latin|windows-12|cp12|gb|big5|shift|euc|koi8", re.IGNORECASE)


def format_of(name: str, data: bytes) -> Format | None:
    """Return the format of a hand file by suffix and root element; None if it is no hand file."""
    suffix = PurePosixPath(name).suffix.lower()
    if suffix not in SUFFIXES:
        return None
    if suffix in usd_layers.SUFFIXES:
        return "usd"
    text = decode_text(data)
    found = _FORMATS_OF.get(root_element(text))
    if found == "urdf" and any(sign in _COMMENT.sub("", text) for sign in _MACROS):
        return "xacro"
    # Without a known root element the suffix decides, and the reader of that format reports the error.
    return found or {".urdf": "urdf", ".xacro": "xacro", ".mjcf": "mjcf"}.get(suffix)  # type: ignore[return-value]


def decode_text(data: bytes) -> str:
    """Decode XML or YAML by byte order mark or declaration, and strip both; invalid UTF-8 is Latin 1."""
    coding: str = json.detect_encoding(data)  # By byte order mark, or by zeros among the first characters.
    if (declared := _DECLARED.match(data)) and _NAMED.match(name := declared[1].decode()):
        coding = name
    try:
        text = data.decode(coding)
    except (UnicodeError, LookupError):
        text = data.decode("latin-1")
    # A declaration is valid only at the very beginning, but comments with a licence often precede it.
    return _DECLARATION.sub("", text, count=1).strip("\ufeff\0 \t\r\n")


def find_main_file(files: Mapping[str, bytes], wanted: str = "", *, where: str = "the hand") -> str:
    """Return the name of the main file; InputError unless one file matches `wanted`, a path or its end."""
    known = {name: kind for name in sorted(files) if (kind := format_of(name, _read_description_head(files, name)))}
    if wanted:
        return _match_main_file(wanted, [name for name in sorted(files) if name in known or name == wanted], where)
    # A file that a xacro description includes may have no macros.
    kinds_of = {name: "xacro" if name.lower().endswith(".xacro") else kind for name, kind in known.items()}
    for chosen in ("urdf", "xacro", "mjcf", "usd"):
        found = [name for name, kind in kinds_of.items() if kind == chosen]
        if chosen == "urdf" and any(name.lower().endswith(".urdf") for name in found):
            found = [name for name in found if name.lower().endswith(".urdf")]
        if len(found) > 1 and chosen != "urdf":
            found = _outermost_files(files, found) or found
        if len(found) == 1:
            return found[0]
        if found:
            names = ", ".join(found[:8]) + (", ..." if len(found) > 8 else "")
            raise InputError(
                f"{where} holds {len(found)} hand files ({names}); name one: --urdf {_shortest_name(found)}, or in a "
                f'ZIP an asset.json with {{"file": "{_shortest_name(found)}"}}'
            )
    raise InputError(f"{where} contains no hand file; give a URDF, xacro, MJCF or USD, or its folder or ZIP")


def _match_main_file(wanted: str, known: list[str], where: str) -> str:
    path = wanted.replace("\\", "/").removeprefix("./")
    for fits in (
        [name for name in known if name == path],
        [name for name in known if name.endswith("/" + path)],
        [name for name in known if hand_name(PurePosixPath(name).name) == path],
    ):
        if len(fits) == 1:
            return fits[0]
        if fits:
            raise InputError(
                f"{where} holds {len(fits)} files {wanted!r} ({', '.join(fits[:5])}); name one by its path"
            )
    raise InputError(
        f"{where} names the file {wanted!r}, which does not exist; there are: {', '.join(known[:8]) or 'none'}"
    )


def _outermost_files(files: Mapping[str, bytes], found: list[str]) -> list[str]:
    """Return the files to which no other one refers by name."""
    texts = {name: decode_text(files[name]).lower() for name in found}

    def is_included(name: str) -> bool:
        return any(PurePosixPath(name).name.lower() in text for other, text in texts.items() if other != name)

    return [name for name in found if not is_included(name)]


def _shortest_name(names: list[str]) -> str:
    leaves = [PurePosixPath(name).name for name in names]
    return leaves[0] if leaves.count(leaves[0]) == 1 else names[0]


def hand_name(leaf: str) -> str:
    """Strip the suffixes of the format from a file name: `claw.urdf.xacro` becomes `claw`."""
    path = PurePosixPath(leaf)
    while path.suffix.lower() in (*SUFFIXES, ".sdf", ".zip"):
        path = path.with_suffix("")
    return path.name


def _read_description_head(files: Mapping[str, bytes], name: str) -> bytes:
    if PurePosixPath(name).suffix.lower() not in XML:
        return b""
    if isinstance(files, ZipFiles) and files.size(name) > 1 << 23:
        with files.open(name) as stream:
            return stream.read(_HEAD_BYTES)
    return files[name]


def root_element(text: str) -> str:
    """Return the tag of the root element in the head of an XML text; "" if there is none."""
    head, at = text[:_HEAD_BYTES], 0
    while prolog := _PROLOG.match(head, at):
        at = prolog.end()
    root = _ROOT.match(head, at)
    return root[1] if root else ""

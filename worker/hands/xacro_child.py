"""Isolated expansion of xacro: `python -m graspd.worker.hands.xacro_child`, JSON object in and out.

Expressions in xacro are Python, and the library's guards can be bypassed. This process therefore has three barriers.
Names that lead out of an expression are refused. An audit hook refuses access to files, processes and the network. The
kernel gives no new file descriptor, which every file, socket and program needs."""

import ast
import fnmatch
import io
import json
import os
import posixpath
import re
import resource
import sys
from pathlib import PurePosixPath
from types import SimpleNamespace
from typing import Any, Final
from xml.dom import minidom

#: Apparent folder of the hand's files.
_TOP: Final = "/hand"
_MAX_NODES: Final = 100_000
#: Audit events that the interpreter raises itself when it evaluates an expression.
_HARMLESS: Final = frozenset({"compile", "exec", "builtins.id", "object.__getattr__"})
#: Memory address in Python's default text of an object.
_ADDRESS: Final = re.compile(r" at 0x[0-9a-f]{6,}")
#: Attributes that lead from a generator, a coroutine or a traceback to the frames around it.
_FRAMES: Final = ("gi_", "cr_", "ag_", "f_", "tb_", "co_", "func_")


class Refused(Exception):
    """The file needs access that the process does not have, or has an invalid expression."""


def main() -> None:
    given = json.loads(sys.stdin.buffer.read())
    # A file can make the library print without end; only the result is needed.
    answers, nowhere = os.dup(1), os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 1)
    os.dup2(nowhere, 2)
    # `$(cwd)` must not reveal anything of this machine.
    os.chdir("/")
    try:
        answer = {"urdf": _expand(given), "error": ""}
    except Exception as error:
        answer = {"urdf": "", "error": _error_text(error)}
    data = json.dumps(answer).encode()
    while data:
        data = data[os.write(answers, data) :]
    os._exit(0)


def _expand(given: dict[str, Any]) -> str:
    # Load all that an expansion needs before access is closed.
    import encodings.idna
    import encodings.utf_8

    import xacro
    import yaml
    from defusedxml import minidom as safe
    from xacro import substitution_args

    from graspd.service.store.mesh_files import match_name

    texts: dict[str, str] = given["texts"]

    def resolve_file(path: str) -> str:
        inside = posixpath.normpath(posixpath.join(_TOP, path.replace("\\", "/")))
        if not inside.startswith(_TOP + "/"):
            name = path.removeprefix(_TOP + "/")
            raise Refused(f"{name!r} lies outside the hand's folder; put it inside, or give the folder that holds both")
        return inside.removeprefix(_TOP + "/")

    def text_of(path: str) -> str:
        name = resolve_file(path)
        name = name if name in texts else match_name(name, texts) or name
        if name in texts and texts[name].startswith("version https://git-lfs."):
            raise Refused(f"includes {name!r}, which is a Git LFS pointer, not the file itself: git lfs pull")
        if name not in texts:
            raise Refused(f"includes {name!r}, which is missing; add the file, or give the folder that holds it")
        return texts[name]

    def parse(source: Any, filename: str | None = None) -> minidom.Document:
        return safe.parseString(text_of(str(filename)) if source is None else source)

    def find(package: str) -> str:
        folder = _find_package(package, given["names"], texts)
        if folder is None:
            raise Refused(f"needs the package {package!r}; give the folder that holds both: --urdf NAME")
        return posixpath.join(_TOP, folder)

    def environment(name: str) -> str:
        raise Refused(f"asks for the environment variable {name!r}; write its value out")

    def evaluate(expression: str, symbols: dict[str, Any], scope: Any = None) -> Any:
        # `symbols` itself is changed: a copy would lack the enclosing scopes.
        symbols.update(__builtins__={})
        return eval(_compile_checked(expression), symbols, scope)

    def substitute(expression: str, context: dict[str, Any]) -> str:
        values = {**_PLAIN, **{k: v for k, v in vars(xacro.math).items() if not k.startswith("_")}}
        values |= {k: substitution_args.convert_value(str(v), "auto") for k, v in context.get("arg", {}).items()}
        values |= {"find": find, "arg": lambda name: values[name], "dirname": lambda: _TOP}
        return str(eval(_compile_checked(expression), {"__builtins__": {}}, values))

    xacro.parse, xacro.safe_eval = parse, evaluate
    xacro.open = lambda path, *_: io.StringIO(text_of(path))
    pattern_of = lambda pattern: [f"{_TOP}/{n}" for n in fnmatch.filter(texts, resolve_file(pattern))]  # noqa: E731
    xacro.glob = SimpleNamespace(glob=pattern_of)
    substitution_args._eval, substitution_args._eval_find = substitute, find
    substitution_args._eval_env = substitution_args._eval_dict["env"] = environment
    substitution_args._eval_optenv = lambda name, default="": default
    xacro.verbosity = 0
    del encodings, yaml
    _restrict_process(given["cpu"], given["memory"])
    main, arguments = f"{_TOP}/{given['main']}", dict(given["arguments"])
    document: minidom.Document = xacro.process_file(main, mappings=arguments, verbosity=0)
    for mesh in document.getElementsByTagName("mesh"):
        if (filename := mesh.getAttribute("filename")).startswith(_TOP + "/"):
            # From `$(find PACKAGE)`: a path in this process, not a file on this machine.
            mesh.setAttribute("filename", f"file://{filename.removeprefix(_TOP)}")
    text = document.toxml()
    if len(text) > given["limit"]:
        raise Refused(f"it expands to {len(text)} characters; at most {given['limit']} are taken")
    if _ADDRESS.search(text):
        raise Refused(
            "an expression gives a Python object instead of text, with a new address each time; write list(...)"
        )
    return text


#: Names that any expression may use.
_PLAIN: Final[dict[str, Any]] = {"true": True, "false": False, "True": True, "False": False} | {
    kind.__name__: kind for kind in (list, dict, map, str, float, int)
}


def _compile_checked(expression: str) -> Any:
    """Compile an expression; raise Refused if it has forbidden names or more than `_MAX_NODES` nodes."""
    tree = ast.parse(expression.strip(), "<expression>", "eval")
    for count, node in enumerate(ast.walk(tree)):
        name = getattr(node, "attr", None) or getattr(node, "id", None) or ""
        if name.startswith(("__", *(_FRAMES if isinstance(node, ast.Attribute) else ()))):
            raise Refused(f"an expression uses {name!r}, which no hand needs: {expression[:60]!r}")
        if count > _MAX_NODES:
            raise Refused("an expression is too long")
    return compile(tree, "<expression>", "eval")


def _find_package(package: str, names: list[str], texts: dict[str, str]) -> str | None:
    """Find the folder of a ROS package by manifest, else by name; return its path relative to the top."""
    for name, text in texts.items():
        if posixpath.basename(name) == "package.xml" and f"<name>{package}</name>" in "".join(text.split()):
            return posixpath.dirname(name)
    folders = {str(folder) for name in names for folder in PurePosixPath(name).parents}
    below = sorted((folder for folder in folders if posixpath.basename(folder) == package), key=len)
    if below:
        return below[0]
    manifests = [name for name in names if posixpath.basename(name) == "package.xml"]
    # An upload may lack the folder that is named after the package.
    return "" if not manifests else None


def _restrict_process(cpu_s: int, memory_bytes: int) -> None:
    """Restrict the process to computation from here on."""
    os.environ.clear()
    # The soft limit's signal differs from that of a machine out of memory.
    resource.setrlimit(resource.RLIMIT_CPU, (cpu_s, cpu_s + 1))
    limits = {"AS": memory_bytes, "CORE": 0, "FSIZE": 0, "NOFILE": 3}
    for what, value in limits.items():
        resource.setrlimit(getattr(resource, f"RLIMIT_{what}"), (value, value))
    sys.addaudithook(_refuse_event)


def _refuse_event(event: str, _arguments: tuple[Any, ...]) -> None:
    if event not in _HARMLESS:
        raise Refused(f"it reaches out of its folder ({event}); expand it yourself and give the URDF")


def _error_text(error: BaseException) -> str:
    """Return a one-line message: that of a wrapped refusal if there is one, else of the error."""
    at: BaseException | None = error
    while at is not None:
        if isinstance(at, Refused):
            return str(at)
        if type(at).__name__ == "EntitiesForbidden":
            return "XML entities are refused; write the text out"
        at = getattr(at, "exc", None) or at.__cause__ or at.__context__
    line = " ".join(str(error).split())[:200] or type(error).__name__
    if "Undefined substitution argument" in line:
        return f'{line}; give its value: --xacro NAME=VALUE, or {{"xacro": {{"NAME": "VALUE"}}}} in asset.json'
    return f"cannot be expanded ({line}); correct it, or expand it yourself and give the URDF"


if __name__ == "__main__":
    main()

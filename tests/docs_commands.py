"""The commands that README and docs print: found, checked against the command line, and run.

usage: python -m tests.docs_commands [PAGE ...] [--list]        (make docs-commands; some hours of two cores for all)

Each page gets a folder and a service of its own; its lines run in their order, as they are printed. What is not run is
told with its reason. Ends with 1 if a line failed.
"""

from __future__ import annotations

import argparse
import os
import re
import shlex
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from importlib.util import find_spec
from itertools import pairwise
from pathlib import Path
from typing import Any, Final

import graspd.cli

REPOSITORY: Final = Path(__file__).resolve().parent.parent
PAGES: Final = (REPOSITORY / "README.md", *sorted((REPOSITORY / "docs").glob("*.md")))
LIMIT_S: Final = 3600.0
_FENCED: Final = re.compile(r"^```(\w*)\n(.*?)^```", re.DOTALL | re.MULTILINE)
_INDENTED: Final = re.compile(r"(?:^\n)((?:^    .*\n)+)", re.MULTILINE)
_FIRST: Final = re.compile(r"(?:\w+=\S+ )*(?:graspd|python|make) ")
_OPERATORS: Final = {"|", "||", "&&", ";", "&", ">", ">>", "<", "2>", "(", ")"}
#: What a line has that is not run here, and why. A line with none of it is run.
NOT_RUN: Final = (
    (r"\.\.\.|…|\[-|\[[A-Z]|<\w", "stands for a family of commands"),
    (r"\b(DATA|DIR|FILE|FOLDER|HAND|OBJECT|OTHER|BEFORE|AFTER|NAME|ID|URL|MESH|SHARDS|SOURCES|W|JOB|PROJECT|KEY)\b",
     "has a place that the reader fills in"),
    (r"huggingface|lerobot", "needs graspd[parquet]"),
    (r"cuda|--join|on_gpu|gpu-check", "needs a GPU, or its tools"),
    (r"^make ", "the verbs of the repository: what they do is tested by itself"),
    (r"graspd (up|api|keeper|worker|view)\b", "does not end"),
    (r"graspd (keys|projects|webhooks|tags)\b", "tests/api has services that they ask"),
    (r"million|kitchen|pilot|train-|--grasps 1000|large_index|\bycb\b", "takes hours"),
)  # fmt: skip


@dataclass(frozen=True)
class Line:
    """A command of a page, without its comment; parts of a continued line are one."""

    page: str
    text: str
    refused: bool = False
    """The page shows an error after it, or its comment says *refused*."""

    @property
    def reason(self) -> str:
        """Why it is not run; empty where it is."""
        return next((why for what, why in NOT_RUN if re.search(what, self.text)), "")

    def fault(self) -> str:
        """A command, option, module or verb of it that is not known; empty where all are."""
        for program, *words in _commands(self.text):
            if program == "graspd":
                found = _graspd_fault(words)
            elif program == "python" and words[:1] == ["-m"]:
                found = "" if find_spec(words[1]) else f"no module {words[1]}"
            elif program == "make":
                verbs = {word for word in words if "=" not in word and not word.startswith("-")}
                unknown = verbs - set(re.findall(r"^([\w-]+):", (REPOSITORY / "Makefile").read_text(), re.MULTILINE))
                found = f"make has no {', '.join(unknown)}" if unknown else ""
            else:
                continue
            if found:
                return found
        return ""


def lines_of(page: Path) -> Iterator[Line]:
    """The commands of a page, from its `sh` blocks and from indented blocks that begin with one."""
    text = page.read_text()
    fenced = [*_FENCED.findall(text), ("", "")]
    indented = (re.sub(r"^    ", "", block, flags=re.MULTILINE) for block in _INDENTED.findall(_FENCED.sub("", text)))
    blocks = [
        (body, after.startswith("graspd: "))
        for (language, body), (_, after) in pairwise(fenced)
        if language in {"sh", "bash"}
    ]
    for block, refused in [*blocks, *((block, False) for block in indented if _FIRST.match(block))]:
        whole = [line.partition(" #") for line in block.replace("\\\n", " ").splitlines()]
        told = [(re.sub(r"\s+", " ", line).strip(), comment.strip()) for line, _, comment in whole]
        commands = [(line, comment) for line, comment in told if _FIRST.match(line + " ")]
        for at, (line, comment) in enumerate(commands, 1):
            ends_so = refused and at == len(commands)
            yield Line(page.name, line, ends_so or comment.startswith("refused"))


def _commands(text: str) -> Iterator[list[str]]:
    """The simple commands of a line, without assignments before them."""
    lexer = shlex.shlex(text, posix=True, punctuation_chars="|&;<>()")
    lexer.whitespace_split = True
    command: list[str] = []
    for word in [*lexer, ";"]:
        if word in _OPERATORS:
            while command and re.match(r"\w+=", command[0]):
                command.pop(0)
            if command:
                yield command
            command = []
        else:
            command.append(word)


def _graspd_fault(words: Sequence[str]) -> str:
    """An unknown command or option of `graspd WORDS`."""
    if not words or words[0].startswith("-"):
        return ""
    module = next((module for name, module, *_ in graspd.cli.COMMANDS if name == words[0]), None)
    if module is None:
        return f"no command {words[0]}"
    command, rest = _resolved(_loaded(module, words[0]), list(words[1:]))
    if isinstance(command, str):
        return command
    known = {option for parameter in command.params for option in (*parameter.opts, *parameter.secondary_opts)}
    for word in rest:
        option = word.partition("=")[0].strip("[]")
        if re.fullmatch(r"--[a-z][\w-]*|-[a-zA-Z]", option) and option not in known | {"--help"}:
            return f"{command.name} has no {option}"
    return ""


@cache
def _loaded(module: str, name: str) -> Any:
    return graspd.cli.load(module, name)


def _resolved(command: Any, words: list[str]) -> tuple[Any, list[str]]:
    """The subcommand that words name, with the rest; or what is wrong."""
    while hasattr(command, "get_command") and words and not words[0].startswith("-"):
        inner = command.get_command(None, words[0])
        if inner is None:
            return f"{command.name} has no {words[0]}", words
        if isinstance(inner, graspd.cli.Deferred):
            inner = _loaded(inner.module, words[0])
        command, words = inner, words[1:]
    return command, words


def stand_ins(folder: Path) -> None:
    """What the pages call the reader's own: a hand; meshes in metres, in millimetres, open, overlapping; shards."""
    import trimesh

    from tests.worker.hands.my_hand import write_my_hand

    write_my_hand(folder)
    (folder / "examples").symlink_to(REPOSITORY / "examples")
    for name in ("mug", "bottle", "block"):
        files = (REPOSITORY / "service" / "builtin" / "objects" / name).rglob("*")
        mesh = trimesh.load(next(file for file in files if file.suffix in {".stl", ".obj", ".ply"}), force="mesh")
        mesh.export(folder / f"{name}.stl")
    (folder / "my_mug.stl").write_bytes((folder / "mug.stl").read_bytes())
    mesh.export(folder / "koala.obj")
    mesh.copy().apply_scale(1000).export(folder / "banana.stl")
    box = trimesh.creation.box((0.06, 0.06, 0.06))
    trimesh.util.concatenate([box, box.copy().apply_translation((0.03, 0, 0))]).export(folder / "overlap.stl")
    box.update_faces(box.face_normals[:, 2] < 0.5)
    box.export(folder / "bowl.stl")
    program = (sys.executable, "-m", "graspd")
    few = ("-n", "8", "--hand", "allegro", "--object", "mug", "--fidelity", "draft")
    for words in (
        ("demo", "--out", "demo-out", "--scenes", "1", "--views", "1", *few),
        ("synth", *few, "-o", "grasps.h5"),
    ):
        subprocess.run([*program, *words], cwd=folder, check=True, capture_output=True)
    (folder / "shards").symlink_to("demo-out/shards")
    (folder / "views.h5").symlink_to("demo-out/shards/views-0000.h5")


def run_page(page: Path) -> list[str]:
    """Run the lines of a page; returns what failed."""
    from service.run.supervisor import Supervisor
    from service.settings import Settings

    failed = []
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch) / "here"
        folder.mkdir()
        stand_ins(folder)
        kept = {name: value for name, value in os.environ.items() if not name.startswith("GRASPD_")}
        kept["PATH"] = f"{Path(sys.executable).parent}{os.pathsep}{kept.get('PATH', '')}"
        with Supervisor(Settings(data_dir=Path(scratch) / "data", port=0), workers=1) as supervisor:
            supervisor.wait_ready(600)
            kept |= {"GRASPD_API_URL": supervisor.api_url, "GRASPD_DATA_DIR": str(Path(scratch) / "data")}
            for line in lines_of(page):
                if line.reason:
                    say(f"  -    {line.text}   ({line.reason})")
                    continue
                done = subprocess.run(
                    line.text, shell=True, cwd=folder, env=kept, capture_output=True, text=True, check=False,
                    timeout=LIMIT_S,
                )  # fmt: skip
                wrong = bool(done.returncode) != line.refused
                say(f"  {'FAIL' if wrong else 'ok  '} {line.text}")
                if wrong:
                    failed.append(f"{page.name}: {line.text}\n{(done.stderr or done.stdout)[-600:]}")
    return failed


def say(text: str) -> None:
    sys.stdout.write(text + "\n")
    sys.stdout.flush()


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("pages", nargs="*", help="names of pages; default: all")
    parser.add_argument("--list", action="store_true", help="only say what would be run, and why something is not")
    given = parser.parse_args(arguments)
    failed = []
    for page in PAGES:
        if (given.pages and page.name not in given.pages) or not (lines := list(lines_of(page))):
            continue
        say(page.name)
        if given.list:
            for line in lines:
                say(f"  {'-  ' if line.reason else 'run'} {line.text}" + (f"   ({line.reason})" if line.reason else ""))
        elif any(not line.reason for line in lines):
            failed += run_page(page)
    say("\n".join(failed) or "all that was run ended well")
    return int(bool(failed))


if __name__ == "__main__":
    sys.exit(main())

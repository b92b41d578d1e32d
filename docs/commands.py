"""Find, check and run the commands of README and docs.

usage: python -m docs.commands [PAGE ...]    (make docs-commands; all pages take hours on two cores)

Each page gets a folder with the files of a reader (`docs/command_files.py`), and a service if a command needs one. The
commands of a page run in the printed order. The exit code is 1 if a command fails.
"""

import argparse
import os
import re
import shlex
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Final

import graspd.cli
from docs.command_files import files_for

REPOSITORY: Final = Path(__file__).resolve().parent.parent
DOCS: Final = REPOSITORY / "docs"
PAGES: Final = (
    *(REPOSITORY / name for name in ("README.md", "CONTRIBUTING.md")),
    *sorted(page for page in DOCS.rglob("*.md") if not {"results", "adr"} & set(page.relative_to(DOCS).parts)),
)
LIMIT_S: Final = 3600.0
#: Address of the service on the pages; each run replaces it by its own address.
_PRINTED_URL: Final = "http://127.0.0.1:8000"
#: Address for pages whose commands need no service; nothing listens there.
_NOBODY: Final = "http://127.0.0.1:9"
#: Commands that need a service. Its start takes half a minute of CPU time.
_ASKS: Final = re.compile(
    r"graspd (submit|jobs|datasets|grasps|tags|admin (index|store)|doctor|controller|worker)\b|"
    r"graspd (objects|hands|networks) (?!check)|http://|\$API|graspd-data"
)
_FENCED: Final = re.compile(r"^```(\w*)\n(.*?)^```\n?", re.DOTALL | re.MULTILINE)
_INDENTED: Final = re.compile(r"(?:^\n)((?:^    .*\n)+)", re.MULTILINE)
_TRIED: Final = re.compile(r"<!-- tried: [\w-]+ -->\s*$")
#: Error message shown after a command that fails.
_REFUSAL: Final = re.compile(r"\s*```\ngraspd: ")
_OURS: Final = {"graspd", "benchmarks", "docs", "examples", "tests"}
#: First words of an indented block of commands; other indented blocks are files or formulas.
_FIRST: Final = re.compile(r"(?:\w+=\S+ )*(?:\S*/)?(?:graspd|python|make|export|cp|curl|docker|kubectl) ")
_OPERATORS: Final = {"|", "||", "&&", ";", "&", ">", ">>", "<", "2>", "(", ")"}
#: Patterns of commands that are not run, with the reason.
NOT_RUN: Final = (
    (
        r'^(\w+="[^"]*" )?(docker|kubectl|sbatch|apptainer|ssh|oauth2-proxy|for|done)\b|SHARED|cp \.env|'
        "--grasps 3200",
        "needs Docker or a cluster",
    ),
    (r"\.\.\.|…|\[-|\[[A-Z]|<\w", "is a template of several commands"),
    (
        r"\b(DATA|DIR|FILE|FOLDER|HAND|OBJECT|OTHER|BEFORE|AFTER|NAME|ID|UUID|URL|MESH|SHARDS|SOURCES|W|JOB|PROJECT|KEY|"
        r"PASSWORD)\b|second_hand",
        "has a placeholder",
    ),
    (r"python src/|dexlearn\.train|cp -r", "needs the sources of another project"),
    *(() if find_spec("torch") else ((r"train_grasp_predictor|network=my_hand|proposed\.h5", "needs torch"),)),
    (r"^pip |\bjq\b|benchmarks\.gallery", "needs other packages or programs"),
    (r"cuda|--join\b|on_gpu|gpu-check", "needs a GPU or its tools"),
    (r"^make |^\. \.venv|pre-commit", "is a make target, or sets up the environment"),
    (r"graspd (up|api|controller|worker|view)\b(?!.*--check)", "does not end"),
    (r"graspd (keys|projects|webhooks)\b", "would make all other commands need a key; tests/api tests it"),
    (
        r"datasets (cancel|retry|delete|restore)",
        "would change the dataset that later commands read; tests/api tests it",
    ),
    (r"--grasps 1000|kitchen\.toml --yes|my-objects --yes$", "takes hours; a small dataset replaces it"),
)


@dataclass(frozen=True)
class Line:
    """A command of a page, without comment and line breaks."""

    page: str
    text: str
    refused: bool = False
    """Whether the command must fail: an error message follows, or its comment says *refused*."""
    tried: bool = False
    """Whether tests/deploy runs the command."""

    @property
    def reason(self) -> str:
        """Reason why the command is not run; empty if it is run."""
        if self.tried:
            return "tests/deploy/test_operations.py runs it"
        return next((why for what, why in NOT_RUN if re.search(what, self.text)), "")

    def fault(self) -> str:
        """Return an unknown command, option, module or make target of the line; empty if all are known."""
        for program, *words in _commands(self.text):
            if program.rpartition("/")[2] == "graspd":
                found = _graspd_fault(words)
            elif program == "python" and words[:1] == ["-m"] and words[1].partition(".")[0] in _OURS:
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
    text = page.read_text()
    blocks = [
        (block[2], bool(_REFUSAL.match(text[block.end() :])), bool(_TRIED.search(text[: block.start()])))
        for block in _FENCED.finditer(text)
        if block[1] in {"sh", "bash"}
    ]
    indented = (re.sub(r"^    ", "", block, flags=re.MULTILINE) for block in _INDENTED.findall(_FENCED.sub("", text)))
    blocks += [(block, False, False) for block in indented if _FIRST.match(block)]
    for block, shows_error, tried in blocks:
        parts = [line.partition(" #") for line in block.replace("\\\n", " ").splitlines()]
        commands = [(" ".join(line.split()), comment.strip()) for line, _, comment in parts if line.strip()]
        for at, (line, comment) in enumerate(commands, 1):
            refused = comment.startswith("refused") or (shows_error and at == len(commands))
            yield Line(page.name, line, refused, tried)


def _commands(text: str) -> Iterator[list[str]]:
    """Split a line into simple commands, without assignments of variables."""
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
    return graspd.cli.load_command(module, name)


def _resolved(command: Any, words: list[str]) -> tuple[Any, list[str]]:
    """Return the subcommand with the remaining words, or an error message."""
    while hasattr(command, "get_command") and words and not words[0].startswith("-"):
        inner = command.get_command(None, words[0])
        if inner is None:
            return f"{command.name} has no {words[0]}", words
        if isinstance(inner, graspd.cli.DeferredCommand):
            inner = _loaded(inner.module, words[0])
        command, words = inner, words[1:]
    return command, words


def run_page(page: Path) -> list[str]:
    """Run the commands of a page; return those that failed, with the end of their output."""
    from graspd.service.run.supervisor import Supervisor
    from graspd.service.settings import Settings

    lines = [line for line in lines_of(page) if not line.reason]
    failed = []
    with tempfile.TemporaryDirectory() as scratch, ExitStack() as stack:
        folder, data = Path(scratch) / "here", Path(scratch) / "data"
        folder.mkdir()
        kept = {name: value for name, value in os.environ.items() if not name.startswith("GRASPD_")}
        kept["PATH"] = f"{Path(sys.executable).parent}{os.pathsep}{kept.get('PATH', '')}"
        (folder / ".curlrc").write_text("fail-with-body\nsilent\n")
        url = _NOBODY
        if any(_ASKS.search(line.text) for line in lines):
            supervisor = stack.enter_context(Supervisor(Settings(data_dir=data, port=0), workers=1))
            supervisor.wait_ready(say=say)
            url = supervisor.api_url
        kept |= {"GRASPD_API_URL": url, "GRASPD_DATA_DIR": str(data), "CURL_HOME": str(folder)}
        kept |= {"API": url, "GRASPD_API_KEY": "none"}
        files_for(page, folder, data, kept)
        for line in lines:
            started = time.monotonic()
            code, came = run_line(line.text.replace(_PRINTED_URL, url), folder, kept)
            if wrong := bool(code) != line.refused:
                failed.append(f"{page.name}: {line.text}\n{came[-600:]}")
            say(f"  {'FAIL' if wrong else 'ok  '} {line.text}   ({time.monotonic() - started:.0f} s)")
    return failed


def run_line(text: str, folder: Path, environment: Mapping[str, str]) -> tuple[int, str]:
    """Run a command at a pseudo-terminal with the answer `y`; return exit code and output."""
    terminal, stdin = os.openpty()
    try:
        os.write(terminal, b"y\n")
        streams: dict[str, Any] = {"stdin": stdin, "stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "text": True}
        place: dict[str, Any] = {"cwd": folder, "env": dict(environment), "timeout": LIMIT_S}
        done = subprocess.run(text, shell=True, check=False, **streams, **place)
    except subprocess.TimeoutExpired:
        return 124, f"still running after {LIMIT_S:.0f} s"
    finally:
        os.close(terminal)
        os.close(stdin)
    return done.returncode, done.stdout


def say(text: str) -> None:
    sys.stdout.write(text + "\n")
    sys.stdout.flush()


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("pages", nargs="*", help="names or paths of pages; default: all")
    given = {Path(name).name for name in parser.parse_args(arguments).pages}
    if unknown := given - {page.name for page in PAGES}:
        parser.error(f"unknown pages of the docs: {', '.join(sorted(unknown))}")
    failed = []
    for page in PAGES:
        if (not given or page.name in given) and not all(line.reason for line in lines_of(page)):
            say(page.name)
            failed += run_page(page)
    say("\n".join(failed) or "all commands that were run succeeded")
    return int(bool(failed))


if __name__ == "__main__":
    sys.exit(main())

"""Compare the results of two checkouts, for changes that must not affect results.

    python -m benchmarks.compare_revisions BEFORE AFTER [--work FOLDER] [--methods fast_graspd,autograsp] [--no-job]

BEFORE and AFTER are folders with a checkout each (`git worktree add`, or `git archive REVISION | tar -x -C FOLDER`).
Both run in the current Python environment, which must suit both. The program compares

- the OpenAPI document: removed or changed parts are differences, added parts are listed;
- the help of every command, line by line;
- shards of `graspd synth` for every built-in hand, on the CPU: arrays bit for bit with type, shape, chunks and
compression, and all attributes except those of the run (date, seconds);
- the store of a small job through the whole service (`graspd demo`): names; shards as above; JSON records, except
times, sizes and checksums; other objects byte for byte.

Fields added to a record are listed and are not differences. The output also counts lines and modules of each package.
Exit code 1: a difference exists."""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import h5py
import numpy as np
import typer

ROOMS: Final = (
    "service",
    "worker",
    "api",
    "baselines",
    "exchange",
    "studies",
    "graspd",
    "tests",
    "benchmarks",
    "examples",
)
#: Attributes of a shard that depend on the run, not on its result.
OF_THE_RUN: Final = {"seconds", "created"}
#: Fields of a record that depend on the run, such as checksums over times. Attributes are compared in shards.
PASSING: Final = {"created", "origin", "at", "seconds", "sha256", "checksum", "size_bytes", "worker", "attributes"}
#: Folders of a store with random identities of each service.
DRAWN: Final = {"marks", "service"}
#: Largest number of printed differences per comparison.
_SHOWN: Final = 12

DOCUMENT: Final = """
import json, sys
from pathlib import Path
from graspd.api.app import create_app
from graspd.service.settings import Settings
print(json.dumps(create_app(Settings(data_dir=Path(sys.argv[1]), host="127.0.0.1")).openapi()))
"""
HELP: Final = """
import typer
try:
    import graspd.cli as graspd
except ImportError:  # one module in older revisions
    import graspd
build = getattr(graspd, "build_app", None) or graspd.build  # the names of 0.2
load = getattr(graspd, "load_command", None) or graspd.load
deferred = getattr(graspd, "DeferredCommand", None) or getattr(graspd, "Deferred", ())
def walk(command, name):
    if isinstance(command, deferred):
        command = load(command.module, command.name, root)
    print("==", name)
    print(command.get_help(typer.Context(command, info_name=name)))
    for child, inner in sorted((getattr(command, "commands", None) or {}).items()):
        walk(inner, f"{name} {child}")
root = typer.Context(typer.main.get_command(build()))
for name, module in sorted({row[0]: row[1] for row in graspd.COMMANDS}.items()):
    walk(load(module, name, root), name)
"""


@dataclass(frozen=True)
class Checkout:
    root: Path
    work: Path

    def run(self, *arguments: str) -> str:
        """Return the output of Python with these arguments; end the program on failure."""
        environment = {key: value for key, value in os.environ.items() if not key.startswith("GRASPD_")}
        environment |= {"PYTHONPATH": str(self.root), "COLUMNS": "120", "NO_COLOR": "1", "TERM": "dumb"}
        command = [sys.executable, *arguments]
        done = subprocess.run(command, cwd=self.root, env=environment, capture_output=True, text=True)
        if done.returncode not in (0, 3):  # 3: `synth` found fewer grasps than wanted
            sys.exit(f"{self.root}: {' '.join(arguments)[:200]} ended with {done.returncode}\n{done.stderr[-2000:]}")
        return done.stdout

    def lines(self) -> Iterator[tuple[str, int]]:
        for room in ROOMS:
            texts = [file.read_text() for file in (self.root / room).rglob("*.py")]
            yield room, sum(len(text.splitlines()) for text in texts)
            yield f"{room}: modules", sum(1 for text in texts if text.strip())


class Report:
    """Prints comparisons and counts differences."""

    def __init__(self) -> None:
        self.different = 0

    def tell(self, what: str, differences: list[str], added: list[str] | None = None) -> None:
        self.different += bool(differences)
        typer.echo(("DIFFERS  " if differences else "equal    ") + what)
        for line in [*differences[:_SHOWN], *(f"added: {line}" for line in (added or [])[:_SHOWN])]:
            typer.echo(f"           {line}")
        if (more := max(0, len(differences) - _SHOWN) + max(0, len(added or []) - _SHOWN)) > 0:
            typer.echo(f"           and {more} more")


def document_differences(before: Any, after: Any, at: str = "") -> tuple[list[str], list[str]]:
    """Return paths of a JSON value that were removed or changed, and paths that were added."""
    if not (isinstance(before, dict) and isinstance(after, dict)):
        return ([] if before == after else [f"{at or '/'}: {_short(before)} | {_short(after)}"]), []
    changed = [f"{at}/{key} was removed" for key in before if key not in after]
    added = [f"{at}/{key}" for key in after if key not in before]
    for key in before:
        if key in after:
            inner = document_differences(before[key], after[key], f"{at}/{key}")
            changed, added = changed + inner[0], added + inner[1]
    return changed, added


def text_differences(before: str, after: str) -> list[str]:
    a, b = before.splitlines(), after.splitlines()
    found = [f"- {line}" for line in a if line not in b] + [f"+ {line}" for line in b if line not in a]
    return found or ([] if a == b else ["the same lines in another order"])


def shard_differences(before: Path, after: Path) -> list[str]:
    """Return differences of two shards: datasets bit for bit, and attributes except those of the run."""
    if before.read_bytes() == after.read_bytes():
        return []
    with h5py.File(before) as one, h5py.File(after) as two:
        names = [_names(one), _names(two)]
        found = [f"only in one: {name}" for name in sorted(names[0] ^ names[1])]
        for name in sorted(names[0] & names[1]):
            found += _node_differences(one[name], two[name])
    return found


def _names(file: h5py.File) -> set[str]:
    found = {"/"}
    file.visit(found.add)
    return found


def _node_differences(one: Any, two: Any) -> Iterator[str]:
    for key in sorted({*one.attrs, *two.attrs} - OF_THE_RUN):
        if key not in one.attrs or key not in two.attrs or not np.array_equal(one.attrs[key], two.attrs[key]):
            yield f"attribute {one.name}@{key}: {one.attrs.get(key)} | {two.attrs.get(key)}"
    if isinstance(one, h5py.Dataset):
        same = [getattr(one, part) == getattr(two, part) for part in ("dtype", "shape", "chunks", "compression")]
        if not all(same) or one.compression_opts != two.compression_opts or one[()].tobytes() != two[()].tobytes():
            yield f"dataset {one.name}"


def compare_interfaces(before: Checkout, after: Checkout, report: Report) -> None:
    """Compare the OpenAPI document and the help of all commands."""
    documents = [json.loads(side.run("-c", DOCUMENT, str(side.work / "data"))) for side in (before, after)]
    report.tell("OpenAPI document", *document_differences(*documents))
    report.tell("help of every command", text_differences(*(side.run("-c", HELP) for side in (before, after))))


def compare_synth(before: Checkout, after: Checkout, methods: list[str], report: Report) -> None:
    hands = sorted(path.name for path in (before.root / "service/builtin/hands").iterdir() if path.is_dir())
    for method in methods:
        for hand in hands:
            files = [side.work / f"{method}-{hand}.h5" for side in (before, after)]
            for side, file in zip((before, after), files, strict=True):
                options = ("--hand", hand, "--object", "mug", "-n", "4", "--fidelity", "draft", "--seed", "7")
                side.run("-m", "graspd", "synth", *options, "--method", method, "--device", "cpu", "-o", str(file))
            report.tell(f"synth: {method}, {hand} on the mug", shard_differences(*files))


def compare_job(before: Checkout, after: Checkout, report: Report) -> None:
    """Compare the stores of a small job."""
    left, right = (_store_of_demo(side) for side in (before, after))
    gone = [f"only in one: {name}" for name in sorted(left.keys() ^ right.keys())]
    report.tell(f"names of {len(left)} objects in the store", gone)
    for name in sorted(left.keys() & right.keys()):
        one, two = left[name], right[name]
        if name.endswith(".h5"):
            report.tell(f"store: {name}", shard_differences(one, two))
        elif name.endswith(".json"):
            texts = [_lasting(json.loads(file.read_text())) for file in (one, two)]
            report.tell(f"store: {name}", *document_differences(*texts))
        else:
            report.tell(f"store: {name}", [] if one.read_bytes() == two.read_bytes() else ["its bytes"])


def _store_of_demo(side: Checkout) -> dict[str, Path]:
    out = side.work / "demo"
    shutil.rmtree(out, ignore_errors=True)
    side.run("-m", "graspd", "demo", "--out", str(out), "--grasps", "4", "--json")
    stores = [path.parent for path in out.rglob("shards") if (path.parent / "jobs").is_dir()]
    if len(stores) != 1:
        sys.exit(f"{side.root}: graspd demo left {len(stores)} stores in {out}")
    files = {str(file.relative_to(stores[0])): file for file in stores[0].rglob("*") if file.is_file()}
    return {name: file for name, file in files.items() if name.partition("/")[0] not in DRAWN}


def _lasting(value: Any) -> Any:
    """Return a JSON value without fields that depend on the run."""
    if isinstance(value, dict):
        kept = {key: inner for key, inner in value.items() if key not in PASSING and not key.endswith("_seconds")}
        return {key: _lasting(inner) for key, inner in kept.items()}
    return [_lasting(inner) for inner in value] if isinstance(value, list) else value


def _short(value: Any) -> str:
    text = json.dumps(value, ensure_ascii=False)
    return text if len(text) < 80 else f"{text[:77]}..."


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("before", type=Path)
    parser.add_argument("after", type=Path)
    parser.add_argument("--work", type=Path, default=Path("compare-revisions"), help="folder for the results of both")
    parser.add_argument("--methods", default="fast_graspd", help="planners to run, separated by commas")
    parser.add_argument("--no-job", action="store_true", help="skip the job through the whole service")
    wanted = parser.parse_args(argv)
    sides = []
    for name in ("before", "after"):
        work = wanted.work.resolve() / name
        work.mkdir(parents=True, exist_ok=True)
        sides.append(Checkout(getattr(wanted, name).resolve(), work))
    before, after = sides
    report = Report()
    compare_interfaces(before, after, report)
    compare_synth(before, after, wanted.methods.split(","), report)
    if not wanted.no_job:
        compare_job(before, after, report)
    typer.echo(f"\n{'lines':24}{'before':>10}{'after':>10}")
    for (what, first), (_, second) in zip(before.lines(), after.lines(), strict=True):
        typer.echo(f"{what:24}{first:>10,}{second:>10,}")
    return 1 if report.different else 0


if __name__ == "__main__":
    sys.exit(main())

"""Sizes of installs and times of imports; prints Markdown.

usage: python -m benchmarks.weight [--runs 5] [--no-wheel] [--json OUT]

Sizes are of the files in this environment; an extra includes all required packages. Times are processor seconds of a
new process, the least of the runs; `python -X importtime` gives the parts."""

from __future__ import annotations

import argparse
import json
import re
import resource
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Iterator
from importlib.metadata import distribution
from pathlib import Path
from typing import Any, Final

from packaging.requirements import Requirement

REPOSITORY: Final = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(REPOSITORY / "docker"))
import pin  # noqa: E402

EXTRAS: Final = ("", "api", "worker", "all", "dev")
LARGEST: Final = 6
_COMMAND: Final = "import sys; sys.argv = ['graspd', {}]; import graspd.cli; graspd.cli.main()"
_OURS: Final = (
    "from graspd.service.model.libraries import freeze_imports, pause_garbage_collection as imports\n"
    "freeze_imports()\nwith imports(): {}"
)
_ENGINE: Final = "import graspd.worker.generation, graspd.worker.planners.fast_graspd.planner"
#: Starts that users wait for, with their code.
STARTS: Final = {
    "Python alone": "pass",
    "`import graspd`": "import graspd",
    "`graspd --help`": _COMMAND.format("'--help'"),
    "`graspd jobs --help`": _COMMAND.format("'jobs', '--help'"),
    "`graspd api --help`": _COMMAND.format("'api', '--help'"),
    "the API": "import graspd.api.server",
    "the API, as its command imports it": _OURS.format("import graspd.api.server"),
    "the planner": _ENGINE,
    "the planner, as commands import it": _OURS.format(_ENGINE),
}


def closure(extra: str) -> set[str]:
    """Return the names of all packages that `graspd[extra]` requires, directly or indirectly."""
    return pin.closure([Requirement(f"graspd[{extra}]" if extra else "graspd")]).keys() - {"graspd"}


def size_mb(name: str) -> float:
    files = distribution(name).files or []
    paths = (Path(str(file.locate())) for file in files)
    return sum(path.stat().st_size for path in paths if path.is_file()) / 1e6


def import_seconds(code: str, runs: int) -> float:
    """Return processor seconds of a new process with this code: least of the runs after an untimed one."""
    times = []
    for _ in range(runs + 1):
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        subprocess.run([sys.executable, "-c", code], cwd=REPOSITORY, check=True, capture_output=True)
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        times.append(after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime)
    return min(times[1:])


def parts_ms(code: str) -> list[tuple[str, float]]:
    """Return milliseconds of a start in the modules of each package, slowest first."""
    done = subprocess.run(
        [sys.executable, "-X", "importtime", "-c", code], cwd=REPOSITORY, check=True, capture_output=True, text=True
    )
    spent: Counter[str] = Counter()
    for us, module in re.findall(r"import time:\s+(\d+) \|\s+\d+ \|\s+(\S+)", done.stderr):
        spent[module.partition(".")[0]] += int(us)
    return [(name, us / 1e3) for name, us in spent.most_common(LARGEST)]


def wheel_kb() -> float | None:
    with tempfile.TemporaryDirectory() as folder:
        done = subprocess.run(
            [sys.executable, str(REPOSITORY / "docker" / "dist.py"), folder], capture_output=True, check=False
        )
        wheels = list(Path(folder).glob("*.whl"))
        return wheels[0].stat().st_size / 1e3 if not done.returncode and wheels else None


def lines(found: dict[str, Any]) -> Iterator[str]:
    yield "| install | packages | MB | largest, MB |\n| --- | --: | --: | --- |"
    for extra, told in found["installs"].items():
        largest = ", ".join(f"{name} {mb:.0f}" for name, mb in told["largest"])
        yield f"| {extra} | {told['packages']} | {told['mb']:.0f} | {largest} |"
    wheel = found["wheel_kb"]
    yield f"\nSize of the wheel: {f'{wheel:.0f} kB' if wheel else 'not built here'}.\n"
    yield "| start | CPU s | slowest imports, ms |\n| --- | --: | --- |"
    for name, told in found["starts"].items():
        parts = ", ".join(f"{package} {ms:.0f}" for package, ms in told["parts_ms"])
        yield f"| {name} | {told['seconds']:.2f} | {parts} |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=5)
    parser.add_argument("--no-wheel", action="store_true", help="do not build the wheel")
    parser.add_argument("--json", type=Path)
    given = parser.parse_args()
    found: dict[str, Any] = {"installs": {}, "wheel_kb": None if given.no_wheel else wheel_kb(), "starts": {}}
    for extra in EXTRAS:
        sizes = sorted(((size_mb(name), name) for name in closure(extra)), reverse=True)
        found["installs"][f"graspd[{extra}]" if extra else "graspd"] = {
            "packages": len(sizes),
            "mb": sum(mb for mb, _ in sizes),
            "largest": [(name, mb) for mb, name in sizes[:LARGEST]],
        }
    for name, code in STARTS.items():
        found["starts"][name] = {"seconds": import_seconds(code, given.runs), "parts_ms": parts_ms(code)}
    sys.stdout.write("\n".join(lines(found)) + "\n")
    if given.json:
        given.json.write_text(json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    main()

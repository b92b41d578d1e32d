"""Make all figures and pictures of the docs; skip studies whose recorded results are current.

usage: python -m benchmarks.results [--quick] [--data DIR] [--sources DIR] [--before CHECKOUT] [--only NAME ...]
       python -m benchmarks.results --list | --stale | --pages | --enter NAME ...

Results go to docs/; with `--quick`, to results-quick/. When a study ends, results/MANIFEST.json of that folder records
it. `--enter` records existing files of docs/ from their contents and the git history. The exit code is 1 if a study
failed, or if `--stale` found a stale study."""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from benchmarks.results.manifest import DOCS, entered, load, save, staleness
from benchmarks.results.page import write_pages
from benchmarks.results.running import Runner
from benchmarks.results.studies import BY_NAME, STUDIES


def main(arguments: Sequence[str] | None = None) -> int:
    given = parser().parse_args(arguments)
    unknown = [name for name in (given.only or []) + (given.enter or []) if name not in BY_NAME]
    if unknown:
        sys.exit(f"no such study: {', '.join(unknown)}; --list has them")
    if given.enter and (given.quick or given.out):
        sys.exit("--enter is for the files in docs/")
    studies = [study for study in STUDIES if not given.only or study.name in given.only]
    out = given.out or (Path("results-quick") if given.quick else DOCS)
    if given.list:
        for study in studies:
            needs = f"   (needs {', '.join(study.wants())})" if study.wants() else ""
            say(f"{study.name}: {study.about}{needs}")
            for line in study.quick if given.quick else study.run:
                say(f"    {line}")
        return 0
    if given.stale:
        old = {study.name: staleness(study, load(out).get(study.name)) for study in studies}
        for name, reason in old.items():
            say(f"{name}: {reason or ('fresh' if BY_NAME[name].stages else '-')}")
        return int(any(old.values()))
    if given.enter:
        save(out, load(out) | {name: entered(BY_NAME[name], out) for name in given.enter})
    if not (given.enter or given.pages):
        places = {"DATA": given.data, "SOURCES": given.sources, "BEFORE": given.before}
        runner = Runner(
            out,
            given.work,
            given.quick,
            given.again,
            given.one_revision,
            {name: path.resolve() for name, path in places.items() if path},
        )
        began, failed = time.monotonic(), 0
        for study in studies:
            say(f"{study.name}: ", end="")
            became = runner.run(study)
            failed += became.startswith("FAILED")
            say(became)
        say(f"{time.monotonic() - began:.0f} s; {failed} failed")
        write_pages(runner.out)
        return int(failed > 0)
    write_pages(out.resolve())
    return 0


def parser() -> argparse.ArgumentParser:
    told = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    told.add_argument("--quick", action="store_true", help="small runs, 20 minutes of two cores")
    told.add_argument("--data", type=Path, help="folder with hands/ and objects/")
    told.add_argument("--sources", type=Path, help="folder with the packages of benchmarks.gallery")
    told.add_argument("--before", type=Path, help="checkout for comparisons of costs")
    told.add_argument("--only", nargs="+", metavar="NAME")
    told.add_argument("--again", action="store_true", help="also run studies with current results")
    told.add_argument("--one-revision", action="store_true", help="also run studies recorded at another commit")
    told.add_argument("--out", type=Path, help="folder instead of docs/ or results-quick/")
    told.add_argument("--work", type=Path, default=Path("results-work"), help="folder for intermediate results")
    told.add_argument("--list", action="store_true", help="list studies, requirements and commands")
    told.add_argument("--stale", action="store_true", help="list studies with results of older algorithms")
    told.add_argument("--pages", action="store_true", help="only write results/README.md and the tables in the docs")
    told.add_argument("--enter", nargs="+", metavar="NAME", help="record existing files")
    return told


def say(text: str, end: str = "\n") -> None:
    sys.stdout.write(text + end)
    sys.stdout.flush()


if __name__ == "__main__":
    sys.exit(main())

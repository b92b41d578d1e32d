"""Pages from the manifest: `docs/results/README.md`, and tables of results in other pages.

A page has the first table of a file between `<!-- results/FILE -->` and `<!-- /results/FILE -->`."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Final

from benchmarks.results.manifest import DOCS, INDEX, REPOSITORY, load, staleness
from benchmarks.results.studies import STUDIES

#: All pages except those that the studies write.
PAGES: Final = (
    REPOSITORY / "README.md",
    *sorted(page for page in DOCS.rglob("*.md") if not page.is_relative_to(DOCS / "results")),
)
_BLOCK: Final = re.compile(r"(<!-- (results/[^ ]+) -->\n).*?(<!-- /\2 -->)", re.DOTALL)
_CITED: Final = re.compile(r"(?:\]\(|src=\")(?:\.\./)*(?:docs/)?((?:results|images)/[^)#\"]+)")


def index(records: Mapping[str, dict[str, Any]]) -> str:
    """Return the page of all studies: files, date, revision, and whether algorithms have changed since."""
    lines = [
        "# Where figures come from",
        "",
        "`make results DATA=DIR` makes all files here and in `docs/images`, study by study. Some studies also need "
        "`SOURCES=DIR` (packages with published hands) or `BEFORE=DIR` (an earlier checkout). `QUICK=1` makes small "
        "runs in `results-quick/`. A study with current files is skipped. `python -m benchmarks.results --list` shows "
        "the commands. Raw numbers (JSON, CSV, SVG) are not in git; the options `--again --only NAME` make those of "
        "one study.",
        "",
        "State *older*: the algorithms of the named stages have changed since the measurement, so new figures may "
        "differ. A dash: no stage is named for the study. Date, version and commit are those of the run "
        "([manifest](MANIFEST.json)). *Or earlier*: no run is recorded; the commit last changed one of the files.",
        "",
        "| study | what | files | date | version | commit | state |",
        "| --- | --- | --- | --- | --- | --- | --- |",
    ]
    for study in STUDIES:
        record = records.get(study.name)
        if record is None:
            lines.append(f"| {study.name} | {study.about} |  |  |  |  | {staleness(study, record)} |")
            continue
        older = re.findall(r"([a-z]+) (?:\d+|None)", staleness(study, record))
        state = (
            f"older: {', '.join(older)}" if older else staleness(study, record) or ("current" if study.stages else "-")
        )
        by = record["revision"] + ("" if record["told_by"] == "run" else " or earlier")
        cells = (study.name, study.about, _files(record), record["date"] or "", _version(record), by, state)
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def _version(record: Mapping[str, Any]) -> str:
    """Return the version of graspd in a record; empty if it has none."""
    told = record["versions"]
    found = re.search(r"[\d.]+", told.get("graspd", "") if isinstance(told, dict) else told or "")
    return found[0] if found else ""


def _files(record: Mapping[str, Any]) -> str:
    """Return the files of a record as links; a folder with many files is one link."""
    by_folder: dict[str, list[str]] = {}
    for path in record["files"]:
        by_folder.setdefault(str(Path(path).parent), []).append(path)
    shown = []
    for folder, paths in by_folder.items():
        if len(paths) > 4:
            page = next((path for path in paths if path.endswith(".md")), folder)
            shown.append(f"[{folder}/]({_from_here(page)}): {len(paths)} files")
        else:
            shown += [f"[{Path(path).name}]({_from_here(path)})" for path in paths]
    return ", ".join(shown)


def _from_here(path: str) -> str:
    return path.removeprefix("results/") if path.startswith("results/") else f"../{path}" if path != "results" else "."


def renewed(text: str, docs: Path) -> str:
    """Return a page with its tables renewed from files under a folder of the docs."""
    return _BLOCK.sub(lambda found: f"{found[1]}{first_table(docs / found[2])}\n{found[3]}", text)


def first_table(file: Path) -> str:
    """Return the first Markdown table of a file."""
    found = re.search(r"^\|.*?(?=\n[^|]|\n\n|\Z)", file.read_text(), re.DOTALL | re.MULTILINE)
    if found is None:
        raise ValueError(f"{file.name} has no table")
    return found[0].rstrip()


def cited(page: Path) -> Iterator[str]:
    """Yield paths (without final slash) under docs/ of the results that a page links to, shows or copies."""
    text = page.read_text()
    for path in _CITED.findall(text):
        yield path.rstrip("/")
    for block in _BLOCK.finditer(text):
        yield block[2]


def write_pages(docs: Path) -> None:
    """Renew the index, and all pages with tables from results."""
    (docs / INDEX).write_text(index(load(docs)))
    if docs == DOCS:
        for page in PAGES:
            before = page.read_text()
            if (after := renewed(before, docs)) != before:
                page.write_text(after)

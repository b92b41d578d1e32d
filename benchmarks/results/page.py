"""What readers see of the manifest: `docs/results/README.md`, and figures that pages show from files it holds.

A page holds the first table of a file between `<!-- results/FILE -->` and `<!-- /results/FILE -->`.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Final

from benchmarks.results.manifest import DOCS, INDEX, REPOSITORY, load, staleness
from benchmarks.results.studies import STUDIES
from service.model.version import STAGE_REVISIONS

#: All pages but those that the studies themselves write.
PAGES: Final = (
    REPOSITORY / "README.md",
    *sorted(page for page in DOCS.rglob("*.md") if not page.is_relative_to(DOCS / "results")),
)
_BLOCK: Final = re.compile(r"(<!-- (results/[^ ]+) -->\n).*?(<!-- /\2 -->)", re.DOTALL)
_CITED: Final = re.compile(r"(?:\]\(|src=\")(?:\.\./)*(?:docs/)?((?:results|images)/[^)#\"]+)")


def index(records: Mapping[str, dict[str, Any]]) -> str:
    """The page of all studies: files, date, revision, and whether today's algorithms would give the same."""
    revisions = ", ".join(f"{stage} {number}" for stage, number in STAGE_REVISIONS.items())
    lines = [
        "# Where the figures come from",
        "",
        "`make results DATA=DIR` makes every file here and in `docs/images` again, study by study (`SOURCES=DIR`, "
        "`BEFORE=DIR` for those that need them; `QUICK=1` for little ones in `results-quick/`); what is recorded and "
        "still holds is not run again. `python -m benchmarks.results --list` has the commands. Raw numbers (JSON, "
        "CSV, SVG, checksums) stand beside the pages and are not in git; `--again --only NAME` makes those of a study.",
        "",
        f"**Fresh** figures are of the algorithms of today ({revisions}); what follows from none of them has a dash. "
        "What was made before the [manifest](MANIFEST.json) was kept has the commit that brought it: it is of that "
        "revision or an earlier one.",
        "",
        "| study | what | files | date | revision | of today's algorithms |",
        "| --- | --- | --- | --- | --- | --- |",
    ]
    for study in STUDIES:
        record = records.get(study.name)
        if record is None:
            lines.append(f"| {study.name} | {study.about} |  |  |  | {staleness(study, record)} |")
            continue
        old = staleness(study, record)
        state = f"**stale**: {old}" if old else "fresh" if study.stages else "-"
        by = record["revision"] + ("" if record["told_by"] == "run" else " or earlier")
        lines.append(f"| {study.name} | {study.about} | {_files(record)} | {record['date'] or ''} | {by} | {state} |")
    return "\n".join(lines) + "\n"


def _files(record: Mapping[str, Any]) -> str:
    """The files of a record as links, a folder of many as one."""
    by_folder: dict[str, list[str]] = {}
    for path in record["files"]:
        by_folder.setdefault(str(Path(path).parent), []).append(path)
    shown = []
    for folder, paths in by_folder.items():
        if len(paths) > 4:
            shown.append(f"[{folder}/]({_from_here(folder)}): {len(paths)} files")
        else:
            shown += [f"[{Path(path).name}]({_from_here(path)})" for path in paths]
    return ", ".join(shown)


def _from_here(path: str) -> str:
    return path.removeprefix("results/") if path.startswith("results/") else f"../{path}" if path != "results" else "."


def renewed(text: str, docs: Path) -> str:
    """A page with the tables that it shows from files under a folder of the docs."""
    return _BLOCK.sub(lambda found: f"{found[1]}{first_table(docs / found[2])}\n{found[3]}", text)


def first_table(file: Path) -> str:
    """The first Markdown table of a file."""
    found = re.search(r"^\|.*?(?=\n[^|]|\n\n|\Z)", file.read_text(), re.DOTALL | re.MULTILINE)
    if found is None:
        raise ValueError(f"{file.name} has no table")
    return found[0].rstrip()


def cited(page: Path) -> Iterator[str]:
    """Paths under docs/ of the figures and pictures that a page links to, shows or copies; folders without a slash."""
    text = page.read_text()
    for path in _CITED.findall(text):
        yield path.rstrip("/")
    for block in _BLOCK.finditer(text):
        yield block[2]


def write_pages(docs: Path) -> None:
    """Renew the index, and every page that shows a table of a figures file."""
    (docs / INDEX).write_text(index(load(docs)))
    if docs == DOCS:
        for page in PAGES:
            before = page.read_text()
            if (after := renewed(before, docs)) != before:
                page.write_text(after)

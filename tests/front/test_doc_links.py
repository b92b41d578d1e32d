"""What README and docs link to is there: files, and headings of pages."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from tests.conftest import PACKAGES, REPOSITORY

PAGES = sorted(
    page
    for page in (
        *REPOSITORY.glob("*.md"),
        *(REPOSITORY / "docs").rglob("*.md"),
        *(REPOSITORY / "examples").rglob("*.md"),
    )
    if page.is_file()
)
#: Sources whose comments, messages and help name pages.
SOURCES = (*PACKAGES, "benchmarks", "docker", "examples")
_NAMED = re.compile(r"(?<![\w/.])(?:docs|README|CONTRIBUTING|ARCHITECTURE|SECURITY)[\w/-]*\.md\b")
_CODE = re.compile(r"^```.*?^```|`[^`\n]*`", re.DOTALL | re.MULTILINE)
_LINK = re.compile(r"\]\(([^()\s]+)\)|(?:src|href)=\"([^\"]+)\"")


def anchors(page: Path) -> set[str]:
    """Names that GitHub gives the headings of a page."""
    text = re.sub(r"^```.*?^```", "", page.read_text(), flags=re.DOTALL | re.MULTILINE)
    found: dict[str, int] = {}
    names = set()
    for heading in re.findall(r"^#+ +(.+?)\s*$", text, re.MULTILINE):
        plain = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", heading)
        name = re.sub(r"[^\w\- ]", "", plain.lower()).replace(" ", "-")
        count = found.get(name, 0)
        found[name] = count + 1
        names.add(f"{name}-{count}" if count else name)
    return names


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(REPOSITORY)))
def test_links_of_a_page_lead_somewhere(page: Path) -> None:
    dead = []
    for one, other in _LINK.findall(_CODE.sub("", page.read_text())):
        link = one or other
        if re.match(r"[a-z]+:", link):
            continue
        place, _, anchor = link.partition("#")
        target = (page.parent / place).resolve() if place else page
        if not target.exists() or (anchor and target.suffix == ".md" and anchor not in anchors(target)):
            dead.append(link)
    assert dead == []


@pytest.mark.parametrize("room", SOURCES)
def test_pages_that_sources_name_exist(room: str) -> None:
    files = [
        file
        for file in (REPOSITORY / room).rglob("*")
        if file.suffix in {".py", ".sh", ".toml", ".yaml", ".yml", ".sbatch", ".html", ".ipynb"}
    ]
    assert files
    named = {(str(file.relative_to(REPOSITORY)), page) for file in files for page in _NAMED.findall(file.read_text())}
    assert {(file, page) for file, page in named if not (REPOSITORY / page).is_file()} == set()

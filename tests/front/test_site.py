"""The documentation as a site (`make docs-site`): built strictly, every page there, nothing fetched from elsewhere."""

from __future__ import annotations

import re
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest

from tests.conftest import REPOSITORY

#: What a browser fetches by itself: a link that a reader follows may lead anywhere.
_FETCHED = re.compile(
    r"<(?:script|img|iframe|source)[^>]* src=\"((?:https?:)?//[^\"]+)|<link[^>]* href=\"((?:https?:)?//[^\"]+)"
)


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    if not (find_spec("material") and find_spec("mkdocstrings")):
        pytest.skip("needs pip install '.[docs]'; make docs-site brings it")
    folder = tmp_path_factory.mktemp("site")
    done = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "--site-dir", folder],
        cwd=REPOSITORY,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    return folder


def test_every_page_of_the_docs_is_a_page_of_the_site(site: Path) -> None:
    pages = [page.relative_to(REPOSITORY / "docs") for page in (REPOSITORY / "docs").rglob("*.md")]
    names = {page.with_name("index.html" if page.name == "README.md" else f"{page.stem}.html") for page in pages}
    assert {name for name in names if not (site / name).is_file()} == set()
    assert "First grasps" in (site / "index.html").read_text()


def test_the_site_fetches_nothing_from_elsewhere(site: Path) -> None:
    fetched = {
        (str(page.relative_to(site)), one or other)
        for page in site.rglob("*.html")
        for one, other in _FETCHED.findall(page.read_text())
    }
    styles = {
        (str(sheet.relative_to(site)), url)
        for sheet in site.rglob("*.css")
        for url in re.findall(r"(?:@import|url\()\s*[\"']?((?:https?:)?//[^\"')]+)", sheet.read_text())
    }
    assert fetched | styles == set()


def test_every_public_name_is_in_the_reference(site: Path) -> None:
    import graspd

    text = (site / "reference" / "api.html").read_text()
    names = {name for name in graspd.__all__ if not name.startswith("_")}
    assert {name for name in names if not re.search(rf'id="[\w.]+\.{name}"', text)} == set()

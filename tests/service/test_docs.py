"""The documentation says what the code does."""

from __future__ import annotations

import re

import pytest

from graspd.service.docs import PAGES, PARTS, renewed
from graspd.service.settings import GONE, Settings
from tests.conftest import REPOSITORY


@pytest.mark.parametrize("page", PAGES)
def test_the_tables_of_a_page_are_up_to_date(page: str) -> None:
    text = (REPOSITORY / page).read_text()
    assert renewed(text) == text, "run: make docs"


def test_every_part_stands_on_some_page() -> None:
    text = "".join((REPOSITORY / page).read_text() for page in PAGES)
    assert all(f"<!-- {name} -->" in text for name in PARTS)


def test_settings_named_in_the_docs_exist() -> None:
    pages = [*REPOSITORY.glob("*.md"), *REPOSITORY.glob("docs/**/*.md"), REPOSITORY / "Makefile"]
    known = {f"GRASPD_{name.upper()}" for name in Settings.model_fields} | GONE.keys()
    for page in pages:
        named = set(re.findall(r"GRASPD_[A-Z][A-Z_]*[A-Z]", page.read_text()))
        assert named <= known, f"{page.name} names unknown settings"

"""What users ask is answered within one search and one page (`tests/docs_questions.yaml`)."""

from __future__ import annotations

import math
import re
from collections import Counter
from functools import cache
from typing import Any

import pytest
import yaml

from tests.conftest import REPOSITORY

DOCS = REPOSITORY / "docs"
QUESTIONS: list[dict[str, Any]] = yaml.safe_load((REPOSITORY / "tests" / "docs_questions.yaml").read_text())
#: Results that a reader looks at before another search.
LOOKED_AT = 5


@cache
def pages() -> dict[str, Counter[str]]:
    """Words of each page, those of its headings ten times, as searches weigh them."""
    found = {}
    for page in DOCS.rglob("*.md"):
        text = page.read_text().lower()
        headings = " ".join(re.findall(r"^#+ (.*)$", text, re.MULTILINE))
        found[str(page.relative_to(DOCS))] = Counter(re.findall(r"\w+", text + f" {headings}" * 10))
    return found


def ranked(search: str) -> list[str]:
    """Pages by BM25 (Robertson and Zaragoza 2009: k1 = 1.2, b = 0.75), as the site's search ranks them."""
    mean = sum(words.total() for words in pages().values()) / len(pages())
    scores: Counter[str] = Counter()
    for word in re.findall(r"\w+", search.lower()):
        having = sum(word in words for words in pages().values())
        rare = math.log(1 + (len(pages()) - having + 0.5) / (having + 0.5))
        for page, words in pages().items():
            scores[page] += rare * 2.2 * words[word] / (words[word] + 1.2 * (0.25 + 0.75 * words.total() / mean))
    return [page for page, _ in scores.most_common()]


def test_there_are_thirty_questions_of_all_parts() -> None:
    assert len({asked["question"] for asked in QUESTIONS}) == len(QUESTIONS) >= 30
    assert {asked["page"].split("/")[0] for asked in QUESTIONS} == {"how-to", "reference", "explanation"}


@pytest.mark.parametrize("asked", QUESTIONS, ids=lambda asked: asked["question"])
def test_a_question_is_answered_within_one_search_and_one_page(asked: dict[str, Any]) -> None:
    text = (DOCS / asked["page"]).read_text()
    assert [words for words in asked["words"] if words not in text] == []
    assert asked["page"] in ranked(asked["search"])[:LOOKED_AT]

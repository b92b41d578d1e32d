"""The command line knows what README and docs print, option by option; `make docs-commands` runs it."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from tests import docs_commands
from tests.conftest import PACKAGES, REPOSITORY
from tests.docs_commands import NOT_RUN, PAGES, Line, lines_of

#: `graspd jobs`, <pre>graspd jobs</pre>, epilog="graspd jobs".
_NAMED = re.compile(r'(?:`|>|epilog=")(graspd\s+[a-z](?:(?!\.\.\.)[^"`{}<…,;])*)')
ALL = [line for page in PAGES for line in lines_of(page)]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_commands_of_a_page_are_those_of_the_command_line(page: Path) -> None:
    faults = {line.text: line.fault() for line in lines_of(page)}
    assert {text: fault for text, fault in faults.items() if fault} == {}


def test_commands_in_sentences_messages_and_examples_of_help_exist() -> None:
    files = [*REPOSITORY.glob("*.md")]
    for room in (*PACKAGES, "docker", "docs"):
        files += [file for file in (REPOSITORY / room).rglob("*") if file.suffix in {".html", ".md", ".py", ".yaml"}]
    # The changelog names commands of older releases.
    named = {(f.name, one) for f in files if f.name != "CHANGELOG.md" for one in _NAMED.findall(f.read_text())}
    assert len(named) > 200
    faults = {(file, one): Line(file, one).fault() for file, one in named}
    assert {one: fault for one, fault in faults.items() if fault} == {}


def test_most_pages_have_commands_and_many_are_run() -> None:
    assert len({line.page for line in ALL}) >= 12
    assert sum(not line.reason for line in ALL) >= 60


def test_every_exception_is_needed() -> None:
    for what, why in NOT_RUN:
        assert any(line.reason == why for line in ALL), f"nothing is left out for {what}"


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        ("graspd synth --hand allegro --object mug -n 4 -o g.h5", ""),
        ("graspd synth --hnd allegro", "synth has no --hnd"),
        ("graspd synthesize mug", "no command synthesize"),
        ("graspd datasets creat x", "datasets has no creat"),
        ("A=1 graspd jobs | head && python -m benchmarks.no_such", "no module benchmarks.no_such"),
        ("make no-such-verb DATA=x", "make has no no-such-verb"),
    ],
)
def test_what_the_command_line_does_not_know_is_found(text: str, fault: str) -> None:
    assert Line("page.md", text).fault() == fault


def test_blocks_of_both_kinds_are_read_and_comments_are_not(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    fenced, indented = "```sh\ngraspd jobs   # list\n```\n", "    graspd synth \\\n        -n 4\n"
    page.write_text(f"# T\n\n{fenced}\n{indented}\n    said: graspd\n\nEnd.\n")
    assert [line.text for line in lines_of(page)] == ["graspd jobs", "graspd synth -n 4"]


@pytest.mark.parametrize(
    ("shown", "missed"),
    [
        ("mug: 8 grasps, 7 valid\n ...\n", ""),
        ("graspd: refused: the mesh is 1.8 m long, too large to grasp; say --units mm\n", ""),
        ("mug: 9 grasps\nnothing of this line\n", "nothing of this line"),
        ("bottle: 3 faces, repaired\n", "bottle: 3 faces, repaired"),
    ],
)
def test_what_a_page_shows_is_held_against_what_came_but_for_numbers(shown: str, missed: str) -> None:
    came = "mug: 12 grasps, 12 valid\ngraspd: refused: the mesh is 178.5 m long, too large to grasp; say --units mm\n"
    assert Line("page.md", "graspd jobs", shown=shown).misses(came) == missed


def test_only_an_error_directly_below_a_command_is_its_own(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    error, block = "```\ngraspd: there is none\n```\n", "```sh\ngraspd jobs\ngraspd tags list\n```\n"
    page.write_text(f"{block}\n{error}\n{block}\nText between.\n\n{error}")
    assert [line.refused for line in lines_of(page)] == [False, True, False, False]


def test_a_page_that_ended_well_waits_for_a_change(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    page, faults = tmp_path / "page.md", ["page.md: graspd jobs"]
    ran: list[str] = []
    page.write_text("```sh\ngraspd jobs\n```\n")

    def run_page(page: Path, leave: str, keep: Path) -> list[str]:
        ran.append(page.name)
        return faults

    monkeypatch.setattr(docs_commands, "PAGES", (page,))
    monkeypatch.setattr(docs_commands, "run_page", run_page)
    once = ["--keep", str(tmp_path / "kept")]
    assert docs_commands.main(once) == 1
    faults.clear()
    assert [docs_commands.main(once) for _ in range(2)] == [0, 0]
    assert len(ran) == 2, "failed once, ended well once"
    assert docs_commands.main([*once, "--again"]) == 0
    page.write_text("```sh\ngraspd jobs --json\n```\n")
    assert docs_commands.main(once) == 0
    assert len(ran) == 4

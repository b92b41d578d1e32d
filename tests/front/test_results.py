"""Figures and pictures of the docs: each is held by the manifest, each command of the list is one that there is."""

import json
import shlex
from importlib.util import find_spec
from pathlib import Path

import pytest

from benchmarks.results import manifest, page
from benchmarks.results.__main__ import main
from benchmarks.results.manifest import DOCS, INDEX, digests, faults, load, staleness, there
from benchmarks.results.running import Runner
from benchmarks.results.studies import BY_NAME, STUDIES, Study, is_raw
from docs.commands import Line
from graspd.service.model.version import STAGE_REVISIONS
from tests.conftest import REPOSITORY
from tests.shell import completed

ATLASES = sorted((DOCS / "results").glob("*stability/stability.md"))
MOST_BYTES, MOST_LINES = 8_000_000, 6_000
_SUM = "python -c \"import sys; open(sys.argv[1], 'w').write(str(1 + 1)); print('done')\" OUT/results/total.txt"
ADD = Study("add", "a sum", ("results/total.txt",), (_SUM,), prints="results/sum.md")


def runner(folder: Path, **options: bool) -> Runner:
    return Runner(folder / "docs", folder / "work", **options)


def test_the_manifest_holds_every_figure_and_picture_of_one_study_each() -> None:
    assert faults(DOCS, load(DOCS)) == []
    held = [path for study in STUDIES for path in digests(study, DOCS)]
    assert len(held) == len(set(held)) and set(held) == there(DOCS)
    assert (DOCS / INDEX).read_text() == page.index(load(DOCS)), "run: make docs"


def test_git_keeps_what_readers_see_and_no_raw_results() -> None:
    listed = completed(["git", "ls-files", "docs"], cwd=REPOSITORY)
    if listed.returncode:
        pytest.skip("no checkout of git")
    files = [REPOSITORY / name for name in listed.stdout.split() if (REPOSITORY / name).is_file()]
    results = [file for file in files if file.is_relative_to(DOCS / "results")]
    raw = {path for file in results if is_raw(path := str(file.relative_to(DOCS)))}
    assert raw == {manifest.MANIFEST}
    assert sum(file.stat().st_size for file in files) <= MOST_BYTES
    texts = [file for file in results if file.suffix not in {".png", ".jpg", ".webp"}]
    assert sum(file.read_text().count("\n") for file in texts) <= MOST_LINES


@pytest.mark.parametrize("path", page.PAGES, ids=lambda path: path.name)
def test_what_a_page_cites_is_held_and_its_tables_are_current(path: Path) -> None:
    held = {name for record in load(DOCS).values() for name in record["files"]} | {INDEX, manifest.MANIFEST}
    assert set(page.cited(path)) <= held | {str(parent) for name in held for parent in Path(name).parents}
    text = path.read_text()
    assert page.renewed(text, DOCS) == text, "run: make docs"


@pytest.mark.parametrize("path", ATLASES, ids=lambda path: path.parent.name)
def test_what_the_atlas_finds_broken_is_among_the_limits(path: Path) -> None:
    still = path.read_text().partition("## What still breaks")[2].partition("\n## ")[0]
    _, _, *rows = [row.split(" | ") for row in still.splitlines() if row.startswith("| ")]
    assert rows
    told = (DOCS / "explanation" / "limits.md").read_text()
    assert str(path.relative_to(DOCS)) in told or all(row[5] == "nothing" for row in rows)


def test_a_figure_of_older_algorithms_is_shown_as_stale() -> None:
    study = BY_NAME["robust"]
    record = load(DOCS)["robust"] | {"stage_revisions": STAGE_REVISIONS | {"synthesize": 1}}
    assert staleness(study, record) == "of synthesize 1"
    assert "| older: synthesize |" in page.index({"robust": record})
    assert "| current |" in page.index({"robust": record | {"stage_revisions": dict(STAGE_REVISIONS)}})
    assert staleness(study, record | {"stage_revisions": dict(STAGE_REVISIONS)}) == ""


def test_every_command_of_the_list_is_there() -> None:
    for line in (line for study in STUDIES for line in (*study.run, *study.quick)):
        program, *words = shlex.split(line)
        if program == "graspd":
            assert not Line("studies.py", line).fault()
        elif program == "python":
            assert find_spec(words[1]), line
        elif program == "bash":
            assert (REPOSITORY / words[0]).is_file(), line
        else:
            assert program == "cp", line


def test_a_study_that_holds_is_not_run_again_and_one_that_fails_leaves_no_record(tmp_path: Path) -> None:
    fails = Study("add", "a sum", ADD.files, (*ADD.run, "python -c 'raise SystemExit(3)'"))
    assert "`python -c 'raise SystemExit(3)'` ended with 3" in runner(tmp_path).run(fails)
    assert load(tmp_path / "docs") == {}
    assert runner(tmp_path).run(ADD).startswith("made")
    assert (tmp_path / "docs/results/total.txt").read_text() == "2"
    assert (tmp_path / "docs/results/sum.md").read_text().endswith("done\n")
    assert runner(tmp_path).run(ADD) == "holds"
    (tmp_path / "docs/results/total.txt").write_text("3")
    assert runner(tmp_path).run(ADD).startswith("made")
    assert (tmp_path / "docs/results/total.txt").read_text() == "2"


def test_folders_of_this_machine_are_not_in_the_figures(tmp_path: Path) -> None:
    tells = "import sys, json; json.dump(sys.argv[1:], open(sys.argv[2], 'w'))"
    line = f'python -c "{tells}" DATA/hands OUT/results/where.json'
    made = runner(tmp_path)
    made.places["DATA"] = tmp_path / "data"
    made.run(Study("add", "a sum", ("results/where.json",), (line,), prints="results/where.md"))
    assert json.loads((tmp_path / "docs/results/where.json").read_text()) == ["DATA/hands", "docs/results/where.json"]


def test_little_runs_leave_the_real_figures_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    before = (DOCS / manifest.MANIFEST).read_bytes()
    assert main(["--quick", "--only", "cost-model"]) == 0
    assert set(load(tmp_path / "results-quick")) == {"cost-model"}
    assert faults(tmp_path / "results-quick", load(tmp_path / "results-quick")) == []
    assert (DOCS / manifest.MANIFEST).read_bytes() == before

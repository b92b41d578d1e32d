"""README and docs: what they print runs, commands and links exist, questions are answered, and the site is strict."""

import html
import json
import math
import os
import re
import sys
from collections import Counter
from collections.abc import Iterator
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import httpx
import pytest
import yaml

import graspd
from docs import commands
from docs.commands import PAGES, Line, lines_of, main, run_page
from graspd.service.run.supervisor import Supervisor
from graspd.service.settings import Settings
from tests.conftest import PACKAGES, REPOSITORY
from tests.shell import completed
from tests.waiting import PATIENCE_S, until_a_worker_is_idle

DOCS = REPOSITORY / "docs"
TUTORIALS = sorted((DOCS / "tutorials").glob("*.md"))
#: `graspd jobs`, <pre>graspd jobs</pre>, epilog="graspd jobs".
_NAMED = re.compile(r'(?:`|>|epilog=")(graspd\s+[a-z](?:(?!\.\.\.)[^"`{}<…,;])*)')
QUESTIONS: list[dict[str, Any]] = yaml.safe_load((REPOSITORY / "tests" / "docs_questions.yaml").read_text())
#: Results that a reader looks at before another search.
LOOKED_AT = 5
#: What a browser fetches by itself: a link that a reader follows may lead anywhere.
_FETCHED = re.compile(r"<(?:(?:script|img|iframe|source)[^>]* src|link[^>]* href)=\"((?:https?:)?//[^\"]+)")
_IMPORTED = re.compile(r"(?:@import|url\()\s*[\"']?((?:https?:)?//[^\"')]+)")


@pytest.fixture(scope="module")
def environment(tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, str]]:
    settings = Settings(data_dir=tmp_path_factory.mktemp("service"), port=0)
    with Supervisor(settings, workers=1) as supervisor:
        supervisor.wait_ready(PATIENCE_S)
        until_a_worker_is_idle(supervisor.api_url)
        kept = {name: value for name, value in os.environ.items() if not name.startswith("GRASPD_")}
        yield kept | {"GRASPD_API_URL": supervisor.api_url, "GRASPD_DATA_DIR": str(settings.data_dir)}


def run(code: str, environment: dict[str, str], folder: Path) -> str:
    done = completed([sys.executable, "-c", code], env=environment, cwd=folder)
    assert done.returncode == 0, done.stderr[-2000:]
    return done.stdout


def test_the_page_runs_as_it_is_printed(environment: dict[str, str], tmp_path: Path) -> None:
    page = (REPOSITORY / "docs" / "reference" / "python.md").read_text()
    blocks = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    said = run("\n".join(blocks), environment, tmp_path)
    assert "<8 grasps of allegro on mug, 8 valid>" in said and "<8 grasps of barrett on mug, 8 valid>" in said
    assert "no_such_file.stl" in said


def test_the_code_on_the_pages_of_the_dashboard_runs(environment: dict[str, str], tmp_path: Path) -> None:
    url = environment["GRASPD_API_URL"]
    with graspd.Client(url) as client, httpx.Client(base_url=url, trust_env=False, timeout=60) as http:
        job = client.submit("barrett", "mug", grasps=8, fidelity="draft").wait()
        shard = http.get(f"/v1/jobs/{job.id}").json()["shards"][0]["id"]
        pages = [http.get(page).text for page in (f"/jobs/{job.id}", f"/grasps/{shard}/3")]
    codes = [
        html.unescape(re.findall(r'<pre id="snippet-python"[^>]*>(.*?)</pre>', page, re.DOTALL)[0]) for page in pages
    ]
    assert "<8 grasps of barrett on mug, 8 valid>" in run(codes[0], environment, tmp_path)
    assert "<grasp at " in run(codes[1], environment, tmp_path)


def test_the_notebook_is_stored_with_its_outputs() -> None:
    notebook = json.loads((REPOSITORY / "examples" / "first_grasps.ipynb").read_text())
    cells = [cell for cell in notebook["cells"] if cell["cell_type"] == "code"]
    assert [cell["execution_count"] for cell in cells] == list(range(1, len(cells) + 1))
    assert all(cell["outputs"] for cell in cells)
    assert "data:image/png" in json.dumps(cells[0]["outputs"]) and '"error"' not in json.dumps(cells)


@pytest.mark.slow
def test_the_notebook_runs(environment: dict[str, str], tmp_path: Path) -> None:
    notebook = json.loads((REPOSITORY / "examples" / "first_grasps.ipynb").read_text())
    cells = ["".join(cell["source"]) for cell in notebook["cells"] if cell["cell_type"] == "code"]
    run("\n".join(["import matplotlib; matplotlib.use('Agg')", *cells]), environment, tmp_path)
    assert (tmp_path / "grasps.h5").is_file()


@pytest.mark.slow
@pytest.mark.timeout(1800)
@pytest.mark.parametrize("page", [*TUTORIALS, REPOSITORY / "docs" / "how-to" / "hands.md"], ids=lambda page: page.stem)
def test_the_commands_of_a_page_run(page: Path) -> None:
    assert run_page(page) == []


def test_a_documented_command_that_fails_turns_the_run_red(tmp_path: Path, monkeypatch: Any, capsys: Any) -> None:
    """Also one that is refused nowhere but on the page, whether a comment or the shown output says so."""
    page = tmp_path / "page.md"
    failing = "graspd hands check nowhere"
    good = f"graspd --version\n{failing}   # refused\n{failing}\n```\n\n```\ngraspd: there is no hand\n"
    page.write_text(f"```sh\n{good}```\n\n```sh\n{failing} a\ngraspd --version  # refused\n```\n")
    monkeypatch.setattr(commands, "PAGES", (page,))
    assert main([]) == 1
    assert re.findall(r"^page\.md: (.*)", capsys.readouterr().out, re.MULTILINE) == [f"{failing} a", "graspd --version"]
    page.write_text(f"```sh\n{good}```\n")
    assert main([]) == 0
    with pytest.raises(SystemExit):
        main(["no_such_page.md"])


def test_the_lines_that_read_the_first_grasps_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    graspd.synthesize("allegro", "mug", grasps=4, fidelity="draft", seed=1).save("mug.h5")
    (block,) = re.findall(r"```python\n(.*?)```", (TUTORIALS[0]).read_text(), re.DOTALL)
    said: dict[str, Any] = {}
    exec(block, said)
    best = said["best"]
    assert (len(best), best.joint_positions.shape) == (3, (3, 16)) and (best.metric("epsilon") > 0).all()


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_commands_of_a_page_are_those_of_the_command_line(page: Path) -> None:
    faults = {line.text: line.fault() for line in lines_of(page)}
    assert {text: fault for text, fault in faults.items() if fault} == {}


def test_commands_in_sentences_messages_and_help_exist() -> None:
    files = [*REPOSITORY.glob("*.md")]
    for room in (*PACKAGES, "docker", "docs"):
        files += [file for file in (REPOSITORY / room).rglob("*") if file.suffix in {".html", ".md", ".py", ".yaml"}]
    # The changelog names commands of older releases.
    named = {(f.name, one) for f in files if f.name != "CHANGELOG.md" for one in _NAMED.findall(f.read_text())}
    assert len(named) > 200
    faults = {(file, one): Line(file, one).fault() for file, one in named}
    assert {one: fault for one, fault in faults.items() if fault} == {}


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


_FOLDERS = (REPOSITORY.glob("*.md"), *((REPOSITORY / name).rglob("*.md") for name in ("docs", "examples")))
LINKING = sorted(page for pages in _FOLDERS for page in pages if page.is_file())
#: Sources whose comments, messages and help name pages.
SOURCES = (*PACKAGES, "benchmarks", "docker", "examples")
_LINKED = re.compile(r"(?<![\w/.])(?:docs|README|CONTRIBUTING|ARCHITECTURE|SECURITY)[\w/-]*\.md\b")
_CODE = re.compile(r"^```.*?^```|`[^`\n]*`", re.DOTALL | re.MULTILINE)
_LINK = re.compile(r"\]\(([^()\s]+)\)|(?:src|href)=\"([^\"]+)\"")


def anchors(page: Path) -> set[str]:
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


@pytest.mark.parametrize("page", LINKING, ids=lambda page: str(page.relative_to(REPOSITORY)))
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
    suffixes = {".py", ".sh", ".toml", ".yaml", ".yml", ".sbatch", ".html", ".ipynb"}
    files = [file for file in (REPOSITORY / room).rglob("*") if file.suffix in suffixes]
    assert files
    named = {(str(file.relative_to(REPOSITORY)), page) for file in files for page in _LINKED.findall(file.read_text())}
    assert {(file, page) for file, page in named if not (REPOSITORY / page).is_file()} == set()


@cache
def pages() -> dict[str, Counter[str]]:
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


@pytest.mark.parametrize("asked", QUESTIONS, ids=lambda asked: asked["question"])
def test_a_question_is_answered_within_one_search_and_one_page(asked: dict[str, Any]) -> None:
    text = (DOCS / asked["page"]).read_text()
    assert [words for words in asked["words"] if words not in text] == []
    assert asked["page"] in ranked(asked["search"])[:LOOKED_AT]


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    if not (find_spec("material") and find_spec("mkdocstrings")):
        pytest.skip("needs pip install '.[docs]'; make docs-site brings it")
    folder = tmp_path_factory.mktemp("site")
    build = (sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet")
    done = completed([*build, "--site-dir", folder], cwd=REPOSITORY)
    assert done.returncode == 0, done.stderr
    return folder


def test_every_page_of_the_docs_is_a_page_of_the_site(site: Path) -> None:
    pages = [page.relative_to(REPOSITORY / "docs") for page in (REPOSITORY / "docs").rglob("*.md")]
    names = {page.with_name("index.html" if page.name == "README.md" else f"{page.stem}.html") for page in pages}
    assert {name for name in names if not (site / name).is_file()} == set()
    assert "First grasps" in (site / "index.html").read_text()


def test_the_site_fetches_nothing_from_elsewhere(site: Path) -> None:
    fetched = {(page.name, url) for page in site.rglob("*.html") for url in _FETCHED.findall(page.read_text())}
    styles = {(sheet.name, url) for sheet in site.rglob("*.css") for url in _IMPORTED.findall(sheet.read_text())}
    assert fetched | styles == set()


def test_every_public_name_is_in_the_reference(site: Path) -> None:
    text = (site / "reference" / "api.html").read_text()
    names = {name for name in graspd.__all__ if not name.startswith("_")}
    assert {name for name in names if not re.search(rf'id="[\w.]+\.{name}"', text)} == set()

"""Files that a public project keeps beside its sources are valid; `import graspd` is light and complete."""

import re
import sys
import tomllib
from pathlib import Path
from typing import Any

import check_jsonschema
import pytest
import yaml
from click.testing import CliRunner
from packaging.specifiers import SpecifierSet

import graspd
from docs.commands import Line
from graspd.service.model.version import PACKAGE_VERSION
from tests.conftest import REPOSITORY
from tests.shell import completed

FORGE = REPOSITORY / ".github"
WORKFLOWS = sorted((FORGE / "workflows").glob("*"))
#: Name of a schema that check-jsonschema brings, and the files that it describes.
SCHEMAS = {
    "citation-file-format": [REPOSITORY / "CITATION.cff"],
    "dependabot": [FORGE / "dependabot.yml"],
    "github-issue-forms": sorted((FORGE / "ISSUE_TEMPLATE").glob("*")),
    "github-workflows": WORKFLOWS,
    "compose-spec": [REPOSITORY / "docker-compose.yml"],
}
PROSE = [
    *(REPOSITORY / name for name in ("CONTRIBUTING.md", "SECURITY.md", "CODE_OF_CONDUCT.md")),
    FORGE / "pull_request_template.md",
]


def jobs() -> dict[str, Any]:
    return {name: job for file in WORKFLOWS for name, job in yaml.safe_load(file.read_text())["jobs"].items()}


@pytest.mark.parametrize("schema", SCHEMAS)
def test_files_are_what_their_readers_take(schema: str) -> None:
    files = SCHEMAS[schema]
    assert files
    done = CliRunner().invoke(check_jsonschema.main, ["--builtin-schema", f"vendor.{schema}", *map(str, files)])
    assert done.exit_code == 0, done.output


def test_workflows_run_commands_that_exist() -> None:
    lines = [line for job in jobs().values() for step in job["steps"] for line in step.get("run", "").splitlines()]
    assert {"make check PYTHON=python", "make test PYTHON=python", "make dist PYTHON=python"} <= set(lines)
    faults = [Line("ci.yml", line).fault() for line in lines]
    assert not any(faults), faults


def test_workflows_test_every_python_that_the_package_allows() -> None:
    project = tomllib.loads((REPOSITORY / "pyproject.toml").read_text())["project"]
    allowed = SpecifierSet(project["requires-python"])
    tested = jobs()["test"]["strategy"]["matrix"]["python"]
    assert tested == [f"3.{minor}" for minor in range(30) if f"3.{minor}" in allowed]


@pytest.mark.parametrize("page", PROSE, ids=lambda page: page.name)
def test_code_that_a_page_names_exists(page: Path) -> None:
    named = re.findall(r"`([^`\n]+)`", re.sub(r"```.*?```", "", page.read_text(), flags=re.DOTALL))
    faults = [Line(page.name, one).fault() for one in named]
    paths = [word for one in named for word in one.split() if "/" in word and not word.startswith(".venv/")]
    assert not any(faults), faults
    assert [path for path in paths if not (REPOSITORY / path).exists()] == []


def test_the_documentation_stays_short() -> None:
    pages = [page for page in REPOSITORY.rglob("*.md") if not {".venv", ".pytest_cache", "build"} & set(page.parts)]
    # Tables that follow from the code are not prose.
    words = {
        page: len(re.sub(r"<!-- (\w+) -->\n.*?<!-- /\1 -->", "", page.read_text(), flags=re.DOTALL).split())
        for page in pages
        if REPOSITORY / "docs" / "results" not in page.parents
    }
    assert words[REPOSITORY / "README.md"] <= 900 and words[REPOSITORY / "CONTRIBUTING.md"] <= 700
    assert sum(words.values()) <= 45_000
    assert len((REPOSITORY / "ARCHITECTURE.md").read_text().splitlines()) <= 300


def test_a_citation_names_the_last_release() -> None:
    cited = yaml.safe_load((REPOSITORY / "CITATION.cff").read_text())
    assert cited["version"] == PACKAGE_VERSION
    assert f"\n## {PACKAGE_VERSION}, {cited['date-released']}\n" in (REPOSITORY / "CHANGELOG.md").read_text()


def test_decisions_have_numbers_of_their_own_and_are_listed() -> None:
    folder = REPOSITORY / "docs" / "adr"
    files = sorted(folder.glob("[0-9]*.md"))
    assert [int(file.name[:4]) for file in files] == list(range(1, len(files) + 1))
    listed = re.findall(r"^- \[(.+)\]\((.+)\)$", (folder / "README.md").read_text(), re.MULTILINE)
    assert listed == [(file.read_text().splitlines()[0].removeprefix("# "), file.name) for file in files]


def test_a_commit_is_checked_by_the_tools_of_make_check() -> None:
    config = yaml.safe_load((REPOSITORY / ".pre-commit-config.yaml").read_text())
    recipe = (REPOSITORY / "Makefile").read_text().partition("\ncheck:")[2].partition("\n\n")[0]
    checked = set(re.findall(r"\$\(BIN\)/([\w-]+)", recipe))
    tools = {hook["entry"].split()[0] for repository in config["repos"] for hook in repository["hooks"]}
    assert tools <= {f".venv/bin/{name}" for name in checked}


ENGINE = {"warp", "newton", "trimesh", "mujoco", "scipy", "yourdfpy"}
WORK = {*ENGINE, "graspd.worker"}
SERVER = {"jinja2", "uvicorn", "fastapi", "starlette", "sqlalchemy", "redis"}
CLIENT = "from graspd.client import client, commands, add_commands, dataset_commands, access_commands, tag_commands"
OVERVIEW = """
import contextlib, io, sys
import graspd.cli
sys.argv = ["graspd", "--help"]
with contextlib.redirect_stdout(io.StringIO()), contextlib.suppress(SystemExit):
    graspd.cli.main()
"""
#: The readers' module for torch is for those who have it.
SERVICE = [file for file in (REPOSITORY / "service").rglob("[a-z]*.py") if file.name != "torch_data.py"]
MODULES = [".".join(("graspd", *file.relative_to(REPOSITORY).with_suffix("").parts)) for file in SERVICE]
#: All that `import graspd` imports of its own: `libraries` imports the others without the garbage collector.
OWN = {"graspd", "graspd.service", "graspd.service.model", "graspd.service.model.libraries"}


def modules_after(statement: str) -> set[str]:
    done = completed([sys.executable, "-c", f"{statement}\nimport sys\nprint(*sys.modules)"], cwd=REPOSITORY)
    assert done.returncode == 0, done.stderr
    return set(done.stdout.split())


@pytest.mark.parametrize(
    ("statement", "absent"),
    [
        ("import graspd", {*WORK, "numpy", "pydantic", "h5py", "httpx"}),
        ("import graspd.api.app", WORK),
        (CLIENT, WORK | SERVER),
        (OVERVIEW, {*WORK, "fastapi", "sqlalchemy", "h5py", "numpy"}),
        (f"import {', '.join(MODULES)}", {*WORK, "torch", "graspd.api"}),
        # A worker says that it lives before the engine and the kernels are imported.
        ("import graspd.commands.worker, graspd.worker.process.main", ENGINE),
        ("import graspd.service.run.supervisor", {*WORK, "fastapi", "sqlalchemy"}),
    ],
    ids=["package", "server", "client", "overview", "service", "worker", "supervisor"],
)
def test_each_part_imports_no_more_than_it_needs(statement: str, absent: set[str]) -> None:
    assert modules_after(statement).isdisjoint(absent)


def test_the_package_imports_itself_where_it_is_used() -> None:
    assert {name for name in modules_after("import graspd") if name.partition(".")[0] == "graspd"} == OWN


def test_every_public_name_is_there_and_the_errors_are_one_tree() -> None:
    found = {name: getattr(graspd, name) for name in graspd.__all__}
    assert all(issubclass(one, graspd.GraspdError) for name, one in found.items() if name.endswith("Error"))
    with pytest.raises(AttributeError, match="no_such_name"):
        _ = graspd.no_such_name

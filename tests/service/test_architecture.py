"""ARCHITECTURE.md and docs say what the code does: tests, layers, files."""

import ast
import importlib
import inspect
import re
import tomllib

import pytest

from docs.tables import PAGES, PARTS, update_tables
from graspd.service.settings import GONE, Settings
from tests.conftest import PACKAGES, REPOSITORY


def test_every_test_that_a_page_names_is_there() -> None:
    pages = [REPOSITORY / "ARCHITECTURE.md", *REPOSITORY.glob("docs/**/*.md")]
    named = [one for page in pages for one in re.findall(r"`(tests/[\w/]+\.py)(?:::(\w+))?`", page.read_text())]
    assert len(named) >= 15
    for file, test in named:
        assert f"def {test}" in (REPOSITORY / file).read_text(), f"{file}::{test}"


def rows_of(heading: str) -> list[list[str]]:
    _, _, rest = (REPOSITORY / "ARCHITECTURE.md").read_text().partition(f"| {heading} |")
    table = rest.partition("\n\n")[0].splitlines()[2:]
    return [[cell.strip() for cell in line.strip("|").split(" | ")] for line in table]


@pytest.mark.parametrize("package", ["api", "worker", "service"])
def test_the_layers_are_those_that_the_contracts_keep(package: str) -> None:
    contracts = tomllib.loads((REPOSITORY / "pyproject.toml").read_text())["tool"]["importlinter"]["contracts"]
    (kept,) = [c["layers"] for c in contracts if c["type"] == "layers" and c["containers"] == [f"graspd.{package}"]]
    layers = [set(re.findall(r"`(\w+)`", first)) for first, _ in rows_of(f"layer of `{package}/` | what it is")]
    assert layers == [set(re.findall(r"\w+", layer)) for layer in kept]


def test_the_files_to_open_for_a_change_are_there() -> None:
    rows = rows_of("I want to ... | open these files | files")
    assert len(rows) >= 8
    for wish, files, number in rows:
        named = re.findall(r"`([\w./]+)`", files)
        assert len(named) == int(number), wish
        missing = [name for name in named if not (REPOSITORY / name).exists()]
        assert not missing, f"{wish}: {missing}"


def test_the_interfaces_of_the_engine_have_these_parameters() -> None:
    _, _, text = (REPOSITORY / "ARCHITECTURE.md").read_text().partition("## Interfaces of the engine")
    named = re.findall(r"^    (graspd[\w.]+) +(\w+)\(([^)]*)\)", text, re.MULTILINE)
    assert len(named) == 10
    for module, function, parameters in named:
        known = inspect.signature(getattr(importlib.import_module(module), function)).parameters
        assert set(re.findall(r"\w+", parameters)) <= set(known), function


#: The task engine of our own: what carries tasks from the controller to a worker's result and back. Rates of batches
#: (`service.index`), the series of `/metrics` and the checks of `graspd doctor` are none of it.
TASK_ENGINE = ["service/queue", "worker/process", "worker/pool"]
_OF_PIPELINE = ("controller", "leading", "lease_reaper", "tagging", "backends")
TASK_ENGINE += [f"service/pipeline/{name}.py" for name in _OF_PIPELINE]


def test_the_task_engine_stays_within_its_budget_of_lines() -> None:
    places = [REPOSITORY / place for place in TASK_ENGINE]
    files = [file for place in places for file in ([place] if place.suffix else sorted(place.glob("*.py")))]
    assert all(place.exists() for place in places) and len(files) >= 20
    assert sum(len(file.read_text().splitlines()) for file in files) <= 3_200


@pytest.fixture(scope="module")
def product() -> dict[str, str]:
    files = [file for package in PACKAGES for file in (REPOSITORY / package).rglob("*.py")]
    return {str(file): text for file in files if (text := file.read_text())}


@pytest.mark.parametrize("what, budget", [("modules", 520), ("lines", 80_000), ("lines that the formatter skips", 40)])
def test_the_product_stays_within_its_budget(what: str, budget: int, product: dict[str, str]) -> None:
    found = {
        "modules": len(product),
        "lines": sum(len(text.splitlines()) for text in product.values()),
        "lines that the formatter skips": sum(text.count("fmt: skip") for text in product.values()),
    }
    assert 0 < found[what] <= budget


def test_first_lines_of_docstrings_are_short(product: dict[str, str]) -> None:
    owners = (ast.Module, ast.ClassDef, ast.FunctionDef)
    nodes = ((file, node) for file, text in product.items() for node in ast.walk(ast.parse(text)))
    docs = ((file, ast.get_docstring(node)) for file, node in nodes if isinstance(node, owners))
    assert [f"{file}: {text}" for file, text in docs if text and len(text.partition("\n")[0]) > 100] == []


def test_no_line_spells_a_key_of_rq(product: dict[str, str]) -> None:
    """RQ itself says where it keeps what: `service.queue.entries` asks it."""
    assert [file for file, text in product.items() if re.search(r"""["']rq:""", text)] == []


def test_the_tables_of_the_pages_are_up_to_date() -> None:
    pages = [(REPOSITORY / page).read_text() for page in PAGES]
    assert [update_tables(text) for text in pages] == pages, "run: make docs"
    assert all(f"<!-- {name} -->" in "".join(pages) for name in PARTS)


def test_settings_named_in_the_docs_exist() -> None:
    pages = [*REPOSITORY.glob("*.md"), *REPOSITORY.glob("docs/**/*.md"), REPOSITORY / "Makefile"]
    known = {f"GRASPD_{name.upper()}" for name in Settings.model_fields} | GONE.keys()
    for page in pages:
        named = set(re.findall(r"GRASPD_[A-Z][A-Z_]*[A-Z]", page.read_text()))
        assert named <= known, f"{page.name} names unknown settings"

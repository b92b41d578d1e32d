"""Templates compile, vendored files are what their lists say, words on a cell of the matrix can be read."""

import hashlib
import json
import re
from pathlib import Path
from typing import Final

import pytest
from jinja2 import meta, nodes

from graspd.api.dashboard.rendering import STATIC, environment

#: Functions that `render` gives to every page; what a macro is called with.
GIVEN: Final = {"may_change", "caller", "address"}
ENVIRONMENT: Final = environment()
TEMPLATES: Final = sorted(ENVIRONMENT.list_templates())
FOLDERS = (STATIC / "vendor", Path(__file__).parents[2] / "browser" / "vendor")
#: What is bundled comes with the list of its parts.
SOURCES = {"ogl-entry.mjs"}
PERMISSIVE = {"MIT", "0BSD", "OFL-1.1", "Apache-2.0", "Unlicense"}
#: What WCAG asks for between a text of that size and what it stands on.
CONTRAST = 4.5
_PAIR = r"light-dark\((#\w{6}), (#\w{6})\)"


def parsed(name: str) -> nodes.Template:
    assert ENVIRONMENT.loader is not None
    return ENVIRONMENT.parse(ENVIRONMENT.loader.get_source(ENVIRONMENT, name)[0])


def macros(template: nodes.Template) -> set[str]:
    return imports(template) | {macro.name for macro in template.find_all(nodes.Macro)}


def imports(template: nodes.Template) -> set[str]:
    return {str(name) for one in template.find_all(nodes.FromImport) for name in one.names}


@pytest.mark.parametrize("name", TEMPLATES)
def test_a_template_compiles_and_calls_what_there_is(name: str) -> None:
    ENVIRONMENT.get_template(name)
    assert imports(parsed(name)) <= macros(parsed("parts.html"))
    called = {call.node.name for call in parsed(name).find_all(nodes.Call) if isinstance(call.node, nodes.Name)}
    missing = called - macros(parsed(name)) - GIVEN - set(ENVIRONMENT.globals)
    including = [one for one in TEMPLATES if name in (meta.find_referenced_templates(parsed(one)) or ())]
    if including:
        # A part uses the macros of the page that includes it.
        missing = {call for call in missing if any(call not in macros(parsed(page)) for page in including)}
    assert missing == set()


@pytest.mark.parametrize("folder", FOLDERS, ids=["served", "for tests"])
def test_vendored_files_are_those_of_the_list(folder: Path) -> None:
    entries = json.loads((folder / "vendor.json").read_text())
    listed = {name: checksum for entry in entries for name, checksum in entry["files"].items()}
    assert {name: hashlib.sha256((folder / name).read_bytes()).hexdigest() for name in listed} == listed
    licences = {entry["licence_file"] for entry in entries}
    assert {path.name for path in folder.iterdir()} == {*listed, *licences, "vendor.json"} | (
        SOURCES if folder == FOLDERS[0] else set()
    )
    assert all((folder / name).stat().st_size > 200 for name in licences)


def test_what_users_are_served_is_licensed_permissively() -> None:
    entries = json.loads((FOLDERS[0] / "vendor.json").read_text())
    assert {entry["licence"] for entry in entries} <= PERMISSIVE
    assert all(entry["version"] and entry["made"] for entry in entries)


def luminance(colour: str) -> float:
    parts = [int(colour[at : at + 2], 16) / 255 for at in (1, 3, 5)]
    linear = [part / 12.92 if part <= 0.04045 else ((part + 0.055) / 1.055) ** 2.4 for part in parts]
    return sum(weight * part for weight, part in zip((0.2126, 0.7152, 0.0722), linear, strict=True))


@pytest.mark.parametrize("scheme", [0, 1], ids=["light", "dark"])
def test_a_shade_leaves_its_words_readable(scheme: int) -> None:
    (ink,) = re.findall(rf"--ink: {_PAIR}", (STATIC / "style.css").read_text())
    shades = re.findall(rf"\.y\d+ > div, i\.y\d+ {{ background: {_PAIR}", (STATIC / "pages.css").read_text())
    assert len(shades) == 11
    for shade in shades:
        darker, lighter = sorted((luminance(ink[scheme]), luminance(shade[scheme])))
        assert (lighter + 0.05) / (darker + 0.05) >= CONTRAST, shade

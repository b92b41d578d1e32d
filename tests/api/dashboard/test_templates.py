"""Every template compiles, and every macro that it calls in any branch is its own or imported."""

from __future__ import annotations

from typing import Final

import pytest
from jinja2 import meta, nodes

from graspd.api.dashboard.rendering import environment

#: Functions that `render` gives to every page; what a macro is called with.
GIVEN: Final = {"may_change", "caller"}
ENVIRONMENT: Final = environment()
TEMPLATES: Final = sorted(ENVIRONMENT.list_templates())


def parsed(name: str, source: str = "") -> nodes.Template:
    assert ENVIRONMENT.loader is not None
    return ENVIRONMENT.parse(source or ENVIRONMENT.loader.get_source(ENVIRONMENT, name)[0])


def unknown_calls(template: nodes.Template) -> set[str]:
    """Names that a template calls and neither defines nor imports."""
    called = {call.node.name for call in template.find_all(nodes.Call) if isinstance(call.node, nodes.Name)}
    return called - macros(template) - GIVEN - set(ENVIRONMENT.globals)


def macros(template: nodes.Template) -> set[str]:
    """Names of the macros that a template defines or imports for itself and the parts that it includes."""
    imported = {name for one in template.find_all(nodes.FromImport) for name in one.names if isinstance(name, str)}
    return imported | {macro.name for macro in template.find_all(nodes.Macro)}


@pytest.mark.parametrize("name", TEMPLATES)
def test_a_template_compiles_and_calls_what_there_is(name: str) -> None:
    ENVIRONMENT.get_template(name)
    missing = unknown_calls(parsed(name))
    including = [one for one in TEMPLATES if name in (meta.find_referenced_templates(parsed(one)) or ())]
    if including:
        # A part uses the macros of the page that includes it.
        missing = {call for call in missing if any(call not in macros(parsed(page)) for page in including)}
    assert missing == set()


def test_a_missing_macro_is_found_in_a_rare_branch() -> None:
    source = '{% from "parts.html" import when %}{% if rare %}{% call delete_dialog("a") %}x{% endcall %}{% endif %}'
    assert unknown_calls(parsed("", source)) == {"delete_dialog"}
    assert unknown_calls(parsed("", source.replace("when", "when, delete_dialog"))) == set()


def test_what_a_page_imports_is_there() -> None:
    known = macros(parsed("parts.html"))
    for name in TEMPLATES:
        for one in parsed(name).find_all(nodes.FromImport):
            assert set(map(str, one.names)) <= known, name

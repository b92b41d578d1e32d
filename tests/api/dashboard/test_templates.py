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


def parsed(name: str) -> nodes.Template:
    assert ENVIRONMENT.loader is not None
    return ENVIRONMENT.parse(ENVIRONMENT.loader.get_source(ENVIRONMENT, name)[0])


def unknown_calls(template: nodes.Template) -> set[str]:
    """Names that a template calls and neither defines nor imports."""
    called = {call.node.name for call in template.find_all(nodes.Call) if isinstance(call.node, nodes.Name)}
    return called - macros(template) - GIVEN - set(ENVIRONMENT.globals)


def macros(template: nodes.Template) -> set[str]:
    """Names of the macros that a template defines or imports for itself and the parts that it includes."""
    return imports(template) | {macro.name for macro in template.find_all(nodes.Macro)}


def imports(template: nodes.Template) -> set[str]:
    return {str(name) for one in template.find_all(nodes.FromImport) for name in one.names}


@pytest.mark.parametrize("name", TEMPLATES)
def test_a_template_compiles_and_calls_what_there_is(name: str) -> None:
    ENVIRONMENT.get_template(name)
    assert imports(parsed(name)) <= macros(parsed("parts.html"))
    missing = unknown_calls(parsed(name))
    including = [one for one in TEMPLATES if name in (meta.find_referenced_templates(parsed(one)) or ())]
    if including:
        # A part uses the macros of the page that includes it.
        missing = {call for call in missing if any(call not in macros(parsed(page)) for page in including)}
    assert missing == set()

"""Names as files and formats allow them, one rule for each."""

from __future__ import annotations

import re
from collections.abc import Sequence

from service.model.names import fitted


def plain_name(name: str) -> str:
    """A name fit for files and addresses; a long one is cut, which the log tells."""
    return fitted(re.sub(r"[^A-Za-z0-9._-]+", "-", name).strip("-.") or "unnamed")


def prim_name(name: str) -> str:
    """A name that USD allows for a prim: ASCII letters, digits and underscores, no digit first."""
    plain = re.sub(r"[^A-Za-z0-9_]+", "_", name) or "_"
    return f"_{plain}" if plain[0].isdigit() else plain


def prim_names(names: Sequence[str]) -> list[str]:
    """Names of prims with one parent: no two are the same, later ones are numbered."""
    found: list[str] = []
    for name in map(prim_name, names):
        number = 1
        while (one := name if number == 1 else f"{name}_{number}") in found:
            number += 1
        found.append(one)
    return found

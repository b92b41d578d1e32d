"""graspd's rooms are top-level packages called service, worker and api: no folder of a user must hide them."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path
from typing import Final

#: The packages that graspd is made of, besides its front door.
ROOMS: Final = ("service", "worker", "api")


def check() -> None:
    """ImportError, in one line that names the folder, if a package of the user stands in the place of one of graspd's.

    Nothing is imported. A room that is not there at all is told when it is needed.
    """
    home = Path(__file__).resolve().parent.parent
    for room in ROOMS:
        if not (home / room).is_dir():
            continue
        spec = find_spec(room)
        if spec is None or spec.origin == str(home / room / "__init__.py"):
            continue
        places = [spec.origin] if spec.origin else list(spec.submodule_search_locations or [])
        found = Path(places[0]) if places else home
        if found.name == "__init__.py":
            found = found.parent
        if found.resolve() != home / room:
            raise ImportError(
                f"graspd: {found} hides graspd's own package {room!r}; rename it, or start Python in another folder"
            )

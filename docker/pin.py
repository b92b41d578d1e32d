"""Pins of the images: every package they install, at the version that is installed here and that the tests ran with.

python docker/pin.py > docker/constraints.txt
"""

from __future__ import annotations

import sys
import tomllib
from collections.abc import Iterable, Iterator
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).resolve().parent.parent
#: What the images are made of; `graspd up` and its embedded Redis do not run there.
EXTRAS = ("api", "worker", "postgres", "otel", "gpu")


def requirements(*extras: str) -> list[Requirement]:
    """What pyproject.toml asks for with these extras."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    lines = list(project["dependencies"])
    for extra in extras:
        lines += project["optional-dependencies"][extra]
    return [Requirement(line) for line in lines]


def closure(wanted: Iterable[Requirement]) -> dict[str, str]:
    """Name and version of all packages that requirements bring in here, the indirect ones too."""
    found: dict[str, str] = {}
    seen: set[tuple[str, frozenset[str]]] = set()
    waiting = list(wanted)
    while waiting:
        requirement = waiting.pop()
        name, extras = canonicalize_name(requirement.name), frozenset(requirement.extras)
        if (name, extras) in seen or (requirement.marker and not requirement.marker.evaluate({"extra": ""})):
            continue
        seen.add((name, extras))
        try:
            found[name] = distribution(name).version
        except PackageNotFoundError:
            raise SystemExit(f"{name} is not installed here; run `make pins`") from None
        waiting += _needs(name, extras)
    return found


def _needs(name: str, extras: frozenset[str]) -> Iterator[Requirement]:
    for line in distribution(name).requires or ():
        requirement = Requirement(line)
        if requirement.marker is None or any(requirement.marker.evaluate({"extra": e}) for e in ("", *extras)):
            requirement.marker = None
            yield requirement


if __name__ == "__main__":
    pins = closure(requirements(*EXTRAS))
    sys.stdout.write("# Versions in the images; `make pins` writes this file.\n")
    sys.stdout.writelines(f"{name}=={version.partition('+')[0]}\n" for name, version in sorted(pins.items()))

"""Pin every package of the images to the installed version, with which the tests ran.

`python docker/pin.py` writes constraints.txt, and api.lock, worker.lock and build.lock with the hashes of the wheels.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tomllib
from collections.abc import Iterable, Iterator
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).resolve().parent.parent
FOLDER = ROOT / "docker"
#: Extras of each image; `graspd up` and its embedded Redis do not run in images.
IMAGES = {"api": ("api", "postgres"), "worker": ("worker", "gpu")}
EXTRAS = tuple(dict.fromkeys(extra for extras in IMAGES.values() for extra in extras))
#: CPU architectures of the images, and their Python version.
MACHINES = ("x86_64", "aarch64")
PYTHON = "3.11"
_NOTE = "# Versions in the images; `make pins` writes this file."


def requirements(*extras: str) -> list[Requirement]:
    """Return the requirements in pyproject.toml with these extras."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    lines = list(project["dependencies"])
    for extra in extras:
        lines += project["optional-dependencies"][extra]
    return [Requirement(line) for line in lines]


def closure(wanted: Iterable[Requirement]) -> dict[str, str]:
    """Return name -> installed version of all required packages, including indirect dependencies."""
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
            raise SystemExit(f"{name} is not installed; run `make pins`") from None
        waiting += _needs(name, extras)
    return found


def _needs(name: str, extras: frozenset[str]) -> Iterator[Requirement]:
    for line in distribution(name).requires or ():
        requirement = Requirement(line)
        if requirement.marker is None or any(requirement.marker.evaluate({"extra": e}) for e in ("", *extras)):
            requirement.marker = None
            yield requirement


def wheels(wanted: Iterable[str]) -> dict[str, tuple[str, set[str]]]:
    """Return name -> version and SHA-256 of the wheels that pip would install, for all architectures.

    Queries the package index. Raises SystemExit if a package has no wheel.
    """
    found: dict[str, tuple[str, set[str]]] = {}
    for machine in MACHINES:
        platforms = [f"manylinux_2_{minor}_{machine}" for minor in range(5, 37)] + [f"manylinux2014_{machine}"]
        command = [sys.executable, "-m", "pip", "install", "--dry-run", "--ignore-installed", "--no-deps", "--quiet"]
        command += ["--report", "-", "--only-binary", ":all:", "--python-version", PYTHON, "--implementation", "cp"]
        command += [word for one in platforms for word in ("--platform", one)]
        done = subprocess.run([*command, "--target", "unused", *wanted], capture_output=True, text=True, check=False)
        if done.returncode:
            raise SystemExit(f"{machine}: {done.stderr.strip().splitlines()[-1]}")
        for one in json.loads(done.stdout[done.stdout.index("{") :])["install"]:
            name, version = canonicalize_name(one["metadata"]["name"]), one["metadata"]["version"]
            _, known = found.setdefault(name, (version, set()))
            known.add(one["download_info"]["archive_info"]["hashes"]["sha256"])
    return found


def main() -> None:
    """Write the constraints, and for each image a lock file with hashes of wheels."""
    pins = _versions(requirements(*EXTRAS))
    lines = [f"{name}=={version}" for name, version in sorted(pins.items())]
    (FOLDER / "constraints.txt").write_text("\n".join([_NOTE, *lines, ""]))
    build = tomllib.loads((ROOT / "pyproject.toml").read_text())["build-system"]["requires"]
    known = wheels([*lines, *build])
    names = {image: _versions(requirements(*extras)).keys() for image, extras in IMAGES.items()}
    names["build"] = {canonicalize_name(Requirement(one).name) for one in build}
    for image, its in names.items():
        locked = [
            " \\\n    --hash=sha256:".join([f"{name}=={known[name][0]}", *sorted(known[name][1])])
            for name in sorted(its)
        ]
        (FOLDER / f"{image}.lock").write_text("\n".join([_NOTE, *locked, ""]))


def _versions(wanted: Iterable[Requirement]) -> dict[str, str]:
    return {name: version.partition("+")[0] for name, version in closure(wanted).items()}


if __name__ == "__main__":
    main()

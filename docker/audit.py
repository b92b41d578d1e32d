"""List known vulnerabilities of packages here and in the images: `python docker/audit.py`.

Queries PyPI's advisory database by pip-audit. Exit code 0: no vulnerability is known; 1: a vulnerability is known, or
the query failed; the output states which.
"""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

PINS = Path(__file__).parent / "constraints.txt"


def main() -> int:
    """Audit the environment, then the versions that the images install."""
    found = [
        _audit("this environment", "--skip-editable", "--local"),
        _audit("the images", "--requirement", str(PINS), "--no-deps", "--disable-pip"),
    ]
    return max(found)


def _audit(what: str, *options: str) -> int:
    command = [sys.executable, "-m", "pip_audit", "--format", "json", "--progress-spinner", "off", *options]
    run = subprocess.run(command, capture_output=True, text=True, check=False)
    try:
        packages: list[dict[str, Any]] = json.loads(run.stdout)["dependencies"]
    except (ValueError, KeyError):
        _say(f"{what}: nothing was audited: {_last_line(run.stderr)}")
        return 1
    asked = [package for package in packages if "skip_reason" not in package]
    bad = [package for package in asked if package["vulns"]]
    for package in bad:
        for flaw in package["vulns"]:
            fix = ", ".join(flaw["fix_versions"]) or "no release fixes it yet"
            _say(f"{package['name']} {package['version']}: {flaw['id']}; {fix}")
    if not asked:
        _say(f"{what}: nothing was audited: the advisory database is unreachable")
        return 1
    unknown = len(packages) - len(asked)
    left_out = f"; {unknown} were skipped" if unknown else ""
    _say(f"{what}: {len(asked)} packages, {len(bad)} with known vulnerabilities{left_out}")
    return 1 if bad else 0


def _last_line(text: str) -> str:
    return (text.strip().splitlines() or ["pip-audit printed no error"])[-1]


def _say(line: str) -> None:
    sys.stdout.write(f"{line}\n")


if __name__ == "__main__":
    sys.exit(main())

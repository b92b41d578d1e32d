"""MkDocs hooks: add pages outside `docs/` to the site; remove links to other files of the repository.

GitHub renders the same files without the hooks, so README.md, CONTRIBUTING.md and others stay in the root folder.
"""

from __future__ import annotations

import os
import posixpath
import re
from pathlib import Path
from typing import Any, Final

from mkdocs.structure.files import File, Files

ROOT: Final = Path(__file__).resolve().parents[1]
#: Page of the repository -> its path in the site.
OUTSIDE: Final = {
    "README.md": "index.md",
    "CONTRIBUTING.md": "project/contributing.md",
    "ARCHITECTURE.md": "project/architecture.md",
    "SECURITY.md": "project/security.md",
    "CODE_OF_CONDUCT.md": "project/conduct.md",
    "CHANGELOG.md": "project/changelog.md",
    "examples/train_grasp_predictor/README.md": "how-to/example-network.md",
    "examples/behaviour_cloning/README.md": "how-to/example-policy.md",
}
_INSIDE: Final = {place: source for source, place in OUTSIDE.items()}
_CODE: Final = re.compile(r"(^```.*?^```)", re.DOTALL | re.MULTILINE)
_LINK: Final = re.compile(r"(!?)\[((?:[^\[\]]|\[[^\]]*\])*)\]\(([^()\s]+)\)|(src|href)=\"([^\"]+)\"")


def on_files(files: Files, *, config: Any) -> Files:
    """Add the pages outside `docs/`."""
    for source, place in OUTSIDE.items():
        files.append(File.generated(config, place, content=(ROOT / source).read_text()))
    return files


def on_page_markdown(markdown: str, *, page: Any, files: Files, **_: Any) -> str:
    """Return the page with links of the site; links to files that are not in the site become plain text."""
    place = page.file.src_uri
    if place.startswith(("results/", "adr/")):
        page.meta.setdefault("search", {"boost": 0.2})  # pages of figures rarely answer a question
    source = _INSIDE.get(place, f"docs/{place}")

    def of_site(link: str) -> str | None:
        """Return the link within the site; None if the site lacks the target."""
        if re.match(r"[a-z]+:|#", link):
            return link
        path, mark, anchor = link.partition("#")
        target = posixpath.normpath(posixpath.join(posixpath.dirname(source), path))
        inside = OUTSIDE.get(target) or target.removeprefix("docs/")
        if (ROOT / target).is_dir() and f"{target}/README.md" in OUTSIDE:
            inside = OUTSIDE[f"{target}/README.md"]
        elif (ROOT / target).is_dir() and files.get_file_from_path(f"{inside}/README.md"):
            inside = f"{inside}/README.md"
        if files.get_file_from_path(inside) is None:
            return None
        return os.path.relpath(inside, posixpath.dirname(place) or ".") + mark + anchor

    def fixed(found: re.Match[str]) -> str:
        if found[4]:
            return f'{found[4]}="{of_site(found[5]) or found[5]}"'
        text = _LINK.sub(fixed, found[2])
        link = of_site(found[3])
        return f"{found[1]}[{text}]({link})" if link else text

    parts = _CODE.split(markdown)
    return "".join(part if number % 2 else _LINK.sub(fixed, part) for number, part in enumerate(parts))

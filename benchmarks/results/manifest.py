"""`MANIFEST.json`: command, date, machine, revision and file digests of each study."""

from __future__ import annotations

import hashlib
import json
import re
import subprocess
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

from benchmarks.results.studies import BY_NAME, STUDIES, Study, files_of, is_raw
from graspd.service.model.version import STAGE_REVISIONS

REPOSITORY: Final = Path(__file__).resolve().parents[2]
DOCS: Final = REPOSITORY / "docs"
#: Paths under the folder of the docs; these two files are not results.
MANIFEST, INDEX = "results/MANIFEST.json", "results/README.md"
_REVISIONS: Final = re.compile(r"^STAGE_REVISIONS[^=]*= (\{[^}]*\})", re.MULTILINE)

Manifest = dict[str, dict[str, Any]]


def load(docs: Path) -> Manifest:
    """Return records by study; empty if there is no manifest."""
    file = docs / MANIFEST
    return json.loads(file.read_text())["studies"] if file.is_file() else {}


def save(docs: Path, records: Manifest) -> None:
    order = list(BY_NAME)
    known = sorted(records, key=lambda name: order.index(name) if name in order else len(order))
    ordered = {name: records[name] for name in known}
    write(docs / MANIFEST, json.dumps({"studies": ordered}, indent=1, allow_nan=False) + "\n")


def write(file: Path, text: str) -> None:
    """Write atomically, so that a killed run leaves no partial file."""
    file.parent.mkdir(parents=True, exist_ok=True)
    partial = file.with_suffix(".part")
    partial.write_text(text)
    partial.replace(file)


def digests(study: Study, docs: Path) -> dict[str, str]:
    """Return the SHA-256 of each file of a study in git, by path under the folder of the docs."""
    paths = {str(file.relative_to(docs)): file for file in files_of(study, docs)}
    return {path: _sha256(file) for path, file in paths.items() if not is_raw(path)}


def faults(docs: Path, records: Mapping[str, dict[str, Any]]) -> list[str]:
    """Return disagreements: files without a record, different digests, missing files, unknown studies."""
    held = {path: digest for record in records.values() for path, digest in record["files"].items()}
    found = [f"{path}: not recorded" for path in sorted(there(docs) - held.keys())]
    for path, digest in held.items():
        if not (docs / path).is_file():
            found.append(f"{path}: missing")
        elif _sha256(docs / path) != digest:
            found.append(f"{path}: changed since it was recorded")
    return found + [f"{name}: no such study" for name in records if name not in BY_NAME]


def there(docs: Path) -> set[str]:
    """Return all results, pictures and other files of studies in a docs folder, except raw results."""
    files = [file for place in ("results", "images") for file in (docs / place).rglob("*") if file.is_file()]
    files += [file for study in STUDIES for file in files_of(study, docs)]
    paths = {str(file.relative_to(docs)) for file in files} - {MANIFEST, INDEX}
    return {path for path in paths if not is_raw(path)}


def staleness(study: Study, record: Mapping[str, Any] | None) -> str:
    """Return why a study is stale; empty if its record has the current revisions."""
    if record is None:
        return "not made yet"
    made = record["stage_revisions"]
    if study.stages and made is None:
        return "of an unknown revision"
    older = [f"{stage} {made.get(stage)}" for stage in study.stages if made.get(stage) != STAGE_REVISIONS[stage]]
    return f"of {', '.join(older)}" if older else ""


def entered(study: Study, docs: Path) -> dict[str, Any]:
    """Return a record of existing files from their contents and the git history; unknown fields are null.
    The revision is the oldest of the commits that last changed one of the files."""
    files = digests(study, docs)
    commits = [_git("log", "-1", "--format=%cI %h", "--", f"docs/{path}") for path in files]
    changed = [path for path in files if _git("status", "--porcelain", "--", f"docs/{path}")]
    date, _, revision = ("", "", _git("rev-parse", "--short", "HEAD")) if changed else min(commits).partition(" ")
    said = _said_by(files_of(study, docs))
    return {
        "told_by": "files and history",
        "command": said.get("command"),
        "revision": revision,
        "stage_revisions": dict(STAGE_REVISIONS) if changed else stage_revisions_at(revision),
        "seeds": None,
        "machine": said.get("device"),
        "versions": said.get("versions"),
        "date": str(said.get("created") or said.get("card_made") or said.get("date") or date)[:10] or None,
        "seconds": None,
        "files": files,
    }


def stage_revisions_at(revision: str) -> dict[str, int] | None:
    """Return `STAGE_REVISIONS` of a commit; None if the commit or the constant does not exist."""
    text = _git("grep", "-h", "-A4", "^STAGE_REVISIONS.*= {", revision, "--", "*.py")
    found = _REVISIONS.search(text)
    return json.loads(found[1].replace(",}", "}").replace("'", '"')) if found else None


def _said_by(files: Any) -> dict[str, Any]:
    """Return the first JSON file with facts about its origin."""
    for file in files:
        if file.suffix == ".json":
            found = json.loads(file.read_text())
            if isinstance(found, dict) and {"command", "created", "card_made", "date"} & found.keys():
                return found
    return {}


def _sha256(file: Path) -> str:
    return hashlib.sha256(file.read_bytes()).hexdigest()


def _git(*arguments: str) -> str:
    """Return the output of git in this checkout; empty on failure."""
    try:
        done = subprocess.run(["git", *arguments], cwd=REPOSITORY, capture_output=True, text=True, check=False)
    except FileNotFoundError:
        return ""
    return "" if done.returncode else done.stdout.strip()


def revision_of_today() -> str:
    """Return the current commit, with `+` if files outside docs/ differ from it."""
    changed = _git("status", "--porcelain", "--untracked-files=no", "--", ":!docs")
    return (_git("rev-parse", "--short", "HEAD") or "unknown") + ("+" if changed else "")

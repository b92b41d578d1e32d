"""Names of the product are words of the glossary, or plain words that docs/reference/names.txt lists."""

import ast
import re

import pytest
import typer

from graspd.cli import COMMANDS, build_app, load_command
from graspd.service.settings import Settings
from graspd.service.store.columns import ATTRIBUTES, SCHEMAS
from tests.conftest import PACKAGES, REPOSITORY

REFERENCE = REPOSITORY / "docs" / "reference"
#: Words that say something else in the field, or nothing (docs/how-to/upgrade.md has the terms in their place).
BANNED = {
    "audit", "courier", "fragile", "judge", "judged", "keeper", "lane", "letter", "mend", "meeting", "raw", "referee",
    "scrub", "sound", "sweeper", "tried", "turnstile", "unjudged", "wishes",
}  # fmt: skip


def words(name: str) -> set[str]:
    return {word.lower() for word in re.findall(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+", name)}


def names() -> dict[str, set[str]]:
    found: dict[str, set[str]] = {kind: set() for kind in ("class", "module", "option", "setting", "column")}
    for package in PACKAGES:
        for file in (REPOSITORY / package).rglob("*.py"):
            path = file.relative_to(REPOSITORY).with_suffix("")
            found["module"] |= {part for part in path.parts if not part.startswith("__")}
            tree = ast.parse(file.read_text())
            classes = {node.name for node in ast.walk(tree) if isinstance(node, ast.ClassDef)}
            found["class"] |= {name for name in classes if not name.startswith("_")}
    found["setting"] = set(Settings.model_fields)
    found["column"] = {path for columns in SCHEMAS.values() for path in columns} | set(ATTRIBUTES)
    root = typer.Context(typer.main.get_command(build_app()))
    for name, module in {row[0]: row[1] for row in COMMANDS}.items():
        commands = [load_command(module, name, root)]
        while commands:
            command = commands.pop()
            commands += (getattr(command, "commands", None) or {}).values()
            found["option"] |= {word.lstrip("-") for one in command.params for word in one.opts}
    return found


NAMES = names()
GLOSSARY = words((REFERENCE / "glossary.md").read_text())
PLAIN = set((REFERENCE / "names.txt").read_text().split())


def known(word: str, vocabulary: set[str]) -> bool:
    return bool({word, f"{word}s", f"{word}es", word.removesuffix("s"), word.removesuffix("es")} & vocabulary)


@pytest.mark.parametrize("kind", sorted(NAMES))
def test_names_are_made_of_known_words_and_none_of_the_old(kind: str) -> None:
    assert {name for name in NAMES[kind] if words(name) & BANNED} == set()
    unknown = {name: new for name in NAMES[kind] if (new := {w for w in words(name) if not known(w, GLOSSARY | PLAIN)})}
    assert unknown == {}, "use a word of docs/reference/glossary.md, or add a plain one to names.txt"


def test_the_list_of_plain_words_has_no_word_too_many() -> None:
    used = set().union(*(words(name) for found in NAMES.values() for name in found))
    assert sorted(PLAIN) == (REFERENCE / "names.txt").read_text().split(), "in order, each once"
    assert {word for word in PLAIN if not known(word, used) or known(word, GLOSSARY)} == set()
    assert not PLAIN & BANNED

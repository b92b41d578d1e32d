"""What somebody may have meant by a word that is not known."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Sequence
from typing import Final

#: Names among which a similar one is sought, and those that a message lists.
SEARCHED: Final = 1000
_LISTED: Final = 20


def known_names(word: str, names: Sequence[str]) -> str:
    """`; there are: A, B` with the first of at most `SEARCHED` names, and the one that is like the word."""
    listed = ", ".join(names[:_LISTED]) + (", ..." if len(names) > _LISTED else "")
    return f"; there are: {listed or 'none yet'}{did_you_mean(word, names)}"


def did_you_mean(word: str, choices: Iterable[str]) -> str:
    """`; did you mean X?` for the choice that is like the word, else nothing."""
    known = {choice.lower(): choice for choice in choices}
    like = difflib.get_close_matches(word.lower(), known, n=1)
    return f"; did you mean {known[like[0]]}?" if like else ""


def one_of(word: str, choices: Iterable[str]) -> str:
    """`A, B, C`, and which of them was meant."""
    known = list(choices)
    return f"{', '.join(known)}{did_you_mean(word, known)}"

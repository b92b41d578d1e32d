"""What somebody may have meant by a word that is not known."""

from __future__ import annotations

import difflib
from collections.abc import Iterable


def did_you_mean(word: str, choices: Iterable[str]) -> str:
    """`; did you mean X?` for the choice that is like the word, else nothing."""
    known = {choice.lower(): choice for choice in choices}
    like = difflib.get_close_matches(word.lower(), known, n=1)
    return f"; did you mean {known[like[0]]}?" if like else ""

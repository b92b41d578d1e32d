"""Filter language for grasps: `epsilon > 0.3 and lift and robust >= 0.75`.

    expression   term { or term }
    term         factor { and factor }
    factor       not factor | ( expression ) | NAME | NAME op VALUE
    op           < <= > >= = == !=

Metrics are compared with numbers; `hand`, `object` and `type` with words; flags stand alone. Comparisons with a missing
number are false. The text is parsed to a tree and never executed. `service.readers.where` evaluates the tree on base
shards, `service.index.queries.grasps` on the index.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from operator import eq, ge, gt, le, lt, ne
from typing import Final

from graspd.service.model.errors import InputError, choices_text
from graspd.service.model.metrics import GRASP_METRICS, GraspType

LONGEST: Final = 1000
_DEEPEST: Final = 40
#: Codes that expressions compare as numbers.
_NUMBERS: Final = ("taxonomy_type", "digits")
_METRICS: Final = {metric.name: metric for metric in GRASP_METRICS if not metric.code or metric.name in _NUMBERS}
_SHORT: Final = {"robust": "robust_share"}
_WORDS: Final = ("hand", "object", "type")
_TYPES: Final = tuple(kind.name.lower() for kind in GraspType)
FLAGS: Final = ("validated", "valid", "feasible", "held", "lift", "lift_hard")
OPERATORS: Final = {"<": lt, "<=": le, ">": gt, ">=": ge, "=": eq, "!=": ne}
_COMPARISONS: Final = {**{op: op for op in OPERATORS}, "==": "="}
_TOKEN: Final = re.compile(
    r"\s*(?:(?P<number>[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)(?![\w.])|(?P<op><=|>=|==|!=|[<>=()])"
    r"|'(?P<quoted>[^']*)'|(?P<word>[A-Za-z0-9_][\w.\-]*))"
)


@dataclass(frozen=True)
class Flag:
    name: str


@dataclass(frozen=True)
class MetricComparison:
    """Comparison of a metric with a number."""

    name: str
    op: str
    bound: float


@dataclass(frozen=True)
class WordComparison:
    name: str
    op: str
    word: str


@dataclass(frozen=True)
class TypeComparison:
    """Comparison of the grasp type by = or !=; both are false for a grasp without type."""

    op: str
    kind: GraspType


@dataclass(frozen=True)
class Negation:
    part: Node


@dataclass(frozen=True)
class Connective:
    word: str
    parts: tuple[Node, ...]


Node = Flag | MetricComparison | WordComparison | TypeComparison | Negation | Connective


def parse_where(text: str) -> Node:
    """Parse an expression to a tree; InputError quotes the mistake or lists the known names."""
    if len(text) > LONGEST:
        raise InputError(f"the expression is {len(text)} characters long; at most {LONGEST} are allowed")
    parser = _Parser(_tokenize(text))
    found = parser.expression(0)
    if rest := parser.tokens[parser.at :]:
        raise InputError(f"{rest[0].text!r} follows a complete expression; join conditions by `and` or `or`")
    return found


@dataclass(frozen=True)
class _Token:
    kind: str
    text: str


def _tokenize(text: str) -> list[_Token]:
    found, at = [], 0
    while at < len(text.rstrip()):
        match = _TOKEN.match(text, at)
        if match is None or match.lastgroup is None:
            raise InputError(f"{text[at:].strip()[:20]!r} cannot be read; write it as: epsilon > 0.3 and valid")
        found.append(_Token(match.lastgroup, match[match.lastgroup]))
        at = match.end()
    return found


class _Parser:
    """Recursive-descent parser over the tokens; `at` is the index of the next token."""

    def __init__(self, tokens: list[_Token]) -> None:
        self.tokens, self.at = tokens, 0

    def expression(self, depth: int) -> Node:
        return self._chain("or", lambda: self._chain("and", lambda: self._factor(depth)))

    def _chain(self, word: str, part: Callable[[], Node]) -> Node:
        parts = [part()]
        while self._accept("word", word):
            parts.append(part())
        return parts[0] if len(parts) == 1 else Connective(word, tuple(parts))

    def _factor(self, depth: int) -> Node:
        if depth > _DEEPEST:
            raise InputError(f"the expression is nested more than {_DEEPEST} deep")
        if self._accept("word", "not"):
            return Negation(self._factor(depth + 1))
        if self._accept("op", "("):
            inner = self.expression(depth + 1)
            if not self._accept("op", ")"):
                raise InputError("a parenthesis is not closed")
            return inner
        return self._condition(self._next("a name"))

    def _condition(self, token: _Token) -> Node:
        name = _SHORT.get(token.text, token.text)
        if token.kind != "word" or token.text in ("and", "or"):
            raise InputError(f"{token.text!r} was found where a name is expected")
        following = self.tokens[self.at] if self.at < len(self.tokens) else _Token("end", "")
        op = _COMPARISONS.get(following.text) if following.kind == "op" else None
        if name in FLAGS:
            if op:
                raise InputError(f"{name} is a flag: write `{name}` or `not {name}`")
            return Flag(name)
        if name not in _METRICS and name not in _WORDS:
            known = [*_METRICS, *FLAGS, *_WORDS]
            raise InputError(f"there is no {token.text!r}; the names are {choices_text(token.text, known)}")
        if op is None:
            raise InputError(f"{name} needs a comparison, such as `{name} {'= power' if name == 'type' else '> 0'}`")
        self.at += 1
        value = self._next("a value")
        if name in _WORDS:
            return _word_comparison(name, op, value)
        if value.kind != "number":
            raise InputError(f"{name} is compared with a number, not with {value.text!r}")
        return MetricComparison(name, op, float(value.text))

    def _accept(self, kind: str, text: str) -> bool:
        is_next = self.tokens[self.at : self.at + 1] == [_Token(kind, text)]
        self.at += is_next
        return is_next

    def _next(self, wanted: str) -> _Token:
        if self.at >= len(self.tokens):
            raise InputError(f"the expression ends where {wanted} is expected")
        self.at += 1
        return self.tokens[self.at - 1]


def _word_comparison(name: str, op: str, value: _Token) -> Node:
    if op not in ("=", "!="):
        raise InputError(f"{name} is compared with a word by = or !=, not by {op}")
    if value.kind not in ("word", "quoted"):
        raise InputError(f"{name} is compared with a word, not with {value.text!r}")
    if name != "type":
        return WordComparison(name, op, value.text)
    if value.text not in _TYPES:
        raise InputError(f"there is no type {value.text!r}; choose one of {choices_text(value.text, _TYPES)}")
    return TypeComparison(op, GraspType[value.text.upper()])

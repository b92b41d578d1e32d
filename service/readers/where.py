"""A small language that chooses grasps by their numbers: `epsilon > 0.3 and lift and robust >= 0.75`.

    expression   term { or term }
    term         factor { and factor }
    factor       not factor | ( expression ) | NAME | NAME op VALUE
    op           < <= > >= = == !=

A metric is called by its name in `service.model.metrics`, a swept one has its value at the threshold that the index
tells. A metric is compared with a number, `hand`, `object` and `type` with a word; a flag stands alone. A grasp whose
shard lacks the number, or says nan, fails each comparison with it. The text is parsed here; nothing of it is evaluated.
"""

from __future__ import annotations

import operator
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from service.model.diversity import GraspType
from service.model.errors import InputError
from service.model.metrics import GRASP_METRICS, GraspMetric
from service.store import standing
from service.store.manifests import INDEX_THRESHOLD_M

Array = NDArray[Any]
#: From the columns of a base shard and what it says of itself (hand, object) to a mask (N,).
Test = Callable[[Mapping[str, Array], Mapping[str, Any]], NDArray[np.bool_]]

#: Longest expression, and deepest nesting of one.
LONGEST: Final = 1000
_DEEPEST: Final = 40
_METRICS: Final = {metric.name: metric for metric in GRASP_METRICS if not metric.code}
_SHORT: Final = {"robust": "robust_share"}
_WORDS: Final = ("hand", "object", "type")
_TOKEN: Final = re.compile(
    r"\s*(?:(?P<number>[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)(?![\w.])|(?P<op><=|>=|==|!=|[<>=()])"
    r"|'(?P<quoted>[^']*)'|(?P<word>[A-Za-z0-9_][\w.\-]*))"
)
_OPERATORS: Final[dict[str, Callable[[Any, Any], Any]]] = {
    "<": operator.lt, "<=": operator.le, ">": operator.gt, ">=": operator.ge,
    "=": operator.eq, "==": operator.eq, "!=": operator.ne,
}  # fmt: skip


def _flag(path: str, value: int) -> Test:
    def test(columns: Mapping[str, Array], _: Mapping[str, Any]) -> NDArray[np.bool_]:
        count = len(columns["quality/valid"])
        return np.asarray(columns[path]) == value if path in columns else np.zeros(count, bool)

    return test


#: What stands alone: true or not.
FLAGS: Final[dict[str, Test]] = {
    "valid": lambda columns, _: standing.valid(columns),
    "sound": lambda columns, _: standing.sound(columns),
    "held": _flag("quality/success", 1),
    "lift": _flag("quality/lift_outcome", 1),
    "lift_hard": _flag("quality/lift_hard", 1),
    "pushes": _flag("quality/pushes", 1),
}


def parse(text: str) -> Test:
    """The test that an expression states.

    Raises:
        InputError: it is no such expression; says where, or what the names are.
    """
    if len(text) > LONGEST:
        raise InputError(f"the expression is {len(text)} characters long; at most {LONGEST} are read")
    parser = _Parser(_tokens(text))
    found = parser.expression(0)
    if parser.at < len(parser.tokens):
        raise InputError(f"{parser.tokens[parser.at].text!r} is left over; join conditions by `and` or `or`")
    return found


@dataclass(frozen=True)
class _Token:
    kind: str
    """number, op, quoted or word."""
    text: str


def _tokens(text: str) -> list[_Token]:
    found, at = [], 0
    while at < len(text.rstrip()):
        match = _TOKEN.match(text, at)
        if match is None or match.lastgroup is None:
            raise InputError(f"{text[at:].strip()[:20]!r} cannot be read; write it as: epsilon > 0.3 and valid")
        found.append(_Token(match.lastgroup, match[match.lastgroup]))
        at = match.end()
    return found


class _Parser:
    """Recursive descent over the tokens; `at` is the next one."""

    def __init__(self, tokens: list[_Token]) -> None:
        self.tokens, self.at = tokens, 0

    def expression(self, depth: int) -> Test:
        return self._chain("or", operator.or_, lambda: self._chain("and", operator.and_, lambda: self._factor(depth)))

    def _chain(self, word: str, join: Callable[[Any, Any], Any], part: Callable[[], Test]) -> Test:
        parts = [part()]
        while self._takes("word", word):
            parts.append(part())

        def test(columns: Mapping[str, Array], said: Mapping[str, Any]) -> NDArray[np.bool_]:
            found = parts[0](columns, said)
            for one in parts[1:]:
                found = join(found, one(columns, said))
            return found

        return test

    def _factor(self, depth: int) -> Test:
        if depth > _DEEPEST:
            raise InputError(f"the expression is nested more than {_DEEPEST} deep")
        if self._takes("word", "not"):
            negated = self._factor(depth + 1)
            return lambda columns, said: ~negated(columns, said)
        if self._takes("op", "("):
            inner = self.expression(depth + 1)
            if not self._takes("op", ")"):
                raise InputError("a parenthesis is not closed")
            return inner
        return self._condition(self._next("a name"))

    def _condition(self, token: _Token) -> Test:
        name = _SHORT.get(token.text, token.text)
        if token.kind != "word" or token.text in ("and", "or"):
            raise InputError(f"{token.text!r} stands where a name is expected")
        following = self.tokens[self.at] if self.at < len(self.tokens) else None
        compared = following is not None and following.kind == "op" and following.text in _OPERATORS
        if name in FLAGS:
            if compared:
                raise InputError(f"{name} is true or not: write `{name}` or `not {name}`")
            return FLAGS[name]
        if name not in _METRICS and name not in _WORDS:
            known = ", ".join([*_METRICS, *FLAGS, *_WORDS])
            raise InputError(f"there is no {token.text!r}; the names are {known}")
        if not compared or following is None:
            raise InputError(f"{name} is to be compared, as in `{name} {'= power' if name == 'type' else '> 0'}`")
        self.at += 1
        value = self._next("a value")
        return _of_word(name, following.text, value) if name in _WORDS else _of_metric(name, following.text, value)

    def _takes(self, kind: str, text: str) -> bool:
        if self.at < len(self.tokens) and self.tokens[self.at] == _Token(kind, text):
            self.at += 1
            return True
        return False

    def _next(self, wanted: str) -> _Token:
        if self.at >= len(self.tokens):
            raise InputError(f"the expression ends where {wanted} is expected")
        self.at += 1
        return self.tokens[self.at - 1]


def _of_metric(name: str, op: str, value: _Token) -> Test:
    if value.kind != "number":
        raise InputError(f"{name} is compared with a number, not with {value.text!r}")
    metric, compare, bound = _METRICS[name], _OPERATORS[op], float(value.text)

    def test(columns: Mapping[str, Array], _: Mapping[str, Any]) -> NDArray[np.bool_]:
        values = value_of(metric, columns)
        with np.errstate(invalid="ignore"):
            return np.isfinite(values) & np.asarray(compare(values, bound))

    return test


def value_of(metric: GraspMetric, columns: Mapping[str, Array]) -> NDArray[np.float64]:
    """(N,) a metric of the grasps of a base shard; nan where the shard lacks it."""
    if metric.path not in columns:
        return np.full(len(columns["quality/valid"]), np.nan)
    values = np.asarray(columns[metric.path], float)
    if not metric.swept:
        return values
    thresholds = np.asarray(columns["quality/thresholds_m"], float)
    return np.asarray(values[:, int(np.argmin(np.abs(thresholds - INDEX_THRESHOLD_M)))])


def _of_word(name: str, op: str, value: _Token) -> Test:
    if op not in ("=", "==", "!="):
        raise InputError(f"{name} is = or != a word, not {op} one")
    if value.kind not in ("word", "quoted"):
        raise InputError(f"{name} is compared with a word, not with {value.text!r}")
    compare = _OPERATORS[op]
    if name != "type":
        return lambda columns, said: np.full(
            len(columns["quality/valid"]), bool(compare(str(said.get(name, "")), value.text))
        )
    types = [kind.name.lower() for kind in GraspType]
    if value.text not in types:
        raise InputError(f"there is no type {value.text!r}; choose one of {', '.join(types)}")
    wanted = types.index(value.text)

    def test(columns: Mapping[str, Array], _: Mapping[str, Any]) -> NDArray[np.bool_]:
        there = "quality/grasp_type" in columns
        kinds = columns["quality/grasp_type"] if there else np.full(len(columns["quality/valid"]), -1)
        return np.asarray(compare(kinds, wanted)) & (np.asarray(kinds) >= 0)

    return test

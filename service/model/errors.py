"""Every error graspd raises on purpose.

    GraspdError
    ├── InputError                the caller's mistake: exit 2, HTTP 422
    │   ├── NotFoundError         unknown job, hand, object, shard: exit 2, HTTP 404
    │   ├── ConflictError         the request clashes with what is there: exit 2, HTTP 409
    │   ├── MeshError             an object mesh that cannot be used
    │   ├── HandError             a hand description that cannot be used
    │   ├── SceneError            a scene without room, or in which no grasp can be found
    │   ├── LoadError             a mass that is beyond what the hand lifts
    │   ├── LimitError            too large, too many: exit 2, HTTP 413
    │   └── QuotaError            the key has all it may have: exit 2, HTTP 429
    ├── UnavailableError          a part of the service does not answer: exit 1, HTTP 503
    │   ├── QueueUnavailable
    │   ├── StoreUnavailable
    │   ├── IndexUnavailable
    │   │   └── IndexDamaged      its file is damaged: a new one takes its place
    │   └── RateError             too many requests: exit 1, HTTP 429
    ├── BusyError                 another graspd owns the data folder, or a port is taken: exit 1, HTTP 409
    ├── DamagedError              a record in the store is not what its name says: exit 1, HTTP 500
    │   └── DamagedShard          a shard's file is not what its checksum says, or is gone: exit 1, HTTP 500
    └── TaskError                 a task ended without a result: exit 1, HTTP 500
        ├── TaskCancelled
        └── TaskRefused           unknown schema or function: never retried

A message is one line that names what is wrong and the fix. `exit_code` and `status` are the one table from errors to
exit codes and HTTP statuses; `slug` names the problem type (RFC 9457).

Secrets do not leave in messages: neither in errors nor in log lines, whatever these quote.

What somebody may have meant by a word that is not known.
"""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, ClassVar, Final, Self

#: Line breaks with the space around them, all that `str.splitlines` knows; control characters.
_BREAK: Final = re.compile(r"\s*[\n\r\v\f\x1c-\x1e\x85\u2028\u2029]\s*")
_CONTROL: Final = re.compile(r"[\x00-\x1f\x7f-\x9f]")


class GraspdError(Exception):
    """Base of all errors that graspd raises on purpose; its text is one line without secrets."""

    slug: ClassVar[str] = "internal"
    status: ClassVar[int] = 500
    exit_code: ClassVar[int] = 1
    title: ClassVar[str] = "Something went wrong"

    def __str__(self) -> str:
        # A quoted key, file name or message of a library may carry line breaks and escapes: they would forge lines in
        # logs and terminals. What a printable text holds stays as it is.
        text = without_secrets(super().__str__())
        if text.isprintable():
            return text
        return _CONTROL.sub(lambda found: repr(found[0])[1:-1], _BREAK.sub(" ", text))


class InputError(GraspdError):
    """The caller's mistake."""

    slug, status, exit_code, title = "invalid-input", 422, 2, "The request cannot be used"


class NotFoundError(InputError):
    """The named thing does not exist."""

    slug, status, title = "not-found", 404, "Not found"


class ConflictError(InputError):
    """The request clashes with the present state."""

    slug, status, title = "conflict", 409, "Conflict"


class AssetError(InputError):
    """A hand or an object that cannot be used.

    Args:
        message: what is wrong, and the fix in options of the command line.
        facts: what was found out before the refusal, as the report of a check has it.
    """

    def __init__(self, message: str = "", *, facts: Mapping[str, Any] | None = None) -> None:
        super().__init__(message)
        self.facts = dict(facts or {})

    @classmethod
    def with_fixes(cls, problem: str, hint: str, *fixes: Mapping[str, Any], **facts: Any) -> Self:
        """An error whose fixes are options: `problem` and `options_suggested` tell them without a command line.

        Args:
            problem: what is wrong.
            hint: the fixes in options of the command line.
            fixes: keys of `asset.json` with their values; None: the user chooses the value.
            facts: further facts.
        """
        return cls(f"{problem}; {hint}", facts={"problem": problem, "options_suggested": list(fixes), **facts})


class MeshError(AssetError):
    """An object mesh that cannot be read or used."""

    slug, title = "bad-mesh", "The mesh cannot be used"


class HandError(AssetError):
    """A hand description that cannot be read or used."""

    slug, title = "bad-hand", "The hand cannot be used"


class SceneError(InputError):
    """A scene that the object does not fit in, or in which no grasp is found."""

    slug, title = "bad-scene", "The scene cannot be used"


class LoadError(InputError):
    """An object, or a wanted payload, that is heavier than anything the hand lifts."""

    slug, title = "too-heavy", "The object is too heavy for the hand"


class LimitError(InputError):
    """Larger or more than the service takes."""

    slug, status, title = "too-large", 413, "Over the limit"


class QuotaError(InputError):
    """The key has as much in work as it may have."""

    slug, status, title = "quota-exceeded", 429, "The quota of the key is used up"

    def __init__(self, message: str = "", *, retry_after_s: int = 60) -> None:
        super().__init__(message)
        self.headers = {"Retry-After": str(retry_after_s)}


class UnavailableError(GraspdError):
    """A part of the service does not answer; the same request may succeed later."""

    slug, status, title = "unavailable", 503, "Temporarily unavailable"


class QueueUnavailable(UnavailableError):
    """Redis does not answer."""

    slug, title = "queue-unavailable", "The queue does not answer"


class StoreUnavailable(UnavailableError):
    """The object store does not answer or cannot be written."""

    slug, title = "store-unavailable", "The object store does not answer"


class IndexUnavailable(UnavailableError):
    """The index database does not answer."""

    slug, title = "index-unavailable", "The index does not answer"


class IndexDamaged(IndexUnavailable):
    """The file of the index is damaged; a new one takes its place and is filled from the store."""

    slug, title = "index-damaged", "The index is damaged"


class RateError(UnavailableError):
    """More requests than the service answers."""

    slug, status, title = "too-many-requests", 429, "Too many requests"


class BusyError(GraspdError):
    """Another process owns the resource."""

    slug, status, title = "busy", 409, "Already in use"


class DamagedError(GraspdError):
    """A record in the store is not what its name says; to try again does not help."""

    slug, title = "damaged", "A record in the store is damaged"


class DamagedShard(DamagedError):
    """A shard whose file is not what its checksum says, or is gone."""

    slug, title = "damaged-shard", "A shard is damaged"


class TaskError(GraspdError):
    """A task ended without a result."""

    slug, title = "task-failed", "The task failed"


class TaskCancelled(TaskError):
    """The task was cancelled while it ran."""

    slug, title = "task-cancelled", "The task was cancelled"


class TaskRefused(TaskError):
    """The task must not run here: unknown schema, unknown function. Never retried."""

    slug, title = "task-refused", "The task was refused"


#: Domain errors by problem type, for the client and the reference page.
ERRORS: Final[dict[str, type[GraspdError]]] = {
    error.slug: error
    for error in (
        InputError,
        NotFoundError,
        ConflictError,
        MeshError,
        HandError,
        SceneError,
        LoadError,
        LimitError,
        QuotaError,
        UnavailableError,
        QueueUnavailable,
        StoreUnavailable,
        IndexUnavailable,
        IndexDamaged,
        RateError,
        BusyError,
        DamagedError,
        DamagedShard,
        TaskError,
        TaskCancelled,
        TaskRefused,
        GraspdError,
    )
}

#: User and password of a URL, up to the last @: a password that nobody quoted may hold one, and a slash.
_LOGIN: Final = re.compile(r"(?<=://)[^/\s\"'<>][^\s\"'<>]*@")
_PARAMETER: Final = re.compile(
    r"([?&][\w.%-]*(?:password|passwd|token|secret|signature|credential|sig|key)=)[^&\s\"'<>]+", re.IGNORECASE
)
_API_KEY: Final = re.compile(r"\bgd_[A-Za-z0-9_-]{8,}")


def without_secrets(text: str) -> str:
    """The text with stars for passwords in URLs and for API keys."""
    if "://" in text:
        text = _PARAMETER.sub(r"\1***", _LOGIN.sub("***@", text))
    return _API_KEY.sub("gd_***", text) if "gd_" in text else text


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

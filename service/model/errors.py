"""Errors that graspd raises on purpose, and "did you mean" hints.

A message is one line that states the problem and the fix. `exit_code` and `status` map errors to exit codes and HTTP
statuses; `slug` names the problem type (RFC 9457). Messages and log lines never contain secrets, even in quoted texts.
"""

import difflib
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any, ClassVar, Final, Self

#: Line breaks with surrounding space (all of `str.splitlines`) and control characters.
_BREAK: Final = re.compile(r"\s*[\n\r\v\f\x1c-\x1e\x85\u2028\u2029]\s*")
_CONTROL: Final = re.compile(r"[\x00-\x1f\x7f-\x9f]")


class GraspdError(Exception):
    """Base class of graspd's own errors; the text is one line without secrets."""

    slug: ClassVar[str] = "internal"
    status: ClassVar[int] = 500
    exit_code: ClassVar[int] = 1
    title: ClassVar[str] = "Something went wrong"

    def __init_subclass__(cls, **properties: Any) -> None:
        """Set the class variables of a subclass."""
        for name, value in properties.items():
            setattr(cls, name, value)

    def __str__(self) -> str:
        # Line breaks and escapes in quoted names or library messages would forge lines in logs and terminals.
        text = without_secrets(super().__str__())
        return _CONTROL.sub(lambda found: repr(found[0])[1:-1], _BREAK.sub(" ", text))


class InputError(GraspdError, slug="invalid-input", status=422, exit_code=2, title="The request cannot be used"):
    """The input of a request or command is invalid."""


class NotFoundError(InputError, slug="not-found", status=404, title="Not found"):
    """The named resource does not exist."""


class ConflictError(InputError, slug="conflict", status=409, title="Conflict"):
    """The request conflicts with the present state."""


class AssetError(InputError):
    """A hand or an object cannot be used; `facts` has the findings of the check until the error."""

    def __init__(self, message: str = "", *, facts: Mapping[str, Any] | None = None) -> None:
        super().__init__(message)
        self.facts = dict(facts or {})

    @classmethod
    def with_fixes(cls, problem: str, hint: str, *fixes: Mapping[str, Any], **facts: Any) -> Self:
        """Create an error with command options in `hint`, keys of `asset.json` in `fixes` (None: any value)."""
        return cls(f"{problem}; {hint}", facts={"problem": problem, "options_suggested": list(fixes), **facts})


class MeshError(AssetError, slug="bad-mesh", title="The mesh cannot be used"):
    """An object mesh cannot be read or used."""


class HandError(AssetError, slug="bad-hand", title="The hand cannot be used"):
    """A hand description cannot be read or used."""


class SceneError(InputError, slug="bad-scene", title="The scene cannot be used"):
    """The object does not fit into the scene, or no grasp is found in it."""


class LoadError(InputError, slug="too-heavy", title="The object is too heavy for the hand"):
    """An object or a wanted payload exceeds what the hand can lift."""


class LimitError(InputError, slug="too-large", status=413, title="Over the limit"):
    """The size or number exceeds a limit of the service."""


class QuotaError(InputError, slug="quota-exceeded", status=429, title="The quota of the key is used up"):
    """The key has reached its quota of unfinished work."""

    def __init__(self, message: str = "", *, retry_after_s: int = 60) -> None:
        super().__init__(message)
        self.headers = {"Retry-After": str(retry_after_s)}


class UnavailableError(GraspdError, slug="unavailable", status=503, title="Temporarily unavailable"):
    """A part of the service does not answer; the same request may succeed later."""


class QueueUnavailable(UnavailableError, slug="queue-unavailable", title="The queue does not answer"):
    """Redis does not answer."""


class StoreUnavailable(UnavailableError, slug="store-unavailable", title="The object store does not answer"):
    """The object store does not answer or cannot be written."""


class IndexUnavailable(UnavailableError, slug="index-unavailable", title="The index does not answer"):
    """The index database does not answer."""


class IndexDamaged(IndexUnavailable, slug="index-damaged", title="The index is damaged"):
    """The file of the index is damaged; a new one replaces it and is rebuilt from the store."""


class RateError(UnavailableError, slug="too-many-requests", status=429, title="Too many requests"):
    """The request exceeds the rate limit of the service."""


class BusyError(GraspdError, slug="busy", status=409, title="Already in use"):
    """Another process owns the resource."""


class DamagedError(GraspdError, slug="damaged", title="A record in the store is damaged"):
    """A stored object does not match its name or checksum; a retry does not help."""


class DamagedShard(DamagedError, slug="damaged-shard", title="A shard is damaged"):
    """A shard's file does not match its checksum, or is missing."""


class TaskError(GraspdError, slug="task-failed", title="The task failed"):
    """A task ended without a result."""


class TaskCancelled(TaskError, slug="task-cancelled", title="The task was cancelled"):
    """The task was cancelled while it ran."""


class TaskRefused(TaskError, slug="task-refused", title="The task was refused"):
    """The task has an unknown schema or function; the worker must neither run nor retry it."""


def _subclasses(kind: type[GraspdError]) -> Iterator[type[GraspdError]]:
    for one in kind.__subclasses__():
        yield one
        yield from _subclasses(one)


ERRORS: Final = {error.slug: error for error in _subclasses(GraspdError) if error is not AssetError}
ERRORS[GraspdError.slug] = GraspdError

#: User and password of a URL, up to the last @, because an unquoted password may contain an @ or a slash.
_LOGIN: Final = re.compile(r"(?<=://)[^/\s\"'<>][^\s\"'<>]*@")
_PARAMETER: Final = re.compile(
    r"([?&][\w.%-]*(?:password|passwd|token|secret|signature|credential|sig|key)=)[^&\s\"'<>]+", re.IGNORECASE
)
_API_KEY: Final = re.compile(r"\bgd_[A-Za-z0-9_-]{8,}")


def without_secrets(text: str) -> str:
    """Replace API keys, and passwords in URLs, with stars."""
    if "://" in text:
        text = _PARAMETER.sub(r"\1***", _LOGIN.sub("***@", text))
    return _API_KEY.sub("gd_***", text) if "gd_" in text else text


#: Limits on the names searched for a similar one, and on the names listed in a message.
SEARCHED: Final = 1000
_LISTED: Final = 20


def available_names(word: str, names: Sequence[str]) -> str:
    """Return `; there are: A, B` with the first names, and a hint if a name is similar to `word`."""
    listed = ", ".join(names[:_LISTED]) + (", ..." if len(names) > _LISTED else "")
    return f"; there are: {listed or 'none yet'}{did_you_mean(word, names)}"


def did_you_mean(word: str, choices: Iterable[str]) -> str:
    """Return `; did you mean X?` for the most similar choice, or an empty text."""
    known = {choice.lower(): choice for choice in choices}
    like = difflib.get_close_matches(word.lower(), known, n=1)
    return f"; did you mean {known[like[0]]}?" if like else ""


def choices_text(word: str, choices: Iterable[str]) -> str:
    known = list(choices)
    return f"{', '.join(known)}{did_you_mean(word, known)}"

"""Bearer keys with scopes. A key is shown only once, at its creation; only its SHA-256 is stored.

All API processes read the keys from one JSON file (mode 600), so changes on the command line apply to the next request.
"""

from __future__ import annotations

import base64
import fcntl
import hashlib
import hmac
import json
import os
import re
import secrets
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from datetime import UTC, datetime, timedelta
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Final, Self

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from graspd.service.model.errors import ConflictError, InputError, NotFoundError, UnavailableError
from graspd.service.model.options import Option
from graspd.service.model.projects import PATTERN, Project

PREFIX: Final = "gd_"
SESSION_S: Final = 12 * 3600


class Scope(StrEnum):
    """Permission of a key; each includes earlier ones. `submit` covers its project, `admin` all projects."""

    READ = "read"
    SUBMIT = "submit"
    ADMIN = "admin"

    def includes(self, other: Scope) -> bool:
        order = list(Scope)
        return order.index(self) >= order.index(other)


#: Limit of a key or project, with its option on the command line.
Limit = Annotated[int | None, Option(places=("limit",))]


class KeyLimits(BaseModel):
    """Limits of one key. None means the limit of the settings, 0 means no limit."""

    requests_per_minute: Limit = Field(None, ge=0, description="requests per minute; 0: no limit")
    concurrency: Limit = Field(None, ge=0, description="concurrent requests; 0: no limit")
    grasps_in_flight: Limit = Field(None, ge=0, description="grasps in unfinished jobs; 0: no limit")
    jobs_per_day: Limit = Field(None, ge=0, description="new jobs per day (UTC); 0: no limit")


class ProjectLimits(BaseModel):
    """Shared limits of the keys of one project. None and 0 mean no limit."""

    grasps_in_flight: Limit = Field(None, ge=0, description="grasps in unfinished jobs; 0: no limit")
    grasps_per_day: Limit = Field(None, ge=0, description="requested grasps per day (UTC); 0: no limit")
    gpu_seconds_per_day: Limit = Field(None, ge=0, description="GPU time of tasks per day (UTC) [s]; 0: no limit")


class Key(BaseModel):
    """Stored key. Rotation does not change its id; later keys with the same name have other ids."""

    id: str = ""
    name: str = Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9._@+-]{0,63}$")
    scope: Scope
    project: Project = ""
    sha256: str
    created: str
    revoked: str | None = None
    expires: str | None = None
    limits: KeyLimits = KeyLimits()

    @model_validator(mode="after")
    def _add_missing_id(self) -> Self:
        # Keys of an earlier version have no id; both secrets of a rotation share the name, and so get the same id.
        self.id = self.id or _sha256(f"name {self.name}")[:16]
        return self

    @property
    def is_live(self) -> bool:
        return self.revoked is None and (self.expires is None or _now() < self.expires)


class _Document(BaseModel):
    model_config = ConfigDict(hide_input_in_errors=True)

    session_secret: str
    keys: list[Key] = []
    projects: dict[str, ProjectLimits] = {}


class KeyFile:
    """Key file; with `closed`, requests need credentials even before the first key."""

    def __init__(self, path: Path, *, closed: bool = False) -> None:
        self.path = path
        self._closed = closed
        self._stamp: tuple[int, ...] | None = None
        self._document = _Document(session_secret="")

    def list(self) -> list[Key]:
        return list(self._read().keys)

    @property
    def is_open(self) -> bool:
        """Whether requests need no key: none was ever made, and the file is not `closed`."""
        return not self._closed and not self._read().keys

    @property
    def has_live_key(self) -> bool:
        return any(key.is_live for key in self._read().keys)

    def add(
        self,
        name: str,
        scope: Scope,
        *,
        lifetime: timedelta | None = None,
        limits: KeyLimits | None = None,
        project: str = "",
    ) -> str:
        """Make a key and return it; it cannot be shown again. An empty project is the unnamed project."""
        token = PREFIX + secrets.token_urlsafe(32)
        with self._edit_document() as document:
            if any(key.name == name and key.is_live for key in document.keys):
                raise ConflictError(f"there is a key named {name!r}; revoke or rotate it, or take another name")
            if "@" in name:
                raise InputError(f"{name!r} is no key name: names with an @ are reserved for users of a proxy")
            try:
                key = Key(
                    id=secrets.token_hex(8),
                    name=name,
                    scope=scope,
                    project=project,
                    sha256=_sha256(token),
                    created=_now(),
                    expires=_now(lifetime) if lifetime else None,
                    limits=limits or KeyLimits(),
                )
            except ValidationError as error:
                if error.errors()[0]["loc"] == ("project",):
                    raise InputError(_project_name_error(project)) from None
                raise InputError(f"{name!r} is no key name; use letters, digits, dot, dash and underscore") from None
            document.keys.append(key)
        return token

    def rotate(self, name: str, *, grace: timedelta = timedelta(0), lifetime: timedelta | None = None) -> str:
        """Return a new secret of a key; the old one stays valid for `grace`; scope, project, limits persist."""
        token = PREFIX + secrets.token_urlsafe(32)
        with self._edit_document() as document:
            old = _live_keys(document, name)
            dates = {"created": _now(), "expires": _now(lifetime) if lifetime else None}
            fresh = old[-1].model_copy(update={"sha256": _sha256(token), **dates})
            for key in old:
                if grace:
                    key.expires = min(_now(grace), key.expires or _now(grace))
                else:
                    key.revoked = _now()
            document.keys.append(fresh)
        return token

    def set_limits(self, name: str, limits: KeyLimits) -> KeyLimits:
        with self._edit_document() as document:
            for key in (found := _live_keys(document, name)):
                key.limits = key.limits.model_copy(update=limits.model_dump(exclude_unset=True))
        return found[-1].limits

    def projects(self) -> dict[str, ProjectLimits]:
        document = self._read()
        named = {key.project: ProjectLimits() for key in document.keys if key.project}
        return dict(sorted((named | document.projects).items()))

    def limits_of(self, project: str) -> ProjectLimits:
        return self._read().projects.get(project, ProjectLimits())

    def limit_project(self, project: str, limits: ProjectLimits) -> ProjectLimits:
        if not re.fullmatch(PATTERN, project):
            raise InputError(_project_name_error(project))
        with self._edit_document() as document:
            known = document.projects.get(project, ProjectLimits())
            document.projects[project] = known.model_copy(update=limits.model_dump(exclude_unset=True))
        return document.projects[project]

    def revoke(self, name: str) -> None:
        with self._edit_document() as document:
            for key in _live_keys(document, name):
                key.revoked = _now()

    def find(self, token: str) -> Key | None:
        digest = _sha256(token)
        return self._find_live_key(lambda key: hmac.compare_digest(key.sha256, digest))

    def open_session(self, key: Key) -> str:
        """Return a signed cookie for a browser that presented a key."""
        if not self._read().session_secret:
            raise UnavailableError(f"the key file {self.path} has no session_secret; `graspd keys add` adds one")
        claim = base64.urlsafe_b64encode(json.dumps([key.sha256, int(time.time()) + SESSION_S]).encode()).decode()
        return f"{claim}.{self._sign(claim)}"

    def find_session(self, cookie: str) -> Key | None:
        """Return the key of a session if both are valid; None also if the file has no `session_secret`."""
        claim, _, signature = cookie.partition(".")
        if not self._read().session_secret or not hmac.compare_digest(signature.encode(), self._sign(claim).encode()):
            return None
        digest, expires = json.loads(base64.urlsafe_b64decode(claim))
        if time.time() > expires:
            return None
        return self._find_live_key(lambda key: key.sha256 == digest)

    def _find_live_key(self, is_it: Callable[[Key], bool]) -> Key | None:
        return next((key for key in self._read().keys if is_it(key) and key.is_live), None)

    def _sign(self, claim: str) -> str:
        return hmac.new(self._read().session_secret.encode(), claim.encode(), "sha256").hexdigest()

    def _read(self) -> _Document:
        try:
            status = self.path.stat()
        except FileNotFoundError:
            return _Document(session_secret="")
        # File timestamps are coarse and inodes are reused: the size distinguishes two quick changes.
        stamp = (status.st_mtime_ns, status.st_ino, status.st_size)
        if stamp != self._stamp:
            try:
                self._document = _Document.model_validate_json(self.path.read_bytes())
            except (ValidationError, OSError) as error:
                fix = "restore it, or remove it to begin anew"
                raise UnavailableError(f"the key file {self.path} cannot be read; {fix}") from error
            self._stamp = stamp
        return self._document

    @contextmanager
    def _edit_document(self) -> Iterator[_Document]:
        """Yield a copy of the document, then write it to the file; a lock serialises commands."""
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
            with self.path.with_name(f".{self.path.name}.lock").open("w") as lock:
                fcntl.flock(lock, fcntl.LOCK_EX)
                document = self._read().model_copy(deep=True)
                document.session_secret = document.session_secret or secrets.token_hex(32)
                yield document
                self._write(document)
        except OSError as error:
            raise UnavailableError(f"the key file {self.path} cannot be written: {error.strerror}") from None

    def _write(self, document: _Document) -> None:
        draft = self.path.with_name(f".{self.path.name}.{os.getpid()}")
        with os.fdopen(os.open(draft, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600), "w") as file:
            file.write(document.model_dump_json(indent=2))
            file.flush()
            os.fsync(file.fileno())
        draft.replace(self.path)


def _project_name_error(name: str) -> str:
    return f"{name!r} is no name of a project; use up to 32 lower-case letters, digits and dashes"


def _live_keys(document: _Document, name: str) -> list[Key]:
    found = [key for key in document.keys if key.name == name and key.is_live]
    if not found:
        raise NotFoundError(f"there is no valid key named {name!r}; `graspd keys list` shows them")
    return found


def _sha256(token: str) -> str:
    return hashlib.sha256(token.encode()).hexdigest()


def _now(ahead: timedelta = timedelta(0)) -> str:
    """Return the time in RFC 3339, UTC, with microseconds; such texts sort by time."""
    return (datetime.now(UTC) + ahead).isoformat(timespec="microseconds").replace("+00:00", "Z")

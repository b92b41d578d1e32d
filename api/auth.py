"""Bearer keys with scopes. A key is shown once when it is made; what is kept is its SHA-256.

The keys lie in one JSON file (mode 600) that every API process reads, so a key made or revoked on the command line
counts at the next request. No file or no live key: the service is open, and then binds to this machine only.
"""

from __future__ import annotations

import base64
import hashlib
import hmac
import json
import os
import secrets
import time
from datetime import UTC, datetime
from enum import StrEnum
from pathlib import Path
from typing import Final

from fastapi import Request
from pydantic import BaseModel, Field, ValidationError

from api.problems import ApiError
from service.errors import ConflictError, InputError, NotFoundError

PREFIX: Final = "gd_"
SESSION_COOKIE: Final = "graspd_session"
SESSION_S: Final = 12 * 3600


class Scope(StrEnum):
    """What a key may do; each includes the one before it."""

    READ = "read"
    SUBMIT = "submit"
    ADMIN = "admin"

    def includes(self, other: Scope) -> bool:
        order = list(Scope)
        return order.index(self) >= order.index(other)


class Key(BaseModel):
    """A key as it is kept."""

    name: str = Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]{0,63}$")
    scope: Scope
    sha256: str
    created: str
    revoked: str | None = None


class _Document(BaseModel):
    session_secret: str
    keys: list[Key] = []


class KeyFile:
    """The file of keys."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._stamp: tuple[int, int] | None = None
        self._document = _Document(session_secret="")

    def list(self) -> list[Key]:
        """All keys, the revoked ones too."""
        return list(self._read().keys)

    @property
    def is_open(self) -> bool:
        """Whether no live key exists, so that anybody who reaches the service may use it."""
        return not any(key.revoked is None for key in self._read().keys)

    def add(self, name: str, scope: Scope) -> str:
        """Make a key and return it; it cannot be shown again.

        Raises:
            ConflictError: a live key has this name.
            InputError: the name is not a plain word.
        """
        document = self._read()
        if any(key.name == name and key.revoked is None for key in document.keys):
            raise ConflictError(f"there is a key named {name!r}; revoke it first or take another name")
        token = PREFIX + secrets.token_urlsafe(32)
        try:
            key = Key(name=name, scope=scope, sha256=_sha256(token), created=_now())
        except ValidationError:
            raise InputError(f"{name!r} is no key name; use letters, digits, dot, dash and underscore") from None
        secret = document.session_secret or secrets.token_hex(32)
        self._write(_Document(session_secret=secret, keys=[*document.keys, key]))
        return token

    def revoke(self, name: str) -> None:
        """End a key's life; it stays in the list.

        Raises:
            NotFoundError: no live key has this name.
        """
        document = self._read()
        if not any(key.name == name and key.revoked is None for key in document.keys):
            raise NotFoundError(f"there is no live key named {name!r}; `graspd keys list` shows them")
        keys = [
            key.model_copy(update={"revoked": _now()}) if key.name == name and key.revoked is None else key
            for key in document.keys
        ]
        self._write(document.model_copy(update={"keys": keys}))

    def find(self, token: str) -> Key | None:
        """The live key behind a token."""
        digest = _sha256(token)
        found = None
        for key in self._read().keys:
            if key.revoked is None and hmac.compare_digest(key.sha256, digest):
                found = key
        return found

    def open_session(self, key: Key) -> str:
        """Signed cookie value for a browser that showed a key."""
        claim = base64.urlsafe_b64encode(json.dumps([key.sha256, int(time.time()) + SESSION_S]).encode()).decode()
        return f"{claim}.{self._sign(claim)}"

    def find_session(self, cookie: str) -> Key | None:
        """The live key behind a session; revoking the key ends its sessions."""
        claim, _, signature = cookie.partition(".")
        if not hmac.compare_digest(signature.encode(), self._sign(claim).encode()):
            return None
        digest, expires = json.loads(base64.urlsafe_b64decode(claim))
        if time.time() > expires:
            return None
        return next((key for key in self._read().keys if key.revoked is None and key.sha256 == digest), None)

    def _sign(self, claim: str) -> str:
        return hmac.new(self._read().session_secret.encode(), claim.encode(), "sha256").hexdigest()

    def _read(self) -> _Document:
        try:
            status = self.path.stat()
        except FileNotFoundError:
            return _Document(session_secret="")
        stamp = (status.st_mtime_ns, status.st_ino)
        if stamp != self._stamp:
            try:
                self._document = _Document.model_validate_json(self.path.read_bytes())
            except (ValidationError, OSError) as error:
                raise InputError(f"the key file {self.path} cannot be read; restore it or remove it") from error
            self._stamp = stamp
        return self._document

    def _write(self, document: _Document) -> None:
        self.path.parent.mkdir(parents=True, exist_ok=True)
        draft = self.path.with_name(f".{self.path.name}.{os.getpid()}")
        with os.fdopen(os.open(draft, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600), "w") as file:
            file.write(document.model_dump_json(indent=2))
        draft.replace(self.path)


def authorize(request: Request, scope: Scope) -> Key | None:
    """The key of a request; None while the service is open.

    Raises:
        ApiError: 401 without a live key, 403 with one of a smaller scope.
    """
    keys: KeyFile = request.app.state.keys
    if keys.is_open:
        return None
    key = identify(request, keys)
    if key is None:
        raise ApiError(
            401,
            "a live key is needed: send `Authorization: Bearer gd_...`; `graspd keys add` makes one",
            headers={"WWW-Authenticate": 'Bearer realm="graspd"'},
        )
    if not key.scope.includes(scope):
        raise ApiError(403, f"the key {key.name!r} has scope {key.scope}; this needs {scope}")
    return key


def identify(request: Request, keys: KeyFile) -> Key | None:
    """The key that a header or a session cookie names."""
    scheme, _, token = request.headers.get("authorization", "").partition(" ")
    if scheme.lower() == "bearer" and token:
        return keys.find(token.strip())
    cookie = request.cookies.get(SESSION_COOKIE)
    return keys.find_session(cookie) if cookie else None


def _sha256(token: str) -> str:
    return hashlib.sha256(token.encode()).hexdigest()


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec="seconds").replace("+00:00", "Z")

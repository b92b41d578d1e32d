"""Webhooks: what is told to an address of a user's when a job or a dataset ends, and how it is signed."""

from __future__ import annotations

import hashlib
import hmac
from typing import Final, Literal
from urllib.parse import urlsplit

from pydantic import Field

from graspd.service.model.domain import Digest
from graspd.service.model.errors import InputError
from graspd.service.model.projects import Project
from graspd.service.model.records import Record

End = Literal["succeeded", "failed", "cancelled"]
MAX_URL: Final = 500
#: Webhooks of one project, and deliveries of one webhook that wait at once.
MOST_HOOKS: Final = 20
MOST_WAITING: Final = 1000
SIGNATURE: Final = "X-Graspd-Signature"
#: Waits before the second and later attempts [s]; after the last one the delivery has failed.
WAITS_S: Final = (5.0, 30.0, 120.0, 600.0, 3600.0, 6 * 3600.0)


class Webhook(Record):
    """`webhooks/{id}.json`: an address, and which ends it is told of. Its secret follows from its id."""

    version: Literal[1] = 1
    id: Digest
    url: str = Field(max_length=MAX_URL)
    states: tuple[End, ...]
    created: str
    owner: str = Field("", max_length=64, description="id of the API key that made it")
    project: Project = Field("", description="whose jobs and datasets it is told of")


def check_url(url: str) -> str:
    """The address itself, if it is one that can be asked; which machine it names is looked at when it is asked.

    Raises:
        InputError: it is none of http or https, names no host, or holds a user.
    """
    try:
        parts = urlsplit(url)
        host, _ = parts.hostname, parts.port
    except ValueError:
        raise InputError("the address of a webhook cannot be read; write https://host/path") from None
    if parts.scheme not in ("http", "https") or not host or parts.username is not None or len(url) > MAX_URL:
        raise InputError("the address of a webhook is https://host/path, without a user, of at most 500 characters")
    if not url.isascii() or any(ord(letter) <= 32 or ord(letter) == 127 for letter in url):
        raise InputError("the address of a webhook holds characters that no address has; write them as %xx")
    return url


def secret_of(master: str, webhook: str) -> str:
    """The secret that a webhook's bodies are signed with; it lies nowhere."""
    return "whsec_" + hmac.new(master.encode(), f"webhook {webhook}".encode(), hashlib.sha256).hexdigest()


def signature(secret: str, at: int, body: bytes) -> str:
    """Value of `X-Graspd-Signature`: `t=TIME,v1=HEX`, the HMAC-SHA256 of `TIME.BODY` under the secret.

    Args:
        at: seconds since 1970. Who receives it refuses one that is minutes old, so that no copy of it counts later.
    """
    mac = hmac.new(secret.encode(), b"%d." % at + body, hashlib.sha256)
    return f"t={at},v1={mac.hexdigest()}"

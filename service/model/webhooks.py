"""Webhooks: signed notifications to a URL when a job or dataset ends."""

import hashlib
import hmac
from typing import Final, Literal
from urllib.parse import urlsplit

from pydantic import Field

from graspd.service.model.base import Digest
from graspd.service.model.errors import InputError
from graspd.service.model.projects import Project
from graspd.service.model.records import Record

End = Literal["succeeded", "failed", "cancelled"]
MAX_URL: Final = 500
MOST_HOOKS: Final = 20
MOST_WAITING: Final = 1000
SIGNATURE: Final = "X-Graspd-Signature"
#: Delays before the second and later attempts [s]; after them a delivery counts as failed.
WAITS_S: Final = (5.0, 30.0, 120.0, 600.0, 3600.0, 6 * 3600.0)


class Webhook(Record):
    """`webhooks/{id}.json`: a URL and the final states of jobs and datasets to report."""

    version: Literal[1] = 1
    id: Digest
    url: str = Field(max_length=MAX_URL)
    states: tuple[End, ...]
    created: str
    owner: str = Field("", max_length=64, description="id of the API key that created it")
    project: Project = Field("", description="project whose jobs and datasets it reports")


def check_url(url: str) -> str:
    """Return the URL; InputError unless it has scheme http or https, a host, no user, and is plain ASCII."""
    try:
        parts = urlsplit(url)
        host, _ = parts.hostname, parts.port
    except ValueError:
        raise InputError("the address of a webhook cannot be read; write https://host/path") from None
    if parts.scheme not in ("http", "https") or not host or parts.username is not None or len(url) > MAX_URL:
        raise InputError("the address of a webhook is https://host/path, without a user, of at most 500 characters")
    if not url.isascii() or any(ord(letter) <= 32 or ord(letter) == 127 for letter in url):
        raise InputError("the address of a webhook has invalid characters; write them as %xx")
    return url


def derive_secret(master: str, webhook: str) -> str:
    """Derive the secret that signs the bodies of a webhook from the secret `master`."""
    return "whsec_" + hmac.new(master.encode(), f"webhook {webhook}".encode(), hashlib.sha256).hexdigest()


def signature(secret: str, at: int, body: bytes) -> str:
    """Return `t=TIME,v1=HEX`, the HMAC-SHA256 of `TIME.BODY`; `at` is in seconds since 1970."""
    mac = hmac.new(secret.encode(), b"%d." % at + body, hashlib.sha256)
    return f"t={at},v1={mac.hexdigest()}"

"""Secrets do not leave in messages: neither in errors nor in log lines, whatever these quote."""

from __future__ import annotations

import re
from typing import Final

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

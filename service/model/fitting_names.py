"""Names that are longer than a service or a format takes."""

from __future__ import annotations

import hashlib
import logging
from functools import lru_cache
from typing import Final

from service.model.errors import InputError

MOST: Final = 64

log = logging.getLogger(__name__)


def refuse_long(name: str) -> str:
    """The name; InputError if it is too long for a thing that a user can name otherwise."""
    if len(name) > MOST:
        raise InputError(f"the name {name} has {len(name)} characters, at most {MOST} are taken; give a shorter one")
    return name


@lru_cache(maxsize=4096)
def fitted(name: str, most: int = MOST) -> str:
    """The name; of one that is too long the beginning and a digest, so that no two become one, told once in the log."""
    if len(name) <= most:
        return name
    short = f"{name[: most - 9]}-{hashlib.sha256(name.encode()).hexdigest()[:8]}"
    log.warning("the name %s has more than %d characters; it becomes %s", name, most, short)
    return short

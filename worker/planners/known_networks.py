"""Networks of this process by a digest: an option of a method names one without naming a file. A file's digest is its
own, that of the service is of the asset."""

from __future__ import annotations

import threading
from pathlib import Path
from typing import Final

from cachetools import LRUCache

from graspd.service.model.digests import digest_bytes
from graspd.service.model.errors import InputError
from graspd.service.store.network_file import ProposalNetwork, from_bytes, read_file

_known: Final[LRUCache[str, ProposalNetwork]] = LRUCache(16)
_lock: Final = threading.Lock()


def keep_file(path: Path) -> str:
    """Read a network's file and keep it; its digest.

    Raises:
        InputError: no network.
    """
    data = read_file(path)
    digest = digest_bytes(data)
    keep(digest, from_bytes(data, str(path)))
    return digest


def keep(digest: str, network: ProposalNetwork) -> None:
    """Know a network by a digest from now on; of many the last ones used are."""
    with _lock:
        _known[digest] = network


def kept(digest: str) -> ProposalNetwork:
    """The network of a digest.

    Raises:
        InputError: none is kept under it.
    """
    with _lock:
        found = _known.get(digest)
    if found is None:
        raise InputError(f"network {digest[:12]} is not known here; give its file: --option network=FILE.npz")
    return found

"""Cache of proposal networks in this process. A method's option names a network by its digest.
The digest is that of a local file or of an asset of the service."""

import threading
from pathlib import Path
from typing import Final

from cachetools import LRUCache

from graspd.service.model.digests import digest_bytes
from graspd.service.model.errors import InputError
from graspd.service.store.network_file import ProposalNetwork, from_bytes, read_file

_known: Final[LRUCache[str, ProposalNetwork]] = LRUCache(16)
_lock: Final = threading.Lock()


def cache_file(path: Path) -> str:
    """Load a network's file, cache it and return its digest; raise InputError if the file is no network."""
    data = read_file(path)
    digest = digest_bytes(data)
    store_network(digest, from_bytes(data, str(path)))
    return digest


def store_network(digest: str, network: ProposalNetwork) -> None:
    with _lock:
        _known[digest] = network


def load_network(digest: str) -> ProposalNetwork:
    """Return the network cached under a digest; raise InputError if there is none."""
    with _lock:
        found = _known.get(digest)
    if found is None:
        raise InputError(f"network {digest[:12]} is not known here; give its file: --option network=FILE.npz")
    return found

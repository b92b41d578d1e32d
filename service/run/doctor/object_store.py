"""The store: written, read back, listed, and asked for the one promise that graspd stands on: create-only puts."""

from __future__ import annotations

import secrets
import time
from concurrent.futures import ThreadPoolExecutor
from typing import Final

from service.model.errors import GraspdError, NotFoundError
from service.model.finding import Finding, bad, good, warning
from service.run.doctor.machine import existing, local_store
from service.settings import Settings
from service.store.store import Store, open_store

_FOLDER: Final = "health"
#: For a dozen requests.
_SLOW_S: Final = 5.0
#: Who put the same name at once; one may win.
_RIVALS: Final = 4
_CREDENTIALS: Final = (
    "see bucket, region and credentials (AWS_ACCESS_KEY_ID, AWS_SECRET_ACCESS_KEY, AWS_REGION, AWS_ENDPOINT_URL; "
    "GOOGLE_APPLICATION_CREDENTIALS; AZURE_STORAGE_ACCOUNT_NAME, ..._KEY): they must allow get, put, list and delete"
)


def store(settings: Settings) -> Finding:
    """Every operation that graspd uses, on an object of a name of its own."""
    name, folder = "store", local_store(settings)
    if folder is not None and not folder.exists():
        return good(name, f"{folder} is made at the first start, below {existing(folder)}")
    try:
        opened = open_store(settings.resolved_store_url, public_endpoint=settings.store_public_endpoint)
        return judge(name, opened)
    except GraspdError as error:
        mend = f"make room below {folder}, and let user and group write there" if folder else _CREDENTIALS
        return bad(name, str(error), mend)


def judge(name: str, opened: Store) -> Finding:
    """The finding on an open store. Raises GraspdError where an operation fails."""
    key = f"{_FOLDER}/doctor-{secrets.token_hex(8)}"
    start = time.perf_counter()
    try:
        wrong = _try(opened, key)
    finally:
        opened.delete(key)
    seconds = time.perf_counter() - start
    if not wrong and opened.exists(key):
        wrong = "an object that was removed is still there"
    if wrong:
        mend = "name a store that keeps this: a local disk, Amazon, Google, Azure, SeaweedFS, Ceph, or a recent MinIO"
        return bad(name, f"{opened.url}: {wrong}", mend)
    line = (
        f"{opened.url} gives what it takes, lists, removes, and refuses a name that is taken ({1000 * seconds:.0f} ms)"
    )
    if opened.url.startswith("memory:"):
        return warning(name, f"{opened.url} is gone with its process", "GRASPD_STORE_URL=file:///FOLDER or s3://BUCKET")
    if seconds > _SLOW_S:
        return warning(name, f"{line}: that is slow", "put the store nearer, or look after the network")
    return good(name, line)


def _try(opened: Store, key: str) -> str:
    """What the store does not keep to, "" if nothing."""
    contents = [secrets.token_bytes(1000) for _ in range(_RIVALS)]
    with ThreadPoolExecutor(_RIVALS) as pool:
        won = list(pool.map(lambda content: opened.put(key, content), contents))
    if sum(won) != 1:
        return f"of {_RIVALS} puts of one name at once, {sum(won)} were taken: results could be overwritten"
    kept = contents[won.index(True)]
    try:
        if opened.get(key) != kept:
            return "what is read is not what was written"
        if opened.get_range(key, 100, 50) != kept[100:150]:
            return "a part of an object is not what was written there"
    except NotFoundError:
        return "what was written is not there when it is read"
    if opened.put(key, b"another") or opened.get(key) != kept:
        return "an object can be overwritten: create-only puts (If-None-Match: *) are not honoured"
    if (key, len(kept)) not in [(entry.key, entry.size) for entry in opened.list(_FOLDER)]:
        return "what was written is not in the list of its folder"
    return ""

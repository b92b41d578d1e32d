"""Hands and objects: uploaded under a name, taken away again."""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Mapping

from api.access.auth import caller_id, must_own
from service.index.views import AssetView, Page
from service.model import names
from service.model.digests import digest_files
from service.model.domain import AssetKind
from service.model.errors import ConflictError, NotFoundError
from service.pipeline import deletion
from service.pipeline.backends import Parts
from service.store import library

log = logging.getLogger(__name__)


class Assets:
    """Hands and objects of everybody; what takes one away asks whose it is. A `name` may be a digest."""

    def __init__(self, parts: Parts) -> None:
        self._parts = parts

    def page(self, kind: AssetKind, *, limit: int = 50, cursor: str | None = None) -> Page[AssetView]:
        """All of a kind, by name."""
        return self._parts.index.assets.page(kind, limit=limit, cursor=cursor)

    def one(self, kind: AssetKind, name: str) -> AssetView:
        return self._parts.index.assets.get(kind, name)

    def files(self, asset: AssetView) -> Mapping[str, bytes]:
        """Its files as they were uploaded, `asset.json` among them."""
        return library.load_asset_files(self._parts.store, asset.kind, asset.digest)

    def model(self, asset: AssetView) -> bytes:
        """The prepared hand or object as binary glTF.

        Raises:
            NotFoundError: it has not been checked yet, or was refused.
        """
        return self._parts.store.get(names.asset_model(asset.kind, asset.digest))

    def add(self, kind: AssetKind, name: str, files: Mapping[str, bytes]) -> AssetView:
        """Keep an uploaded hand or object; the keeper queues its check.

        Raises:
            ConflictError: the name stands for other content, or the content has another name.
        """
        self._refuse_taken(kind, name, digest_files(kind, files))
        index, store = self._parts.index, self._parts.store
        asset = library.store_files(store, kind, name, files, owner=caller_id())
        # Of two uploads at once that want one name, the later one must see the earlier one's record.
        with index.database.writing() as connection:
            self._refuse_taken(kind, name, asset.digest)
            asset = library.record_asset(store, asset)
            index.write.add_asset(asset, library.load_check(store, kind, asset.digest), within=connection)
        return index.assets.get(kind, asset.digest)

    def delete(self, kind: AssetKind, name: str) -> None:
        """Take a hand or object away that nothing needs.

        Raises:
            NotYours: another key uploaded it.
        """
        asset = self._parts.index.assets.get(kind, name)
        if not asset.builtin:
            must_own(asset.owner, f"{kind.value} {name!r}")
        deletion.delete_asset(self._parts, kind, asset.digest, owner=caller_id())
        log.info("%s %s deleted", kind, asset.name)

    def _refuse_taken(self, kind: AssetKind, name: str, digest: str) -> None:
        with contextlib.suppress(NotFoundError):
            known = self._parts.index.assets.get(kind, name)
            # A refused upload holds no name: the same file with the mend must get in.
            if known.digest != digest and known.verdict != "refuse":
                raise ConflictError(f"there is another {kind.value} named {name!r}; choose a name of its own")

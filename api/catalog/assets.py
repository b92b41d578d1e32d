"""Hands, objects and networks: upload, correction and deletion."""

import io
import json
import logging
from collections.abc import Mapping, MutableMapping
from dataclasses import replace
from typing import Final

from graspd.api.access.auth import InScope, caller_id, project_scope, require_ownership
from graspd.service.index.views import AssetView
from graspd.service.model import names
from graspd.service.model.digests import digest_files
from graspd.service.model.errors import ConflictError, DamagedError, LimitError, NotFoundError
from graspd.service.model.names import MOST, shorten_name
from graspd.service.model.projects import EVERYTHING, ProjectScope, project_mark
from graspd.service.model.states import AssetKind
from graspd.service.pipeline import deletion
from graspd.service.pipeline.backends import Services, record_transaction
from graspd.service.store import descriptions, library
from graspd.service.store.assets import ZipFiles, asset_json
from graspd.service.store.integrity import get_sealed, put_document
from graspd.service.store.network_file import network_report

log = logging.getLogger(__name__)
_NAMES_TRIED: Final = 100


class Assets:
    """Assets in the caller's scope; deletion requires ownership. A `name` may be a digest."""

    def __init__(self, services: Services) -> None:
        self._services = services

    page = InScope(lambda index: index.assets.page)
    get = InScope(lambda index: index.assets.get)
    datasets_of = InScope(lambda index: index.datasets.users_of)

    def files(self, asset: AssetView) -> Mapping[str, bytes]:
        return library.load_asset_files(self._services.store, asset.kind, asset.digest)

    def model(self, asset: AssetView) -> bytes:
        """Return the prepared hand or object as binary glTF; raise NotFoundError before its check."""
        return get_sealed(self._services.store, names.asset_key(asset.kind, asset.digest, "model.glb"))

    def add(
        self,
        kind: AssetKind,
        name: str,
        files: MutableMapping[str, bytes],
        *,
        self_test: bool = False,
        shared: bool = False,
        rename: bool = False,
    ) -> AssetView:
        """Store an upload. Workers check hands and objects; a network is checked here.

        With `self_test`, the check of a hand includes grasps. All projects may use a `shared` asset. With `rename`, the
        asset gets the next free name if its name is taken, and existing content keeps its name.
        """
        found = network_report(files, name) if kind is AssetKind.NETWORK else None
        project = project_scope().project
        digest = self._add_project_mark(kind, name, files, "" if shared else project)
        known = self._find(kind, digest)
        if known is None and self._find(kind, digest, EVERYTHING):
            raise ConflictError(f"this {kind.value} is private to another project; upload it without `shared`")
        if known and (rename or known.verdict == "refuse"):
            return known
        if rename and self._digest_of_name(kind, name):
            name = self._next_name(kind, name)
        self._check_name(kind, name, digest)
        index, store = self._services.index, self._services.store
        said = {"owner": caller_id(), "project": project, "shared": shared, "self_test": self_test}
        asset = library.store_files(store, kind, name, files, said=said)
        if found is not None:
            # The check is stored first, because jobs can use the network once it is recorded.
            put_document(store, names.asset_key(kind, asset.digest, "check.json"), found)
        # With two simultaneous uploads under one name, the later one must find the record of the earlier one.
        with record_transaction(self._services) as (connection, put):
            self._check_name(kind, name, asset.digest)
            asset = library.record_asset(store, asset, put)
            index.write.add_asset(asset, library.load_check(store, kind, asset.digest), within=connection)
        return self.get(kind, asset.digest)

    def hand_facts(self, asset: AssetView) -> descriptions.HandFacts:
        """Return facts and guesses about a hand; raise ConflictError if an older version made its model."""
        return descriptions.read_hand_facts(self.model(asset))

    def correct(self, name: str, corrections: descriptions.HandCorrections, new_name: str = "") -> AssetView:
        """Create a hand from the same files with corrected facts; by default its name gets a number."""
        hand = self.get(AssetKind.HAND, name)
        facts = self.hand_facts(hand)
        archive = self._services.store.get(names.asset_key(AssetKind.HAND, hand.digest, "files.zip"))
        files = ZipFiles(io.BytesIO(archive), limit_bytes=library.UNPACKED_LIMIT_BYTES)
        if digest_files(AssetKind.HAND, files) != hand.digest:
            raise DamagedError(f"the files of the hand {hand.name!r} in the store are damaged; upload it again")
        said = descriptions.parse_json_object(asset_json(files), "asset.json")
        text = json.dumps(descriptions.apply_corrections(said, facts, corrections)).encode()
        if len(text) > descriptions.MAX_BYTES:
            raise LimitError(f"the corrected asset.json exceeds {descriptions.MAX_BYTES} bytes; give fewer corrections")
        files["asset.json"] = text
        if not new_name:
            for mark in ({}, project_mark(files, project_scope().project)):
                files.update(mark)
                if known := self._find(AssetKind.HAND, digest_files(AssetKind.HAND, files)):
                    return known
        return self.add(AssetKind.HAND, new_name or self._next_name(AssetKind.HAND, hand.name), files)

    def _next_name(self, kind: AssetKind, name: str) -> str:
        stem, _, number = name.rpartition("-")
        stem, first = (stem, int(number) + 1) if stem and number.isdigit() and len(number) < 4 else (name, 2)
        for tried in range(first, first + _NAMES_TRIED):
            named = f"{shorten_name(stem, MOST - 5)}-{tried}"
            if not self._digest_of_name(kind, named):
                return named
        raise ConflictError(f"there are many {kind.value}s named {stem}-...; choose a name")

    def delete(self, kind: AssetKind, name: str) -> None:
        asset = self.get(kind, name)
        if not asset.builtin:
            require_ownership(asset.owner, f"{kind.value} {name!r}", asset.project)
        deletion.delete_asset(self._services, kind, asset.digest, owner=caller_id(), scope=project_scope())
        log.info("%s %s deleted", kind, asset.name)

    def _add_project_mark(self, kind: AssetKind, name: str, files: MutableMapping[str, bytes], project: str) -> str:
        """Make the files private to the project by adding its mark; return their digest."""
        files.update(project_mark(files, ""))
        digest = digest_files(kind, files)
        if not project:
            return digest
        known = self._find(kind, digest)
        # Identical files that are shared already are not stored a second time.
        if known and known.name == name and (known.shared or known.builtin):
            return digest
        files.update(project_mark(files, project))
        return digest_files(kind, files)

    def _find(self, kind: AssetKind, name: str, scope: ProjectScope | None = None) -> AssetView | None:
        try:
            return self._services.index.assets.get(kind, name, scope=scope or project_scope())
        except NotFoundError:
            return None

    def _digest_of_name(self, kind: AssetKind, name: str) -> str:
        """Return the digest that a name refers to; empty if only other projects or refused uploads have it."""
        known = self._find(kind, name, replace(project_scope(), everything=False))
        return known.digest if known and known.verdict != "refuse" else ""

    def _check_name(self, kind: AssetKind, name: str, digest: str) -> None:
        if self._digest_of_name(kind, name) not in ("", digest):
            raise ConflictError(f"there is another {kind.value} named {name!r}; give this one another name")

"""Tags for grasps of a project, and exports of selected grasps as CSV, JSON or shards in a ZIP."""

import csv
import io
import json
import logging
import zipfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing
from functools import partial
from pathlib import PurePosixPath
from tempfile import TemporaryFile
from typing import IO, Any, Final, Literal

import numpy as np

from graspd.api.access.auth import InScope, caller_id, may_change, project_scope, require_ownership
from graspd.api.catalog.grasps import Grasps
from graspd.api.models import Selection, TagChange
from graspd.service.index.views import GraspView, TagView
from graspd.service.model.errors import InputError, LimitError, NotFoundError
from graspd.service.model.projects import ProjectScope
from graspd.service.model.records import MOST_TAGS, Grasp, Tag, rows_by_shard, tag_id
from graspd.service.pipeline import tagging
from graspd.service.pipeline.backends import Services
from graspd.service.store.integrity import read_checked
from graspd.service.store.shards import read_shard, relative_path_of, shard_bytes_of_rows

log = logging.getLogger(__name__)


class Tags:
    """Tags of the caller's project, by name or id; changes can raise ForeignResource (another owner)."""

    def __init__(self, services: Services, grasps: Grasps) -> None:
        self._services = services
        self._grasps = grasps

    all = InScope(lambda index: index.tags.all)
    names_by_grasp = InScope(lambda index: index.tags.names_by_grasp)

    def get(self, name: str) -> TagView:
        wanted = self._services.index.tags.id_of(name, scope=project_scope())
        return next(tag for tag in self.all() if tag.id == wanted)

    def resolve_selection(self, selection: Selection) -> list[Grasp]:
        """Return the grasps of a selection, each once; raise NotFoundError if one is out of scope."""
        if selection.filter is not None:
            return self._grasps.matching_grasps(selection.filter)
        named = sorted({(grasp.shard_id, grasp.row) for grasp in selection.grasps or ()})
        there = self._services.index.tags.existing_grasps(named, scope=project_scope())
        for shard, row in named:
            if (shard, row) not in there:
                raise NotFoundError(f"there is no grasp {row} in shard {shard!r}")
        return named

    def tag_grasps(self, name: str, selection: Selection) -> TagChange:
        if not (grasps := self.resolve_selection(selection)):
            raise InputError("no grasp passes this filter, so none gets the tag")
        project = project_scope().project

        def permit(tag: Tag | None) -> None:
            _require_tag_ownership(tag)
            if tag is None and self._tag_count(project) >= MOST_TAGS:
                raise LimitError(f"there are {MOST_TAGS} tags already, the maximum; delete one")

        changed = tagging.tag_grasps(self._services, name, grasps, project=project, owner=caller_id(), permit=permit)
        log.info("tag %s given to %d grasps", name, changed)
        return TagChange(tag=self.get(tag_id(name, project)), changed=changed)

    def untag_grasps(self, name: str, selection: Selection) -> TagChange:
        tag = self._services.index.tags.id_of(name, scope=project_scope())
        changed = tagging.untag_grasps(
            self._services, tag, self.resolve_selection(selection), permit=_require_tag_ownership
        )
        return TagChange(tag=self.get(tag), changed=changed)

    def delete(self, name: str) -> None:
        tag = self._services.index.tags.id_of(name, scope=project_scope())
        tagging.delete_tag(self._services, tag, permit=_require_tag_ownership, owner=caller_id())
        log.info("tag %s removed", name)

    def _tag_count(self, project: str) -> int:
        """Return the number of tags of the project; for the unnamed project, of the caller's key."""
        found = self._services.index.tags.all(scope=ProjectScope(project, everything=False))
        return sum(bool(project) or may_change(tag.owner, tag.project) for tag in found)


def _require_tag_ownership(tag: Tag | None) -> None:
    if tag is not None:
        require_ownership(tag.owner, f"the tag {tag.name!r}", tag.project)


Format = Literal["csv", "json", "zip"]
MEDIA_TYPES: Final[dict[Format, str]] = {"csv": "text/csv", "json": "application/json", "zip": "application/zip"}
#: Maximum number of shards per ZIP: about ten seconds of work.
MOST_SHARDS: Final = 2000
_CHUNK: Final = 1 << 20
_COLUMNS: Final = (*GraspView.model_fields, "tags")


class GraspExports:
    """Writer of selected grasps to files; a file stays on the service's disk until it is sent."""

    def __init__(self, services: Services, grasps: Grasps, tags: Tags) -> None:
        self._services = services
        self._grasps = grasps
        self._tags = tags

    def export(self, places: Sequence[Grasp], format: Format, said: Mapping[str, Any]) -> tuple[int, Iterator[bytes]]:
        """Write grasps that are in scope, and their selection `said`, to a file; return its size and bytes."""
        file = TemporaryFile()  # noqa: SIM115 (it is closed once it is sent)
        try:
            {"csv": self._write_csv, "json": self._write_json, "zip": self._write_zip}[format](file, places, said)
            size = file.tell()
            file.seek(0)
        except BaseException:
            file.close()
            raise
        return size, _stream(file)

    def _export_rows(self, places: Sequence[Grasp]) -> Iterator[dict[str, Any]]:
        tags = self._tags.names_by_grasp(places)
        for grasp in self._grasps.get_many(places):
            yield grasp.model_dump(mode="json") | {"tags": tags.get((grasp.shard_id, grasp.row), [])}

    def _write_csv(self, file: IO[bytes], places: Sequence[Grasp], _: Mapping[str, Any]) -> None:
        text = io.TextIOWrapper(file, encoding="utf-8", newline="")
        rows = csv.DictWriter(text, _COLUMNS)
        rows.writeheader()
        rows.writerows(row | {"tags": " ".join(row["tags"])} for row in self._export_rows(places))
        text.detach()

    def _write_json(self, file: IO[bytes], places: Sequence[Grasp], said: Mapping[str, Any]) -> None:
        file.write(b'{"chosen": ' + json.dumps(said).encode() + b', "items": [')
        for number, row in enumerate(self._export_rows(places)):
            file.write((b",\n" if number else b"\n") + json.dumps(row).encode())
        file.write(b"\n]}\n")

    def _write_zip(self, file: IO[bytes], places: Sequence[Grasp], said: Mapping[str, Any]) -> None:
        shards = rows_by_shard(places)
        if not shards:
            raise InputError("the selection contains no grasp; change it")
        if len(shards) > MOST_SHARDS:
            fix = "select fewer, or write them with `graspd grasps where` on a machine that can read the store"
            raise LimitError(f"these grasps are in {len(shards)} shards, and a ZIP has at most {MOST_SHARDS}; {fix}")
        looked_at, names = 0, list[PurePosixPath]()
        with zipfile.ZipFile(file, "w") as packed:
            for shard_id, rows in shards.items():
                known = self._services.index.shards.get(shard_id, scope=project_scope())
                data = read_checked(self._services.store, known.key, known.sha256)
                shard = read_shard(data, kind="base", name=known.key)
                mask = np.zeros(known.count, bool)
                mask[list(rows)] = True
                looked_at += len(mask)
                names.append(relative_path_of(shard, names))
                # ZipInfo has a fixed date, so that the same grasps give an identical file.
                packed.writestr(zipfile.ZipInfo(str(names[-1])), shard_bytes_of_rows(shard, mask))
            facts = {**said, "looked_at": looked_at, "kept": len(set(places)), "shards": [*map(str, names)]}
            packed.writestr(zipfile.ZipInfo("subset.json"), json.dumps(facts, indent=1) + "\n")


def _stream(file: IO[bytes]) -> Iterator[bytes]:
    with closing(file):
        yield from iter(partial(file.read, _CHUNK), b"")

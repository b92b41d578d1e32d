"""Datasets and sets of objects over HTTP."""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator
from typing import Any, Final

from pydantic import TypeAdapter

from api.client.client import Client, path_of
from service.index.dataset_views import CellView, DatasetView, ObjectSetView, SnapshotView
from service.index.views import Page
from service.model.dataset_records import Snapshot, SnapshotShard
from service.model.states import State
from service.pipeline.datasets.estimate import Estimate
from service.pipeline.datasets.spec import DatasetRequest, Matrix

_PAGE: Final = 200
_POLL_S: Final = 1.0


class DatasetClient:
    """The dataset's side of an API client; raises what the API's problem documents say."""

    def __init__(self, client: Client) -> None:
        self._client = client

    @property
    def url(self) -> str:
        return self._client.url

    def create(self, request: DatasetRequest) -> DatasetView:
        answer = self._client.send("POST", "/v1/datasets", json=_asked(request))
        return DatasetView.model_validate_json(answer.content)

    def estimate(self, matrix: Matrix) -> Estimate:
        body = {name: value for name, value in _asked(matrix).items() if name in Matrix.model_fields}
        return Estimate.model_validate_json(self._client.send("POST", "/v1/datasets/estimate", json=body).content)

    def datasets(self, *, limit: int = 50, cursor: str | None = None) -> Page[DatasetView]:
        """Datasets, newest first."""
        answer = self._client.send("GET", "/v1/datasets", params={"limit": limit, "cursor": cursor})
        return Page[DatasetView].model_validate_json(answer.content)

    def dataset(self, name: str) -> DatasetView:
        return DatasetView.model_validate_json(self._client.send("GET", path_of("datasets", name)).content)

    def cells(self, name: str, *, state: State | None = None) -> Iterator[CellView]:
        """All cells of a dataset, or those in a state."""
        cursor: str | None = None
        while True:
            params = {"limit": _PAGE, "cursor": cursor, "state": state}
            answer = self._client.send("GET", path_of("datasets", name, "cells"), params=params)
            page = Page[CellView].model_validate_json(answer.content)
            yield from page.items
            cursor = page.next
            if cursor is None:
                return

    def cancel(self, name: str) -> DatasetView:
        return DatasetView.model_validate_json(self._client.send("POST", path_of("datasets", name, "cancel")).content)

    def retry(self, name: str) -> DatasetView:
        return DatasetView.model_validate_json(self._client.send("POST", path_of("datasets", name, "retry")).content)

    def take_snapshot(self, name: str) -> SnapshotView:
        answer = self._client.send("POST", path_of("datasets", name, "snapshots"))
        return SnapshotView.model_validate_json(answer.content)

    def snapshots(self, name: str) -> Page[SnapshotView]:
        """The newest snapshots of a dataset."""
        answer = self._client.send("GET", path_of("datasets", name, "snapshots"), params={"limit": _PAGE})
        return Page[SnapshotView].model_validate_json(answer.content)

    def snapshot(self, name: str, digest: str) -> Snapshot:
        """A snapshot with its list of shards."""
        answer = self._client.send("GET", path_of("datasets", name, "snapshots", digest))
        return Snapshot.model_validate_json(answer.content)

    def fetch(self, shard: SnapshotShard) -> Iterator[bytes]:
        """Bytes of a shard's file."""
        return self._client.fetch(path_of("shards", shard.id, "file"))

    def add_object_set(self, name: str, objects: Iterable[str]) -> ObjectSetView:
        answer = self._client.send("POST", "/v1/object-sets", json={"name": name, "objects": list(objects)})
        return ObjectSetView.model_validate_json(answer.content)

    def object_sets(self) -> list[ObjectSetView]:
        answer = self._client.send("GET", "/v1/object-sets")
        return TypeAdapter(list[ObjectSetView]).validate_json(answer.content)

    def watch(self, name: str) -> Iterator[DatasetView]:
        """A dataset every second until it ends."""
        while True:
            dataset = self.dataset(name)
            yield dataset
            if dataset.state.is_final:
                return
            time.sleep(_POLL_S)


def _asked(matrix: Matrix) -> dict[str, Any]:
    """The body of a request; what is empty is left out, as an older service does not know all of it."""
    return {name: value for name, value in matrix.model_dump(mode="json").items() if value not in ({}, "")}

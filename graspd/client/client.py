"""HTTP client: exchanges the models of the API; raises its problem documents as exceptions."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import Any, Final, TypeVar
from urllib.parse import quote

import httpx
from httpx_sse import EventSource
from pydantic import BaseModel, TypeAdapter

from graspd.api.formatting import is_loopback
from graspd.api.models import Job, JobDetail
from graspd.service.cli import write_output
from graspd.service.index.views import AssetView, CellView, DatasetView, ObjectSetView, Page, SnapshotView
from graspd.service.model.domain import JobRequest
from graspd.service.model.errors import ERRORS, GraspdError, InputError, RateError, UnavailableError, without_secrets
from graspd.service.model.states import AssetKind, State
from graspd.service.pipeline.datasets.spec import DatasetRequest, Estimate, Matrix

_PATIENCE_S: Final = 30.0
_CONNECT_S: Final = 5.0
_TIMEOUT: Final = httpx.Timeout(_PATIENCE_S, connect=_CONNECT_S)
#: Longest wait for data of a stream [s]: the server sends a keep-alive every 15 s.
_STREAM_TIMEOUT: Final = httpx.Timeout(40.0, connect=5.0)
_POLL_S: Final = 0.3
_DATASET_POLL_S: Final = 1.0
_PAGE: Final = 200
#: Waits [s] before retries if the service reports too many requests.
_WAITS_S: Final = (2.0, 5.0, 10.0, 20.0)

View = TypeVar("View", bound=BaseModel)


class Client(AbstractContextManager["Client"]):
    """Connection to one graspd API; `transport` replaces the network in tests."""

    def __init__(self, url: str, *, key: str | None = None, transport: httpx.BaseTransport | None = None) -> None:
        address = _address(url.strip().rstrip("/"))
        self.url = without_secrets(str(address)).rstrip("/")
        self._http = httpx.Client(
            base_url=address,
            headers=_authorization((key or "").strip()),
            timeout=_TIMEOUT,
            transport=transport,
            follow_redirects=True,
            # A proxy from the environment cannot reach loopback addresses of this machine.
            trust_env=not is_loopback(address.host),
        )

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        self._http.close()

    def submit(self, request: JobRequest) -> JobDetail:
        """Submit a job; an identical request returns the same job."""
        return self.request(JobDetail, "POST", "/v1/jobs", json=request.model_dump(mode="json"))

    def job(self, job_id: str) -> JobDetail:
        return self.request(JobDetail, "GET", request_path("jobs", job_id))

    def jobs(self, *, state: State | None = None, prefix: str = "", limit: int = 50) -> Page[Job]:
        """Return the newest jobs whose ids begin with `prefix`, at most `limit`."""
        return self.request(Page[Job], "GET", "/v1/jobs", params={"state": state, "prefix": prefix, "limit": limit})

    def assets(self, kind: AssetKind, *, refused: bool = False) -> Iterator[AssetView]:
        """Yield all hands, objects or networks; refused ones only on request."""
        return self._pages(AssetView, f"/v1/{kind.value}s", refused=refused)

    def asset(self, kind: AssetKind, name: str) -> AssetView:
        return self.request(AssetView, "GET", request_path(f"{kind.value}s", name))

    def upload(
        self,
        kind: AssetKind,
        path: Path,
        *,
        name: str | None = None,
        options: dict[str, Any] | None = None,
        self_test: bool = False,
        shared: bool = False,
    ) -> AssetView:
        """Upload a file or a ZIP; `options` override keys of its `asset.json`."""
        fields = ({"name": name} if name else {}) | ({"options": json.dumps(options)} if options else {})
        fields |= {name: "true" for name, wanted in {"self_test": self_test, "shared": shared}.items() if wanted}
        try:
            with path.open("rb") as file:
                sent = {"file": (path.name, file)}
                return self.request(AssetView, "POST", f"/v1/{kind.value}s", files=sent, data=fields)
        except OSError as error:
            raise InputError(f"{path} cannot be read: {error.strerror}") from None

    def wait_for_check(self, kind: AssetKind, digest: str, *, timeout_s: float = 120.0) -> AssetView:
        """Return an uploaded asset after its check; raise UnavailableError after `timeout_s`."""
        deadline = time.monotonic() + timeout_s
        while (asset := self.asset(kind, digest)).verdict is None:
            if time.monotonic() > deadline:
                why = asset.message or "is a worker running?"
                raise UnavailableError(f"no worker has checked {kind.value} {asset.name!r} yet; {why}")
            time.sleep(_POLL_S)
        return asset

    def fetch(
        self, path: str, *, params: dict[str, str] | None = None, patience_s: float = _PATIENCE_S
    ) -> Iterator[bytes]:
        """Yield chunks of a file from the API; each takes at most `patience_s` [s]."""
        timeout = httpx.Timeout(patience_s, connect=_CONNECT_S)
        with _convert_errors(self.url), self._http.stream("GET", path, params=params, timeout=timeout) as answer:
            _raise_for(answer)
            yield from answer.iter_bytes()

    def save(
        self, address: str, path: Path, *, params: dict[str, str] | None = None, patience_s: float = _PATIENCE_S
    ) -> Path:
        """Download a file from the API; `path` appears once it is complete. `patience_s`: see `fetch`."""
        write_output(path, self.fetch(address, params=params, patience_s=patience_s))
        return path

    def watch(self, job_id: str) -> Iterator[Job]:
        """Yield a job at each change until it ends; reconnect if the connection breaks."""
        while True:
            try:
                for event, data in self._events(request_path("jobs", job_id, "events")):
                    if event in ("progress", "end"):
                        yield Job.model_validate(data)
                    if event == "end":
                        return
            except UnavailableError:
                if not self._is_reachable_again():
                    raise
            time.sleep(_POLL_S)

    def wait(self, job_id: str, on_progress: Callable[[Job], None] | None = None) -> JobDetail:
        for job in self.watch(job_id):
            if on_progress is not None:
                on_progress(job)
        return self.job(job_id)

    def create_dataset(self, request: DatasetRequest) -> DatasetView:
        return self.request(DatasetView, "POST", "/v1/datasets", json=_matrix_body(request))

    def estimate(self, matrix: Matrix) -> Estimate:
        body = {name: value for name, value in _matrix_body(matrix).items() if name in Matrix.model_fields}
        return self.request(Estimate, "POST", "/v1/datasets/estimate", json=body)

    def datasets(self, *, limit: int = 50) -> Page[DatasetView]:
        return self.request(Page[DatasetView], "GET", "/v1/datasets", params={"limit": limit})

    def dataset(self, name: str) -> DatasetView:
        return self.request(DatasetView, "GET", request_path("datasets", name))

    def cells(self, name: str, *, state: State | None = None) -> Iterator[CellView]:
        """Yield all cells of a dataset, or those in a state."""
        return self._pages(CellView, request_path("datasets", name, "cells"), state=state)

    def take_snapshot(self, name: str) -> SnapshotView:
        return self.request(SnapshotView, "POST", request_path("datasets", name, "snapshots"))

    def watch_dataset(self, name: str) -> Iterator[DatasetView]:
        """Yield a dataset every second until it ends."""
        while not (dataset := self.dataset(name)).state.is_final:
            yield dataset
            time.sleep(_DATASET_POLL_S)
        yield dataset

    def add_object_set(self, name: str, objects: Iterable[str]) -> ObjectSetView:
        body = {"name": name, "objects": list(objects)}
        return self.request(ObjectSetView, "POST", "/v1/object-sets", json=body)

    def object_sets(self) -> list[ObjectSetView]:
        return TypeAdapter(list[ObjectSetView]).validate_json(self.send("GET", "/v1/object-sets").content)

    def _pages(self, kind: type[View], path: str, **params: Any) -> Iterator[View]:
        params |= {"limit": _PAGE, "cursor": None}
        while True:
            page: Page[Any] = self.request(Page[kind], "GET", path, params=params)  # type: ignore[valid-type]
            yield from page.items
            params["cursor"] = page.next
            if page.next is None:
                return

    def request(self, kind: type[View], method: str, path: str, **options: Any) -> View:
        """Send a request and return the response as a model."""
        return kind.model_validate_json(self.send(method, path, **options).content)

    def _is_reachable_again(self) -> bool:
        deadline = time.monotonic() + _PATIENCE_S
        while time.monotonic() < deadline:
            try:
                self.send("GET", "/healthz")
                return True
            except UnavailableError:
                time.sleep(_POLL_S)
        return False

    def _events(self, path: str) -> Iterator[tuple[str, Any]]:
        with _convert_errors(self.url), self._http.stream("GET", path, timeout=_STREAM_TIMEOUT) as answer:
            _raise_for(answer)
            yield from parse_events(answer)

    def send(self, method: str, path: str, *, params: dict[str, Any] | None = None, **options: Any) -> httpx.Response:
        """Send a request and return the response; raise a problem document as an exception."""
        given = {name: value for name, value in (params or {}).items() if value is not None}
        for wait in (*_WAITS_S, None):
            with _convert_errors(self.url):
                answer = self._http.request(method, path, params=given or None, **options)
            # A retry helps only against the limit on the rate of requests, not against quotas.
            if wait is None or answer.status_code != 429 or RateError.slug not in answer.text:
                break
            time.sleep(min(wait, float(answer.headers.get("retry-after", wait))))
        _raise_for(answer)
        return answer


def request_path(*parts: str) -> str:
    """Build an address of the API from its parts, with escaped names: `/v1/tags/good%20ones/remove`."""
    return "/v1/" + "/".join(quote(part, safe="") for part in parts)


def _matrix_body(matrix: Matrix) -> dict[str, Any]:
    """Build the body of a matrix without empty fields, because an older service may reject these."""
    return {name: value for name, value in matrix.model_dump(mode="json").items() if value not in ({}, "")}


def _address(url: str) -> httpx.URL:
    fix = "give http://HOST:PORT or https://HOST/PATH, an IPv6 address in brackets: http://[::1]:8000"
    try:
        found = httpx.URL(url)
    except (httpx.InvalidURL, ValueError):
        found = httpx.URL()
    if found.scheme not in ("http", "https") or not found.host:
        raise InputError(f"the address of the API {url!r} cannot be used; {fix}")
    return found


def _authorization(key: str) -> dict[str, str]:
    if not key:
        return {}
    if not (key.isascii() and key.isprintable() and " " not in key):
        raise InputError("the API key (GRASPD_API_KEY) contains an invalid character; copy it again")
    return {"Authorization": f"Bearer {key}"}


def parse_events(answer: httpx.Response) -> Iterator[tuple[str, Any]]:
    for event in EventSource(answer).iter_sse():
        if event.data:
            yield event.event, event.json()


@contextmanager
def _convert_errors(url: str) -> Iterator[None]:
    try:
        yield
    except (httpx.ConnectError, httpx.ConnectTimeout):
        fix = "start one with `graspd up`, or set GRASPD_API_URL"
        raise UnavailableError(f"no graspd answers at {url}; {fix}") from None
    except (httpx.HTTPError, httpx.InvalidURL) as error:
        raise UnavailableError(f"the connection to {url} broke: {error or type(error).__name__}") from None


def _raise_for(answer: httpx.Response) -> None:
    if answer.is_success:
        return
    answer.read()
    try:
        problem = answer.json()
        slug, detail = str(problem["type"]).rpartition("/")[2], str(problem["detail"])
    except (ValueError, KeyError, TypeError):
        slug, detail = "", f"{answer.url} answered {answer.status_code}, but not as a graspd API; check the address"
    fallback: type[GraspdError] = InputError if answer.is_client_error else UnavailableError
    raise ERRORS.get(slug, fallback)(detail)

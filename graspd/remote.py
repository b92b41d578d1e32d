"""Client of a graspd service: submit jobs, wait for them, and fetch their grasps."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Self, Unpack

from graspd.grasps import Grasps, concatenate
from graspd.service.model.domain import JobOptions, JobRequest
from graspd.service.model.errors import InputError, TaskError
from graspd.service.model.options import validate, with_keywords
from graspd.service.model.states import State
from graspd.service.store.shards import read_shard

if TYPE_CHECKING:
    from graspd.keywords import JobKeywords

try:
    from graspd.api.models import JobDetail
    from graspd.client.client import Client as HttpClient
    from graspd.client.client import request_path
    from graspd.client.reports import open_client
except ModuleNotFoundError as error:
    raise ImportError(f"graspd.Client needs {error.name}; run pip install 'graspd[api]'") from error


class Client:
    """A graspd service. Usable as a context manager.

    Args:
        url: address of its API; None: GRASPD_API_URL, or the service that runs on this machine's data folder.
        key: Bearer key, if the service requires one; None: GRASPD_API_KEY.
    """

    def __init__(self, url: str | None = None, *, key: str | None = None) -> None:
        self._http = open_client(url, key=key)

    def __repr__(self) -> str:
        return f"<client of {self._http.url}>"

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the connection."""
        self._http.close()

    @with_keywords(JobOptions, "job")
    def submit(self, hand: str, object: str, **options: Unpack[JobKeywords]) -> Job:
        """Submit a job; an identical request returns the same job.

        Args:
            hand: name of a hand in the service.
            object: name of an object in the service.
            options: fields of POST /v1/jobs; docs/reference/options.md lists them, with units, bounds and defaults.

        Raises:
            InputError: an unknown option, or a value out of range.
            NotFoundError: unknown hand or object.
            UnavailableError: the service does not answer.
        """
        request = validate(JobRequest, {"hand": hand, "object": object, **options})
        return Job(self._http, self._http.submit(request))

    def get(self, path: str, **query: Any) -> Any:
        """Return the JSON of a GET route, such as `get("jobs", state="failed")["items"]`.

        Args:
            path: address below /v1.
            query: parameters of the route; `cursor`, the field `next` of a list, requests the next items.

        Raises:
            NotFoundError: there is no such resource.
        """
        return self._http.send("GET", f"/v1/{path}", params=query).json()

    def job(self, job_id: str) -> Job:
        """Return a job by its id.

        Raises:
            NotFoundError: there is no such job.
        """
        return Job(self._http, self._http.job(job_id))

    def shard(self, shard_id: str) -> Grasps:
        """Return the grasps of a base shard by the shard's id.

        Raises:
            NotFoundError: there is no such shard.
        """
        file = b"".join(self._http.fetch(request_path("shards", shard_id, "file")))
        return concatenate([read_shard(file, kind="base", name=shard_id[:12])])


class Job:
    """A job of the service: grasps of one hand on one object."""

    def __init__(self, http: HttpClient, said: JobDetail) -> None:
        self._http, self._said = http, said

    def __repr__(self) -> str:
        return f"<job {self.id[:12]}: {self.hand} on {self.object}, {self.state}>"

    @property
    def id(self) -> str:
        """Id of the job."""
        return self._said.id

    @property
    def hand(self) -> str:
        """Name of the hand."""
        return self._said.request.hand

    @property
    def object(self) -> str:
        """Name of the object."""
        return self._said.request.object

    @property
    def state(self) -> str:
        """State at the last request: queued, running, succeeded, failed or cancelled."""
        return str(self._said.state)

    def wait(self, progress: Callable[[float], None] | None = None) -> Self:
        """Wait until the job has ended.

        Args:
            progress: called with the finished share, 0 to 1.

        Raises:
            TaskError: it failed or was cancelled; finished grasps can still be fetched.
        """
        on_progress = (lambda job: progress(float(job.progress))) if progress else None
        self._said = self._http.wait(self.id, on_progress=on_progress)
        if self._said.state != State.SUCCEEDED:
            reasons = [attempt.reason for attempt in self._said.attempts]
            raise TaskError(f"job {self.id[:12]} ended {self.state}{': ' + reasons[-1] if reasons else ''}")
        return self

    def grasps(self) -> Grasps:
        """Fetch the grasps made so far.

        Raises:
            InputError: there are none yet.
        """
        self._said = self._http.job(self.id)
        base = [shard for shard in self._said.shards if shard.kind == "base"]
        if not base:
            raise InputError(f"job {self.id[:12]} has made no grasps yet: it is {self.state}")
        ordered = sorted(base, key=lambda shard: shard.batch)
        return concatenate([read_shard(b"".join(self._http.fetch(one.file)), name=one.id[:12]) for one in ordered])

    def cancel(self) -> Self:
        """Cancel the job; finished shards remain."""
        self._said = self._http.request(JobDetail, "POST", request_path("jobs", self.id, "cancel"))
        return self

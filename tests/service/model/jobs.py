"""A job of a hand and an object that nobody stored."""

from __future__ import annotations

from graspd.service.model.digests import job_id, shard_id
from graspd.service.model.domain import JobRequest
from graspd.service.model.records import JobRecord
from graspd.service.model.states import Stage
from tests.fakes import job_record

HAND, OBJECT = "a" * 32, "b" * 32
DIGESTS = {"hand_digest": HAND, "object_digest": OBJECT}


def record(wanted: JobRequest) -> JobRecord:
    return job_record(wanted, job_id(wanted, HAND, OBJECT))


def shard(stage: Stage, wanted: JobRequest) -> str:
    return shard_id(stage, request=wanted, batch=0, count=32, revision=1, **DIGESTS)

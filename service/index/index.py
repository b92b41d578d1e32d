"""The index as the API and the keeper see it."""

from __future__ import annotations

from service.index.changes.datasets import DatasetChanges
from service.index.changes.records import Changes
from service.index.changes.removals import Removals
from service.index.notes import Notes
from service.index.queries.costs import CostQueries
from service.index.queries.datasets import DatasetQueries
from service.index.queries.feed import Feed
from service.index.queries.grasps import GraspQueries
from service.index.queries.jobs import JobQueries
from service.index.queries.service import ServiceQueries
from service.index.queries.summaries import Summaries


class Index(
    JobQueries,
    GraspQueries,
    Summaries,
    ServiceQueries,
    DatasetQueries,
    CostQueries,
    Feed,
    Changes,
    DatasetChanges,
    Notes,
    Removals,
):
    """SQL rows derived from the store; `url` is an SQLAlchemy URL.

    Reads answer the API; writes come from the API and the keeper only. Every method raises IndexUnavailable when the
    database is away. Cursors are opaque, `limit` is cut to 200; an unknown id is a NotFoundError.
    """

"""The index as the API and the keeper see it."""

from __future__ import annotations

from service.index.changes import Changes
from service.index.cost_queries import CostQueries
from service.index.dataset_changes import DatasetChanges
from service.index.dataset_queries import DatasetQueries
from service.index.feed import Feed
from service.index.grasp_queries import GraspQueries
from service.index.job_queries import JobQueries
from service.index.notes import Notes
from service.index.removals import Removals
from service.index.service_queries import ServiceQueries
from service.index.summaries import Summaries


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

"""Deletions that can still be undone."""

from __future__ import annotations

import logging
from datetime import datetime, timedelta

from pydantic import Field

from graspd.api.access.auth import must_own, project_scope
from graspd.service.index.views import View
from graspd.service.pipeline import deletion
from graspd.service.pipeline.backends import Services
from graspd.service.store.records import Deletion, What, deletions

log = logging.getLogger(__name__)


class DeletionView(View):
    """Resource that was deleted within the grace time."""

    what: What
    id: str = Field(description="of the job, tag, hand, object or network; name of the dataset")
    name: str
    at: str = Field(description="when it was deleted")
    until: str = Field(description="until then it can be restored")
    owner: str = Field(description="id of the key that it was submitted with")
    project: str


class Deletions:
    """Deletions in the caller's scope; permission to delete includes permission to restore."""

    def __init__(self, services: Services) -> None:
        self._services = services

    def recent(self) -> list[DeletionView]:
        """Return what can be restored, newest first."""
        return [self._view(one) for one in deletions(self._services.store) if self._is_seen(one)]

    def restore(self, what: What, name: str) -> DeletionView:
        """Restore a resource by its name or id.

        Raises:
            NotFoundError: nothing of that name was deleted within the grace time.
            NotYours: another key submitted it.
            ConflictError: the name is in use again, or a resource it needs is deleted too.
        """

        def permit(one: Deletion) -> None:
            must_own(one.submitter, f"{what} {name!r}", one.project)

        found = deletion.restore(self._services, what, name, permit=permit, among=self._is_seen)
        log.info("%s %s restored", what, found.name or found.id)
        return self._view(found)

    def _is_seen(self, one: Deletion) -> bool:
        return project_scope().everything or one.project == project_scope().project

    def _view(self, one: Deletion) -> DeletionView:
        ends = datetime.fromisoformat(one.at) + timedelta(seconds=self._services.settings.shard_grace_s)
        until = ends.isoformat(timespec="seconds").replace("+00:00", "Z")
        said = {"name": one.name or one.id, "owner": one.submitter}
        return DeletionView(what=one.what, id=one.id, at=one.at, until=until, project=one.project, **said)

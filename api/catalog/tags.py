"""Tags: names that users give to grasps of their project."""

from __future__ import annotations

import logging
from collections.abc import Collection

from graspd.api.access.auth import caller_id, may_change, must_own, project_scope
from graspd.api.catalog.grasps import Grasps
from graspd.api.models import Selection, TagChange
from graspd.service.index.views import TagView
from graspd.service.model.errors import InputError, LimitError, NotFoundError
from graspd.service.model.projects import ProjectScope
from graspd.service.model.records import MOST_TAGS, Grasp, Tag, tag_id
from graspd.service.pipeline import tagging
from graspd.service.pipeline.backends import Services

log = logging.getLogger(__name__)


class Tags:
    """Tags of the caller's project, each by its name or id; changes raise ForeignResource."""

    def __init__(self, services: Services, grasps: Grasps) -> None:
        self._services = services
        self._grasps = grasps

    def all(self) -> list[TagView]:
        return self._services.index.tags.all(scope=project_scope())

    def one(self, name: str) -> TagView:
        wanted = self._services.index.tags.named(name, scope=project_scope())
        return next(tag for tag in self.all() if tag.id == wanted)

    def of(self, grasps: Collection[Grasp]) -> dict[Grasp, list[str]]:
        """Return the tag names of each of these grasps that has tags."""
        return self._services.index.tags.of(grasps, scope=project_scope())

    def chosen(self, selection: Selection) -> list[Grasp]:
        """Return the grasps of a selection, each once, in order; NotFoundError if one is out of scope."""
        if selection.filter is not None:
            return self._grasps.members(selection.filter)
        named = sorted({(grasp.shard_id, grasp.row) for grasp in selection.grasps or ()})
        there = self._services.index.tags.there(named, scope=project_scope())
        for shard, row in named:
            if (shard, row) not in there:
                raise NotFoundError(f"there is no grasp {row} in shard {shard!r}")
        return named

    def give(self, name: str, selection: Selection) -> TagChange:
        if not (grasps := self.chosen(selection)):
            raise InputError("no grasp passes this filter, so none gets the tag")
        project = project_scope().project

        def permit(tag: Tag | None) -> None:
            _permit(tag)
            if tag is None and self._mine(project) >= MOST_TAGS:
                raise LimitError(f"there are {MOST_TAGS} tags, which is the most; delete one")

        changed = tagging.give(self._services, name, grasps, project=project, owner=caller_id(), permit=permit)
        log.info("tag %s given to %d grasps", name, changed)
        return TagChange(tag=self.one(tag_id(name, project)), changed=changed)

    def take_off(self, name: str, selection: Selection) -> TagChange:
        tag = self._services.index.tags.named(name, scope=project_scope())
        changed = tagging.take_off(self._services, tag, self.chosen(selection), permit=_permit)
        return TagChange(tag=self.one(tag), changed=changed)

    def remove(self, name: str) -> None:
        tag = self._services.index.tags.named(name, scope=project_scope())
        tagging.remove(self._services, tag, permit=_permit, owner=caller_id())
        log.info("tag %s removed", name)

    def _mine(self, project: str) -> int:
        """Return the number of tags of the project; without a project name, of the caller's key."""
        found = self._services.index.tags.all(scope=ProjectScope(project, everything=False))
        return sum(bool(project) or may_change(tag.owner, tag.project) for tag in found)


def _permit(tag: Tag | None) -> None:
    if tag is not None:
        must_own(tag.owner, f"the tag {tag.name!r}", tag.project)

"""Tags: names that users give to grasps, to find them again and to take them away together."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Annotated, Final, Literal

from pydantic import Field

from service.model.base import TagName
from service.model.digests import digest_json
from service.model.domain import Digest
from service.model.projects import Project
from service.model.records import Record

#: Tags of one project (of one key, where it belongs to none), and grasps of one tag.
MOST_TAGS: Final = 100
MOST_TAGGED: Final = 20_000
#: A grasp: its shard, and its row there.
Grasp = tuple[str, int]
Row = Annotated[int, Field(ge=0, lt=2**31)]


class Tag(Record):
    """`tags/{id}/{number:06}.json`: a tag after a change of a user's. The last one counts; `gone` is the end."""

    version: Literal[1] = 1
    id: Digest
    name: TagName
    number: int = Field(ge=1)
    created: str
    changed: str
    owner: str = Field("", max_length=64, description="id of the API key that made it")
    project: Project = Field("", description="whose grasps it is given to")
    gone: bool = False
    grasps: dict[Digest, tuple[Row, ...]] = Field(default_factory=dict, description="rows of each base shard")

    @property
    def members(self) -> set[Grasp]:
        """The grasps that have it."""
        return {(shard, row) for shard, rows in self.grasps.items() for row in rows}


def tag_id(name: str, project: str) -> str:
    """What a project's tag of a name is called in the store."""
    return digest_json(["tag", project, name])


def by_shard(grasps: Iterable[Grasp]) -> Mapping[str, tuple[int, ...]]:
    """Rows of each shard, in order."""
    found: dict[str, list[int]] = {}
    for shard, row in sorted(set(grasps)):
        found.setdefault(shard, []).append(row)
    return {shard: tuple(rows) for shard, rows in found.items()}

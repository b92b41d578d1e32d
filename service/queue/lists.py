"""The lists in Redis that tasks wait in: one a lane and stage, so that a worker may serve some stages only.

While workers of two versions are there, a task that only some of them can do waits apart: in a list whose name ends in
what it asks of a worker, `bulk-synthesize.2.10` for schema 2 and revision 10. Who cannot do it never looks there.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable
from itertools import product
from typing import Any, Final

from redis.exceptions import ResponseError

from service.model.states import Lane, Stage
from service.model.workers import FIRST_SCHEMA, Ability, Need
from service.queue import entries
from service.queue.port import lane_order
from service.queue.rq_keys import LISTS, list_name

#: Later stages first: a batch that was begun is finished before the next begins.
_STAGE_ORDER: Final = (Stage.INGEST, Stage.RENDER, Stage.SCENE, Stage.SYNTHESIZE)
#: Versions that can be told apart at once; a name beyond them is nobody's.
_MOST_APART: Final = 64
_APART: Final = re.compile(r"(.+)\.([0-9]{1,4})\.([0-9]{1,4})")
_COMMON: Final = tuple(f"{lane.value}-{stage.value}" for lane, stage in product(Lane, Stage))
_PLACES: Final = dict(zip(_COMMON, product(Lane, Stage), strict=True))


def queue_name(lane: Lane, stage: Stage, need: Need | None = None) -> str:
    """Name of the RQ queue of a lane and stage; of what waits apart, if there is a need."""
    common = f"{lane.value}-{stage.value}"
    return common if need is None else f"{common}.{need.schema}.{need.revision}"


def queue_names(stages: Collection[Stage], taken: int = 0, *, ability: Ability | None = None) -> list[str]:
    """Queues of a worker that serves these stages, in the order in which it takes its next task after `taken`.

    What waits apart comes first: others cannot do it.
    """
    return [
        name
        for lane in lane_order(taken)
        for stage in _STAGE_ORDER
        if stage in stages
        for name in (*_apart(lane, stage, ability), queue_name(lane, stage))
    ]


def known_lists(connection: Any) -> list[str]:
    """Names of the lists that may hold tasks: the common ones, and those apart that were ever used."""
    try:
        found = connection.smembers(LISTS)
    except ResponseError as error:
        if not entries.is_wrong_type(error):
            raise
        found = set()
    named = (list_name(raw.decode(errors="replace")) for raw in found)
    return [*_COMMON, *sorted(name for name in named if is_apart(name))[:_MOST_APART]]


def place_of(name: str) -> tuple[Lane, Stage]:
    """Lane and stage of a list of `known_lists`."""
    return _PLACES[_common(name)]


def is_apart(name: str) -> bool:
    """Whether a list is for some workers of its stage only."""
    return name not in _PLACES and _common(name) in _PLACES


def without_takers(names: Iterable[str], abilities: Collection[tuple[Stage, Ability]]) -> list[str]:
    """Lists apart that no worker looks into: none with such an ability serves their stage."""
    served = {
        queue_name(lane, stage, need)
        for stage, ability in abilities
        for lane in Lane
        for need in _needs(stage, ability)
    }
    return [name for name in names if is_apart(name) and name not in served]


def _common(name: str) -> str:
    found = _APART.fullmatch(name)
    return found[1] if found else name


def _apart(lane: Lane, stage: Stage, ability: Ability | None) -> list[str]:
    return [queue_name(lane, stage, need) for need in _needs(stage, ability)] if ability is not None else []


def _needs(stage: Stage, ability: Ability) -> list[Need]:
    """What a worker can do of what may wait apart."""
    if not ability.looks_apart:
        return []
    revision = ability.revisions.get(stage.value, 0)
    return [Need(stage, schema, schema, revision) for schema in range(FIRST_SCHEMA, ability.schemas[1] + 1)]

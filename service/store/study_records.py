"""What a study leaves in the store for everybody: each record is an immutable object, the last by name counts.

A record of a kind is `{kind}/{created}.json`; `charts` come from `graspd chart`, `scene_charts/{scene}` from it with a
scene, `stability` from `graspd stability`.
"""

from __future__ import annotations

import itertools
import json
import re
from collections.abc import Mapping
from typing import Any, Final

from service.model.digests import digest_json
from service.model.scene_spec import SceneSpec
from service.store.seals import get_document, put_sealed
from service.store.store import Store

CHARTS: Final = "charts"
IN_SCENES: Final = "scene_charts"
STABILITY: Final = "stability"


def charts_of(place: SceneSpec) -> str:
    """The kind of the charts that hold for a scene: one for each kind of scene, and one for each scene file, by its
    supports and the target's pose. Neighbours, faces and `touch` do not count."""
    if place.kind == "free":
        return CHARTS
    if place.kind != "file":
        return f"{IN_SCENES}/{place.kind}"
    told = place.model_dump(mode="json", include={"supports", "target"})
    return f"{IN_SCENES}/file-{digest_json(told)[:12]}"


def kind_of(chart: Mapping[str, Any]) -> str:
    """The kind of a chart as `graspd chart` made it."""
    return charts_of(SceneSpec.model_validate(chart["scene"])) if "scene" in chart else CHARTS


def scene_kinds(store: Store) -> list[str]:
    """The kinds of charts in scenes of which there is one, by name."""
    return sorted({entry.key.rpartition("/")[0] for entry in store.list(IN_SCENES) if entry.key.endswith(".json")})


def publish(store: Store, kind: str, record: Mapping[str, Any]) -> str:
    """Put a record beside the earlier ones of its kind; its key follows from its `created`, and those of one moment
    are numbered.

    Raises:
        ValueError: a number in it that JSON does not know.
    """
    stem = f"{kind}/{re.sub(r'[^0-9A-Za-z]', '', str(record['created']))}"
    keys = (f"{stem}{number:03}.json" if number else f"{stem}.json" for number in itertools.count())
    data = json.dumps(record, allow_nan=False).encode()
    return next(key for key in keys if put_sealed(store, key, data))


def latest(store: Store, kind: str) -> dict[str, Any] | None:
    """The record of a kind that was published last; None where there is none.

    Raises:
        DamagedError: its bytes are not those that were published.
    """
    key = latest_key(store, kind)
    return get_document(store, key) if key else None


def latest_key(store: Store, kind: str) -> str:
    """The key of that record; empty where there is none."""
    return max((entry.key for entry in store.list(kind) if entry.key.endswith(".json")), default="")

"""Seconds and bytes of a batch: measured on this service's finished batches where there are any, else stored.

The nearest measurement counts: the same hand on the same object, else the same hand, else any hand; each at the same
method, fidelity and referee and on the same kind of device. What is stored stands in `STORED` and `STORED_METHODS`,
with its origin.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Collection, Hashable, Iterable
from dataclasses import dataclass
from typing import Final

from service.domain import BATCH_SIZE, JobOptions
from service.index.cost_queries import BatchCost


@dataclass(frozen=True)
class Rate:
    """What grasps of one recipe cost, and where that is known from."""

    seconds_per_try: float
    valid_yield: float
    """Valid grasps per grasp tried."""
    bytes_per_grasp: float
    origin: str
    batches: int
    """Finished batches it was measured on; 0: stored."""


@dataclass(frozen=True)
class StageRate:
    """What a scene (per batch and scene) or a picture (per million pixels) costs."""

    seconds: float
    size_bytes: float
    origin: str
    batches: int


#: Where the stored numbers come from: the CPU times and sizes of docs/scaling.md, for a worker with two cores that is
#: busy nine tenths of its time.
ORIGIN: Final = "stored default: 2 CPU cores, docs/scaling.md"
#: Seconds per grasp tried, with postures, quality and verdict; valid yield of standard (docs/results/matrix.md: 1,785
#: of 2,542 tries), which stands for the others too.
STORED: Final[dict[str, tuple[float, float]]] = {
    "draft": (0.13, 0.7),
    "standard": (0.16, 0.7),
    "fine": (0.24, 0.7),
}
#: The same of other methods at their source's budget: the planner's time and success in docs/results/chart.md, and what
#: postures, quality and verdict cost besides.
STORED_METHODS: Final[dict[str, tuple[float, float]]] = {
    "graspit": (1.5, 0.2),
    "graspd2022": (0.75, 0.4),
    "dfc": (0.3, 0.44),
    "autograsp": (0.13, 0.36),
}
_BYTES_PER_GRASP: Final = 1338.0
STORED_SCENE: Final = StageRate(0.5, 240.0, ORIGIN, 0)
STORED_PICTURE: Final = StageRate(2.1, 1.34e6, ORIGIN, 0)


class Rates:
    """The measurements of one moment."""

    def __init__(self, batches: Iterable[BatchCost], options: JobOptions, devices: Collection[str]) -> None:
        """Batches of `synthesize` that were made as the options ask.

        Args:
            devices: devices of the present workers; none: whatever was measured on counts.
        """
        self._options = options
        self._groups: dict[Hashable, list[BatchCost]] = defaultdict(list)
        recipe = recipe_of(options)
        for batch in batches:
            if batch.tried and recipe_of(batch.request) == recipe and (not devices or batch.device in devices):
                for key in ((batch.hand, batch.object), batch.hand, ()):
                    self._groups[key].append(batch)
        self._known: dict[Hashable, Rate] = {}

    def of(self, hand: str, obj: str) -> Rate:
        """The rate of a cell."""
        levels: tuple[tuple[Hashable, str], ...] = (
            ((hand, obj), f"{hand} on {obj}"),
            (hand, f"{hand} on other objects"),
            ((), "other hands and objects"),
        )
        for key, words in levels:
            if key in self._groups:
                return self._measured(key, words)
        return self._stored()

    def _measured(self, key: Hashable, words: str) -> Rate:
        if key not in self._known:
            batches = _whole(self._groups[key])
            tried = sum(batch.tried for batch in batches)
            devices = ", ".join(sorted({batch.device for batch in batches}))
            self._known[key] = Rate(
                seconds_per_try=sum(batch.seconds for batch in batches) / tried,
                valid_yield=sum(batch.valid for batch in batches) / tried,
                bytes_per_grasp=sum(b.size_bytes for b in batches) / max(1, sum(b.count for b in batches)),
                origin=f"measured here: {words}, {devices}",
                batches=len(batches),
            )
        return self._known[key]

    def _stored(self) -> Rate:
        method, name = self._options.method, self._options.knobs.name
        if method in STORED_METHODS:
            return Rate(*STORED_METHODS[method], _BYTES_PER_GRASP, f"{ORIGIN}, {method}", 0)
        seconds, share = STORED.get(name, STORED["standard"])
        origin = ORIGIN if name in STORED else f"{ORIGIN}, of standard for want of {name}"
        if method != "fast_graspd":
            origin = f"{ORIGIN}, of fast_graspd for want of {method}"
        return Rate(seconds, share, _BYTES_PER_GRASP, origin, 0)


def _whole(batches: list[BatchCost]) -> list[BatchCost]:
    """Those of at least half a full batch, if there are any: a small one spends its time on loading."""
    return [batch for batch in batches if 2 * batch.tried >= BATCH_SIZE] or batches


def recipe_of(options: JobOptions) -> Hashable:
    """What decides how long a grasp takes, besides hand, object and device."""
    return (
        options.method,
        tuple(sorted((name, str(value)) for name, value in options.options.items())),
        options.knobs.model_dump_json(exclude={"name"}),
        options.want,
        options.referee,
        options.robustness,
    )


def scene_rate(batches: Iterable[BatchCost]) -> StageRate:
    """Seconds per batch and scene, bytes per grasp and scene."""
    found = [batch for batch in batches if batch.request.scenes]
    rows = sum(batch.count for batch in found)
    if not rows:
        return STORED_SCENE
    scenes = sum(batch.request.scenes for batch in found)
    seconds = sum(batch.seconds for batch in found) / scenes
    return StageRate(seconds, sum(b.size_bytes for b in found) / rows, "measured here", len(found))


def picture_rate(batches: Iterable[BatchCost], options: JobOptions) -> StageRate:
    """Seconds and bytes per million pixels, of pictures with the same channels where there are any."""
    found = [batch for batch in batches if batch.count]
    found = [batch for batch in found if batch.request.channels == options.channels] or found
    pixels = sum(batch.count * batch.request.width * batch.request.height for batch in found) / 1e6
    if not pixels:
        return STORED_PICTURE
    seconds = sum(batch.seconds for batch in found) / pixels
    return StageRate(seconds, sum(batch.size_bytes for batch in found) / pixels, "measured here", len(found))

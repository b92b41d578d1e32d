"""Seconds and bytes of a batch: measured on finished batches of this service, else stored values.

The nearest measurement counts: of the same hand and object, else of the same hand, else of any hand; always with the
same method, fidelity, validation and device. After the first measurement, one factor (seconds on this machine / stored
seconds) scales all stored values. A rate's interval is the scatter of batches, or the error of a stored value.
"""

from collections import defaultdict
from collections.abc import Collection, Hashable, Iterable, Sequence
from dataclasses import dataclass, replace
from statistics import median, quantiles
from typing import Final

from graspd.service.index.queries.overview import BatchCost
from graspd.service.model.domain import BATCH_SIZE, JobOptions
from graspd.service.model.scene_spec import TOUCH


@dataclass(frozen=True)
class Rate:
    """Cost of grasps with the same options, its origin and interval."""

    seconds_per_try: float
    valid_yield: float
    bytes_per_grasp: float
    origin: str
    batches: int
    """Number of finished batches that were measured; 0 for stored values."""
    spread: tuple[float, float]
    """Lower and upper factor on the seconds."""


@dataclass(frozen=True)
class Machine:
    """Speed of this machine relative to the stored numbers."""

    factor: float = 1.0
    """Median over all batches of the ratio of seconds on this machine to stored seconds."""
    spread: tuple[float, float] = (1.0, 1.0)
    """Interval of single batches, as factors of the median."""
    batches: int = 0
    """Number of compared batches; 0 if the factor is unknown."""

    @property
    def stored_spread(self) -> tuple[float, float]:
        """Lower and upper factor on stored seconds on this machine."""
        low, high = SCALED_SPREAD if self.batches else STORED_SPREAD
        return low * self.spread[0], high * self.spread[1]

    def scaled_origin(self, origin: str) -> str:
        scale = f", x {self.factor:.2g}, measured here (batches: {self.batches})"
        return origin + scale if self.batches else origin


@dataclass(frozen=True)
class StageRate:
    """Cost of a scene (per batch and scene), a picture (per million pixels) or an episode."""

    seconds: float
    size_bytes: float
    origin: str
    batches: int
    spread: tuple[float, float] = (1.0, 1.0)
    """Lower and upper factor on the seconds."""


#: Narrowest interval of a measured rate: the observed difference between two runs of the same batches.
MEASURED_SPREAD: Final = (0.8, 1.25)
#: Interval of a stored rate on a machine with a known factor, because fidelities and methods scale differently.
SCALED_SPREAD: Final = (0.5, 2.0)
#: Interval of a stored rate on an unknown machine; a small shared machine was ten times as slow.
STORED_SPREAD: Final = (1 / 3, 10.0)
#: Origin of the stored numbers: graspd 0.1, for a worker that keeps two CPU cores busy for 90 % of the time.
ORIGIN: Final = "stored default: 2 CPU cores, docs/explanation/scaling.md"
#: Seconds per candidate (with postures, metrics and validation), and yield: that of `standard`, 1,785 of 2,542.
STORED: Final[dict[str, tuple[float, float]]] = {"draft": (0.13, 0.7), "standard": (0.16, 0.7), "fine": (0.24, 0.7)}
#: The same of other methods at their published budget: time and success of the planner (docs/results/chart.md), plus
#: postures, metrics and validation.
STORED_OTHER: Final = {"graspit": (1.5, 0.2), "graspd2022": (0.75, 0.4), "dfc": (0.3, 0.44), "autograsp": (0.13, 0.36)}
_BYTES_PER_GRASP: Final = 1338.0
STORED_SCENE: Final = StageRate(0.5, 240.0, ORIGIN, 0)
#: Cost of a scene in which grasps are planned; `STORED_SCENE` applies to transfers of existing grasps.
STORED_PLACE: Final = StageRate(0.5, 2200.0, ORIGIN, 0)
#: Seconds per candidate in a scene relative to a free object, and yield, for built-in hands and objects on tables; true
#: values differ by up to a factor of four.
STORED_IN_SCENE: Final = (1.6, 0.5)
#: Seconds per valid grasp and perturbed model on two cores (docs/results/robust.md); few tests end early.
STORED_MODEL_S: Final = 0.018
STORED_PICTURE: Final = StageRate(2.1, 1.34e6, ORIGIN, 0)
#: Seconds and bytes of an episode, and of its film by one camera at 320 x 240.
STORED_EPISODE: Final = (1.0, 16e3)
STORED_FILM: Final = (2.5, 170e3)


class Rates:
    def __init__(self, batches: Iterable[BatchCost], options: JobOptions, devices: Collection[str]) -> None:
        """Group the `synthesize` batches of these options and devices (empty: all) by hand and object."""
        self._options = options
        self._groups: dict[Hashable, list[BatchCost]] = defaultdict(list)
        recipe = cost_options(options)
        here = [batch for batch in batches if batch.candidates and (not devices or batch.device in devices)]
        self.machine = measure_machine(here)
        for batch in here:
            if cost_options(batch.request) == recipe:
                for key in ((batch.hand, batch.object), batch.hand, ()):
                    self._groups[key].append(batch)
        self._known: dict[Hashable, Rate] = {}

    def rate_for(self, hand: str, obj: str) -> Rate:
        """Return the rate of the nearest measurement, else the stored rate."""
        levels: tuple[tuple[Hashable, str], ...] = (
            ((hand, obj), f"{hand} on {obj}"),
            (hand, f"{hand} on other objects"),
            ((), "other hands and objects"),
        )
        for key, words in levels:
            if key in self._groups:
                return self._measured_rate(key, words)
        seconds, share, origin = _stored_rates(self._options)
        origin, factor = self.machine.scaled_origin(origin), self.machine.factor
        return Rate(seconds * factor, share, _BYTES_PER_GRASP, origin, 0, self.machine.stored_spread)

    def _measured_rate(self, key: Hashable, words: str) -> Rate:
        if key not in self._known:
            batches = _large_batches(self._groups[key])
            candidates = sum(batch.candidates for batch in batches)
            devices = ", ".join(sorted({batch.device for batch in batches}))
            self._known[key] = Rate(
                seconds_per_try=sum(batch.seconds for batch in batches) / candidates,
                valid_yield=sum(batch.counted_grasps for batch in batches) / candidates,
                bytes_per_grasp=sum(b.size_bytes for b in batches) / max(1, sum(b.count for b in batches)),
                origin=f"measured here: {words}, {devices}",
                batches=len(batches),
                spread=_relative_deciles([batch.seconds / batch.candidates for batch in batches], MEASURED_SPREAD),
            )
        return self._known[key]


def expected_candidates(rate: Rate, options: JobOptions) -> float:
    """Return the expected number of candidates of a job."""
    if options.want == "candidates":
        return float(options.grasps)
    most = options.grasps * options.budget
    return min(most, options.grasps / rate.valid_yield) if rate.valid_yield > 0 else most


def _stored_rates(options: JobOptions) -> tuple[float, float, str]:
    """Return stored seconds per candidate, yield and origin."""
    if options.model_count:
        plain = options.model_copy(update={"robust": 0.0, "robust_models": 0})
        seconds, share, origin = _stored_rates(plain)
        longer = seconds + share * options.model_count * STORED_MODEL_S
        return longer, share, f"{origin}, and {options.model_count} models"
    if options.in_scene:
        free = {"scene": "free", "faces": "drawn", "touch": TOUCH, "neighbours": ()}
        seconds, _, origin = _stored_rates(options.model_copy(update=free))
        longer, share = STORED_IN_SCENE
        return longer * seconds, share, f"{origin}, in a scene"
    method, name = options.method, options.resolved_fidelity.name
    if method in STORED_OTHER:
        return *STORED_OTHER[method], f"{ORIGIN}, {method}"
    origin = ORIGIN if name in STORED else f"{ORIGIN}, value of standard (none for {name})"
    if method != "fast_graspd":
        origin = f"{ORIGIN}, value of fast_graspd (none for {method})"
    return *STORED.get(name, STORED["standard"]), origin


def measure_machine(batches: Iterable[BatchCost]) -> Machine:
    """Compare the seconds of `synthesize` batches with the stored seconds of the same options."""
    comparable = [batch for batch in batches if batch.candidates and _has_stored_rate(batch.request)]
    ratios = [
        batch.seconds / batch.candidates / _stored_rates(batch.request)[0]
        for batch in _large_batches(comparable)
        if batch.seconds > 0
    ]
    if not ratios:
        return Machine()
    return Machine(median(ratios), _relative_deciles(ratios, (1.0, 1.0)), len(ratios))


def _has_stored_rate(request: JobOptions) -> bool:
    if request.options or request.in_scene or request.model_count:
        return False
    return request.method in STORED_OTHER or (
        request.method == "fast_graspd" and request.resolved_fidelity.name in STORED
    )


def _relative_deciles(values: list[float], least: tuple[float, float]) -> tuple[float, float]:
    """Return the first and last decile of the values, divided by the median; at least as wide as `least`."""
    if len(values) < 2 or (middle := median(values)) <= 0:
        return least
    tenths = quantiles(values, n=10, method="inclusive")
    return min(least[0], tenths[0] / middle), max(least[1], tenths[-1] / middle)


def _large_batches(batches: list[BatchCost]) -> list[BatchCost]:
    """Return batches that are at least half full, or all if none is: in small batches, loading dominates."""
    return [batch for batch in batches if 2 * batch.candidates >= BATCH_SIZE] or batches


def cost_options(options: JobOptions) -> Hashable:
    """Return the options that decide the cost of a grasp on a given hand, object and device."""
    return (
        options.method,
        tuple(sorted((name, str(value)) for name, value in options.options.items())),
        options.resolved_fidelity.model_dump_json(exclude={"name"}),
        options.want,
        options.validation,
        (options.model_count, options.robust),
        (options.second_engine, options.second_engine_share),
        options.scene_spec.kind,
        len(options.all_neighbours),
    )


def scene_rate(batches: Iterable[BatchCost], options: JobOptions, machine: Machine) -> StageRate:
    """Return seconds per batch and scene, and bytes per grasp and scene (per scene if planned in scenes)."""
    found = [batch for batch in batches if batch.request.scenes and batch.request.in_scene == options.in_scene]
    scenes = [batch.batches * batch.request.scenes for batch in found]
    stored = STORED_PLACE if options.in_scene else STORED_SCENE
    return _stage_rate(found, scenes, [batch.count for batch in found], stored, machine)


def picture_rate(batches: Iterable[BatchCost], options: JobOptions, machine: Machine) -> StageRate:
    """Return seconds and bytes per million pixels, if possible of pictures with the same channels."""
    found = [batch for batch in batches if batch.count]
    found = [batch for batch in found if batch.request.channels == options.channels] or found
    megapixels = [batch.count * batch.request.width * batch.request.height / 1e6 for batch in found]
    return _stage_rate(found, megapixels, megapixels, STORED_PICTURE, machine)


def episode_rate(batches: Iterable[BatchCost], options: JobOptions, machine: Machine) -> StageRate:
    """Return seconds and bytes per episode of the same robot and cameras."""
    like = (options.episodes, options.film)
    found = [one for one in batches if one.count and (one.request.episodes, one.request.film) == like]
    counts = [batch.count for batch in found]
    seconds, size = (whole + len(options.film) * film for whole, film in zip(STORED_EPISODE, STORED_FILM, strict=True))
    return _stage_rate(found, counts, counts, StageRate(seconds, size, ORIGIN, 0), machine)


def _stage_rate(
    batches: list[BatchCost], units: Sequence[float], rows: Sequence[float], stored: StageRate, machine: Machine
) -> StageRate:
    """Return seconds per unit of work and bytes per row of the batches; without rows, the stored rate."""
    if not sum(rows):
        seconds, origin = stored.seconds * machine.factor, machine.scaled_origin(stored.origin)
        return replace(stored, seconds=seconds, origin=origin, spread=machine.stored_spread)
    seconds = sum(batch.seconds for batch in batches) / sum(units)
    each = [batch.seconds / number for batch, number in zip(batches, units, strict=True)]
    size = sum(batch.size_bytes for batch in batches) / sum(rows)
    return StageRate(seconds, size, "measured here", len(batches), _relative_deciles(each, MEASURED_SPREAD))

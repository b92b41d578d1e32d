"""Table of all grasp metrics; perturbed parameters, grasp types and approach directions.

Shards (`service.store.columns`), manifests, index, API, dashboard, dataset cards and docs derive from this table. A
new metric needs a meaning and a row here, and a function (`MEASURES` in `worker.quality.table`). It must be
`optional`, because older shards lack it. A yes-or-no property of a grasp is a verdict, not a metric.
"""

import math
from collections.abc import Iterable
from dataclasses import dataclass
from enum import IntEnum
from typing import Any, Final, Literal

#: Column titles shorter than this are symbols, whose case has a meaning.
_SYMBOL: Final = 4


class IndexLevel(IntEnum):
    """Storage of a metric in the index; each level includes the levels before it."""

    NO = 0
    KEPT = 1
    """A column, returned with the grasp."""
    SORTED = 2
    """Also a database index, for ranges and sorting."""
    OFFERED = 3
    """Also for filters, means and distributions of a job's grasps in API and dashboard."""


@dataclass(frozen=True)
class GraspMetric:
    name: str
    """Name everywhere except in base shards, where the dataset is `quality/{name}`."""
    units: str
    """Unit in the shard, such as `cm^2`; `1`: no unit."""
    meaning: str
    title: str
    short: str = ""
    swept: bool = False
    """One value per contact threshold; the index has the value at `INDEX_THRESHOLD_M`."""
    whole: bool = False
    code: bool = False
    """Whether the number encodes a category, so that sums and means are meaningless."""
    optional: bool = False
    indexed: IndexLevel = IndexLevel.OFFERED
    bounds: tuple[float, float] = (0, math.inf)
    less_is_better: bool = False
    digits: int | None = None
    """Decimal places in a card's table; None omits the metric from the table."""
    plot: Literal["no", "whole", "cut"] = "no"
    """Whether a card plots its distribution, and whether the plot ends at the 99th percentile."""

    @property
    def path(self) -> str:
        return f"quality/{self.name}"

    @property
    def limits(self) -> tuple[float | None, float | None]:
        low, high = (bound if math.isfinite(bound) else None for bound in self.bounds)
        return low, high

    @property
    def unit(self) -> str:
        return "" if self.units == "1" else self.units.replace("^2", "²").replace("^3", "³")

    @property
    def column_title(self) -> str:
        return self.short or self.title

    @property
    def heading(self) -> str:
        words = self.column_title if len(self.column_title) < _SYMBOL else self.column_title.lower()
        return f"{words}, {self.unit}" if self.unit else words


#: Meaning of each metric.
_MEANINGS: Final = {
    "epsilon": "radius of the largest ball in the L1 grasp wrench space (Ferrari-Canny)",
    "wrench_volume": "volume of the L1 grasp wrench space; nan: not measured at this threshold",
    "contact_area_cm2": "hand surface closer to the object than the threshold",
    "intersection_volume_cm3": "volume shared by hand and object",
    "penetration_depth_mm": "deepest hand-object penetration",
    "self_penetration_depth_mm": "deepest hand-hand penetration",
    "simulated_displacement_cm": "displacement of the object in the displacement test; nan: not tested, or diverged",
    "robustness": "share of positive verdicts under noise of 1 mm and 1 degree on the object; written by graspd 0.2",
    "robust_share": "share of perturbed models in which the grasp holds, or a bound of it if the test ended early; "
    "nan: not tested",
    "payload_kg": "heaviest mass, at least the object's, that the grasp lifts in a scene or holds if pushed; nan: "
    "not measured",
    "shake_margin": "largest ratio of motion in the hand to its limit while shaken after the lift; below 1: held; "
    "nan: not shaken",
    "clearance_m": "least distance of the hand from supports and neighbours during approach, closing and lift",
    "contact_links": "hand bodies within 2 mm of the object",
    "grasp_type": "0 undefined, 1 power, 2 precision, 3 lateral; from the links in contact",
    "taxonomy_type": "number of the type in the GRASP taxonomy, by the contacts; 0: none of the types with a rule",
    "digits": "digits in contact: sum of 1 thumb, 2 index, 4 middle, 8 ring, 16 little; without a thumb in the "
    "hand's order",
    "region_share": "share of the contact area, within 2 mm of the object, that is in the required contact region",
    "like_distance_m": "distance of the wrist from the demonstrated wrist pose",
    "like_angle_deg": "angle of the wrist's rotation from the demonstrated wrist pose",
    "approach_cell": "direction of approach in the object's frame: one of 48 equal-area cells, 12 x band of height + "
    "azimuth sector",
    "stability_loss": "stability loss L_stable of the planner; nan: the planner has none",
}


def _metric(name: str, units: str, title: str, **properties: Any) -> GraspMetric:
    return GraspMetric(name, units, _MEANINGS[name], title, **properties)


#: Properties of categories, of shares between 0 and 1, and of metrics with a long tail of bad values.
_CODE: Final[dict[str, Any]] = {"whole": True, "code": True, "optional": True}
_SHARE: Final[dict[str, Any]] = {"optional": True, "bounds": (0, 1), "digits": 2, "plot": "whole"}
_COST: Final[dict[str, Any]] = {"less_is_better": True, "digits": 2, "plot": "cut"}
_KEPT, _SORTED = IndexLevel.KEPT, IndexLevel.SORTED
GRASP_METRICS: Final[tuple[GraspMetric, ...]] = (
    _metric("epsilon", "1", "ε (Ferrari-Canny)", short="ε", swept=True, digits=2, plot="whole"),
    _metric("wrench_volume", "1", "Wrench space volume", short="Vol", swept=True, indexed=_SORTED, digits=1),
    _metric("contact_area_cm2", "cm^2", "Contact area", swept=True, digits=0, plot="whole"),
    _metric(
        "intersection_volume_cm3",
        "cm^3",
        "Intersection volume",
        short="Intersection",
        less_is_better=True,
        digits=3,
        plot="cut",
    ),
    _metric("penetration_depth_mm", "mm", "Penetration", **_COST),
    _metric("self_penetration_depth_mm", "mm", "Self-penetration", indexed=_SORTED, less_is_better=True, digits=2),
    _metric(
        "simulated_displacement_cm",
        "cm",
        "Simulated displacement",
        short="Displacement",
        **_COST,
        optional=True,
        indexed=IndexLevel.NO,
    ),
    _metric("robustness", "1", "Share held under noise", short="Robustness", **_SHARE, indexed=_KEPT),
    _metric("robust_share", "1", "Robust share", short="Robust", **_SHARE),
    _metric("payload_kg", "kg", "Payload", optional=True, bounds=(0, 100), digits=2, plot="cut"),
    _metric("shake_margin", "1", "Motion when shaken", short="Shaken", **_COST, optional=True),
    _metric("clearance_m", "m", "Clearance in its scene", short="Clearance", optional=True, bounds=(-1, 1), digits=4),
    _metric("contact_links", "1", "Links in contact", whole=True, indexed=_KEPT, digits=0),
    _metric("grasp_type", "enum", "Type", **_CODE, indexed=_SORTED, bounds=(0, 3)),
    _metric("taxonomy_type", "enum", "Taxonomy type", **_CODE, indexed=_KEPT, bounds=(0, 33)),
    _metric("digits", "1", "Digits in contact", **_CODE, indexed=_KEPT, bounds=(0, 63)),
    _metric("region_share", "1", "Contact in the region", optional=True, indexed=_SORTED, bounds=(0, 1), digits=2),
    _metric(
        "like_distance_m", "m", "Distance from the demonstration", optional=True, indexed=_KEPT, less_is_better=True
    ),
    _metric(
        "like_angle_deg",
        "deg",
        "Angle from the demonstration",
        optional=True,
        indexed=_KEPT,
        bounds=(0, 180),
        less_is_better=True,
    ),
    _metric("approach_cell", "1", "Approach cell", **_CODE, indexed=_KEPT, bounds=(0, 47)),
    _metric(
        "stability_loss", "1", "Stability loss", indexed=_SORTED, bounds=(-math.inf, math.inf), less_is_better=True
    ),
)


def indexed_metrics(least: IndexLevel = IndexLevel.KEPT) -> tuple[GraspMetric, ...]:
    return tuple(metric for metric in GRASP_METRICS if metric.indexed >= least)


#: Default and maximum number of perturbed models.
ROBUST_MODELS: Final = 8
MOST_ROBUST_MODELS: Final = 64


class PerturbedParameter(IntEnum):
    """Perturbed parameter of a model. Shards contain its number, so new parameters must be appended."""

    NONE = 0
    SHAPES = 1
    JOINTS = 2
    COUPLINGS = 3
    FRICTION = 4
    MASS = 5
    CENTRE = 6
    POSE = 7
    CALIBRATION = 8
    ORDER = 9

    @property
    def word(self) -> str:
        return self.name.lower()


AXIS_MEANINGS: Final[dict[PerturbedParameter, str]] = {
    PerturbedParameter.SHAPES: "collision shapes",
    PerturbedParameter.JOINTS: "joint drives",
    PerturbedParameter.COUPLINGS: "couplings of joints",
    PerturbedParameter.FRICTION: "friction",
    PerturbedParameter.MASS: "mass of the object",
    PerturbedParameter.CENTRE: "centre of mass",
    PerturbedParameter.POSE: "pose of the object",
    PerturbedParameter.CALIBRATION: "calibration of the hand",
    PerturbedParameter.ORDER: "order of closing",
}

AXIS_WORDS: Final = tuple(axis.word for axis in AXIS_MEANINGS)


def perturbed_parameter_name(number: int) -> str | None:
    return PerturbedParameter(number).word if number in AXIS_MEANINGS else None


class GraspType(IntEnum):
    """Grasp type by the opposition of the contacts; `worker.quality.table` defines the rule."""

    NONE = 0
    """Undefined: at most one digit touches."""
    POWER = 1
    PRECISION = 2
    LATERAL = 3


#: Approach cells have equal area: bands of equal height z (Archimedes), each divided into equal azimuth sectors.
BANDS: Final = 4
SECTORS: Final = 12
DIRECTION_CELLS: Final = BANDS * SECTORS

#: Mean distance of corresponding points of the hand [m] below which two grasps are near-duplicates. Twice this
#: distance is hardly visible in a picture. Fewer than 1 in 100 pairs of batches have near-duplicates.
MIN_DISTANCE_M: Final = 0.005


def entropy_bits(counts: Iterable[int]) -> float:
    """Return the Shannon entropy [bit] of a distribution over categories; 0 for one category or no grasps."""
    positive = [count for count in counts if count > 0]
    total = sum(positive)
    return -sum(count / total * math.log2(count / total) for count in positive) + 0.0


def evenness(counts: Iterable[int], kinds: int) -> float:
    """Return 2^entropy / kinds: 1 if uniform, 1 / kinds for a single category, 0 without grasps."""
    counts = list(counts)
    return float(2 ** entropy_bits(counts) / kinds) if any(counts) else 0.0

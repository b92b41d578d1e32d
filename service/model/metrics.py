"""The metrics of a grasp: one table, from which all follows that stores, indexes, filters, shows and documents them;
and the axes of robustness, grasp types and directions.

Shards (`service.store.columns`), manifests, the index, the API, the dashboard, a dataset's card and the docs read this
table. A new metric is a row here and the function that computes it (`MEASURES` in `worker.quality.table`); make it
`optional`, since older shards lack it. The index gets its column when it is opened next
(`service.index.database`). What says yes or no of a grasp is a verdict and no metric.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from enum import IntEnum
from typing import Final, Literal

#: Shorter names than this are symbols: they keep their case.
_SYMBOL: Final = 4


class IndexLevel(IntEnum):
    """What the index knows of a metric; each includes those before it."""

    NO = 0
    KEPT = 1
    """A column: it is told with the grasp."""
    SORTED = 2
    """A database index as well: grasps can be bounded and sorted by it."""
    OFFERED = 3
    """The API and the dashboard offer that, and means and distributions of a job's grasps."""


@dataclass(frozen=True)
class GraspMetric:
    """One number of each grasp."""

    name: str
    """Its dataset in a base shard is `quality/{name}`; everywhere else it is called by this name."""
    units: str
    """As the shard says it: `cm^2`; `1`: none."""
    meaning: str
    title: str
    short: str = ""
    """Heading where there is little room; the title, if not given."""
    swept: bool = False
    """A value at each contact threshold; the index holds the one at `INDEX_THRESHOLD_M`."""
    whole: bool = False
    """A count."""
    code: bool = False
    """A number that stands for a kind: sums and means of it say nothing."""
    optional: bool = False
    """A shard may lack it."""
    indexed: IndexLevel = IndexLevel.NO
    bounds: tuple[float, float] = (0, math.inf)
    """Least and largest value that a filter may name."""
    less_is_better: bool = False
    digits: int | None = None
    """After the point, in a card's table; None: not in the table."""
    plot: Literal["no", "whole", "cut"] = "no"
    """Whether a card draws its distribution, and whether a long tail is cut."""

    @property
    def path(self) -> str:
        """Dataset of a base shard."""
        return f"quality/{self.name}"

    @property
    def limits(self) -> tuple[float | None, float | None]:
        """The bounds; None: there is none."""
        low, high = (bound if math.isfinite(bound) else None for bound in self.bounds)
        return low, high

    @property
    def unit(self) -> str:
        """As people read it; empty: none."""
        return "" if self.units == "1" else self.units.replace("^2", "²").replace("^3", "³")

    @property
    def column_title(self) -> str:
        """Heading of a column."""
        return self.short or self.title

    @property
    def heading(self) -> str:
        """The same within a text, with the unit."""
        words = self.column_title if len(self.column_title) < _SYMBOL else self.column_title.lower()
        return f"{words}, {self.unit}" if self.unit else words


GRASP_METRICS: Final[tuple[GraspMetric, ...]] = (
    GraspMetric(
        "epsilon",
        "1",
        "radius of the largest ball in the L1 grasp wrench space (Ferrari-Canny)",
        title="ε (Ferrari-Canny)",
        short="ε",
        swept=True,
        indexed=IndexLevel.OFFERED,
        digits=2,
        plot="whole",
    ),
    GraspMetric(
        "wrench_volume",
        "1",
        "volume of the L1 grasp wrench space; nan: not measured at this threshold",
        title="Wrench space volume",
        short="Vol",
        swept=True,
        indexed=IndexLevel.SORTED,
        digits=1,
    ),
    GraspMetric(
        "contact_area_cm2",
        "cm^2",
        "hand surface closer to the object than the threshold",
        title="Contact area",
        swept=True,
        indexed=IndexLevel.OFFERED,
        digits=0,
        plot="whole",
    ),
    GraspMetric(
        "intersection_volume_cm3",
        "cm^3",
        "volume shared by hand and object",
        title="Intersection volume",
        short="Intersection",
        indexed=IndexLevel.OFFERED,
        less_is_better=True,
        digits=3,
        plot="cut",
    ),
    GraspMetric(
        "penetration_depth_mm",
        "mm",
        "deepest hand-object penetration",
        title="Penetration",
        indexed=IndexLevel.OFFERED,
        less_is_better=True,
        digits=2,
        plot="cut",
    ),
    GraspMetric(
        "self_penetration_depth_mm",
        "mm",
        "deepest hand-hand penetration",
        title="Self-penetration",
        indexed=IndexLevel.SORTED,
        less_is_better=True,
        digits=2,
    ),
    GraspMetric(
        "simulated_displacement_cm",
        "cm",
        "object's way in the displacement test; nan: not tested, or it blew up",
        title="Simulated displacement",
        short="Displacement",
        optional=True,
        less_is_better=True,
        digits=2,
        plot="cut",
    ),
    GraspMetric(
        "robustness",
        "1",
        "share of verdicts that survive 1 mm and 1 degree of noise on the object",
        title="Verdicts that survive noise",
        short="Robustness",
        optional=True,
        indexed=IndexLevel.KEPT,
        bounds=(0, 1),
        digits=2,
        plot="whole",
    ),
    GraspMetric(
        "robust_share",
        "1",
        "share of the models around the nominal one in which it holds too; where validating ended "
        "early, what it is at least, or at most below the wanted one; nan: not validated there",
        title="Models survived",
        short="Robust",
        optional=True,
        indexed=IndexLevel.OFFERED,
        bounds=(0, 1),
        digits=2,
        plot="whole",
    ),
    GraspMetric(
        "payload_kg",
        "kg",
        "heaviest mass that it lifts out of its scene, or holds under the six pushes, from the "
        "object's own on; nan: not measured",
        title="Payload",
        optional=True,
        indexed=IndexLevel.OFFERED,
        bounds=(0, 100),
        digits=2,
        plot="cut",
    ),
    GraspMetric(
        "shake_margin",
        "1",
        "worst displacement or rotation in the hand over its limit, shaken after the lift: below "
        "1 it survives; nan: not shaken",
        title="Motion when shaken",
        short="Shaken",
        optional=True,
        indexed=IndexLevel.OFFERED,
        less_is_better=True,
        digits=2,
        plot="cut",
    ),
    GraspMetric(
        "clearance_m",
        "m",
        "least room of the hand among supports: coming, closing and lifting",
        title="Clearance in its scene",
        short="Clearance",
        optional=True,
        indexed=IndexLevel.OFFERED,
        bounds=(-1, 1),
        digits=4,
    ),
    GraspMetric(
        "contact_links",
        "1",
        "hand bodies within 2 mm of the object",
        title="Links in contact",
        whole=True,
        indexed=IndexLevel.KEPT,
        digits=0,
    ),
    GraspMetric(
        "grasp_type",
        "enum",
        "0 not told, 1 power, 2 precision, 3 lateral: by what of the hand touches",
        title="Type",
        whole=True,
        code=True,
        optional=True,
        indexed=IndexLevel.SORTED,
        bounds=(0, 3),
    ),
    GraspMetric(
        "approach_cell",
        "1",
        "cell of 48 equal ones on the sphere, from which the palm comes, in the object's frame: "
        "band of height times 12 plus azimuth",
        title="Cell of the approach",
        whole=True,
        code=True,
        optional=True,
        indexed=IndexLevel.KEPT,
        bounds=(0, 47),
    ),
    GraspMetric(
        "stability_loss",
        "1",
        "planner's L_stable; nan: the planner has none",
        title="Stability loss",
        indexed=IndexLevel.SORTED,
        bounds=(-math.inf, math.inf),
        less_is_better=True,
    ),
)


def indexed(least: IndexLevel = IndexLevel.KEPT) -> tuple[GraspMetric, ...]:
    """Metrics of which the index knows that much."""
    return tuple(metric for metric in GRASP_METRICS if metric.indexed >= least)


#: Models around the nominal one in which a grasp is validated, where nobody says how many.
ROBUST_MODELS: Final = 8

MOST_ROBUST_MODELS: Final = 64


class Axis(IntEnum):
    """What differs from the nominal model. Numbers stand in shards: new axes come last."""

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
        """As documents and pages say it."""
        return self.name.lower()


#: What differs on each axis, for people.
AXIS_MEANINGS: Final[dict[Axis, str]] = {
    Axis.SHAPES: "collision shapes",
    Axis.JOINTS: "joint drives",
    Axis.COUPLINGS: "couplings of joints",
    Axis.FRICTION: "friction",
    Axis.MASS: "mass of the object",
    Axis.CENTRE: "centre of mass",
    Axis.POSE: "pose of the object",
    Axis.CALIBRATION: "calibration of the hand",
    Axis.ORDER: "order of closing",
}

#: Words of the axes.
AXIS_WORDS: Final = tuple(axis.word for axis in AXIS_MEANINGS)


def axis_word(number: int) -> str | None:
    """The word of an axis as a shard has it; None: none, or one that this version does not know."""
    return Axis(number).word if number in AXIS_MEANINGS else None


class GraspType(IntEnum):
    """What a hand does in a grasp, by the opposition in it; `worker.quality.table` has the rule."""

    NONE = 0
    """Not told: one digit alone touches, or nothing does."""
    POWER = 1
    PRECISION = 2
    LATERAL = 3


#: Directions fall into cells of equal area: bands of equal height z (Archimedes), each cut into equal azimuths.
BANDS: Final = 4
SECTORS: Final = 12

DIRECTION_CELLS: Final = BANDS * SECTORS

#: Two grasps of a job are nearer than this only by accident [m]: mean distance between the same points of the hand's
#: surface. Twice as much is hard to tell apart in a picture; of 100 pairs of batches less than one has such a pair.
MIN_DISTANCE_M: Final = 0.005


def entropy_bits(counts: Iterable[int]) -> float:
    """Shannon entropy [bit] of how grasps are shared out to kinds; 0: all are of one, or there are none."""
    known = [count for count in counts if count > 0]
    total = sum(known)
    return -sum(count / total * math.log2(count / total) for count in known) + 0.0


def evenness(counts: Iterable[int], kinds: int) -> float:
    """Kinds that would be needed to spread as widely if each were used alike, over all kinds: 2^entropy / kinds.

    1 is even; 1 / kinds is all of one kind; 0 if there is none.
    """
    counts = list(counts)
    return float(2 ** entropy_bits(counts) / kinds) if any(counts) else 0.0

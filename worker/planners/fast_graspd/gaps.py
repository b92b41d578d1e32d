"""Whether fingertips fit beside an object in its scenes, and the geometric reason where they do not.

A fingertip is taken as a ball as wide as the thinnest fingertip of the hand, beside an end of a pair of points that the
hand could hold between. This is necessary for a grasp between opposed fingertips and not sufficient.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from worker.hands.jaws import thinnest_fingertip
from worker.hands.model import HandModel
from worker.hands.oppositions import oppositions_of
from worker.hands.pinches import HEIGHTS_M, pinches_of
from worker.objects.model import ObjectModel
from worker.planners.fast_graspd.across import STEEP, Crossings, crossings_of, room_beside
from worker.simulation.surroundings import CLEAR_M, Surroundings

#: A gap that is wider is as good as this, and how exactly others are told [m].
WIDEST_M: Final = 0.064
EXACT_M: Final = 0.0005


def why_narrow(hand: HandModel, obj: ObjectModel, scenes: Sequence[Surroundings]) -> str | None:
    """Why no fingertips of a hand can hold an object between them in any of the scenes; None: nothing tells."""
    known, pairs = oppositions_of(hand), crossings_of(obj)
    if not len(known) or not len(pairs):
        return None
    fits = pairs.width <= known.widest
    if not fits.any():
        return (
            f"opposite sides of {obj.name} are at least {1e3 * pairs.width.min():.0f} mm apart, and {hand.name} opens "
            f"to {1e3 * known.widest:.0f} mm"
        )
    height = max(float(np.ptp(obj.hull_vertices @ scene.up)) for scene in scenes)
    if height <= HEIGHTS_M[-1] and not len(pinches_of(hand, height)):
        return (
            f"{obj.name} lies {1e3 * height:.0f} mm high, and fingertips of {hand.name} that rest beside it do not "
            "face each other so near to their ends"
        )
    thin = thinnest_fingertip(hand)
    gap = max(_widest_gap(pairs, fits, scene, thin) for scene in scenes)
    if gap >= thin + CLEAR_M:
        return None
    return (
        f"the gap of about {1e3 * gap:.0f} mm beside {obj.name} is thinner than the thinnest fingertip of {hand.name}, "
        f"{1e3 * thin:.0f} mm, and the {1e3 * CLEAR_M:.0f} mm that it keeps"
    )


def _widest_gap(pairs: Crossings, fits: NDArray[np.bool_], scene: Surroundings, thin: float) -> float:
    """The widest ball that fits beside both ends of one of the pairs that fit [m]; steep ones need room below them."""
    level, above = np.abs(pairs.axis @ scene.up) < STEEP, np.ones(len(pairs), bool)
    for obstacle in scene.obstacles:
        above &= np.minimum(*(obstacle.distance(end) for end in pairs.ends())) >= thin
    rows = fits & (level | above)
    if not rows.any():
        return 0.0
    pairs = Crossings(pairs.middle[rows], pairs.axis[rows], pairs.width[rows])
    low, high = 0.0, WIDEST_M
    while high - low > EXACT_M:
        middle = 0.5 * (low + high)
        low, high = (middle, high) if room_beside(pairs, scene, middle).max() >= 0.0 else (low, middle)
    return low

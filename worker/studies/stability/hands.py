"""Hands that are hard: few fingers and many, small ones and large ones, drives that move several joints.

A family of hands stands for them: like fingers of three joints in a ring around a palm, which lean outward while they
are open.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Final, Literal

import numpy as np

from service.model.digests import digest_files
from service.model.errors import GraspdError
from service.model.states import AssetKind
from service.model.studies import MapCell, StabilityMap, reachable
from worker.hands.load import load_hand
from worker.hands.model import HandModel
from worker.run import ALONE, Run
from worker.studies.stability.shapes import BOUNDS, MEASURE, cube, refused, shape_cell

Coupling = Literal["each joint", "distal follows", "a drive a finger", "one drive"]

FINGERS: Final = (1, 2, 3, 4, 5, 6, 8)
COUPLINGS: Final[tuple[Coupling, ...]] = ("each joint", "distal follows", "a drive a finger", "one drive")
#: Size over that of a human hand, whose fingers are about 10 cm long.
SIZES: Final = (0.25, 0.5, 0.75, 1.0, 1.5, 2.0, 3.0)
#: Turn of the distal joint over that of the one before it.
RATIOS: Final = (-0.5, 0.0, 0.5, 1.0, 1.5, 2.0)
#: What they hold [mm].
CUBE_MM: Final = 50.0

#: Palm, links and their radius [m] of a hand of size 1, from the palm outward.
_PALM_M, _LINKS_M, _RADIUS_M = (0.032, 0.02), (0.045, 0.035, 0.027), 0.009
#: How far open fingers lean outward, and the ends of their joints [rad].
_LEAN: Final = 0.45
_ENDS: Final = (1.7, 1.6, 1.3)
#: Torque of a joint of a hand of size 1 [N m].
_EFFORT: Final = 1.0


def ring_hand(fingers: int, *, coupling: Coupling = "each joint", size: float = 1.0, ratio: float = 0.8) -> HandModel:
    """A hand of like fingers around a palm.

    Args:
        fingers: their number.
        coupling: what a drive moves.
        size: of the hand, over that of a human one.
        ratio: turn of the distal joint over that of the middle one, where it follows.

    Raises:
        HandError: it is no usable hand.
    """
    urdf = ring_urdf(fingers, coupling=coupling, size=size, ratio=ratio)
    files = {"ring.urdf": urdf.encode()}
    return load_hand(files, name=f"ring of {fingers}", digest=digest_files(AssetKind.HAND, files))


def ring_urdf(fingers: int, *, coupling: Coupling, size: float, ratio: float) -> str:
    """The URDF of `ring_hand`."""
    radius, height = (size * x for x in _PALM_M)
    parts = [f'<robot name="ring"><link name="palm">{_solid("cylinder", -height / 2, radius, height)}</link>']
    for k in range(fingers):
        angle = 2 * np.pi * k / fingers
        at = f"{radius * np.cos(angle):.6f} {radius * np.sin(angle):.6f} 0"
        parts += _finger(k, f'<origin xyz="{at}" rpy="0 {_LEAN} {angle:.6f}"/>', coupling, size, ratio)
    return "\n".join([*parts, "</robot>"])


def _finger(k: int, base: str, coupling: Coupling, size: float, ratio: float) -> list[str]:
    parts, before = [], "palm"
    for j, (length, end) in enumerate(zip(_LINKS_M, _ENDS, strict=True)):
        name, long = f"finger_{k}_{j}", size * length
        solid = _solid("cylinder", long / 2, size * _RADIUS_M, long) + _solid("sphere", long, size * _RADIUS_M, 0)
        origin = base if j == 0 else f'<origin xyz="0 0 {size * _LINKS_M[j - 1]:.6f}"/>'
        low, high = sorted((0.0, end * ratio / 0.8)) if j == 2 and coupling == "distal follows" else (0.0, end)
        parts += [
            f'<link name="{name}">{solid}</link>',
            f'<joint name="joint_{k}_{j}" type="revolute"><parent link="{before}"/><child link="{name}"/>{origin}'
            f'<axis xyz="0 -1 0"/><limit lower="{low}" upper="{high}" effort="{_EFFORT * size}" velocity="3"/>'
            f"{_mimic(k, j, coupling, ratio)}</joint>",
        ]
        before = name
    return parts


def _mimic(k: int, j: int, coupling: Coupling, ratio: float) -> str:
    """What a joint follows, if it is no drive."""
    leads = {"each joint": (k, j), "distal follows": (k, min(j, 1)), "a drive a finger": (k, 0), "one drive": (0, 0)}
    lead = leads[coupling]
    if lead == (k, j):
        return ""
    follows = ratio if coupling == "distal follows" else _ENDS[j] / _ENDS[0]
    return f'<mimic joint="joint_{lead[0]}_{lead[1]}" multiplier="{follows:.6f}" offset="0"/>'


def _solid(kind: str, height: float, radius: float, length: float) -> str:
    size = f' length="{length:.6f}"' if kind == "cylinder" else ""
    shape = f'<geometry><{kind} radius="{radius:.6f}"{size}/></geometry>'
    return f'<collision><origin xyz="0 0 {height:.6f}"/>{shape}</collision>'


def hand_map(
    *,
    fingers: Sequence[int] = FINGERS,
    sizes: Sequence[float] = SIZES,
    ratios: Sequence[float] = RATIOS,
    couplings: Sequence[Coupling] = COUPLINGS,
    fidelity: str = "standard",
    count: int = 8,
    run: Run = ALONE,
    say: Callable[[str], None] = lambda line: None,
) -> StabilityMap:
    """Valid grasps of a cube in each hand, or why the hand is refused."""
    makes: list[tuple[str, float, str, Callable[[], HandModel]]] = []
    for way in couplings:
        makes += [("fingers of a ring", n, way, partial(ring_hand, n, coupling=way)) for n in fingers]
        makes += [("size, of three fingers", s, way, partial(ring_hand, 3, coupling=way, size=s)) for s in sizes]
    for n in (2, 3, 4):
        following = partial(ring_hand, n, coupling="distal follows")
        makes += [("distal over middle joint", r, f"{n} fingers", partial(following, ratio=r)) for r in ratios]
    cells = [_cell(panel, x, y, make, fidelity, count, run, say) for panel, x, y, make in makes]
    return StabilityMap(
        "hands",
        f"{count} grasps of a cube of {CUBE_MM:g} mm in hands that are hard, {fidelity}",
        "the hand's parameter",
        "what a drive moves",
        MEASURE,
        BOUNDS,
        reachable(cells, lambda cell: True),
        "few or no valid grasps, and a low share in the hand's self-test",
        "a hand without two parts that oppose each other is refused; the self-test of a new hand says which share "
        "holds plain objects; a job that finds too few says so",
        "tests/worker/studies/test_stability_hands.py::test_a_palm_without_fingers_is_refused_and_three_of_them_hold",
        reach="all: users bring such hands",
    )


def _cell(
    panel: str,
    x: float,
    y: str,
    make: Callable[[], HandModel],
    fidelity: str,
    count: int,
    run: Run,
    say: Callable[[str], None],
) -> MapCell:
    try:
        hand = make()
    except GraspdError as error:
        cell = refused(panel, x, y, error)
    else:
        cell = shape_cell(hand, (panel, x, y), cube(CUBE_MM), {"units": "m"}, {"fidelity": fidelity}, count, run)
    say(f"{panel} {x:g} {y}: {cell.outcome} {cell.value:.2f} {cell.note}")
    return cell

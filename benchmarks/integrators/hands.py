"""Difficult hands: few or many fingers, sizes, coupled drives; all are prepared like uploads.

The hands have equal three-joint fingers in a ring, which lean outward when open."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Final, Literal

import numpy as np

from graspd.service.model.digests import digest_files
from graspd.service.model.errors import GraspdError
from graspd.service.model.states import AssetKind
from graspd.service.model.studies import StabilityMap, mark_reachable
from graspd.studies.stability.shapes import BOUNDS, MEASURE, MapOptions, cube, refused_cell, shape_cell
from graspd.worker.hands.load import load_hand
from graspd.worker.hands.model import HandModel

Coupling = Literal["each joint", "distal follows", "one drive per finger", "one drive"]

FINGERS: Final = (1, 2, 3, 4, 5, 6, 8)
COUPLINGS: Final[tuple[Coupling, ...]] = ("each joint", "distal follows", "one drive per finger", "one drive")
#: Size relative to a human hand, whose fingers are about 10 cm long.
SIZES: Final = (0.25, 0.5, 0.75, 1.0, 1.5, 2.0, 3.0)
RATIOS: Final = (-0.5, 0.0, 0.5, 1.0, 1.5, 2.0)  # rotation of the distal joint over that of the middle joint
CUBE_MM: Final = 50.0  # cube that these hands grasp [mm]

#: Radius and height of the palm, lengths of the links from it outward, and their radius [m], at size 1.
_PALM_M, _LINKS_M, _RADIUS_M = (0.032, 0.02), (0.045, 0.035, 0.027), 0.009
#: Outward lean of open fingers, and limits of their joints [rad].
_LEAN: Final = 0.45
_ENDS: Final = (1.7, 1.6, 1.3)
_EFFORT: Final = 1.0  # torque of a joint of a hand of size 1 [N m]


def ring_hand(fingers: int, *, coupling: Coupling = "each joint", size: float = 1.0, ratio: float = 0.8) -> HandModel:
    """Return a hand of equal fingers around a palm, of a size relative to a human hand.
    `ratio` is the rotation of a coupled distal joint over that of the middle joint. Raises HandError: unusable."""
    radius, height = (size * x for x in _PALM_M)
    parts = [f'<robot name="ring"><link name="palm">{_shape_element("cylinder", -height / 2, radius, height)}</link>']
    for k in range(fingers):
        angle = 2 * np.pi * k / fingers
        at = f"{radius * np.cos(angle):.6f} {radius * np.sin(angle):.6f} 0"
        parts += _finger_elements(k, f'<origin xyz="{at}" rpy="0 {_LEAN} {angle:.6f}"/>', coupling, size, ratio)
    files = {"ring.urdf": "\n".join([*parts, "</robot>"]).encode()}
    return load_hand(files, name=f"ring of {fingers}", digest=digest_files(AssetKind.HAND, files))


def _finger_elements(k: int, base: str, coupling: Coupling, size: float, ratio: float) -> list[str]:
    parts, before = [], "palm"
    for j, (length, end) in enumerate(zip(_LINKS_M, _ENDS, strict=True)):
        name, long = f"finger_{k}_{j}", size * length
        solid = _shape_element("cylinder", long / 2, size * _RADIUS_M, long) + _shape_element(
            "sphere", long, size * _RADIUS_M, 0
        )
        origin = base if j == 0 else f'<origin xyz="0 0 {size * _LINKS_M[j - 1]:.6f}"/>'
        low, high = sorted((0.0, end * ratio / 0.8)) if j == 2 and coupling == "distal follows" else (0.0, end)
        parts += [
            f'<link name="{name}">{solid}</link>',
            f'<joint name="joint_{k}_{j}" type="revolute"><parent link="{before}"/><child link="{name}"/>{origin}'
            f'<axis xyz="0 -1 0"/><limit lower="{low}" upper="{high}" effort="{_EFFORT * size}" velocity="3"/>'
            f"{_mimic_element(k, j, coupling, ratio)}</joint>",
        ]
        before = name
    return parts


def _mimic_element(k: int, j: int, coupling: Coupling, ratio: float) -> str:
    """Return the mimic element of a joint that follows another one; empty for driven joints."""
    leads = {
        "each joint": (k, j),
        "distal follows": (k, min(j, 1)),
        "one drive per finger": (k, 0),
        "one drive": (0, 0),
    }
    lead = leads[coupling]
    if lead == (k, j):
        return ""
    follows = ratio if coupling == "distal follows" else _ENDS[j] / _ENDS[0]
    return f'<mimic joint="joint_{lead[0]}_{lead[1]}" multiplier="{follows:.6f}" offset="0"/>'


def _shape_element(kind: str, height: float, radius: float, length: float) -> str:
    size = f' length="{length:.6f}"' if kind == "cylinder" else ""
    shape = f'<geometry><{kind} radius="{radius:.6f}"{size}/></geometry>'
    return f'<collision><origin xyz="0 0 {height:.6f}"/>{shape}</collision>'


def hand_map(
    options: MapOptions,
    *,
    fingers: Sequence[int],
    couplings: Sequence[Coupling],
    sizes: Sequence[float] = (),
    ratios: Sequence[float] = (),
) -> StabilityMap:
    makes: list[tuple[str, float, str, Callable[[], HandModel]]] = []
    for way in couplings:
        makes += [("number of fingers in a ring", n, way, partial(ring_hand, n, coupling=way)) for n in fingers]
        makes += [
            ("size of a hand with three fingers", s, way, partial(ring_hand, 3, coupling=way, size=s)) for s in sizes
        ]
    for n in (2, 3, 4):
        following = partial(ring_hand, n, coupling="distal follows")
        makes += [
            ("rotation of distal joint over middle joint", r, f"{n} fingers", partial(following, ratio=r))
            for r in ratios
        ]
    cells = []
    for panel, x, y, make in makes:
        try:
            cell = shape_cell(make(), (panel, x, y), cube(CUBE_MM), options, fidelity=options.fidelity)
        except GraspdError as error:
            cell = refused_cell(panel, x, y, error)
        options.say(f"{panel} {x:g} {y}: {cell.outcome} {cell.value:.2f} {cell.note}")
        cells.append(cell)
    return StabilityMap(
        "hands",
        f"{options.count} grasps of a cube of {CUBE_MM:g} mm with difficult hands, {options.fidelity}",
        "the hand's parameter",
        "joints per drive",
        MEASURE,
        BOUNDS,
        mark_reachable(cells, lambda cell: True),
        "few or no valid grasps, and a low share in the hand's self-test",
        "a hand without two opposed parts is refused; the self-test of a new hand reports the share of its grasps that "
        "hold simple objects; a job with too few valid grasps reports it",
        "tests/studies/test_stability.py::test_palm_without_fingers_is_refused_and_three_of_them_hold",
        reach="all: uploaded hands can have such structures",
    )

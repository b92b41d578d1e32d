"""Difficult scenes of boxes.

They are flat and tall boxes on a table, boxes among walls and neighbours, and too small or large boxes."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any, Final

import numpy as np
import trimesh

from graspd.service.model.domain import JobRequest
from graspd.service.model.errors import GraspdError
from graspd.service.model.fidelity import FIDELITIES
from graspd.service.model.scene_spec import Box, HalfSpace, SceneSpec
from graspd.service.model.studies import MapCell, Outcome, StabilityMap, mark_reachable
from graspd.service.model.transforms import quat_rotate
from graspd.studies.stability.shapes import MILLIMETRES, MapOptions, outcome_of, prepare_mesh, refused_cell
from graspd.worker.generation import ValidatedBatch, validated_grasps
from graspd.worker.hands.kinematics import body_poses
from graspd.worker.hands.model import HandModel
from graspd.worker.scenes.kinds import rest_poses, supports_of
from graspd.worker.simulation.environment import Scenes

#: Boxes on a table: heights, and sides of their square footprints [mm].
HEIGHTS_MM: Final = (5, 10, 20, 40, 80, 140, 200)
SIDES_MM: Final = (30, 60, 120)
#: Target among walls and neighbours: sides and height [mm].
TARGET_MM: Final = (50, 50, 80)
_TARGET: Final = "50 x 50 x 80 mm"
GAPS_MM: Final = (5, 10, 20, 40, 80, 160)
#: Walls by name: their directions from the target.
WALLS: Final[dict[str, tuple[tuple[int, int], ...]]] = {
    "one": ((1, 0),),
    "corner": ((1, 0), (0, 1)),
    "two opposite": ((1, 0), (-1, 0)),
    "four": ((1, 0), (-1, 0), (0, 1), (0, -1)),
}
WALL_MM: Final = (300, 20)  # height and thickness of a wall [mm]: higher than the reach of any hand
#: Neighbours of the target's size, on its four sides and at its four corners.
NEIGHBOURS: Final[dict[str, tuple[tuple[int, int], ...]]] = {
    "one": ((1, 0),),
    "four": ((1, 0), (-1, 0), (0, 1), (0, -1)),
    "eight": ((1, 0), (-1, 0), (0, 1), (0, -1), (1, 1), (1, -1), (-1, 1), (-1, -1)),
}
#: Side of a cube over the span of the hand.
RATIOS: Final = (0.05, 0.1, 0.2, 0.3, 0.4, 0.6, 0.8)
KINDS: Final = ("free", "table", "bin", "shelf")

_MEASURE: Final = "share of candidates that are lifted out of the scene; –: no candidate was clear"
_FEWER: Final = (
    "a grasp without a clear trajectory or without a lift is never valid; a run whose budget ends reports how many "
    "it found; a scene without a free approach is refused with a message"
)
Placement = tuple[tuple[float, ...], SceneSpec]  # a box's sides [mm], and the scene in which it stands


@dataclass(frozen=True)
class _Study:
    title: str
    axes: tuple[str, str]
    placement: Callable[[HandModel, Any, Any], Placement]
    """Function from hand, x and y to the box and its scene."""
    guard_test: str
    reach: str


_STUDIES: Final = {
    "scene_height": _Study(
        "boxes on a table",
        ("height [mm]", "side of the footprint [mm]"),
        lambda hand, height, side: _upright_box((side, side, height)),
        "test_a_plate_flat_on_a_table_ends_with_fewer_and_says_so",
        "uploaded objects can have such shapes",
    ),
    "scene_wall": _Study(
        f"a box of {_TARGET} beside walls",
        ("distance from the walls [mm]", "walls"),
        lambda hand, gap, name: _upright_box(TARGET_MM, _walls(WALLS[name], gap)),
        "test_object_in_a_narrow_well_is_refused_or_comes_out_valid",
        "bins, shelves and scene files have such walls",
    ),
    "scene_neighbours": _Study(
        f"a box of {_TARGET} among equal boxes",
        ("gap between them [mm]", "fixed boxes around it"),
        lambda hand, gap, name: _upright_box(TARGET_MM, _neighbours(NEIGHBOURS[name], gap)),
        "test_a_box_among_boxes_is_lifted_out_or_not_valid",
        "clutter has such neighbours",
    ),
    "scene_size": _Study(
        "cubes of different sizes relative to the hand's span",
        ("side of the cube over the hand's span", "scene"),
        lambda hand, ratio, kind: (3 * (1e3 * ratio * span_of(hand),), SceneSpec(kind=kind)),
        "test_refused_scenes_are_cells_that_say_why_walls_stand_off",
        "uploaded objects can have such shapes",
    ),
}


def scene_map(
    name: str, hands: Sequence[HandModel], options: MapOptions, *, xs: Sequence[float], ys: Sequence[float | str]
) -> StabilityMap:
    """Return the map of a study of `_STUDIES`."""
    study = _STUDIES[name]
    cells = [_cell(hand, x, y, study.placement(hand, x, y), options) for hand, y, x in product(hands, ys, xs)]
    measure, guard = _MEASURE, _FEWER
    if name == "scene_size":
        spans = ", ".join(f"{hand.name} {1e3 * span_of(hand):.0f} mm" for hand in hands)
        measure += f"; scene free: held in the six pushes; span: largest distance between fingertips: {spans}"
        guard += "; an object larger than the bin or the shelf is refused with a message"
    return StabilityMap(
        name,
        f"{options.count} grasps of {study.title}, {options.fidelity}",
        *study.axes,
        measure,
        "weak: below 0.5; broken: 0",
        mark_reachable(cells, lambda cell: True),
        "few or no valid grasps; `clear_share` or `lift_share` of `graspd synth --json` is low",
        guard,
        f"tests/studies/test_stability.py::{study.guard_test}",
        reach=f"all: {study.reach}",
    )


def span_of(hand: HandModel) -> float:
    """Return the largest distance between the centres of two fingertips in the pre-shape [m]."""
    root = np.array([[0.0, 0, 0, 1, 0, 0, 0]])
    poses = body_poses(hand, root, hand.expand(hand.preshape[None]))[0]
    tips = [piece for piece in hand.pieces if piece.body in hand.fingertips]
    places = np.array([poses[p.body, :3] + quat_rotate(poses[p.body, 3:], p.vertices.mean(axis=0)) for p in tips])
    return float(np.linalg.norm(places[:, None] - places[None], axis=2).max())


def _upright_box(sides_mm: tuple[float, ...], around: Iterable[Box] = ()) -> Placement:
    """Return a box of these sides [mm] upright on a table, with boxes around it."""
    height = sides_mm[2] * MILLIMETRES
    target = (0.0, 0.0, height / 2, 1.0, 0.0, 0.0, 0.0)
    return sides_mm, SceneSpec(kind="file", supports=(HalfSpace(), *around), target=target)


def _walls(directions: Sequence[tuple[int, int]], gap_mm: float) -> list[Box]:
    """Return walls at a gap from the target; they are three times as long as high."""
    high, thick = (value * MILLIMETRES for value in WALL_MM)
    found = []
    for x, y in directions:
        side = TARGET_MM[0 if x else 1] * MILLIMETRES / 2 + gap_mm * MILLIMETRES + thick / 2
        size = (thick, 3 * high, high) if x else (3 * high, thick, high)
        found.append(Box(size=size, pose=(x * side, y * side, high / 2, 1.0, 0.0, 0.0, 0.0)))
    return found


def _neighbours(directions: Sequence[tuple[int, int]], gap_mm: float) -> list[Box]:
    size = tuple(side * MILLIMETRES for side in TARGET_MM)
    step = [side + gap_mm * MILLIMETRES for side in size[:2]]
    return [
        Box(size=(size[0], size[1], size[2]), pose=(x * step[0], y * step[1], size[2] / 2, 1.0, 0.0, 0.0, 0.0))
        for x, y in directions
    ]


def _cell(hand: HandModel, x: float | str, y: float | str, placement: Placement, options: MapOptions) -> MapCell:
    try:
        found = plan_candidates(hand, *placement, options)
    except GraspdError as error:
        cell = refused_cell(hand.name, x, y, error)
    else:
        cell = MapCell(hand.name, x, y, *_cell_values(found))
    options.say(f"{hand.name} {x} {y}: {cell.outcome} {cell.note}")
    return cell


def plan_candidates(hand: HandModel, sides_mm: Sequence[float], spec: SceneSpec, options: MapOptions) -> ValidatedBatch:
    """Return validated candidates for a box of these sides [mm] in a scene.
    Raises GraspdError: the box or the scene is refused."""
    mesh: Any = trimesh.creation.box(np.asarray(sides_mm) * MILLIMETRES)
    count, fidelity = options.count, options.fidelity
    obj = prepare_mesh(mesh, FIDELITIES[fidelity].face_error_m)
    request = JobRequest(hand="hand", object="box", grasps=count, want="candidates", fidelity=fidelity, rechecks=0)
    scenes = None
    if spec.kind != "free":
        scenes = Scenes(supports_of(spec), rest_poses(spec, obj, count=2, seed=0)["scene/object_pose"])
    return validated_grasps(hand, obj, request, count=count, scenes=scenes, run=options.run)


def _cell_values(found: ValidatedBatch) -> tuple[float, Outcome, str, str]:
    """Return value, outcome, note and label of a cell."""
    valid = float(found.columns["quality/valid"].mean())
    clear = found.shares.get("clear_share", 1.0)
    said = f"{valid:.0%} valid" if not found.shares else f"{clear:.0%} clear, {valid:.0%} lifted"
    return valid, outcome_of(valid), said, "–" if clear == 0 else ""

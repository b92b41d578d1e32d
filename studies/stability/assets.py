"""Difficult objects and hands: thin, sharp, open, tiny, huge; few or many fingers, coupled drives.

All are prepared like uploads. The hands have equal three-joint fingers in a ring, which lean outward when open."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import product
from typing import Any, Final, Literal

import numpy as np
import trimesh

from graspd.service.model.digests import digest_files
from graspd.service.model.domain import JobRequest
from graspd.service.model.errors import GraspdError
from graspd.service.model.states import AssetKind
from graspd.service.model.studies import MapCell, Outcome, StabilityMap, mark_reachable
from graspd.worker.execution_context import DEFAULT_CONTEXT, ExecutionContext
from graspd.worker.generation import validated_grasps
from graspd.worker.hands.load import load_hand
from graspd.worker.hands.model import HandModel
from graspd.worker.objects.model import ObjectModel
from graspd.worker.objects.prepare import load_object

#: Panel, x and y of a cell.
Place = tuple[str, float | str, float | str]

MILLIMETRES: Final = 1e-3
#: Text for maps of candidates: measure of a cell, bounds of bad values, and symptom for users.
MEASURE: Final = "share of valid candidates (held by the validator and accepted by the geometric gate)"
BOUNDS: Final = "weak: below 0.5; broken: 0, or a value that is not finite"
SHOWS: Final = "few or no valid grasps; the job reports that its budget is used up"


def plate_mesh(thickness_mm: float) -> Any:
    """Return a plate of 80 x 60 mm."""
    return trimesh.creation.box((0.08, 0.06, thickness_mm * MILLIMETRES))


def wedge(angle_deg: float) -> Any:
    """Return a triangular prism, 80 mm long, with an edge of the given angle."""
    half = 0.06 * np.tan(np.radians(angle_deg) / 2)
    section = np.array([[0.0, 0.0], [0.06, -half], [0.06, half]])
    ends = [np.column_stack([section, np.full(3, z)]) for z in (-0.04, 0.04)]
    return trimesh.convex.convex_hull(np.concatenate(ends))


def ring_mesh(diameter_mm: float) -> Any:
    """Return a thick ring: a wall of 15 mm around a hole of the given diameter."""
    inner = diameter_mm * MILLIMETRES / 2
    return trimesh.creation.annulus(inner, inner + 0.015, 0.05, sections=48)


def cross_mesh(depth_mm: float) -> Any:
    """Return a cross of two bars, with four concave corners of the given depth."""
    deep = depth_mm * MILLIMETRES
    arms = [trimesh.creation.box((0.03 + 2 * deep, 0.03, 0.05)), trimesh.creation.box((0.03, 0.03 + 2 * deep, 0.05))]
    return trimesh.boolean.union(arms, engine="manifold")


def cube(side_mm: float) -> Any:
    return trimesh.creation.box(3 * (side_mm * MILLIMETRES,))


def _half_inverted(faces: Any) -> Any:
    faces[::2] = faces[::2, ::-1]
    return faces


def box_with_defect(name: str) -> Any:
    """Return a box with the named defect of `DEFECTS`."""
    mesh = trimesh.creation.box((0.07, 0.06, 0.05))
    return trimesh.Trimesh(mesh.vertices, DEFECTS[name](mesh.faces.copy()), process=False)


#: Family -> unit of its parameter, constructor, parameters.
FAMILIES: Final[dict[str, tuple[str, Callable[[float], Any], tuple[float, ...]]]] = {
    "plate": ("thickness [mm]", plate_mesh, (0.2, 0.5, 1, 2, 5, 10)),
    "wedge": ("angle of the edge [deg]", wedge, (5, 10, 20, 40, 80)),
    "ring": ("diameter of the hole [mm]", ring_mesh, (4, 8, 16, 32, 64)),
    "cross": ("depth of the corners [mm]", cross_mesh, (2, 5, 10, 20)),
    "cube": ("side [mm]", cube, (1, 3, 10, 30, 60, 100, 200, 500, 1000)),
}
_ALLOW_OPEN: Final = "a side is missing, --allow-open"
#: Defects of a box, as functions on its faces.
DEFECTS: Final[dict[str, Callable[[Any], Any]]] = {
    "a side is missing": lambda faces: faces[2:],
    _ALLOW_OPEN: lambda faces: faces[2:],
    "inside out": lambda faces: faces[:, ::-1],
    "every other face inside out": _half_inverted,
}
CLOSED: Final = tuple(name for name in DEFECTS if name != _ALLOW_OPEN)  # defects that ingest refuses or closes


@dataclass(frozen=True)
class MapOptions:
    """Settings of the jobs behind the cells of a map."""

    count: int  # number of grasps of each job
    fidelity: str = "draft"
    run: ExecutionContext = DEFAULT_CONTEXT
    say: Callable[[str], None] = lambda line: None  # receives a line per cell


def shape_map(
    hand: HandModel, options: MapOptions, *, fidelities: Sequence[str], families: Sequence[str], defects: Sequence[str]
) -> StabilityMap:
    jobs: list[tuple[str, float | str, Any]] = [
        (f"{family}: {FAMILIES[family][0]}", value, FAMILIES[family][1](value))
        for family in families
        for value in FAMILIES[family][2]
    ]
    jobs += [("mesh of a box", name, box_with_defect(name)) for name in defects]
    cells = []
    for (panel, value, mesh), fidelity in product(jobs, fidelities):
        place, allow_open = (panel, value, fidelity), value == _ALLOW_OPEN
        cell = shape_cell(hand, place, mesh, options, allow_open=allow_open, fidelity=fidelity)
        options.say(f"{panel} {value} {fidelity}: {cell.outcome} {cell.value:.2f} {cell.note}")
        cells.append(cell)
    return StabilityMap(
        "shapes",
        f"{options.count} grasps of {hand.name} on difficult shapes",
        "the shape's parameter",
        "fidelity",
        MEASURE,
        BOUNDS,
        mark_reachable(cells, lambda cell: True),
        SHOWS,
        "ingest refuses meshes without an inside and reports `thin` walls; gate and validator reject grasps with "
        "deep penetration; a job with too few valid grasps reports it",
        "tests/studies/test_stability.py::test_a_shape_is_refused_or_its_grasps_are_sound",
        reach="all: uploaded objects can have such shapes",
    )


def prepare_mesh(mesh: Any, face_error_m: float, *, allow_open: bool = False) -> ObjectModel:
    """Prepare a mesh in metres like an upload. Raises MeshError: the mesh is refused."""
    files = {"shape.ply": bytes(mesh.export(file_type="ply"))}
    digest, options = digest_files(AssetKind.OBJECT, files), {"units": "m", "allow_open": allow_open}
    return load_object(files, name="shape", digest=digest, face_error_m=face_error_m, options=options)


def shape_cell(
    hand: HandModel, place: Place, mesh: Any, options: MapOptions, *, allow_open: bool = False, **asked: Any
) -> MapCell:
    """Return the share of valid candidates of a hand on a mesh in metres.
    `asked` is the job's fidelity or method."""
    request = JobRequest(hand="hand", object="shape", grasps=options.count, want="candidates", rechecks=0, **asked)
    try:
        obj = prepare_mesh(mesh, request.resolved_fidelity.face_error_m, allow_open=allow_open)
        found = validated_grasps(hand, obj, request, count=options.count, run=options.run)
    except GraspdError as error:
        return refused_cell(*place, error)
    valid = float(found.columns["quality/valid"].mean())
    depth = float(np.median(found.columns["quality/penetration_depth_mm"]))
    finite = bool(np.isfinite(found.grasps.grasp.hand_pose).all() and np.isfinite(depth))
    outcome = outcome_of(valid) if finite else "broken"
    return MapCell(*place, valid, outcome, f"{valid:.0%} valid, {depth:.2f} mm deep (median)")


def outcome_of(valid: float) -> Outcome:
    return "broken" if valid == 0 else "weak" if valid < 0.5 else "good"


def refused_cell(panel: str, x: float | str, y: float | str, error: GraspdError) -> MapCell:
    return MapCell(panel, x, y, float("nan"), "refused", str(error))


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

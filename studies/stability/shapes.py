"""Stability studies: planners on thin, sharp, open, tiny and huge shapes, prepared like uploads."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any, Final

import numpy as np
import trimesh

from graspd.service.model.digests import digest_files
from graspd.service.model.domain import JobRequest
from graspd.service.model.errors import GraspdError
from graspd.service.model.states import AssetKind
from graspd.service.model.studies import MapCell, Outcome, StabilityMap, mark_reachable
from graspd.worker.execution_context import DEFAULT_CONTEXT, ExecutionContext
from graspd.worker.generation import validated_grasps
from graspd.worker.hands.load import hand_from_path
from graspd.worker.hands.model import HandModel
from graspd.worker.objects.model import ObjectModel
from graspd.worker.objects.prepare import load_object

#: Panel, x and y of a cell.
Place = tuple[str, float | str, float | str]

MILLIMETRES: Final = 1e-3
#: Text for maps of candidates: measure of a cell, bounds of bad values, and symptom for users.
MEASURE: Final = "share of valid candidates (held by the validator and accepted by the geometric gate)"
BOUNDS: Final = "weak: below 0.5; broken: 0, or a value that is not finite"
_SAID: Final[dict[str, Any]] = {
    "x": "the shape's parameter",
    "measure": MEASURE,
    "bounds": BOUNDS,
    "shows": "few or no valid grasps; the job reports that its budget is used up",
}


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


def box_with_defect(name: str) -> Any:
    """Return a box with the named defect of `DEFECTS`."""
    mesh = trimesh.creation.box((0.07, 0.06, 0.05))
    return trimesh.Trimesh(mesh.vertices, DEFECTS[name](mesh.faces), process=False)


#: Family -> unit of its parameter, constructor, parameters.
FAMILIES: Final[dict[str, tuple[str, Callable[[float], Any], tuple[float, ...]]]] = {
    "plate": (
        "thickness [mm]",
        lambda mm: trimesh.creation.box((0.08, 0.06, mm * MILLIMETRES)),
        (0.2, 0.5, 1, 2, 5, 10),
    ),
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
    "every other face inside out": lambda faces: np.where(np.arange(len(faces))[:, None] % 2, faces, faces[:, ::-1]),
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
    jobs = _jobs({family: FAMILIES[family][2] for family in families})
    jobs += [("mesh of a box", name, box_with_defect(name)) for name in defects]
    return StabilityMap(
        "shapes",
        f"{options.count} grasps of {hand.name} on difficult shapes",
        y="fidelity",
        cells=_cells(hand, jobs, options, "fidelity", fidelities),
        guard="ingest refuses meshes without an inside and reports `thin` walls; gate and validator reject grasps with "
        "deep penetration; a job with too few valid grasps reports it",
        guard_test="tests/studies/test_stability.py::test_a_shape_is_refused_or_its_grasps_are_sound",
        reach="all: uploaded objects can have such shapes",
        **_SAID,
    )


def _jobs(shapes: Mapping[str, Sequence[float]]) -> list[tuple[str, float | str, Any]]:
    """Return panel, parameter and mesh of each shape; `shapes` has the parameters of each family."""
    return [
        (f"{family}: {FAMILIES[family][0]}", value, FAMILIES[family][1](value))
        for family, values in shapes.items()
        for value in values
    ]


def _cells(
    hand: HandModel, jobs: Sequence[tuple[str, float | str, Any]], options: MapOptions, axis: str, values: Sequence[str]
) -> list[MapCell]:
    """Return the cells of all jobs for each fidelity or method, as `axis` says."""
    cells = []
    for (panel, x, mesh), y in product(jobs, values):
        cell = shape_cell(hand, (panel, x, y), mesh, options, allow_open=x == _ALLOW_OPEN, **{axis: y})
        options.say(f"{panel} {x} {y}: {cell.outcome} {cell.value:.2f} {cell.note}")
        cells.append(cell)
    return mark_reachable(cells, lambda cell: True)


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


def run_studies(
    names: Sequence[str], hand: str, *, quick: bool, work: ExecutionContext, say: Callable[[str], None]
) -> list[StabilityMap]:
    """Return the maps of the named studies; `say` receives a line per cell."""
    model = hand_from_path(hand)
    options = MapOptions(4 if quick else 8, "draft" if quick else "standard", work, say)
    studies: dict[str, Callable[[], StabilityMap]] = {
        "shapes": lambda: shape_map(
            model,
            options,
            fidelities=("draft",) if quick else ("draft", "standard", "fine"),
            families=("plate", "cube") if quick else tuple(FAMILIES),
            # Grasps on an open mesh cost more than the rest of a quick run.
            defects=CLOSED if quick else tuple(DEFECTS),
        ),
        "baselines": lambda: baseline_map(
            model, options, methods=METHODS[:2] if quick else METHODS, shapes={"cube": (60,)} if quick else SHAPES
        ),
    }
    found = []
    for name in names:
        say(f"study {name}")
        found.append(studies[name]())
    return found


#: Methods that plan around a free object; the first is graspd's own, the others are baselines.
METHODS: Final = ("fast_graspd", "autograsp", "dfc", "graspit", "graspd2022")
#: Parameters of each family of shapes: an easy one and difficult ones.
SHAPES: Final[dict[str, tuple[float, ...]]] = {
    "plate": (1, 10),
    "wedge": (10, 80),
    "ring": (8, 64),
    "cross": (20,),
    "cube": (10, 30, 60, 100, 200),
}


def baseline_map(
    hand: HandModel, options: MapOptions, *, methods: Sequence[str], shapes: dict[str, tuple[float, ...]]
) -> StabilityMap:
    return StabilityMap(
        "baselines",
        f"{options.count} grasps of {hand.name} by each method on difficult shapes",
        y="method",
        cells=_cells(hand, _jobs(shapes), options, "method", methods),
        guard="gate and validator reject bad grasps; a job with too few valid grasps reports it",
        guard_test="tests/studies/test_stability.py::test_a_job_whose_every_grasp_is_bad_ends_with_none",
        reach="all: a job may use any method",
        **_SAID,
    )

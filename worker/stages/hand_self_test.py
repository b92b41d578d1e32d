"""Self-test of a hand: grasps of a sphere, a box and a cylinder of suitable size.
Free grasps are validated at level standard; other grasps lift the objects off a table."""

import logging
import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
import trimesh
from numpy.typing import NDArray

from graspd.service.model.domain import BATCH_SIZE, JobOptions
from graspd.service.model.errors import InputError
from graspd.service.model.scene_spec import SceneSpec
from graspd.service.model.transforms import IDENTITY_POSE, Floats, apply
from graspd.worker.control.postures import squeeze
from graspd.worker.execution_context import DEFAULT_CONTEXT, ExecutionContext
from graspd.worker.generation import ValidatedBatch, validated_grasps
from graspd.worker.grasps import Posture, join_grasp_sets
from graspd.worker.hands.jaws import fingertip_pad, jaws_of
from graspd.worker.hands.kinematics import body_poses
from graspd.worker.hands.model import HandModel
from graspd.worker.hands.pinch_postures import pinch_postures_of
from graspd.worker.objects.model import ObjectModel
from graspd.worker.objects.prepare import load_object
from graspd.worker.scenes.placement import scenes_of
from graspd.worker.validation.decomposition import decompose
from graspd.worker.validation.payload import PayloadLimit, payload_limit
from graspd.worker.validation.protocol import Outcome

#: Total number of free grasps, and the share that must hold for the verdict ready.
GRASPS: Final = 64
READY: Final = 0.7
#: Total number of grasps of objects on a table, and the share that must lift.
TABLE_GRASPS: Final = 16
TABLE_READY: Final = 0.6
TABLE: Final = SceneSpec(kind="table")
TABLE_SCENES: Final = 2
#: Width of the objects as a share of a gripper's opening or of the reach of a hand's fingers, and its bounds [m].
OF_OPENING: Final = 0.55
OF_REACH: Final = 0.5
WIDTH_M: Final = (0.012, 0.08)
STRONG_N: Final = 1000.0  # sum of normal forces of the squeeze for the payload [N]: actuators reach their limits
#: A servo that reaches its torque limit within less fingertip motion than this [m] presses with arbitrary force.
SOFT_M: Final = 0.0015
log = logging.getLogger(__name__)


@dataclass(frozen=True)
class BestGrasp:
    """Valid grasp with the largest epsilon; ties are broken by displacement."""

    obj: ObjectModel
    grasp: Posture
    rank: tuple[float, float]


@dataclass(frozen=True)
class SelfTest:
    """Shares `gsr` of n free grasps that hold, and `table` of `table_n` grasps on a table that lift."""

    gsr: float
    n: int
    width_m: float
    by_object: dict[str, float]
    table: float
    table_n: int
    best: BestGrasp | None = None  # None if no grasp held
    lost: float = 0.0  # share of failed grasps that lost the object during closing; the others fail under the pushes
    give_m: float = math.inf  # fingertip motion [m] within which the stiffest servo goes from zero to its limit
    limit: PayloadLimit | None = None  # payload on a table at full actuator force; None if no grasp lifts

    @property
    def line(self) -> str:
        share = f"{100 * self.gsr:.0f} % hold"
        lifts = f"{100 * self.table:.0f} % lift off a table"
        if self.gsr >= READY and self.table >= TABLE_READY:
            return f"ready: {share}, {lifts}"
        if self.gsr >= READY:
            return f"suspicious: {share}, but {lifts}: check closing, pre-shape and palm"
        worst = min(self.by_object, key=lambda name: self.by_object[name])
        weak = f"{100 * self.by_object[worst]:.0f} % of a {worst}; {self._weakness()}"
        if self.table >= TABLE_READY:
            return f"ready for tables: {lifts}; of free grasps {share}, {weak}"
        return f"suspicious: {share}, {lifts}, {weak}"

    def _weakness(self) -> str:
        """Return the likely reason why free grasps do not hold."""
        if self.lost > 0.5:
            return "most objects are lost while the hand closes: check palm, closing and pads"
        if self.give_m < SOFT_M:
            give = f"{1e3 * self.give_m:.1f} mm of fingertip motion"
            return f"its servos reach their limits within {give}: give less stiffness in asset.json"
        return "most objects slip when pushed: check effort, stiffness and pads"

    def facts(self) -> dict[str, Any]:
        limit = self.limit and self.limit.facts()
        shares = {"gsr": self.gsr, "n": self.n, "table": self.table, "table_n": self.table_n}
        return shares | {"width_m": self.width_m, "by_object": self.by_object, "says": self.line, "limit": limit}


def failed_facts(reason: str, says: str = "suspicious") -> dict[str, Any]:
    """Return the facts of a hand that could not be tested."""
    shares = {"gsr": 0.0, "n": 0, "table": 0.0, "table_n": 0}
    return shares | {"width_m": 0.0, "by_object": {}, "says": f"{says}: {reason}", "limit": None}


def self_test_facts(hand: Callable[[], HandModel], run: ExecutionContext = DEFAULT_CONTEXT) -> dict[str, Any]:
    """Return the facts of a self-test, also of one that ended with an error. Raises TaskCancelled."""
    try:
        return self_test(hand(), run).facts()
    except InputError as error:
        return failed_facts(str(error))
    except (ArithmeticError, LookupError, MemoryError, ValueError) as error:
        log.warning("a self-test ended with an error", exc_info=True)
        return failed_facts(f"the test itself failed ({type(error).__name__})", "not tried")


def self_test(
    hand: HandModel, run: ExecutionContext = DEFAULT_CONTEXT, *, grasps: int = GRASPS, on_table: int = TABLE_GRASPS
) -> SelfTest:
    """Test grasps of a sphere, a box and a cylinder with the defaults of `JobOptions`, then on a table.
    There is no time limit: a busy machine gives the same verdict. Raises InputError: a hand finds no start around one
    of the objects. TaskCancelled."""
    width = fitting_width(hand)
    held: dict[str, list[bool]] = {}
    lost: list[bool] = []
    lifted: list[tuple[int, float, PayloadLimit | None]] = []
    best: BestGrasp | None = None
    objects = plain_objects(width)
    for number, (name, obj) in enumerate(objects.items()):
        part = run.with_progress_range(number / len(objects), (number + 1) / len(objects))
        free, standing = (count // 3 + (number < count % 3) for count in (grasps, on_table))
        found = _plan_batches(hand, obj, free, part.with_progress_range(0.0, 0.7))
        lifted += [_test_lifts(hand, obj, standing, part.with_progress_range(0.7, 1.0))]
        held[name] = [bool(value == 1) for batch in found for value in batch.columns["quality/success"]]
        lost += [bool(one) for batch in found for one in _lost_in_closing(batch)]
        better = [_best_grasp(obj, batch) for batch in found]
        best = max((one for one in (best, *better) if one), key=lambda one: one.rank, default=None)
    every = [value for values in held.values() for value in values]
    by_object = {name: float(np.mean(values)) for name, values in held.items() if values}
    slack = float(np.mean(lost)) if lost else 0.0
    tried = sum(planned for planned, _, _ in lifted)
    table = sum(planned * share for planned, share, _ in lifted) / max(tried, 1)
    limit = _join_limits([limit for _, _, limit in lifted if limit is not None])
    return SelfTest(
        float(np.mean(every)), len(every), width, by_object, table, tried, best, slack, _drive_deflection(hand), limit
    )


def _join_limits(limits: list[PayloadLimit]) -> PayloadLimit | None:
    if not limits:
        return None
    lifts, bound = (max(getattr(one, name) for one in limits) for name in ("lifts_kg", "bound_kg"))
    return replace(limits[0], grasps=sum(one.grasps for one in limits), lifts_kg=lifts, bound_kg=bound)


def _lost_in_closing(batch: ValidatedBatch) -> NDArray[np.bool_]:
    """Return a mask of the grasps that do not hold because the object was lost during closing."""
    failed = batch.columns["quality/success"] != 1
    outcome = batch.columns["quality/verdict_outcome"][failed]
    return np.asarray((outcome == Outcome.LOST_WHILE_CLOSING).any(axis=1))


def _drive_deflection(hand: HandModel) -> float:
    """Return the least fingertip motion [m] that raises a closing dof's torque from zero to its limit."""
    if jaws_of(hand) is not None:
        return math.inf
    step = 1e-4
    q = hand.preshape + np.concatenate([np.zeros((1, hand.dofs)), step * np.eye(hand.dofs)])
    poses = body_poses(hand, np.tile(IDENTITY_POSE, (len(q), 1)), hand.expand(q))
    pads = np.stack([apply(poses[:, tip], fingertip_pad(hand, tip).centre) for tip in hand.fingertips], axis=1)
    lever = np.linalg.norm(pads[1:] - pads[0], axis=2).max(axis=1) / step
    closes = (hand.closing != 0) & (lever > 0)
    return float(np.min((hand.effort / hand.stiffness * lever)[closes], initial=math.inf))


def _plan_batches(hand: HandModel, obj: ObjectModel, count: int, run: ExecutionContext) -> list[ValidatedBatch]:
    sizes = [min(BATCH_SIZE, count - first) for first in range(0, count, BATCH_SIZE)]
    return [validated_grasps(hand, obj, _request(n), count=n, batch=batch, run=run) for batch, n in enumerate(sizes)]


def _request(count: int) -> JobOptions:
    return JobOptions(want="candidates", grasps=count, validation="standard")


def _test_lifts(
    hand: HandModel, obj: ObjectModel, count: int, run: ExecutionContext
) -> tuple[int, float, PayloadLimit | None]:
    """Test grasps of an object on a table.
    Return the number of planned grasps, the share that lifts, and the payload at full actuator force."""
    scenes, _ = scenes_of(TABLE, obj, count=TABLE_SCENES, seed=0)
    found = validated_grasps(hand, obj, _request(count), count=count, scenes=scenes, run=run)
    grasps, about = found.grasps.moved(np.negative(obj.centre)), obj.centred
    strong = replace(grasps, squeeze=squeeze(hand, about, grasps.grasp, total_normal_force=STRONG_N))
    both = join_grasp_sets([grasps, strong])
    assert both.scene is not None
    placed, pieces = scenes.centred(obj).placed(both.scene), decompose(about)
    limit = payload_limit(hand, about, both, pieces=pieces, placed=placed, least=1, run=run.without_progress())
    return found.planned, found.shares["lift_share"], limit and replace(limit, grasps=count)


def _best_grasp(obj: ObjectModel, found: ValidatedBatch) -> BestGrasp | None:
    columns = found.columns
    rows = np.flatnonzero(columns["quality/success"] == 1)
    if not len(rows):
        return None
    # Thin pads at two places give epsilon 0 at any threshold; the least motion under the pushes then decides.
    ranks = [(float(columns["quality/epsilon"][k].max()), -float(columns["quality/verdict_margin"][k])) for k in rows]
    row = max(range(len(rows)), key=ranks.__getitem__)
    return BestGrasp(obj, found.grasps.grasp.take(rows[[row]]), ranks[row])


def fitting_width(hand: HandModel) -> float:
    """Return the width of objects that suit a hand [m]."""
    if (jaws := jaws_of(hand)) is not None:
        return float(np.clip(OF_OPENING * jaws.opening, *WIDTH_M))
    poses = body_poses(hand, IDENTITY_POSE, hand.expand(hand.preshape))[0]
    tips = np.array([_finger_end(hand, body, poses[body]) for body in hand.fingertips or (hand.bodies - 1,)])
    reach = float(np.median(np.linalg.norm(tips - hand.palm.centre, axis=1)))
    # Objects thinner than the least gap between opposed pads do not suit a hand.
    least = float(known.width[0]) if len(known := pinch_postures_of(hand)) else 0.0
    return float(np.clip(max(OF_REACH * reach, least), *WIDTH_M))


def _finger_end(hand: HandModel, body: int, pose: Floats) -> Floats:
    """Return a finger's end [m]: its last joint, or its pad if only one joint closes it."""
    closing, at = 0, body
    while at > 0:
        closing += int(hand.closing[hand.dof[at]] != 0)
        at = int(hand.parent[at])
    return apply(pose, fingertip_pad(hand, body).centre) if closing == 1 else pose[:3]


def plain_objects(width: float) -> dict[str, ObjectModel]:
    """Return a sphere, a box and a cylinder; the last two are longer than wide."""
    meshes = {
        "sphere": trimesh.creation.icosphere(3, width / 2),
        "box": trimesh.creation.box((width, 1.2 * width, 1.8 * width)),
        "cylinder": trimesh.creation.cylinder(width / 2, 2 * width, sections=48),
    }
    objects = {}
    for number, (name, mesh) in enumerate(meshes.items()):
        files = {f"{name}.stl": bytes(mesh.export(file_type="stl"))}
        objects[name] = load_object(files, name=name, digest=f"{number:032x}", face_error_m=3e-4)
    return objects

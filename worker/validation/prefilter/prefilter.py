"""The GPU prefilter in MuJoCo Warp: it decides clear verdicts.

MuJoCo on the CPU decides all other verdicts, and rechecks a sample of the clear ones. At level `standard` only clear
failures are final, at level `fast` clear verdicts of both kinds. Other levels and lifts do not use the prefilter.

The validator's model is compiled once; postures, commands and pushes are arrays. Worlds take grasps from a queue on the
device until it is empty, and one graph serves any number of grasps."""

import hashlib
import importlib.util
import logging
from collections import OrderedDict
from dataclasses import dataclass, fields, replace
from functools import cache
from importlib.metadata import version
from typing import Any, Final, Self

import numpy as np
import warp as wp
from numpy.typing import NDArray

from graspd.service.model.errors import InputError
from graspd.service.model.transforms import Floats
from graspd.worker.engines import backend
from graspd.worker.engines.devices import check_device, exclusive, is_out_of_memory
from graspd.worker.execution_context import DEFAULT_CONTEXT, ExecutionContext
from graspd.worker.grasps import GraspSet, Posture
from graspd.worker.hands.jaws import jaws_of
from graspd.worker.hands.model import HandModel
from graspd.worker.validation import protocol
from graspd.worker.validation.model import Scene
from graspd.worker.validation.prefilter import kernels
from graspd.worker.validation.prefilter.kernels import BAND, MOST_TICKS, PATIENCE
from graspd.worker.validation.protocol import INTERVAL_S, Outcome, Rollout, ValidatedBy

log = logging.getLogger(__name__)

RECHECK_ONE_IN: Final = 50  # one clear verdict in this many is also validated on the CPU
REVISION: Final = 1  # revision of the prefilter's code; increase it if code (not a constant) changes verdicts
#: Pool sizes, for few grasps and for many; with arbitrary sizes nearly every launch would build a new pool.
WORLDS: Final = {"cuda": (256, 1024), "cpu": (8, 32)}
_KEPT_POOLS: Final = 4  # number of cached pools (model, arrays, graph): those that were used last
#: The prefilter is trusted while the CPU contradicts at most this share of the rechecked verdicts, or only one verdict.
_MOST_CONTRADICTED: Final = 0.05


@dataclass(frozen=True)
class PrefilterOutcomes:
    """Outcomes of N grasps in the worlds."""

    outcome: NDArray[np.uint8]  # (N, 6) `Outcome` of each push; an undecided grasp has pushes without a simulation
    margin: Floats  # (N,) largest ratio of displacement or rotation to its limit
    penetration_m: Floats
    self_penetration_m: Floats
    overflow: NDArray[np.bool_]  # (N,) whether contacts or constraints were dropped for lack of memory
    ticks: NDArray[np.int32]  # (N,) simulated ticks, of `protocol.INTERVAL_S` each

    @property
    def held(self) -> NDArray[np.bool_]:
        """(N,) whether all six pushes were held, clearly or not."""
        return np.asarray((self.outcome == Outcome.HELD).all(axis=1))

    @property
    def clearly_held(self) -> NDArray[np.bool_]:
        """(N,) whether the grasp held with a clear margin."""
        return np.asarray(self.held & (self.margin < BAND[0]) & ~self.overflow)

    @property
    def clearly_failed(self) -> NDArray[np.bool_]:
        """(N,) whether the object is lost with a clear margin, or the hand starts inside it."""
        inside = self.outcome[:, 0] == Outcome.PENETRATION
        kinds = (Outcome.LOST_WHILE_CLOSING, Outcome.DISPLACED, Outcome.ROTATED)
        lost = np.isin(self.outcome, kinds).any(axis=1) & np.isfinite(self.margin) & (self.margin > BAND[1])
        return np.asarray((inside | lost) & ~self.overflow)

    def replace_rows(self, rows: NDArray[np.intp], again: Self) -> Self:
        changed: dict[str, Any] = {}
        for field in fields(self):
            changed[field.name] = getattr(self, field.name).copy()
            changed[field.name][rows] = getattr(again, field.name)
        return replace(self, **changed)


class WorldPool:
    """Worlds of one scene on one device. Not thread-safe."""

    def __init__(self, scene: Scene, device: str, worlds: int) -> None:
        self.scene, self.device, self.worlds = scene, device, worlds
        self._engine = mujoco_warp()
        self._steps = round(protocol.INTERVAL_S / scene.physics.timestep)
        self._doublings, self._capacity = 0, 0
        self.launches = 0  # ticks of the last `validate`
        self._voiding = sum(int(getattr(self._engine.OverflowType, name)) for name in _VOIDING)
        with wp.ScopedDevice(device):
            self._model = self._engine.put_model(scene.model)
            self._model.opt.warn_overflow = 0
            self._of_hand = wp.array(scene.hand_geoms.astype(np.int32), dtype=wp.int32)
            terms = self._terms = kernels.TestConstants()
            terms.object_qpos, terms.object_body, terms.push = scene.object_qpos, scene.object_body, scene.push_force
            terms.centre = wp.vec3(*(float(x) for x in scene.centre))
            self._allocate()

    def validate(self, grasps: GraspSet, run: ExecutionContext = DEFAULT_CONTEXT) -> PrefilterOutcomes:
        """Run the test of level standard on N grasps. Raises TaskCancelled: `run.cancelled()` returned True."""
        with wp.ScopedDevice(self.device):
            found = self._validate(grasps, run)
            lost = np.flatnonzero(found.overflow)
            while len(lost) and self._doublings < DOUBLINGS:
                self._doublings += 1
                log.info("%d of %d grasps need more memory for contacts; it is doubled", len(lost), len(grasps))
                self._allocate()
                found = found.replace_rows(lost, self._validate(grasps.take(lost), run.without_progress()))
                lost = np.flatnonzero(found.overflow)
        return found

    def _allocate(self) -> None:
        model, w, more = self.scene.model, self.worlds, 2**self._doublings
        self._data = data = self._engine.make_data(model, nworld=w, nconmax=CONTACTS * more, njmax=ROWS * more)
        self._graph: Any = None
        engine = self._arrays = kernels.Engine()
        engine.qpos, engine.qvel, engine.warmstart, engine.ctrl = data.qpos, data.qvel, data.qacc_warmstart, data.ctrl
        engine.mocap_pos, engine.mocap_quat, engine.force = data.mocap_pos, data.mocap_quat, data.xfrc_applied
        engine.overflow = data.overflow
        worlds = self._worlds = kernels.Worlds()
        for name in ("grasp", "ticks", "push", "looks", "broken"):
            setattr(worlds, name, wp.zeros(w, dtype=wp.int32))
        worlds.before = wp.zeros(w, dtype=wp.vec3)
        worlds.turned_before = wp.zeros(w, dtype=wp.float32)
        worlds.qpos = wp.zeros((w, model.nq), dtype=wp.float32)
        worlds.qvel = wp.zeros((w, model.nv), dtype=wp.float32)
        worlds.warmstart = wp.zeros((w, model.nv), dtype=wp.float32)
        self._state = wp.zeros(3, dtype=wp.int32)

    def _validate(self, grasps: GraspSet, run: ExecutionContext) -> PrefilterOutcomes:
        n = len(grasps)
        self._reserve(n)
        starts = self._states(grasps.pregrasp)
        depth, short = self._depths(self._states(grasps.grasp))
        at_start, short_too = self._depths(starts)
        inside = at_start.max(axis=1) > protocol.MAX_PENETRATION_M
        queue, found = np.flatnonzero(~inside), self._found
        for array in (found.outcome, found.margin, found.ticks, found.overflow):
            array.zero_()
        self._upload(grasps, starts, queue)
        self._simulate(len(queue), run)
        outcome = found.outcome.numpy()[:n].astype(np.uint8)
        outcome[inside, 0] = protocol.Outcome.PENETRATION
        return PrefilterOutcomes(
            outcome=outcome,
            margin=found.margin.numpy()[:n].astype(float),
            penetration_m=depth[:, 0],
            self_penetration_m=depth[:, 1],
            overflow=short | short_too | ((found.overflow.numpy()[:n] & self._voiding) != 0),
            ticks=found.ticks.numpy()[:n],
        )

    def _reserve(self, n: int) -> None:
        """Allocate arrays for at least `n` grasps. Allocation is rare, because graphs refer to these arrays."""
        if n <= self._capacity:
            return
        rows, model, self._graph = max(self.worlds, 1 << (n - 1).bit_length()), self.scene.model, None
        asked, found = kernels.GraspCommands(), kernels.WorldVerdicts()
        asked.queue = wp.zeros(rows, dtype=wp.int32)
        asked.start = wp.zeros((rows, model.nq), dtype=wp.float32)
        asked.position = wp.zeros((rows, 3), dtype=wp.vec3)
        asked.turn = wp.zeros((rows, 3), dtype=wp.vec4)
        asked.control = wp.zeros((rows, 3, model.nu), dtype=wp.float32)
        found.outcome = wp.zeros((rows, len(protocol.DIRECTIONS)), dtype=wp.int32)
        found.margin = wp.zeros(rows, dtype=wp.float32)
        found.ticks, found.overflow = (wp.zeros(rows, dtype=wp.int32) for _ in range(2))
        self._capacity, self._asked, self._found = rows, asked, found

    def _states(self, posture: Posture) -> NDArray[np.float32]:
        """Return the states (N, nq) with the hand in postures and the object at its start."""
        scene = self.scene
        out = np.tile(scene.model.qpos0, (len(posture), 1))
        out[:, scene.object_qpos : scene.object_qpos + 7] = [*scene.centre, 1, 0, 0, 0]
        out[:, scene.joint_qpos] = posture.joint_positions
        if scene.root_qpos >= 0:
            out[:, scene.root_qpos : scene.root_qpos + 7] = posture.hand_pose
        return out.astype(np.float32)

    def _upload(self, grasps: GraspSet, starts: NDArray[np.float32], queue: NDArray[np.intp]) -> None:
        scene, parts = self.scene, (grasps.pregrasp, grasps.grasp, grasps.squeeze)
        poses = np.stack([part.hand_pose for part in parts], axis=1)
        joints = np.stack([part.joint_positions for part in parts], axis=1)
        values: dict[str, Any] = {"queue": queue, "start": starts, "control": scene.controls(joints)}
        values |= {"position": poses[..., :3], "turn": poses[..., 3:]}
        for name, value in values.items():
            array = getattr(self._asked, name)
            whole = array.numpy()
            whole[: len(value)] = value
            array.assign(whole)

    def _depths(self, states: NDArray[np.float32]) -> tuple[Floats, NDArray[np.bool_]]:
        """Return the deepest penetrations (N, 2), hand-object and hand-hand [m], and a mask (N,) of overflows."""
        n, data = len(states), self._data
        out, rows, short = wp.zeros((n, 2), dtype=wp.float32), wp.array(states, dtype=wp.float32), np.zeros(n, bool)
        for first in range(0, n, self.worlds):
            wp.launch(kernels.set_states, self.worlds, inputs=[first, rows], outputs=[self._arrays])
            self._engine.fwd_position(self._model, data)
            contact = data.contact
            inputs = [first, self._of_hand, data.nacon, contact.worldid, contact.geom, contact.dist]
            wp.launch(kernels.measure_depths, data.naconmax, inputs=inputs, outputs=[out])
            most = max(int(data.nacon.numpy()[0]), int(data.ncollision.numpy()[0]))
            short[first : first + self.worlds] = most > data.naconmax
        return out.numpy().astype(float), short

    def _simulate(self, count: int, run: ExecutionContext) -> None:
        self.launches = 0
        self._state.assign(np.array([0, self.worlds, count], np.int32))
        outputs = [self._worlds, self._arrays, self._state]
        wp.launch(kernels.begin, self.worlds, inputs=[self._terms, self._asked], outputs=outputs)
        while True:
            taken, alive, _ = self._state.numpy()
            run.progress(min(int(taken), count) - int(alive), count, "prefilter")
            if alive <= 0:
                return
            run.check("the prefilter")
            self.launches += 1
            self._tick()

    def _tick(self) -> None:
        """Run one tick of all worlds; on CUDA as a graph, once the first tick has loaded the kernels."""
        if self._graph is not None:
            wp.capture_launch(self._graph)
            return
        self._launch()
        if wp.get_device().is_cuda and wp.is_conditional_graph_supported():
            with wp.ScopedCapture() as capture:
                self._launch()
            self._graph = capture.graph

    def _launch(self) -> None:
        for _ in range(self._steps):
            self._engine.step(self._model, self._data)
        outputs = [self._worlds, self._arrays, self._found, self._state]
        wp.launch(kernels.check_state, self.worlds, inputs=[self._terms, self._asked], outputs=outputs)


_pools: OrderedDict[tuple[str, str, int], WorldPool] = OrderedDict()


@dataclass(frozen=True)
class PrefilterVerdicts:
    """Verdicts of the prefilter on N grasps."""

    stands: dict[int, Rollout]  # final verdicts, by row; the CPU validates all other rows
    rechecked: dict[int, bool]  # clear verdicts that the CPU rechecks, by row; True if the prefilter held the grasp

    def count_contradicted(self, rollouts: dict[int, Rollout]) -> int:
        return sum(rollouts[row].success != held for row, held in self.rechecked.items())

    def is_trusted(self, contradicted: int) -> bool:
        """Check whether so few verdicts were contradicted that all other verdicts are trusted."""
        return contradicted <= max(1, _MOST_CONTRADICTED * len(self.rechecked))


def prefilter_key_terms(hand: HandModel, level: str, run: ExecutionContext) -> list[Any]:
    """Return the prefilter's terms for `verdict_key`; empty if it is not used for verdicts of this level.
    Grippers do without it, since the engines distribute contacts of flat pads differently, and hands with tendons,
    since the engines differ on a tenth of Shadow's grasps (docs/explanation/quality.md). Raises InputError: the
    prefilter is required but not installed."""
    if run.prefilter == "off" or level not in ("standard", "fast") or jaws_of(hand) is not None or hand.tendons:
        return []
    if run.prefilter == "auto" and not (run.device.startswith("cuda") and has_mujoco_warp()):
        return []
    return [mujoco_warp_version(), REVISION, *BAND, PATIENCE, MOST_TICKS, RECHECK_ONE_IN]


def run_prefilter(
    scene: Scene, terms: str, grasps: GraspSet, *, level: str, run: ExecutionContext
) -> PrefilterVerdicts:
    """Run the prefilter on grasps in a scene; `terms` is a digest of everything that determines the scene."""
    postures = GraspSet(grasps.grasp, grasps.pregrasp, grasps.squeeze, grasps.stability_loss)
    if not len(grasps):
        return PrefilterVerdicts({}, {})
    try:
        with exclusive:
            found = _pool(scene, terms, run.device, len(grasps)).validate(postures, run)
            check_device(run.device)
    except RuntimeError as error:
        if not is_out_of_memory(error):
            raise
        log.warning("%s has no memory for the prefilter: the CPU validates %d grasps", run.device, len(grasps))
        return PrefilterVerdicts({}, {})
    clear = found.clearly_failed | (found.clearly_held if level == "fast" else False)
    rechecked = clear & _recheck_sample(grasps)
    if found.overflow.any():
        log.warning("%d of %d grasps overflow the prefilter; the CPU validates them", found.overflow.sum(), len(grasps))
    return PrefilterVerdicts(
        {int(row): _rollout(found, int(row), scene) for row in np.flatnonzero(clear & ~rechecked)},
        {int(row): bool(found.held[row]) for row in np.flatnonzero(rechecked)},
    )


def _pool(scene: Scene, terms: str, device: str, count: int) -> WorldPool:
    """Return a cached pool for `count` grasps of a scene: making a graph takes longer than one use of it."""
    few, many = WORLDS[device.partition(":")[0]]
    size = few if count <= few else many
    key = (terms, device, size)
    if key not in _pools:
        while len(_pools) >= _KEPT_POOLS:
            _pools.popitem(last=False)
        _pools[key] = WorldPool(scene, device, size)
    _pools.move_to_end(key)
    return _pools[key]


def _recheck_sample(grasps: GraspSet) -> NDArray[np.bool_]:
    """Select (N,) one grasp in `RECHECK_ONE_IN` by the digest of its pose, independently of its batch."""
    pose = np.ascontiguousarray(grasps.grasp.hand_pose, float)
    digests = (hashlib.sha256(row.tobytes()).digest() for row in pose)
    return np.array([int.from_bytes(one[:8], "big") % RECHECK_ONE_IN == 0 for one in digests], bool)


def _rollout(found: PrefilterOutcomes, row: int, scene: Scene) -> Rollout:
    return Rollout(
        outcomes=[Outcome(int(one)) for one in found.outcome[row]],
        margin=float(found.margin[row]),
        penetration_m=float(found.penetration_m[row]),
        self_penetration_m=float(found.self_penetration_m[row]),
        steps=int(found.ticks[row]) * round(INTERVAL_S / scene.physics.timestep),
        validated_by=ValidatedBy.MUJOCO_WARP,
    )


#: Initial capacity of contacts and constraint rows per world: twice the observed need of grasps of three hands.
CONTACTS: Final = 96
ROWS: Final = 256
DOUBLINGS: Final = 3  # largest number of times that the capacity is doubled when it overflows
#: Overflows that drop contacts or constraints. Other overflows are iteration limits, which MuJoCo also has.
_VOIDING: Final = ("NEFC", "NJMAX_NNZ", "BROADPHASE", "NARROWPHASE", "CCD", "EPA_HORIZON")


def has_mujoco_warp() -> bool:
    """Check whether MuJoCo Warp is installed, without importing it."""
    return importlib.util.find_spec("mujoco_warp") is not None


def mujoco_warp_version() -> str:
    """Return name and version; raise InputError if MuJoCo Warp is not installed."""
    if not has_mujoco_warp():
        raise InputError("the prefilter needs mujoco-warp; run pip install 'graspd[gpu]'")
    return f"mujoco-warp {version('mujoco-warp')}"


@cache
def mujoco_warp() -> Any:
    """Initialise Warp and return the module `mujoco_warp`; raise InputError if mujoco-warp is missing."""
    mujoco_warp_version()
    backend.start_warp()
    import mujoco_warp as engine

    return engine

"""The first judge beside the CPU: it gives the clear verdicts, and MuJoCo on the CPU all others and a sample of these.

At level `certificate` it only refuses: what clearly fails goes no further, and whatever may hold is certified on the
CPU. At level `screen` its clear verdicts stand both ways. It has no part in the letter, and none in lifts.
"""

from __future__ import annotations

import hashlib
import logging
import threading
from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray

from worker.engines.devices import check_device, is_out_of_memory
from worker.engines.mujoco_warp import has_mujoco_warp, mujoco_warp_version
from worker.grasps import GraspSet, joined
from worker.hands.jaws import jaws_of
from worker.hands.model import HandModel
from worker.quality.referee.first.trials import AUDIT_ONE_IN, FirstTrials
from worker.quality.referee.model import Scene
from worker.quality.referee.protocol import INTERVAL_S, JudgedBy, Outcome, Trial
from worker.run import ALONE, Run

if TYPE_CHECKING:
    from worker.quality.referee.first.worlds import WorldPool

log = logging.getLogger(__name__)

#: Worlds of a pool, for few grasps and for many: pools of any size would be made anew for nearly every launch.
WORLDS: Final = {"cuda": (256, 1024), "cpu": (8, 32)}
#: Pools that are kept, each with its model, arrays and graph: those of the pairs that were judged last.
_KEPT_POOLS: Final = 4
#: Share of audited verdicts that the CPU may contradict, beyond one, before the first judge is not believed.
_MOST_CONTRADICTED: Final = 0.05

_pools: OrderedDict[tuple[str, str, int], WorldPool] = OrderedDict()
_lock = threading.Lock()


@dataclass(frozen=True)
class Screened:
    """What the first judge says of N grasps."""

    stands: dict[int, Trial]
    """Verdicts that stand, by row. All other rows are for the CPU."""
    audited: dict[int, bool]
    """Verdicts that would stand and are asked of the CPU as well: whether the first judge said that the grasp holds."""

    def contradicted(self, trials: dict[int, Trial]) -> int:
        """How many audited verdicts the CPU's trials contradict."""
        return sum(trials[row].success != held for row, held in self.audited.items())

    def believed(self, contradicted: int) -> bool:
        """Whether the verdicts that stand may stand."""
        return contradicted <= max(1, _MOST_CONTRADICTED * len(self.audited))


def first_terms(hand: HandModel, level: str, run: Run) -> list[Any]:
    """The terms of the first judge where it takes part in verdicts of a level, for `verdict_key`; else none.

    Grippers have none: their flat pads touch in an area, and how the engines spread contacts over it differs. Hands
    with tendons have none: on a tenth of Shadow's grasps the engines differ (docs/explanation/quality.md).

    Raises:
        InputError: it is insisted on, and not installed.
    """
    if run.first_judge == "off" or level not in ("certificate", "screen"):
        return []
    if jaws_of(hand) is not None or hand.tendons:
        return []
    if run.first_judge == "auto" and not (run.device.startswith("cuda") and has_mujoco_warp()):
        return []
    return FirstTrials.terms(mujoco_warp_version())


def screened(scene: Scene, terms: str, grasps: GraspSet, *, level: str, run: Run) -> Screened:
    """What the first judge says of grasps in a scene; in one launch with those of the others in `run.meeting`.

    Args:
        scene: the referee's own.
        terms: digest of all that the scene follows from.
        grasps: N grasps.
        level: certificate or screen.
        run: its device is where the worlds are.

    Raises:
        TaskCancelled: when `run.cancelled()` answers True.
    """

    def work(asked: Sequence[GraspSet]) -> list[FirstTrials]:
        with _lock:
            every = joined(asked)
            found = _pool(scene, terms, run.device, len(every)).judge(every, run if run.meeting is None else ALONE)
        check_device(run.device)
        return found.parts([len(one) for one in asked])

    postures = GraspSet(grasps.grasp, grasps.pregrasp, grasps.squeeze, grasps.stability_loss)
    if not len(grasps):
        return Screened({}, {})
    try:
        if run.meeting is None:
            found = work([postures])[0]
        else:
            key = ("first judge", terms, run.device)
            found = run.meeting.ask(key, postures, work, size=len(grasps), cancelled=run.cancelled)
    except RuntimeError as error:
        if not is_out_of_memory(error):
            raise
        log.warning("%s has no memory for the first judge: the CPU judges %d grasps", run.device, len(grasps))
        return Screened({}, {})
    clear = found.clearly_failed | (found.clearly_held if level == "screen" else False)
    audited = clear & _drawn(grasps)
    if found.overflow.any():
        log.warning("%d of %d grasps overflow the first judge; the CPU judges them", found.overflow.sum(), len(grasps))
    return Screened(
        {int(row): _trial(found, int(row), scene) for row in np.flatnonzero(clear & ~audited)},
        {int(row): bool(found.held[row]) for row in np.flatnonzero(audited)},
    )


def _pool(scene: Scene, terms: str, device: str, count: int) -> WorldPool:
    """Worlds for so many grasps of a scene. The last ones are kept: a graph takes longer to make than to use once."""
    few, many = WORLDS[device.partition(":")[0]]
    size = few if count <= few else many
    key = (terms, device, size)
    if key not in _pools:
        while len(_pools) >= _KEPT_POOLS:
            _pools.popitem(last=False)
        from worker.quality.referee.first.worlds import WorldPool  # its kernels are read for those who ask it

        _pools[key] = WorldPool(scene, device, size)
    _pools.move_to_end(key)
    return _pools[key]


def _drawn(grasps: GraspSet) -> NDArray[np.bool_]:
    """(N,) one grasp in so many, told by its own numbers: whatever batch it stands in."""
    pose = np.ascontiguousarray(grasps.grasp.hand_pose, float)
    digests = (hashlib.sha256(row.tobytes()).digest() for row in pose)
    return np.array([int.from_bytes(one[:8], "big") % AUDIT_ONE_IN == 0 for one in digests], bool)


def _trial(found: FirstTrials, row: int, scene: Scene) -> Trial:
    return Trial(
        outcomes=[Outcome(int(one)) for one in found.outcome[row]],
        margin=float(found.margin[row]),
        penetration_m=float(found.penetration_m[row]),
        self_penetration_m=float(found.self_penetration_m[row]),
        steps=int(found.ticks[row]) * round(INTERVAL_S / scene.physics.timestep),
        judged_by=JudgedBy.MUJOCO_WARP,
    )

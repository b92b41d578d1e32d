"""Worlds of one hand and one object in MuJoCo Warp, which judge grasps by the schedule of `kernels`.

The model is the referee's own, compiled once; what differs between grasps (postures, commands, pushes) is data. A pool
of worlds takes grasps from a queue on the device, so a launch stays full until the queue is empty, and one graph serves
any number of grasps.
"""

from __future__ import annotations

import logging
from typing import Any, Final

import numpy as np
import warp as wp
from numpy.typing import NDArray

from service.model.transforms import Floats
from worker.engines.mujoco_warp import mujoco_warp
from worker.grasps import GraspSet, Posture
from worker.quality.referee import protocol
from worker.quality.referee.first import kernels
from worker.quality.referee.first.trials import FirstTrials
from worker.quality.referee.model import Scene
from worker.run import ALONE, Run

log = logging.getLogger(__name__)

#: Contacts and constraint rows that a world has room for at first: twice what grasps of three hands were seen to need.
CONTACTS: Final = 96
ROWS: Final = 256
#: Room is doubled up to this many times where it did not do.
DOUBLINGS: Final = 3
#: Overflows that leave contacts or constraints out. The others are limits of iterations, which MuJoCo has as well.
_VOIDING: Final = ("NEFC", "NJMAX_NNZ", "BROADPHASE", "NARROWPHASE", "CCD", "EPA_HORIZON")


class WorldPool:
    """Worlds of one scene on one device. Not for several threads at once."""

    def __init__(self, scene: Scene, device: str, worlds: int) -> None:
        self.scene, self.device, self.worlds = scene, device, worlds
        self._engine = mujoco_warp()
        self._steps = round(protocol.INTERVAL_S / scene.physics.timestep)
        self._doublings, self._capacity = 0, 0
        self.launches = 0
        """Ticks of the last `judge`."""
        voiding = (getattr(self._engine.OverflowType, name) for name in _VOIDING)
        self._voiding = int(sum(int(bit) for bit in voiding))
        with wp.ScopedDevice(device):
            self._model = self._engine.put_model(scene.model)
            self._model.opt.warn_overflow = 0
            self._of_hand = wp.array(scene.hand_geoms.astype(np.int32), dtype=wp.int32)
            self._terms = self._make_terms()
            self._allocate()

    def judge(self, grasps: GraspSet, run: Run = ALONE) -> FirstTrials:
        """The certificate's test of N grasps.

        Raises:
            TaskCancelled: when `run.cancelled()` answers True.
        """
        with wp.ScopedDevice(self.device):
            found = self._judge(grasps, run)
            lost = np.flatnonzero(found.overflow)
            while len(lost) and self._doublings < DOUBLINGS:
                self._doublings += 1
                log.info("%d of %d grasps need more room for contacts: it is doubled", len(lost), len(grasps))
                self._allocate()
                found = found.put(lost, self._judge(grasps.take(lost), run.quiet()))
                lost = np.flatnonzero(found.overflow)
        return found

    def _make_terms(self) -> Any:
        scene, terms = self.scene, kernels.Terms()
        terms.object_qpos, terms.object_body = scene.object_qpos, scene.object_body
        terms.push = scene.push
        terms.centre = wp.vec3(*(float(x) for x in scene.centre))
        return terms

    def _allocate(self) -> None:
        """Data of the simulations, with the room that is known to be needed."""
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

    def _judge(self, grasps: GraspSet, run: Run) -> FirstTrials:
        n = len(grasps)
        self._room_for(n)
        starts = self._states(grasps.pregrasp)
        depth, short = self._depths(self._states(grasps.grasp))
        at_start, short_too = self._depths(starts)
        inside = at_start.max(axis=1) > protocol.MAX_PENETRATION_M
        queue, found = np.flatnonzero(~inside), self._found
        for name in ("outcome", "margin", "ticks", "overflow"):
            getattr(found, name).zero_()
        self._ask(grasps, starts, queue)
        self._simulate(len(queue), run)
        outcome = found.outcome.numpy()[:n].astype(np.uint8)
        outcome[inside, 0] = protocol.Outcome.PENETRATION
        return FirstTrials(
            outcome=outcome,
            margin=found.margin.numpy()[:n].astype(float),
            penetration_m=depth[:, 0],
            self_penetration_m=depth[:, 1],
            overflow=short | short_too | ((found.overflow.numpy()[:n] & self._voiding) != 0),
            ticks=found.ticks.numpy()[:n],
        )

    def _room_for(self, n: int) -> None:
        """Arrays for at least so many grasps. A graph holds on to its arrays, so they change as seldom as may be."""
        if n <= self._capacity:
            return
        rows, model, self._graph = max(self.worlds, 1 << (n - 1).bit_length()), self.scene.model, None
        asked, found = kernels.Grasps(), kernels.Found()
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
        """(N, nq) the hand in postures, the object at its start."""
        scene = self.scene
        out = np.tile(scene.model.qpos0, (len(posture), 1))
        out[:, scene.object_qpos : scene.object_qpos + 7] = [*scene.centre, 1, 0, 0, 0]
        out[:, scene.joint_qpos] = posture.joint_positions
        if scene.root_qpos >= 0:
            out[:, scene.root_qpos : scene.root_qpos + 7] = posture.hand_pose
        return out.astype(np.float32)

    def _ask(self, grasps: GraspSet, starts: NDArray[np.float32], queue: NDArray[np.intp]) -> None:
        """Put grasps on the device, with the order in which they are taken."""
        scene, parts = self.scene, (grasps.pregrasp, grasps.grasp, grasps.squeeze)
        poses = np.stack([part.hand_pose for part in parts], axis=1)
        joints = np.stack([part.joint_positions for part in parts], axis=1)
        values: dict[str, Any] = {
            "queue": queue,
            "start": starts,
            "position": poses[..., :3],
            "turn": poses[..., 3:],
            "control": scene.controls(joints),
        }
        for name, value in values.items():
            array = getattr(self._asked, name)
            whole = array.numpy()
            whole[: len(value)] = value
            array.assign(whole)

    def _depths(self, states: NDArray[np.float32]) -> tuple[Floats, NDArray[np.bool_]]:
        """(N, 2) deepest penetration of hand and object, and within the hand [m]; (N,) whether room was short."""
        n, data = len(states), self._data
        out, rows, short = wp.zeros((n, 2), dtype=wp.float32), wp.array(states, dtype=wp.float32), np.zeros(n, bool)
        for first in range(0, n, self.worlds):
            wp.launch(kernels.place, self.worlds, inputs=[first, rows], outputs=[self._arrays])
            self._engine.fwd_position(self._model, data)
            contact = data.contact
            wp.launch(
                kernels.depths, data.naconmax,
                inputs=[first, self._of_hand, data.nacon, contact.worldid, contact.geom, contact.dist], outputs=[out],
            )  # fmt: skip
            most = max(int(data.nacon.numpy()[0]), int(data.ncollision.numpy()[0]))
            short[first : first + self.worlds] = most > data.naconmax
        return out.numpy().astype(float), short

    def _simulate(self, count: int, run: Run) -> None:
        """Tick until no world has a grasp."""
        self.launches = 0
        self._state.assign(np.array([0, self.worlds, count], np.int32))
        wp.launch(
            kernels.begin, self.worlds, inputs=[self._terms, self._asked],
            outputs=[self._worlds, self._arrays, self._state],
        )  # fmt: skip
        while True:
            taken, alive, _ = self._state.numpy()
            run.progress(min(int(taken), count) - int(alive), count, "first judge")
            if alive <= 0:
                return
            run.check("the first judge")
            self.launches += 1
            self._tick()

    def _tick(self) -> None:
        """One tick of all worlds; on CUDA a graph, once the first tick has loaded what it launches."""
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
        wp.launch(
            kernels.look, self.worlds, inputs=[self._terms, self._asked],
            outputs=[self._worlds, self._arrays, self._found, self._state],
        )  # fmt: skip

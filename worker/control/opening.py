"""Opening of hands from their grasps, on a device.
Purpose: see `worker.control.postures`; method: `worker.simulation.kernels.opening` and `.jamming`."""

from collections.abc import Callable
from typing import Any, Final

import numpy as np
import warp as wp
from numpy.typing import NDArray

from graspd.service.model.transforms import Floats, quat_rotate
from graspd.worker.grasps import Posture
from graspd.worker.hands.digits import finger_of_body
from graspd.worker.hands.jaws import jaws_of, prismatic_dofs
from graspd.worker.hands.model import HandModel
from graspd.worker.quality.posed import PostureData
from graspd.worker.simulation.kernels import distance, jamming, opening, optimizers
from graspd.worker.simulation.launches import Launches, launch

#: Distance from the object at which fingers stop opening [m]. It covers the errors of a calibrated arm. From a larger
#: distance, fingers arrive faster on closing and push the object away more often.
CLEARANCE_M: Final = 0.003
#: A finger closer than this to the object after opening [m] is opened again, against `HandModel.closing` alone.
STUCK_M: Final = 0.003
#: The root retreats only if the open hand is closer than this to the object [m]. A palm in contact pushes the object
#: away. So does a palm that returns from a large distance while the fingers close.
PALM_CLEARANCE_M: Final = 0.0005
#: Share of the direction against `HandModel.closing` in a finger's opening direction. The rest follows the contact
#: normals, so that the closing finger does not drag the object along.
PLAIN_OPENING: Final = 0.3
#: Opening steps of revolute [rad] and prismatic joints [m], and the number of steps.
OPENING_STEP: Final = 0.05
SLIDING_STEP_M: Final = 0.002
OPENING_STEPS: Final = 24
#: Allowed penetration of an opening finger into the rest of the hand, in addition to that in the grasp [m]; checked
#: shares of its path; number of checks. A jammed finger opens half as far. If the last check fails, it does not open.
JAM_M: Final = 5e-4
WAY: Final = (1 / 3, 2 / 3, 1.0)
JAM_LOOKS: Final = 4
RETREATS_M: Final = (0.0, 0.0025, 0.005, 0.0075, 0.010, 0.015, 0.020)

#: Returns a mask (n, F) of blocked fingers, for hands `rows` (n,) and paths (n, K, D) of their dofs.
Blocked = Callable[[NDArray[np.intp], Floats], NDArray[np.bool_]]


def fingers_of_dofs(hand: HandModel) -> NDArray[np.int32]:
    """Return the first finger (D,) that each dof drives; -1 if none, so that the dof does not open."""
    finger = fingers_of_bodies(hand)
    driven = [finger[np.flatnonzero((hand.dof == d) & (finger >= 0))] for d in range(hand.dofs)]
    return np.array([f[0] if len(f) else -1 for f in driven], np.int32)


def fingers_of_bodies(hand: HandModel) -> NDArray[np.int32]:
    """Return the opening unit (L,) of each body: its finger, or for grippers the dof that moves it."""
    if jaws_of(hand) is None:
        return finger_of_body(hand)
    out = np.full(hand.bodies, -1, np.int32)
    for body in range(1, hand.bodies):
        out[body] = out[hand.parent[body]] if out[hand.parent[body]] >= 0 else hand.dof[body]
    return out


def dof_steps(hand: HandModel) -> Floats:
    """Return the opening step (D,) of each dof [rad or m]."""
    return np.where(prismatic_dofs(hand), SLIDING_STEP_M, OPENING_STEP)


def count_fingers(hand: HandModel) -> int:
    return max(1, len(hand.fingertips), int(fingers_of_bodies(hand).max()) + 1)


class Openings:
    """N hands opened together from grasps with dofs `q` (N, D); open dofs `wide` (N, D), by default `q`."""

    def __init__(self, posing: PostureData, hand_pose: Floats, q: Floats, wide: Floats | None = None) -> None:
        self.posing, self.hand_pose, self.q = posing, hand_pose, q
        self.count, self.fingers_count = len(q), count_fingers(posing.hand)
        with wp.ScopedDevice(posing.device):
            self.fingers = _fingers(posing.hand)
            self.hands = opening.Hands()
            self.hands.position, self.hands.rotation = posing.upload_roots(hand_pose)
            self.hands.q = wp.array(q, dtype=wp.float64)
            self.open = wp.array(q if wide is None else wide, dtype=wp.float64)
            self.step = wp.zeros(1, dtype=wp.int32)
        self.bodies = posing.allocate_bodies(self.count)

    def open_from(self, grasp: Posture) -> None:
        """Open each finger from `grasp` until it is `CLEARANCE_M` from the object, or as far as possible."""
        first, plain = self._sweep(), self._sweep()
        self._open_directions(grasp, first)
        self._step(first)
        self._launch(opening.open_against_closing, self.count, [self.fingers, STUCK_M, first], [plain, self.step])
        self._step(plain)
        inputs = [self.fingers, self.hands, STUCK_M, first, plain]
        self._launch(opening.write_opening, self.open.shape, inputs, [self.open])

    def without_jams(self, blocked: Blocked | None = None) -> Floats:
        """Return the open dofs (N, D); fingers that jam or are `blocked` open less far or not at all.
        A finger that jams on opening would not reach the grasp on closing."""
        jams = self._jams()
        depth = self._depths(jams)
        depth[0].run()
        self._launch(jamming.limit_depth, self.count, [JAM_M], [jams])
        for look in range(JAM_LOOKS):
            for way in depth[1:]:
                way.run()
            if blocked is not None:
                rows = np.flatnonzero(jams.going.numpy())
                out = np.zeros((self.count, self.fingers_count), np.int32)
                if len(rows):
                    finger = fingers_of_dofs(self.posing.hand)
                    share = np.where(finger >= 0, jams.share.numpy()[rows][:, finger], 1.0)
                    move = (self.open.numpy()[rows] - self.q[rows]) * share
                    out[rows] = blocked(rows, self.q[rows, None] + np.array(WAY)[None, :, None] * move[:, None])
                jams.blocked.assign(out)
            less = wp.float64(0.5 if look < JAM_LOOKS - 1 else 0.0)
            self._launch(jamming.shorten_paths, self.count, [less], [jams])
        self._launch(jamming.write_path, self.open.shape, [self.fingers, self.hands, jams], [self.open])
        return np.array(self.open.numpy())

    def retreated(self) -> Floats:
        """Return root poses (N, 7) of the open hands; hands in contact retreat along the palm's approach."""
        posing, device = self.posing, self.posing.device
        with wp.ScopedDevice(device):
            back = jamming.Retreat()
            back.going, back.chosen = wp.full(self.count, 1, dtype=wp.int32), wp.zeros(self.count, dtype=wp.int32)
            back.clear = wp.full(self.count, PALM_CLEARANCE_M, dtype=wp.float32)
            back.best = wp.full(self.count, -1e9, dtype=wp.float32)
            jams = self._jams()
            self._place(Launches(device), jams, 1.0).run()
            approach = wp.vec3d(*posing.hand.palm.approach)
        points = [posing.probe.skin, posing.points, posing.lane]
        for step, way in enumerate(RETREATS_M):
            inputs = [*points, approach, PALM_CLEARANCE_M, wp.float64(way), self.bodies]
            self._launch(jamming.hand_clearance, (self.count, posing.lanes), inputs, [back])
            self._launch(jamming.select_retreat, self.count, [PALM_CLEARANCE_M, step], [back])
        poses = self.hand_pose.copy()
        away = np.array(RETREATS_M)[back.chosen.numpy()]
        poses[:, :3] -= away[:, None] * quat_rotate(poses[:, 3:], posing.hand.palm.approach)
        return poses

    def _launch(self, kernel: Any, dim: Any, inputs: list[Any], outputs: list[Any]) -> None:
        launch(kernel, dim, inputs=inputs, outputs=outputs, device=self.posing.device)

    def _sweep(self) -> Any:
        out, shape = opening.Sweep(), (self.count, self.fingers_count)
        with wp.ScopedDevice(self.posing.device):
            out.going = wp.empty(self.count, dtype=wp.int32)
            out.direction = wp.empty((self.count, self.posing.hand.dofs), dtype=wp.float64)
            out.clear, out.best = (wp.empty(shape, dtype=wp.float32) for _ in range(2))
            out.chosen = wp.empty(shape, dtype=wp.int32)
        return out

    def _open_directions(self, grasp: Posture, sweep: Any) -> None:
        posing, hand = self.posing, self.posing.hand
        bodies, near = posing.nearest_points(grasp, CLEARANCE_M)
        with wp.ScopedDevice(posing.device):
            wrench = [wp.empty((self.count, hand.bodies), dtype=wp.vec3d) for _ in range(2)]
            away = wp.empty((self.count, hand.dofs), dtype=wp.float64)
        inputs = [posing.points, bodies, near, CLEARANCE_M]
        self._launch(opening.body_wrenches, (self.count, hand.bodies), inputs, wrench)
        inputs = [posing.chain, self.fingers, wp.float64(PLAIN_OPENING), bodies]
        self._launch(opening.opening_directions, self.count, inputs, [*wrench, away, sweep])

    def _step(self, sweep: Any) -> None:
        posing, out = self.posing, Launches(self.posing.device)
        inputs = [posing.chain, self.fingers, self.hands, CLEARANCE_M, self.step]
        out.add(opening.place_opening, self.count, inputs=inputs, outputs=[sweep, self.bodies])
        inputs = [posing.probe.skin, posing.points, self.fingers, posing.lane, CLEARANCE_M, self.bodies]
        out.add(opening.finger_clearance, (self.count, posing.lanes), inputs=inputs, outputs=[sweep])
        out.add(opening.select_opening, self.count, inputs=[CLEARANCE_M, self.step], outputs=[sweep])
        out.add(optimizers.advance, 1, inputs=[], outputs=[self.step])
        out.run(OPENING_STEPS + 1)

    def _jams(self) -> Any:
        out, shape = jamming.FingerJams(), (self.count, self.fingers_count)
        with wp.ScopedDevice(self.posing.device):
            out.going = wp.full(self.count, 1, dtype=wp.int32)
            out.share = wp.full(shape, 1.0, dtype=wp.float64)
            out.limit, out.depth = (wp.zeros(shape, dtype=wp.float32) for _ in range(2))
            out.blocked = wp.zeros(shape, dtype=wp.int32)
        return out

    def _place(self, out: Launches, jams: Any, way: float) -> Launches:
        inputs = [self.posing.chain, self.fingers, self.hands, jams, self.open, wp.float64(way)]
        out.add(jamming.place_on_path, self.count, inputs=inputs, outputs=[self.bodies])
        return out

    def _depths(self, jams: Any) -> list[Launches]:
        """Return launches that compute fingers' depths in other links: in the grasp, then at each of `WAY`."""
        posing, probe = self.posing, self.posing.probe
        shape = (self.count, len(posing.hand.pieces))
        with wp.ScopedDevice(posing.device):
            frames = [wp.empty(shape, dtype=wp.vec3), wp.empty(shape, dtype=wp.quat)]
        bodies = [self.bodies.position, self.bodies.rotation]
        found = []
        for way in (0.0, *WAY):
            out = self._place(Launches(posing.device), jams, way)
            inputs = [probe.pieces, wp.vec3d(), *probe.frames, *bodies]
            out.add(distance.place_pieces, shape, inputs=inputs, outputs=frames)
            inputs = [probe.pieces, probe.body_points, self.fingers, self.bodies, *frames]
            out.add(jamming.finger_depth, (self.count, posing.hand.bodies), inputs=inputs, outputs=[jams])
            found.append(out)
        return found


def _fingers(hand: HandModel) -> Any:
    out = opening.Fingers()
    out.of_body = wp.array(fingers_of_bodies(hand), dtype=wp.int32)
    out.of_dof = wp.array(fingers_of_dofs(hand), dtype=wp.int32)
    out.closing = wp.array(np.asarray(hand.closing, float), dtype=wp.float64)
    out.step = wp.array(dof_steps(hand), dtype=wp.float64)
    out.lower = wp.array(hand.lower, dtype=wp.float64)
    out.upper = wp.array(hand.upper, dtype=wp.float64)
    return out

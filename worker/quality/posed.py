"""Posed hands on a device, in double precision, and the kernels' data of a hand and an object."""

from typing import Any, Final

import numpy as np
import warp as wp
from numpy.typing import NDArray

from graspd.service.model.transforms import Floats
from graspd.worker.grasps import Posture
from graspd.worker.hands.digits import finger_of_body
from graspd.worker.hands.model import HandModel
from graspd.worker.objects.memory_cache import cached_by_content
from graspd.worker.objects.model import ObjectModel
from graspd.worker.quality.contact import LINK_CONTACT_M, contact_links
from graspd.worker.quality.probe import Probe, probe_of
from graspd.worker.simulation.device import allocate_bodies, chain_of, posed_bodies, to_xyzw
from graspd.worker.simulation.kernels import balance, jamming, opening, optimizers, touching
from graspd.worker.simulation.launches import launch

#: Points per CPU thread, and hands at a time: their data fits the cache.
CPU_LANE: Final = 64
CPU_HANDS: Final = 128
GPU_HANDS: Final = 4096  # hands at a time on a GPU


class PostureData:
    """Device data of a hand and an object for the posture kernels."""

    def __init__(self, probe: Probe) -> None:
        self.probe, self.hand, self.device = probe, probe.hand, probe.device
        is_cuda, finger = bool(wp.get_device(self.device).is_cuda), finger_of_body(probe.hand)
        #: Points of a hand per thread, threads per hand, and hands processed at a time.
        self.lane, self.at_once = (1, GPU_HANDS) if is_cuda else (CPU_LANE, CPU_HANDS)
        self.lanes = -(-len(probe.points) // self.lane)
        self.fingers = max(1, int(finger.max()) + 1)
        with wp.ScopedDevice(self.device):
            for module in (touching, balance, opening, jamming, optimizers):
                wp.load_module(module=module, device=self.device)
            self.chain, self.points = chain_of(probe.hand, self.device), _upload_points(probe)
            self.effort = wp.array(probe.hand.effort, dtype=wp.float64)
            self.finger = wp.array(finger, dtype=wp.int32)  # (L,) finger of each body; -1 without finger

    def row_slices(self, count: int) -> list[slice]:
        return [slice(i, min(i + self.at_once, count)) for i in range(0, count, self.at_once)]

    def allocate_bodies(self, count: int) -> Any:
        with wp.ScopedDevice(self.device):
            return allocate_bodies(self.hand, count)

    def upload_roots(self, hand_pose: Floats) -> tuple[Any, Any]:
        """Return positions (about the object's centre of mass) and rotations of root poses (n, 7)."""
        with wp.ScopedDevice(self.device):
            position = wp.array(hand_pose[:, :3] - self.probe.obj.centre_of_mass, dtype=wp.vec3d)
            return position, wp.array(to_xyzw(hand_pose[:, 3:]), dtype=wp.quatd)

    def nearest_points(self, posture: Posture, reach: float) -> tuple[Any, Any]:
        """Return the bodies of posed hands, and the object's surface within `reach` [m] of their points."""
        count = len(posture)
        root = np.array(posture.hand_pose, float)
        root[:, :3] -= self.probe.obj.centre_of_mass
        bodies = posed_bodies(self.hand, root, posture.joint_positions, self.device)
        near, shape = touching.NearbySurface(), (count, len(self.probe.points))
        with wp.ScopedDevice(self.device):
            near.distance, near.cosine = wp.empty(shape, dtype=wp.float32), wp.empty(shape, dtype=wp.float64)
            near.closest, near.normal = (wp.empty(shape, dtype=wp.vec3) for _ in range(2))
            inputs = [self.probe.skin, self.points, self.lane, bodies, reach]
            launch(touching.find_nearby_surface, (count, self.lanes), inputs=inputs, outputs=[near])
        return bodies, near

    def count_touching_links(self, posture: Posture) -> NDArray[np.int32]:
        """Count (N,) bodies of posed hands with points closer to the object than `LINK_CONTACT_M`.
        The quality table also tests object points, so its number is at least as large."""
        return contact_links(self._gaps(posture, LINK_CONTACT_M, self.points.body.numpy(), self.hand.bodies))

    def finger_gaps(self, posture: Posture, reach: float) -> Floats:
        """Return the least distance (N, F) of each finger's points, at most `reach` [m], also without points."""
        return self._gaps(posture, reach, self.finger.numpy()[self.points.body.numpy()], self.fingers)

    def _gaps(self, posture: Posture, reach: float, part: NDArray[np.int32], count: int) -> Floats:
        """Return the least distance (N, count) of each part of the hand, at most `reach` [m].
        `part` (points,) is the part of each hand point; points with -1 are ignored."""
        found = np.full((len(posture), count), reach)
        for rows in self.row_slices(len(posture)):
            distance = self.nearest_points(posture.take(rows), reach)[1].distance.numpy()
            for one in np.unique(part[part >= 0]):
                found[rows, one] = distance[:, part == one].min(axis=1)
        return found


def _upload_points(probe: Probe) -> Any:
    points, out = probe.points, touching.Points()
    order = np.argsort(points.body, kind="stable")
    out.first = wp.array(np.searchsorted(points.body[order], np.arange(probe.hand.bodies + 1)), dtype=wp.int32)
    out.body = wp.array(points.body[order], dtype=wp.int32)
    out.position = wp.array(points.position[order], dtype=wp.vec3d)
    out.normal = wp.array(points.normal[order], dtype=wp.vec3d)
    return out


@cached_by_content(8)
def posture_data_of(hand: HandModel, obj: ObjectModel, *, points: int, device: str) -> PostureData:
    """Return the data of the pair on a device, with `points` hand points; cached in memory."""
    return PostureData(probe_of(hand, obj, hand_points=points, object_points=64, device=device))

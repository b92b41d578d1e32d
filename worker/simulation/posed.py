"""The bodies of many hands, placed by a kernel: what looks at hundreds of postures would spend most of its
time in NumPy's `body_poses` otherwise. Double precision, as there."""

from __future__ import annotations

import threading
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp
from cachetools import LRUCache

from service.model.transforms import Floats
from worker.hands.model import HandModel, JointType
from worker.simulation.device import to_xyzw
from worker.simulation.kernels import chain as kernels


@dataclass(frozen=True)
class PosedBodies:
    """The L bodies of a hand in P postures, object frame."""

    chain: Any
    """The hand, `kernels.chain.Chain`."""
    bodies: Any
    """Their poses (P, L), `kernels.chain.Bodies`."""

    @classmethod
    def of(cls, hand: HandModel, hand_pose: Floats, joint_positions: Floats, device: str = "cpu") -> PosedBodies:
        """Hands with roots (P, 7) and joint positions (P, J), as `body_poses` takes them."""
        chain, count = chain_of(hand, device), len(hand_pose)
        with wp.ScopedDevice(device):
            root, joints = (
                wp.array(np.ascontiguousarray(given, float), dtype=wp.float64, ndim=2)
                for given in (hand_pose, joint_positions)
            )
            bodies = room_for_bodies(hand, count)
            wp.launch(kernels.pose, count, inputs=[chain, root, joints], outputs=[bodies])
        return cls(chain, bodies)

    @property
    def position(self) -> Any:
        """(P, L) origins [m]."""
        return self.bodies.position

    @property
    def rotation(self) -> Any:
        """(P, L) quaternions."""
        return self.bodies.rotation


def room_for_bodies(hand: HandModel, count: int) -> Any:
    """Poses of so many hands, not filled in, on the present device."""
    out = kernels.Bodies()
    out.position = wp.empty((count, hand.bodies), dtype=wp.vec3d)
    out.rotation = wp.empty((count, hand.bodies), dtype=wp.quatd)
    return out


_chains: LRUCache[tuple[str, str], Any] = LRUCache(8)
_lock = threading.Lock()


def chain_of(hand: HandModel, device: str) -> Any:
    """The hand on a device as `kernels.chain.Chain`, from memory where it was used lately."""
    key = (hand.content, device)
    with _lock:
        if (found := _chains.get(key)) is None:
            # Loading here keeps threads from compiling the same module at once.
            wp.load_module(module=kernels, device=device)
            with wp.ScopedDevice(device):
                found = _chains[key] = _chain(hand)
        return found


def _chain(hand: HandModel) -> Any:
    """The hand as `kernels.chain.Chain`, on the present device."""
    out, features = kernels.Chain(), hand.features
    joint = np.zeros(hand.bodies, np.int32)
    joint[hand.joint_body] = np.arange(len(hand.joint_body))
    order = np.argsort(features.body, kind="stable")
    out.parent, out.joint = wp.array(hand.parent, dtype=wp.int32), wp.array(joint, dtype=wp.int32)
    out.turns = wp.array(hand.joint_type == JointType.REVOLUTE, dtype=wp.int32)
    out.origin_p = wp.array(hand.origin[:, :3], dtype=wp.vec3d)
    out.origin_q = wp.array(to_xyzw(hand.origin[:, 3:]), dtype=wp.quatd)
    out.axis = wp.array(hand.axis, dtype=wp.vec3d)
    out.dof = wp.array(hand.dof, dtype=wp.int32)
    out.multiplier = wp.array(hand.multiplier, dtype=wp.float64)
    out.offset = wp.array(hand.offset, dtype=wp.float64)
    out.tip = wp.array(np.isin(np.arange(hand.bodies), hand.fingertips), dtype=wp.int32)
    out.first = wp.array(np.searchsorted(features.body[order], np.arange(hand.bodies + 1)), dtype=wp.int32)
    out.centre = wp.array(features.centre[order], dtype=wp.vec3d)
    out.about = wp.array(features.axis[order], dtype=wp.vec3d)
    out.radius = wp.array(features.radius[order], dtype=wp.float64)
    return out

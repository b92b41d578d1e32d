"""Neighbours laid beside an object that is at rest: between walls, on a face that was chosen, or where many find room.

Each one rests as it fell by itself, so its pose is exact; the place and the turn about the vertical are drawn until its
hull is clear of walls and of the others.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Final

import mujoco
import numpy as np

from service.model.errors import SceneError
from service.model.transforms import Floats, compose, quat_from_axis_angle, quat_rotate
from worker.grasps import moved
from worker.objects.model import ObjectModel
from worker.scenes.kinds import GAP, SUNK
from worker.scenes.neighbours import add_hull
from worker.scenes.simulate import drop
from worker.simulation.surroundings import Obstacle

#: Least gap between two objects [m]; from walls it is that of the object, `GAP`.
BETWEEN: Final = 0.005
#: Draws of all neighbours of a scene, and of each of them.
_DRAWS: Final = 32
_PLACES: Final = 100
#: A neighbour's middle is at most this far from the object's, as a multiple of the sum of both bounding radii, and that
#: much farther with each draw that found no room.
_REACH: Final = 1.25
_FARTHER: Final = 0.1


def lay_beside(
    obj: ObjectModel,
    again: Callable[[int, int], Floats],
    others: Sequence[ObjectModel],
    supports: Sequence[Obstacle],
    *,
    within: tuple[float, float] | None = None,
    count: int,
    seed: int,
) -> tuple[Floats, Floats]:
    """Poses of an object (S, 7) and of its M neighbours (S, M, 7) that stand `BETWEEN` apart and clear of all supports.

    Args:
        obj: the object that is grasped.
        again: its pose (7,) in scene i at try k.
        others: the neighbours; each rests on z = 0.
        supports: what stands in the scene frame.
        within: x by y about the origin that they must not leave [m].
        count: number of scenes S.
        seed: any non-negative integer. Scene i depends on the objects, the supports, the seed and i alone.

    Raises:
        SceneError: there is no room for all of them.
        MeshError: one never comes to rest, or is flat.
    """
    resting = [drop(one, count=count, seed=_seed_of(seed, k))["scene/object_pose"] for k, one in enumerate(others)]
    hulls = _Hulls([obj, *others], supports, within)
    poses = np.zeros((count, 1 + len(others), 7))
    for scene in range(count):
        rest = [one[scene] for one in resting]
        for k in range(_DRAWS):
            target, rng = again(scene, k), np.random.default_rng([seed, scene, k, len(others)])
            if (found := _drawn(hulls, target, rest, _REACH + _FARTHER * k, rng)) is not None:
                poses[scene] = found
                break
        else:
            raise SceneError(
                f"there is no room for {len(others)} neighbours beside {obj.name} in scene {scene}: none of {_DRAWS} "
                f"draws left {1e3 * BETWEEN:.0f} mm between all of them; take fewer or smaller ones, or a wider scene"
            )
    poses = moved(poses, np.zeros(3))
    return poses[:, 0], poses[:, 1:]


def _seed_of(seed: int, number: int) -> int:
    """A seed of a neighbour's own: two of one object must not lie alike."""
    return int(np.random.SeedSequence([seed, 1 + number]).generate_state(1)[0])


def _drawn(
    hulls: _Hulls, target: Floats, resting: Sequence[Floats], reach: float, rng: np.random.Generator
) -> Floats | None:
    """(1 + M, 7) poses of one scene; None where no place was found for one of the neighbours."""
    placed = [target]
    middle = hulls.middle(0, target)
    for number, rest in enumerate(resting, start=1):
        far = reach * (hulls.objects[0].radius + hulls.objects[number].radius)
        for _ in range(_PLACES):
            pose = _turned(rest, rng.uniform(0, 2 * np.pi))
            low, high = hulls.room(number, pose)
            centre = hulls.middle(number, pose)
            low, high = np.maximum(low, middle - far - centre), np.minimum(high, middle + far - centre)
            if (low > high).any():
                continue
            pose[:2] += rng.uniform(low, high)
            if hulls.clear(number, pose) and hulls.apart([*placed, pose]):
                placed.append(pose)
                break
        else:
            return None
    return np.array(placed)


def _turned(pose: Floats, angle: float) -> Floats:
    """The pose turned about the vertical through the origin."""
    about = np.concatenate([np.zeros(3), quat_from_axis_angle(np.array([0.0, 0, 1]), np.asarray(angle))])
    return compose(about, pose)


class _Hulls:
    """The convex hulls of some objects, and how far they are from each other and from what stands around."""

    def __init__(
        self, objects: Sequence[ObjectModel], supports: Sequence[Obstacle], within: tuple[float, float] | None
    ) -> None:
        self.objects = objects
        self._supports = supports
        self._room = np.inf if within is None else np.asarray(within) / 2 - GAP
        spec: Any = mujoco.MjSpec()
        for number, one in enumerate(objects):
            add_hull(spec, spec.worldbody.add_body(mocap=True), str(number), one)
        self._model = spec.compile()
        self._data = mujoco.MjData(self._model)

    def middle(self, number: int, pose: Floats) -> Floats:
        """(2,) where an object's centre of mass stands."""
        return np.asarray((quat_rotate(pose[3:], self.objects[number].centre_of_mass) + pose[:3])[:2])

    def room(self, number: int, pose: Floats) -> tuple[Floats, Floats]:
        """(2,) and (2,) least and greatest shift along x and y that keeps an object within the walls."""
        corners = self._corners(number, pose)[:, :2]
        return -self._room - corners.min(axis=0), self._room - corners.max(axis=0)

    def clear(self, number: int, pose: Floats) -> bool:
        """Whether an object is `GAP` away from every support that it does not stand on."""
        corners = self._corners(number, pose)
        return all(_beyond(support, corners) for support in self._supports)

    def _corners(self, number: int, pose: Floats) -> Floats:
        return quat_rotate(pose[3:], self.objects[number].hull_vertices) + pose[:3]

    def apart(self, poses: Sequence[Floats]) -> bool:
        """Whether the last of the poses, of the first objects, is `BETWEEN` away from the others."""
        last = len(poses) - 1
        self._data.mocap_pos[: last + 1] = [pose[:3] for pose in poses]
        self._data.mocap_quat[: last + 1] = [pose[3:] for pose in poses]
        mujoco.mj_kinematics(self._model, self._data)
        gaps = (mujoco.mj_geomDistance(self._model, self._data, k, last, BETWEEN, None) for k in range(last))
        return all(gap >= BETWEEN for gap in gaps)


def _beyond(support: Obstacle, corners: Floats) -> bool:
    """Whether a hull lies beyond one plane of a support: on it where the plane looks up, else `GAP` away.

    A plane between two convex bodies parts them; where only an edge against an edge would, this says no.
    """
    room = (corners @ support.planes[:, :3].T - support.planes[:, 3]).min(axis=0)
    least = np.where(support.planes[:, 2] > 1 - 1e-6, -SUNK, GAP)
    return bool((room >= least).any())

"""What a viewer shows of hand, object and scene, as nodes of viser's scene tree. Metres; poses x y z, w x y z."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from service.model.scene_spec import Box, HalfSpace
from service.model.transforms import Floats
from service.readers.ways import Waypoint
from worker.hands.kinematics import body_poses
from worker.hands.model import HandModel
from worker.objects.model import ObjectModel
from worker.quality.probe import Probe, probe_of
from worker.rendering.hands import drawn_parts, drawn_poses, without_visuals
from worker.scenes.neighbours import Neighbours

#: Points of the hand whose distance from the object is shown, where it is less than this [m].
POINTS: Final = 3000
NEAR_M: Final = 0.005
_OBJECT: Final = (232, 184, 120)
_NEIGHBOUR: Final = (180, 174, 191)
_TABLE: Final = (207, 212, 214)
_WALL: Final = (143, 163, 176)
_DISC_M: Final = 0.32
#: Signed distance [m] and colour: red inside, green touching, blue near; lightness changes too.
_STOPS: Final = (-0.001, -0.0002, 0.0003, 0.002, NEAR_M)
_COLOURS: Final = np.array([(209, 38, 60), (240, 128, 60), (20, 184, 122), (53, 162, 240), (185, 212, 245)], np.float64)

Supports = Sequence[HalfSpace | Box]


class Models:
    """Nodes under `/grasp` (the frame of the object at rest) and `/scene`."""

    def __init__(self, scene: Any, hand: HandModel, obj: ObjectModel, *, mounted: bool = False) -> None:
        """Build the nodes; with those of the links above the hand's root if it is `mounted`."""
        self._scene, self._hand, self._mounted = scene, hand, mounted
        self._probe: Probe = probe_of(hand, obj, hand_points=POINTS, object_points=64)
        scene.set_up_direction("+z")
        self.rest = scene.add_frame("/grasp", show_axes=False)
        self.thing = scene.add_frame("/grasp/object", show_axes=False)
        scene.add_mesh_simple("/grasp/object/mesh", obj.vertices, obj.faces, color=_OBJECT, flat_shading=True)
        self.bodies = self._nodes(hand, "hand")
        #: The hand as the engine sees it, where it looks otherwise.
        self._bare = without_visuals(hand) if hand.visuals.meshes else None
        self.collisions = self._nodes(self._bare, "collision") if self._bare else []
        self.show_collision(False)
        self.contacts: Any = None
        self._around: list[Any] = []

    def _nodes(self, hand: HandModel, name: str) -> list[Any]:
        nodes = []
        for number, part in enumerate(drawn_parts(hand, mounted=self._mounted)):
            colour = tuple(round(255 * _srgb(share)) for share in part.look.base)
            path, solid = f"/grasp/{name}/{number}", part.solid
            nodes.append(
                self._scene.add_mesh_simple(path, solid.vertices, solid.faces, color=colour, flat_shading=True)
            )
        return nodes

    def show_collision(self, on: bool) -> None:
        """Whether the hand is drawn by its collision shapes, where it has other looks."""
        if self.collisions:
            for nodes, shown in ((self.bodies, not on), (self.collisions, on)):
                for node in nodes:
                    node.visible = shown

    def surround(self, supports: Supports, object_pose: Floats, neighbours: Neighbours | None, number: int) -> None:
        """Build the scene anew around an object at a pose (7,); `number` is the scene's, of the neighbours' poses."""
        for node in self._around:
            node.remove()
        self._around = []
        _place(self.rest, object_pose)
        for k, support in enumerate(supports):
            if isinstance(support, Box):
                node = self._scene.add_box(
                    f"/scene/support{k}", color=_WALL, dimensions=support.size, opacity=0.35, cast_shadow=False
                )
                _place(node, np.asarray(support.pose, float))
            else:
                node = self._scene.add_mesh_simple(
                    f"/scene/support{k}", *_disc(support, object_pose[:3]), color=_TABLE, side="front"
                )
            self._around.append(node)
        for k, other in enumerate(neighbours.objects if neighbours else ()):
            node = self._scene.add_mesh_simple(
                f"/scene/neighbour{k}", other.vertices, other.faces, color=_NEIGHBOUR, flat_shading=True
            )
            assert neighbours is not None
            _place(node, neighbours.poses[number, k])
            self._around.append(node)

    def show_scene(self, on: bool) -> None:
        """Whether supports and neighbours are drawn."""
        for node in self._around:
            node.visible = on

    def pose(self, point: Waypoint, *, wrist: Floats | None = None, contacts: bool) -> Floats:
        """Take a posture, of a mounted hand at wrist angles (1, U); the distances (P,) of the hand's points from the
        object [m], at most the probe's reach."""
        posture = point.hand_pose[None], point.joint_positions[None]
        for hand, nodes in ((self._hand, self.bodies), (self._bare, self.collisions)):
            if hand is not None:
                for node, pose in zip(nodes, drawn_poses(hand, *posture, wrist)[0], strict=True):
                    _place(node, pose)
        self.thing.position = point.carried
        # The probe's object stays where it rests.
        points = self._probe.posed_points(body_poses(self._hand, *posture))[0] - point.carried
        distance = np.asarray(self._probe.signed_distance(points)[0])
        near = distance < NEAR_M
        if self.contacts is not None:
            self.contacts.remove()
        shown = near & contacts
        self.contacts = self._scene.add_point_cloud(
            "/grasp/object/contacts",
            points[shown].astype(np.float32),
            _colours(distance[shown]),
            point_size=0.0022,
            point_shape="circle",
            precision="float32",
        )
        return distance


def _place(node: Any, pose: Floats) -> None:
    node.position = pose[:3]
    node.wxyz = pose[3:] / np.linalg.norm(pose[3:])


def _disc(plane: HalfSpace, middle: Floats, corners: int = 96) -> tuple[Floats, NDArray[np.int64]]:
    """The plane of a half-space about the foot of a point, seen from outside only."""
    normal = np.asarray(plane.normal, float)
    length = float(np.linalg.norm(normal))
    normal = normal / length
    beside = np.cross(normal, [1.0, 0, 0] if abs(normal[0]) < 0.9 else [0, 1.0, 0])
    beside /= np.linalg.norm(beside)
    foot = middle + (plane.offset / length - normal @ middle) * normal
    angle = np.linspace(0, 2 * np.pi, corners, endpoint=False)[:, None]
    ring = foot + _DISC_M * (np.cos(angle) * beside + np.sin(angle) * np.cross(normal, beside))
    turn = np.arange(corners)
    return np.concatenate([foot[None], ring]), np.stack([0 * turn, 1 + turn, 1 + (turn + 1) % corners], axis=1)


def _colours(distance: Floats) -> NDArray[np.uint8]:
    parts = [np.interp(distance, _STOPS, _COLOURS[:, k]) for k in range(3)]
    return np.stack(parts, axis=-1).astype(np.uint8)


def _srgb(linear: float) -> float:
    return 12.92 * linear if linear <= 0.0031308 else 1.055 * linear ** (1 / 2.4) - 0.055

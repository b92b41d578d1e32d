"""Pictures of grasps: hand and object alone before a plain backdrop, from given sides."""

from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from graspd.service.model.colours import linear_rgb_from_hex
from graspd.service.model.transforms import IDENTITY_POSE, Floats, apply, quat_rotate
from graspd.worker.execution_context import DEFAULT_CONTEXT, ExecutionContext
from graspd.worker.grasps import move_poses
from graspd.worker.hands.kinematics import body_poses
from graspd.worker.hands.model import HandModel
from graspd.worker.objects.model import ObjectModel
from graspd.worker.rendering.cameras import Cameras, direction_of, intrinsics, look_at
from graspd.worker.rendering.hands import drawn_bodies, hand_parts
from graspd.worker.rendering.scenery import Appearance, CameraShot, Lamp, Solid
from graspd.worker.rendering.tracer import Tracer

#: Sides 120 degrees apart, measured from the side view of the hand [rad].
THREE_SIDES: Final = tuple(np.radians([-35.0, 85.0, 205.0]).tolist())
ELEVATION: Final = np.radians(20.0)
FIELD_OF_VIEW: Final = np.radians(24.0)
SAMPLES: Final = 12
#: Hand parts farther than this from the object's bounding ball are not framed [m]: a forearm may leave the picture.
NEAR_M: Final = 0.14
_TOGETHER: Final = 16  # grasps traced together: bounds the memory

_FILL: Final = 0.86  # share of the picture's width or height that hand and object take up
#: Direction of the lamp: left of the camera, above it, in front of the object. The camera looks along -x.
TOWARD_LAMP: Final = np.array([0.45, -0.45, 0.77]) / np.linalg.norm([0.45, -0.45, 0.77])
OBJECT_LOOK: Final = Appearance(linear_rgb_from_hex("#dd7432"), roughness=0.5)
STUDIO: Final = Lamp(
    key=(1.85, 1.8, 1.7),
    sky=(0.76, 0.79, 0.84),
    ground=(0.3, 0.29, 0.28),
    backdrop_low=(1.15, 1.17, 1.19),
    backdrop_high=(1.4, 1.42, 1.44),
)


def grasp_pictures(
    hand: HandModel,
    obj: ObjectModel,
    hand_pose: Floats,
    joint_positions: Floats,
    size: tuple[int, int] = (320, 320),
    azimuths: Sequence[float] = THREE_SIDES[:1],
    *,
    run: ExecutionContext = DEFAULT_CONTEXT,
    samples: int = SAMPLES,
) -> NDArray[np.uint8]:
    """Render hands at root poses (N, 7) in the object frame from A sides; return sRGB (N, A, H, W, 3).
    Azimuths [rad] are about the object's z axis; 0 looks across the direction in which the palm approaches. Object and
    hand fill the picture of `size` [px]. Raises TaskCancelled: `run.cancelled()` returned True."""
    hand_pose = move_poses(np.atleast_2d(np.asarray(hand_pose, float)), np.negative(obj.centre))
    obj = obj.centred
    joints = np.atleast_2d(np.asarray(joint_positions, float))
    thing = Solid(obj.vertices, obj.faces, obj.corner_normals)
    stage = Tracer([thing, *(part.solid for part in hand_parts(hand))], run.device)
    shots = []
    for start in range(0, len(hand_pose), _TOGETHER):
        part = slice(start, start + _TOGETHER)
        bodies = body_poses(hand, hand_pose[part], joints[part])
        shots.append(_render_sides(stage, hand, obj, bodies, size, azimuths, samples, run))
    empty = np.zeros((0, len(azimuths), size[1], size[0], 3), np.uint8)
    return np.concatenate([empty, *shots])


def _render_sides(
    stage: Tracer,
    hand: HandModel,
    obj: ObjectModel,
    bodies: Floats,
    size: tuple[int, int],
    azimuths: Sequence[float],
    samples: int,
    run: ExecutionContext,
) -> NDArray[np.uint8]:
    worlds, parts = len(bodies), hand_parts(hand)
    points = np.concatenate([np.tile(obj.hull_vertices, (worlds, 1, 1)), hand_points(hand, bodies)], axis=1)
    poses = np.concatenate([np.tile(IDENTITY_POSE, (worlds, 1, 1)), bodies[:, drawn_bodies(hand)]], axis=1)
    stage.place(poses, [[OBJECT_LOOK, *(part.look for part in parts)]] * worlds)
    k = intrinsics(*size, FIELD_OF_VIEW)
    sides = []
    for azimuth in azimuths:
        angles = np.array([side_azimuth(hand, world) + azimuth for world in bodies])
        cameras = np.stack([_fit_grasp_camera(obj, points[w], angles[w], k, size) for w in range(worlds)])
        sides.append(stage.render(studio_shot(cameras, k, size, angles, samples), run.without_progress()).rgb)
    return np.stack(sides, axis=1)


def studio_shot(
    cameras: Floats,
    k: Floats,
    size: tuple[int, int],
    angles: Floats,
    samples: int,
    *,
    world: NDArray[np.intp] | None = None,
    toward_lamp: Floats = TOWARD_LAMP,
) -> CameraShot:
    """Return cameras (V, 4, 4) in studio light that turns with `angles` (worlds,) [rad]: no side is dark.
    `world` (V,) is the world of each camera; by default, camera k is in world k."""
    return CameraShot(
        world=(np.arange(len(angles)) if world is None else world).astype(np.int32),
        extrinsics=cameras,
        intrinsics=k,
        width=size[0],
        height=size[1],
        samples=samples,
        toward_lamp=toward_lamp,
        turn=-angles,
        lamps=[STUDIO] * len(angles),
    )


def side_azimuth(hand: HandModel, bodies: Floats) -> float:
    """Return the azimuth of a camera that looks across the palm's direction of approach [rad]."""
    towards = quat_rotate(bodies[0, 3:], hand.palm.approach)
    # For a vertical approach of the palm, the x axis of the hand's root is used.
    flat = towards[:2] if np.hypot(*towards[:2]) > 0.2 else quat_rotate(bodies[0, 3:], np.array([1.0, 0, 0]))[:2]
    return float(np.arctan2(flat[1], flat[0]) + 0.5 * np.pi)


def _fit_grasp_camera(obj: ObjectModel, points: Floats, angle: float, k: Floats, size: tuple[int, int]) -> Floats:
    middle = 0.5 * (obj.hull_vertices.min(axis=0) + obj.hull_vertices.max(axis=0))
    reach = np.linalg.norm(obj.hull_vertices - middle, axis=1).max()
    return fit_camera(points[np.linalg.norm(points - middle, axis=1) < reach + NEAR_M], angle, k, size)


def fit_camera(near: Floats, angle: float, k: Floats, size: tuple[int, int], *, elevation: float = ELEVATION) -> Floats:
    """Return extrinsics (4, 4) of a camera at azimuth `angle` [rad] that frames the points (P, 3)."""
    centre = 0.5 * (near.min(axis=0) + near.max(axis=0))
    direction = direction_of(angle, elevation)
    distance = 4.0 * float(np.linalg.norm(near - centre, axis=1).max())
    # Perspective changes with the distance; after three rounds the error is below a per cent.
    for _ in range(3):
        camera = Cameras(*size, k, look_at(centre + distance * direction, centre)[None])
        (pixels,), _ = camera.project(near)
        low, high = pixels.min(axis=0), pixels.max(axis=0)
        depth_ray = np.linalg.inv(k) @ np.append(0.5 * (low + high), 1.0) * distance
        centre = centre + camera.extrinsics[0, :3, :3].T @ (depth_ray * [1, 1, 0])
        distance *= float(np.max((high - low) / np.asarray(size))) / _FILL
    return look_at(centre + distance * direction, centre)


def hand_points(hand: HandModel, bodies: Floats) -> Floats:
    """Return the corners (N, P, 3) of all pieces in the object frame."""
    body = np.concatenate([np.full(len(piece.vertices), piece.body) for piece in hand.pieces])
    corners = np.concatenate([piece.vertices for piece in hand.pieces])
    return apply(bodies[:, body], corners)

"""Pictures of a hand or an object alone, for a user to check the model."""

from collections.abc import Sequence
from pathlib import Path
from typing import Final

import manifold3d
import numpy as np
from numpy.typing import ArrayLike, NDArray
from PIL import Image, ImageDraw

from graspd.service.model.colours import linear_rgb_from_hex
from graspd.service.model.errors import InputError
from graspd.service.model.transforms import IDENTITY_POSE, Floats, apply, compose, quat_from_matrix
from graspd.worker.hands.closing import closing_posture
from graspd.worker.hands.kinematics import body_poses
from graspd.worker.hands.model import HandModel
from graspd.worker.objects.mesh_geometry import corner_normals
from graspd.worker.objects.model import ObjectModel
from graspd.worker.objects.topology import from_manifold
from graspd.worker.rendering import pictures, sheets
from graspd.worker.rendering.cameras import intrinsics
from graspd.worker.rendering.hands import drawn_bodies, hand_parts
from graspd.worker.rendering.scenery import Appearance, Solid
from graspd.worker.rendering.tracer import Tracer

#: Size of one picture of a portrait [px].
SIZE: Final = (340, 360)
_SAMPLES: Final = 16
_CAPTION: Final = 30
_COLUMNS: Final = 3
#: Share of the motion from open to closed at which a hand is shown closing.
_CLOSING_SHARE: Final = 0.6
_ARROW: Final = Appearance(linear_rgb_from_hex("#dd7432"), roughness=0.5)
_ARROW_SHARE: Final = 0.4  # ratio of the arrow's length to the largest extent of the hand
#: Azimuths of the views [rad]: the approach points mainly right in the first, and towards the camera in the second.
_HAND_AZIMUTHS: Final = tuple(np.radians([32.0, 122.0]).tolist())
_OBJECT_AZIMUTHS: Final = tuple(np.radians([-50.0, 40.0, 130.0]).tolist())


def hand_portrait(hand: HandModel) -> Image.Image:
    """Draw the hand open, in its pre-shape and closing, from two sides, with an arrow for the approach."""
    parts, upright = hand_parts(hand), _upright_pose(hand)
    named = {
        "open": closing_posture(hand, 0.0),
        "pre-shape": hand.preshape,
        "closing": closing_posture(hand, _CLOSING_SHARE),
    }
    joints = hand.expand(np.array(list(named.values())))
    bodies = np.array(body_poses(hand, np.tile(upright, (len(named), 1)), joints))
    corners = [apply(bodies[:, piece.body, None], piece.vertices) for piece in hand.pieces]
    extent = float(np.ptp(np.concatenate(corners, axis=1), axis=(0, 1)).max())
    arrow = _arrow(_ARROW_SHARE * extent)
    palm = compose(upright, np.concatenate([hand.palm.centre, _quat_of_z(hand.palm.approach)]))
    points = np.concatenate([*(c.reshape(-1, 3) for c in corners), apply(palm, arrow.vertices)])
    poses = np.concatenate([bodies[:, drawn_bodies(hand)], np.tile(palm, (len(named), 1, 1))], axis=1)
    azimuths = np.repeat(_HAND_AZIMUTHS, len(named))
    looks = [*(part.look for part in parts), _ARROW]
    solids = [*(part.solid for part in parts), arrow]
    return _compose_page(_render_worlds(solids, np.tile(poses, (2, 1, 1)), looks, points, azimuths), [*named] * 2)


def object_portrait(obj: ObjectModel) -> Image.Image:
    """Draw the prepared mesh from three sides, z up."""
    obj = obj.centred
    solid = Solid(obj.vertices, obj.faces, obj.corner_normals)
    extents = " x ".join(f"{1e3 * extent:.0f}" for extent in np.ptp(obj.vertices, axis=0))
    captions = [f"{obj.name}, {extents} mm", f"{len(obj.faces)} faces", f"within {1e3 * obj.deviation_m:.2f} mm"]
    poses = np.tile(IDENTITY_POSE, (len(captions), 1, 1))
    return _compose_page(
        _render_worlds([solid], poses, [pictures.OBJECT_LOOK], obj.vertices, _OBJECT_AZIMUTHS), captions
    )


def write_png(image: Image.Image, path: Path) -> None:
    """Write a PNG; raise InputError if the file cannot be written."""
    try:
        path.write_bytes(sheets.png_bytes(image))
    except OSError as error:
        raise InputError(f"{path} cannot be written: {error.strerror}") from None


def _render_worlds(
    solids: Sequence[Solid], poses: Floats, looks: list[Appearance], points: Floats, azimuths: ArrayLike
) -> NDArray[np.uint8]:
    """Render N worlds (N, H, W, 3), each from its azimuth; every camera frames the same points."""
    stage = Tracer(solids, "cpu")
    stage.place(poses, [looks] * len(poses))
    k = intrinsics(*SIZE, pictures.FIELD_OF_VIEW)
    angles = np.asarray(azimuths, float)
    cameras = np.stack([pictures.fit_camera(points, angle, k, SIZE) for angle in angles])
    return stage.render(pictures.studio_shot(cameras, k, SIZE, angles, _SAMPLES)).rgb


def _compose_page(shown: NDArray[np.uint8], captions: Sequence[str]) -> Image.Image:
    width, height = SIZE[0], SIZE[1] + _CAPTION
    page = Image.new("RGB", (_COLUMNS * width, len(shown) // _COLUMNS * height), sheets.PAPER)
    draw = ImageDraw.Draw(page)
    for number, (picture, caption) in enumerate(zip(shown, captions, strict=True)):
        row, column = divmod(number, _COLUMNS)
        page.paste(Image.fromarray(picture), (column * width, row * height))
        sheets.draw_text(draw, (column * width + 12, row * height + SIZE[1] + 21), caption, 15, sheets.INK)
    return page.quantize(192, dither=Image.Dither.NONE)


def _upright_pose(hand: HandModel) -> Floats:
    """Return the root pose with fingertips up and the approach along +y, to the right seen from +x."""
    poses = body_poses(hand, IDENTITY_POSE, hand.expand(closing_posture(hand, 0.0)))[0]
    centres = {piece.body: apply(poses[piece.body], piece.vertices).mean(axis=0) for piece in hand.pieces}
    tips = np.mean([centres.get(body, poses[body, :3]) for body in hand.fingertips], axis=0)
    forward, up = hand.palm.approach, tips - hand.palm.centre
    up = up - (up @ forward) * forward
    if np.linalg.norm(up) < 0.35 * np.linalg.norm(tips - hand.palm.centre):
        # A gripper's fingers point along its approach: it hangs, as over a table.
        up, forward = -forward, np.eye(3)[int(np.argmin(np.abs(forward)))]
        forward = forward - (forward @ up) * up / (up @ up)
    rows = [np.cross(forward, up), forward, up]
    rotation = np.array([row / np.linalg.norm(row) for row in rows])
    return np.concatenate([np.zeros(3), quat_from_matrix(rotation)])


def _quat_of_z(direction: Floats) -> Floats:
    """Return the quaternion w x y z of a rotation that takes z to `direction`."""
    side = np.cross(np.eye(3)[int(np.argmin(np.abs(direction)))], direction)
    side /= np.linalg.norm(side)
    return quat_from_matrix(np.stack([side, np.cross(direction, side), direction], axis=1))


def _arrow(length: float) -> Solid:
    shaft = manifold3d.Manifold.cylinder(0.72 * length, 0.03 * length, 0.03 * length, 32)
    head = manifold3d.Manifold.cylinder(0.28 * length, 0.09 * length, 0.0, 32).translate((0, 0, 0.72 * length))
    vertices, faces = from_manifold(shaft + head)
    return Solid(vertices, faces.astype(np.int32), corner_normals(vertices, faces.astype(np.int32)))

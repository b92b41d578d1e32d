"""Pictures of a hand or an object alone, for a user to check the model."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Final

import manifold3d
import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from graspd.service.model.colours import hexadecimal
from graspd.service.model.errors import InputError
from graspd.service.model.transforms import IDENTITY_POSE, Floats, apply, compose, quat_from_matrix
from graspd.worker.hands.closing import posture
from graspd.worker.hands.jaws import pads_of
from graspd.worker.hands.kinematics import body_poses
from graspd.worker.hands.model import HandModel
from graspd.worker.objects.mesh_geometry import corner_normals, from_manifold
from graspd.worker.objects.model import ObjectModel
from graspd.worker.rendering import sheets
from graspd.worker.rendering.cameras import intrinsics
from graspd.worker.rendering.hands import hand_parts, without_visuals
from graspd.worker.rendering.pictures import (
    FIELD_OF_VIEW,
    FLOOR,
    FLOOR_SIZE,
    OBJECT_LOOK,
    fit_camera,
    floor_pose,
    studio_shot,
)
from graspd.worker.rendering.scenery import Appearance, Box, Solid
from graspd.worker.rendering.tracer import Tracer

#: Size of one picture of a portrait [px].
SIZE: Final = (340, 360)
_SAMPLES: Final = 16
_CAPTION: Final = 30
#: Share of the motion from open to closed at which a hand is shown closing.
_CLOSING_SHARE: Final = 0.6
_ARROW: Final = Appearance(hexadecimal("#dd7432"), roughness=0.5)
_CLOSING: Final = Appearance(hexadecimal("#2fa7a0"), roughness=0.5)
_PAD: Final = Appearance(hexadecimal("#d6409f"), roughness=0.5)
#: Radius of a pad's dots over the largest extent of the hand; most dots of a pad.
_DOT_SHARE: Final = 0.008
_DOTS: Final = 60
#: Axes x, y, z of the palm's frame.
_AXES: Final = tuple(Appearance(hexadecimal(code), roughness=0.5) for code in ("#c8343c", "#3c9a4a", "#3566c8"))
_FRAME_SHARE: Final = 0.25
_CLOSING_ARROW_SHARE: Final = 0.22
_OPACITY: Final = 0.35
_AWAY_M: Final = -50.0  # position of parts that are not drawn [m]
#: Views of a hand, by the camera's azimuth [rad].
_SIDES: Final = {"from the right": 0.0, "from behind": np.radians(-90.0), "from the front": np.radians(90.0)}
_ARROW_SHARE: Final = 0.4  # length of the arrow over the largest extent of the hand
#: View towards the palm from the side on which the approach points right [rad].
_HAND_AZIMUTH: Final = np.radians(32.0)
_OBJECT_AZIMUTHS: Final = tuple(np.radians([-50.0, 40.0, 130.0]).tolist())


def hand_portrait(hand: HandModel) -> Image.Image:
    """Draw the hand open, in its pre-shape and closing; an arrow on the palm's centre shows the approach."""
    parts, upright = hand_parts(hand), _upright(hand)
    named = {"open": posture(hand, 0.0), "pre-shape": hand.preshape, "closing": posture(hand, _CLOSING_SHARE)}
    joints = hand.expand(np.array(list(named.values())))
    bodies = np.array(body_poses(hand, np.tile(upright, (len(named), 1)), joints))
    corners = [apply(bodies[:, piece.body, None], piece.vertices) for piece in hand.pieces]
    extent = float(np.ptp(np.concatenate(corners, axis=1), axis=(0, 1)).max())
    arrow = _arrow(_ARROW_SHARE * extent)
    palm = compose(upright, np.concatenate([hand.palm.centre, _quat_of_z(hand.palm.approach)]))
    points = np.concatenate([*(c.reshape(-1, 3) for c in corners), apply(palm, arrow.vertices)])
    poses = np.concatenate([bodies[:, [part.body for part in parts]], np.tile(palm, (len(named), 1, 1))], axis=1)
    looks = [*(part.look for part in parts), _ARROW]
    solids = [*(part.solid for part in parts), arrow]
    return _row(_shoot(solids, poses, looks, points, [_HAND_AZIMUTH] * len(named)), list(named))


def hand_sides(hand: HandModel) -> Image.Image:
    """Draw the hand's collision shapes, about to close, from three sides; the palm is half transparent.

    Three thin arrows are the palm's frame (x red, y green, z blue: the approach). The orange arrow is the approach;
    teal arrows show the motion of each fingertip as the hand closes. Pink dots are the pads: the contact sides of jaws,
    or the inner sides of fingertips.
    """
    bare = without_visuals(hand)
    parts, upright = hand_parts(bare), _upright(bare)
    closer = np.clip(bare.preshape + 0.1 * bare.closing * bare.span, bare.lower, bare.upper)
    bodies, after = np.array(body_poses(bare, np.tile(upright, (2, 1)), bare.expand(np.stack([bare.preshape, closer]))))
    corners: dict[int, list[Floats]] = {body: [] for body in range(bare.bodies)}
    for piece in bare.pieces:
        corners[piece.body].append(piece.vertices)
    shaped = {body: np.concatenate(parts) for body, parts in corners.items() if parts}
    points = np.concatenate([apply(bodies[body], vertices) for body, vertices in shaped.items()])
    extent = float(np.ptp(points, axis=0).max())
    palm = compose(upright, np.concatenate([bare.palm.centre, _quat_of_z(bare.palm.approach)]))
    marks = [(_arrow(_ARROW_SHARE * extent), _ARROW, palm)]
    for axis, look in zip(np.eye(3), _AXES, strict=True):
        frame = np.concatenate([np.zeros(3), _quat_of_z(axis)])
        marks.append((_arrow(_FRAME_SHARE * extent), look, compose(palm, frame)))
    for tip in bare.fingertips:
        centre = shaped[tip].mean(axis=0) if tip in shaped else np.zeros(3)
        start, end = apply(bodies[tip], centre), apply(after[tip], centre)
        if np.linalg.norm(end - start) > 1e-6:
            way = np.concatenate([start, _quat_of_z((end - start) / np.linalg.norm(end - start))])
            marks.append((_arrow(_CLOSING_ARROW_SHARE * extent), _CLOSING, way))
    marks += [
        (_dots(pad.points, _DOT_SHARE * extent), _PAD, bodies[pad.body]) for pad in pads_of(hand) if len(pad.points)
    ]
    poses = np.stack([*(bodies[part.body] for part in parts), *(pose for _, _, pose in marks)])
    solids = [*(part.solid for part in parts), *(solid for solid, _, _ in marks)]
    looks = [*(part.look for part in parts), *(look for _, look, _ in marks)]
    seen = np.concatenate([points, *(apply(pose, solid.vertices) for solid, _, pose in marks)])
    without = poses.copy()
    without[[number for number, part in enumerate(parts) if part.body == 0], 2] = _AWAY_M
    whole, open_ = (
        _shoot(solids, np.tile(row, (len(_SIDES), 1, 1)), looks, seen, list(_SIDES.values())).astype(float)
        for row in (poses, without)
    )
    blended = (_OPACITY * whole + (1 - _OPACITY) * open_).round().astype(np.uint8)
    return _page(blended, list(_SIDES))


def above(first: Image.Image, second: Image.Image) -> Image.Image:
    """Stack two pictures vertically."""
    page = Image.new("RGB", (max(first.width, second.width), first.height + second.height), sheets.PAPER)
    page.paste(first.convert("RGB"), (0, 0))
    page.paste(second.convert("RGB"), (0, first.height))
    return page


def object_portrait(obj: ObjectModel) -> Image.Image:
    """Draw the prepared mesh from three sides, z up."""
    obj = obj.centred
    solid = Solid(obj.vertices, obj.faces, obj.corner_normals)
    extents = " x ".join(f"{1e3 * extent:.0f}" for extent in np.ptp(obj.vertices, axis=0))
    captions = [f"{obj.name}, {extents} mm", f"{len(obj.faces)} faces", f"within {1e3 * obj.deviation_m:.2f} mm"]
    poses = np.tile(IDENTITY_POSE, (len(captions), 1, 1))
    return _row(_shoot([solid], poses, [OBJECT_LOOK], obj.vertices, _OBJECT_AZIMUTHS), captions)


def write_png(image: Image.Image, path: Path) -> None:
    """Write a PNG; raise InputError if the file cannot be written."""
    try:
        path.write_bytes(sheets.png(image))
    except OSError as error:
        raise InputError(f"{path} cannot be written: {error.strerror}") from None


def _shoot(
    solids: Sequence[Solid], poses: Floats, looks: list[Appearance], points: Floats, azimuths: Sequence[float]
) -> NDArray[np.uint8]:
    """Render W worlds (W, H, W, 3), each from its azimuth; every camera frames the same points."""
    worlds = len(poses)
    stage = Tracer([Box(FLOOR_SIZE), *solids], "cpu")
    floors = np.tile(floor_pose(points), (worlds, 1, 1))
    stage.place(np.concatenate([floors, poses], axis=1), [[FLOOR, *looks]] * worlds)
    k = intrinsics(*SIZE, FIELD_OF_VIEW)
    cameras = np.stack([fit_camera(points, angle, k, SIZE) for angle in azimuths])
    return stage.shoot(studio_shot(cameras, k, SIZE, np.asarray(azimuths), _SAMPLES)).rgb


def _row(pictures: NDArray[np.uint8], captions: Sequence[str]) -> Image.Image:
    return _page(pictures, captions).quantize(192, dither=Image.Dither.NONE)


def _page(pictures: NDArray[np.uint8], captions: Sequence[str]) -> Image.Image:
    width, height = SIZE
    page = Image.new("RGB", (width * len(pictures), height + _CAPTION), sheets.PAPER)
    draw = ImageDraw.Draw(page)
    for number, (picture, caption) in enumerate(zip(pictures, captions, strict=True)):
        page.paste(Image.fromarray(picture), (number * width, 0))
        sheets.text(draw, (number * width + 12, height + 21), caption, 15, sheets.INK)
    return page


def _upright(hand: HandModel) -> Floats:
    """Return the root pose with the approach along +y, right of a camera on +x, and fingertips up."""
    poses = body_poses(hand, IDENTITY_POSE, hand.expand(posture(hand, 0.0)))[0]
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


def _dots(points: Floats, radius: float) -> Solid:
    """Return small balls at points (P, 3), thinned to `_DOTS`."""
    ball = manifold3d.Manifold.sphere(radius, 12)
    few = points[:: max(1, -(-len(points) // _DOTS))]
    vertices, faces = from_manifold(ball)
    corners = (few[:, None] + vertices[None]).reshape(-1, 3)
    every = (np.arange(len(few))[:, None, None] * len(vertices) + faces[None]).reshape(-1, 3).astype(np.int32)
    return Solid(corners, every, corner_normals(corners, every))


def _arrow(length: float) -> Solid:
    shaft = manifold3d.Manifold.cylinder(0.72 * length, 0.03 * length, 0.03 * length, 32)
    head = manifold3d.Manifold.cylinder(0.28 * length, 0.09 * length, 0.0, 32).translate((0, 0, 0.72 * length))
    vertices, faces = from_manifold(shaft + head)
    return Solid(vertices, faces.astype(np.int32), corner_normals(vertices, faces.astype(np.int32)))

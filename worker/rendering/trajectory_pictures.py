"""Pictures and animations of grasps along their trajectories, from the sides that show most."""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from graspd.service.model.colours import linear_rgb_from_hex
from graspd.service.model.errors import InputError
from graspd.service.model.scene_spec import HalfSpace
from graspd.service.model.transforms import IDENTITY_POSE, Floats, apply, compose
from graspd.service.readers.trajectories import Waypoint
from graspd.worker.execution_context import DEFAULT_CONTEXT, ExecutionContext
from graspd.worker.grasps import move_poses
from graspd.worker.hands.kinematics import body_poses
from graspd.worker.hands.model import HandModel
from graspd.worker.objects.mesh_geometry import to_centred_frame
from graspd.worker.objects.model import ObjectModel
from graspd.worker.rendering import pictures as studio
from graspd.worker.rendering.cameras import intrinsics, look_at
from graspd.worker.rendering.hands import drawn_bodies, drawn_parts, drawn_poses
from graspd.worker.rendering.scenery import Appearance, Solid, Supports, slab_poses, slabs, visible_share
from graspd.worker.rendering.tracer import Tracer
from graspd.worker.scenes.neighbours import Neighbours

#: Postures in a strip of pictures: of a grasp with a lift, and of a free grasp.
STRIP: Final = ("standoff", "pregrasp", "grasp", "lift")
FREE_STRIP: Final = ("pregrasp", "grasp", "squeeze")
#: Candidate sides: number of azimuths, and heights above the horizon [rad].
_AROUND: Final = 16
_HEIGHTS: Final = tuple(np.radians([20.0, 35.0, 52.0]).tolist())
_APART: Final = np.radians(50.0)  # least angle between two sides of one grasp, if possible [rad]
_GLANCE: Final = 48  # edge of the pictures that rate the sides [px]
#: Direction of the lamp under a board: from the front, as high as a window.
_UNDER_A_BOARD: Final = np.array([0.85, -0.42, 0.32]) / np.linalg.norm([0.85, -0.42, 0.32])
_HIGH_M: Final = 3.0
_TABLE: Final = Appearance(linear_rgb_from_hex("#b9bfc2"), roughness=0.85)
_WALL: Final = Appearance(linear_rgb_from_hex("#7f97a5"), roughness=0.8)
_BESIDE: Final = Appearance(linear_rgb_from_hex("#8d86a3"), roughness=0.6)


@dataclass(frozen=True)
class PictureScenes:
    """Scenes of N grasps: S scenes of an object with common supports, or one free object."""

    supports: Supports = ()
    object_pose: Floats = field(default_factory=lambda: np.array(IDENTITY_POSE)[None])  # (S, 7) in the scene frame
    index: NDArray[np.intp] | None = None  # (N,) scene of each grasp; None if all are in the first
    neighbours: Neighbours | None = None
    wrist: Floats | None = None  # (N, U) wrist angles for drawing the links above the hand's root; None hides them

    def centred(self, obj: ObjectModel) -> PictureScenes:
        """Return the scenes with the frames of their object `obj` and of the neighbours at their centres."""
        if not self.supports:
            return self  # a free object is about the origin, where the tracer is most exact
        beside = None if self.neighbours is None else self.neighbours.centred
        return replace(self, object_pose=to_centred_frame(self.object_pose, obj.centre), neighbours=beside)

    def scene(self, number: int) -> int:
        return 0 if self.index is None else int(self.index[number])


def trajectory_pictures(
    hand: HandModel,
    obj: ObjectModel,
    frames: Sequence[Sequence[Waypoint]],
    around: PictureScenes,
    size: tuple[int, int] = (300, 300),
    *,
    sides: int = 1,
    whole: bool = False,
    run: ExecutionContext = DEFAULT_CONTEXT,
    samples: int = studio.SAMPLES,
) -> NDArray[np.uint8]:
    """Render N grasps of F postures from A sides; return sRGB (N, A, F, H, W, 3).
    Postures are in the frame of the object at rest. Sides that show more of object and fingers come first. `whole`
    frames the whole hand; else far parts may be cut off. Raises TaskCancelled: `run.cancelled()` returned True."""
    if not frames:
        return np.zeros((0, sides, 0, size[1], size[0], 3), np.uint8)
    stage = _GraspRenderer(hand, obj, around, len(frames[0]), run, np.inf if whole else studio.NEAR_M)
    return np.stack([stage.render(number, way, size, sides, samples) for number, way in enumerate(frames)])


class _GraspRenderer:
    """One tracer for all grasps: its worlds are the frames of one grasp."""

    def __init__(
        self,
        hand: HandModel,
        obj: ObjectModel,
        around: PictureScenes,
        frames: int,
        run: ExecutionContext,
        near_m: float,
    ) -> None:
        self.hand, self.frames, self.run, self.near_m = hand, frames, run, near_m
        self.around = around = around.centred(obj)
        self.centre, self.obj = np.array(obj.centre), obj.centred
        self.others = around.neighbours.objects if around.neighbours else ()
        self.boxes = slabs(around.supports)
        objects = [Solid(o.vertices, o.faces, o.corner_normals) for o in (self.obj, *self.others)]
        parts = drawn_parts(hand, mounted=around.wrist is not None)
        self.tracer = Tracer([*self.boxes, *objects, *(part.solid for part in parts)], run.device)
        planes = [_TABLE if isinstance(s, HalfSpace) else _WALL for s in around.supports]
        self.looks = [*planes, studio.OBJECT_LOOK, *(_BESIDE for _ in self.others), *(part.look for part in parts)]

    def render(
        self, number: int, way: Sequence[Waypoint], size: tuple[int, int], sides: int, samples: int
    ) -> NDArray[np.uint8]:
        """Render one grasp (A, F, H, W, 3)."""
        scene = self.around.scene(number)
        rest = np.asarray(self.around.object_pose[scene], float)
        roots = compose(rest, move_poses(np.stack([point.hand_pose for point in way]), -self.centre))
        joints, wrist = np.stack([point.joint_positions for point in way]), self.around.wrist
        bodies = body_poses(self.hand, roots, joints)
        drawn = drawn_poses(self.hand, roots, joints, None if wrist is None else np.tile(wrist[number], (len(way), 1)))
        things = np.stack([compose(rest, np.append(point.carried, IDENTITY_POSE[3:])) for point in way])
        solid = np.stack([apply(pose, self.obj.hull_vertices) for pose in things])
        points = np.concatenate([solid, studio.hand_points(self.hand, bodies)], axis=1)
        middles = 0.5 * (solid.min(axis=1) + solid.max(axis=1))
        reach = float(np.linalg.norm(solid - middles[:, None], axis=2).max()) + self.near_m
        near = points[np.linalg.norm(points - middles[:, None], axis=2) < reach]
        standing = slab_poses(self.around.supports, middles[0], 0.0)
        beside = self.around.neighbours.poses[scene] if self.around.neighbours else np.zeros((0, 7))
        poses = np.tile(np.concatenate([standing, things[0][None], beside]), (self.frames, 1, 1))
        poses[:, len(standing)] = things
        self.tracer.place(np.concatenate([poses, drawn], axis=1), [self.looks] * self.frames)
        above = middles[0] + np.array([0, 0, _HIGH_M])
        covered = visible_share(self.around.supports, above, middles[:1]) < 1
        lamp = _UNDER_A_BOARD if covered else studio.TOWARD_LAMP
        grasp = next((k for k, point in enumerate(way) if point.name == "grasp"), 0)
        k = intrinsics(*size, studio.FIELD_OF_VIEW)
        pictures = []
        for angle, height in self._best_sides(grasp, near, studio.side_azimuth(self.hand, bodies[grasp]), sides):
            cameras = np.stack([studio.fit_camera(near, angle, k, size, elevation=height)] * self.frames)
            shot = studio.studio_shot(cameras, k, size, np.full(self.frames, angle), samples, toward_lamp=lamp)
            pictures.append(self.tracer.render(shot, self.run.without_progress()).rgb)
        return np.stack(pictures)

    def _best_sides(self, world: int, near: Floats, first: float, count: int) -> list[tuple[float, float]]:
        """Return azimuth and height [rad] of the sides that show most, apart from one another.
        The score sums the square roots of the visible areas of object and hand. Each area is relative to its largest
        value over all sides. A small bonus favours sides that look across the palm's approach."""
        sides = [(first + 2 * np.pi * a / _AROUND, h) for h in _HEIGHTS for a in range(_AROUND)]
        centre = 0.5 * (near.min(axis=0) + near.max(axis=0))
        far = 1.15 * float(np.linalg.norm(near - centre, axis=1).max()) / np.sin(studio.FIELD_OF_VIEW / 2)
        eyes = [centre + far * np.array([np.cos(a) * np.cos(h), np.sin(a) * np.cos(h), np.sin(h)]) for a, h in sides]
        cameras = np.stack([look_at(eye, centre) for eye in eyes])
        size, worlds = (_GLANCE, _GLANCE), np.full(len(sides), world)
        k = intrinsics(*size, studio.FIELD_OF_VIEW)
        glance = studio.studio_shot(cameras, k, size, np.full(self.frames, first), 1, world=worlds)
        seen = self.tracer.render(replace(glance, shaded=False), self.run.without_progress()).shape
        thing = len(self.boxes)
        first_of_hand = thing + 1 + len(self.others)
        # Links above the hand's root, such as a forearm, do not count.
        fingers = (seen >= first_of_hand) & (seen < first_of_hand + len(drawn_bodies(self.hand)))
        shares = [(seen == thing).sum(axis=(1, 2)), fingers.sum(axis=(1, 2))]
        score = sum(np.sqrt(share / max(1, share.max())) for share in shares)
        across = np.array([abs(np.cos(a - first)) * np.cos(h) for a, h in sides])
        order = np.argsort(-(score + 0.15 * across), kind="stable")
        chosen: list[int] = []
        for apart in (_APART, 0.0):
            for one in order.tolist():
                turns = [abs(np.angle(np.exp(1j * (sides[one][0] - sides[other][0])))) for other in chosen]
                if len(chosen) < count and one not in chosen and min(turns, default=np.pi) >= apart:
                    chosen.append(one)
        return [sides[one] for one in chosen]


#: File formats by suffix. A GIF has 256 colours and is many times as large as a WebP.
KINDS: Final[dict[str, dict[str, Any]]] = {
    ".gif": {"format": "GIF", "optimize": False, "disposal": 1},
    ".webp": {"format": "WEBP", "quality": 82, "method": 4},
    ".png": {"format": "PNG", "default_image": False},
}
_PALETTE_OF: Final = 9  # number of pictures whose colours make the palette of a GIF


def animation_kind(suffix: str) -> str:
    """Return the suffix in lower case; raise InputError if no animation format has it."""
    if (small := suffix.lower()) not in KINDS:
        raise InputError(f"an animation is written as {', '.join(KINDS)}, not as {suffix or 'a file without suffix'}")
    return small


def encode_animation(pictures: NDArray[np.uint8], seconds: Sequence[float], suffix: str) -> bytes:
    """Encode a looping animation of pictures (F, H, W, 3) sRGB; `suffix` is one of `KINDS`.
    Durations [s] are stored in milliseconds, in a GIF in hundredths of a second.
    Raises InputError: no animation format has this suffix."""
    kind = animation_kind(suffix)
    images = [Image.fromarray(picture) for picture in pictures]
    if kind == ".gif":
        images = _quantise_together(pictures)
    buffer = io.BytesIO()
    durations = [round(1000 * shown) for shown in seconds]
    images[0].save(buffer, save_all=True, append_images=images[1:], duration=durations, loop=0, **KINDS[kind])
    return buffer.getvalue()


def _quantise_together(pictures: NDArray[np.uint8]) -> list[Image.Image]:
    """Quantise without dither, so that static parts stay identical between pictures."""
    some = np.unique(np.linspace(0, len(pictures) - 1, _PALETTE_OF).round().astype(int))
    palette = Image.fromarray(np.concatenate(pictures[some])).quantize(256, method=Image.Quantize.MEDIANCUT)
    return [Image.fromarray(picture).quantize(palette=palette, dither=Image.Dither.NONE) for picture in pictures]

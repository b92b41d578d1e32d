"""The tracer against closed forms of boxes and shadows, and against itself where it takes a short cut."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
import trimesh

from graspd.service.model.pinhole import pixel_rays
from graspd.service.model.transforms import apply, invert, quat_conjugate, quat_from_axis_angle, quat_rotate
from graspd.worker.rendering.cameras import intrinsics, look_at
from graspd.worker.rendering.kernels import shading
from graspd.worker.rendering.scenery import Appearance, Box, CameraShot, Lamp, Solid
from graspd.worker.rendering.tracer import Tracer

WIDTH, HEIGHT = 96, 72
FLOOR, WALL = Box((0.8, 0.6, 0.1)), Box((0.3, 0.02, 0.2))
WORLDS, RADIUS = 3, 0.05
TOWARD_LAMP = np.array([0.4, 0.3, 0.8]) / np.linalg.norm([0.4, 0.3, 0.8])
#: Of outlines, where rounding decides what a ray meets: the share of pixels that two tracers may see otherwise.
OUTLINE = 1e-3


def solid(mesh: trimesh.Trimesh) -> Solid:
    return Solid(mesh.vertices, mesh.faces, mesh.vertex_normals[mesh.faces])


BALL = solid(trimesh.creation.icosphere(subdivisions=3, radius=RADIUS))
SOLIDS = [FLOOR, WALL, BALL, solid(trimesh.creation.annulus(r_min=0.03, r_max=0.05, height=0.08))]
LOOKS = [
    Appearance((0.5, 0.4, 0.3), (0.3, 0.2, 0.1), shading.TILES, 2.0, roughness=0.4),
    Appearance((0.5, 0.5, 0.5), (0.2, 0.2, 0.2), shading.SPECKLE, 1.0, roughness=0.6),
    Appearance((0.8, 0.2, 0.1), roughness=0.3),
    Appearance((0.2, 0.3, 0.8), roughness=0.5, metalness=0.8),
]


@pytest.fixture(scope="module")
def poses() -> np.ndarray:
    """(worlds, P, 7): a floor and a wall that are turned, a ball and a ring that stand and float about."""
    rng = np.random.default_rng(3)
    poses = np.zeros((WORLDS, len(SOLIDS), 7))
    poses[..., 3] = 1.0
    poses[:, 0, 2] = -0.05
    poses[:, 1, :3] = (0.0, 0.15, 0.1)
    poses[:, 2:, :2] = rng.uniform(-0.1, 0.1, (WORLDS, 2, 2))
    poses[:, 2:, 2] = rng.uniform(0.05, 0.2, (WORLDS, 2))
    up = np.array([0.0, 0.0, 1.0])
    poses[:, :2, 3:] = quat_from_axis_angle(up, rng.uniform(0, 6, (WORLDS, 1)))
    axes = rng.normal(size=(WORLDS, 2, 3))
    axes /= np.linalg.norm(axes, axis=-1, keepdims=True)
    poses[:, 2:, 3:] = quat_from_axis_angle(axes, rng.uniform(0, 3, (WORLDS, 2)))
    return poses


def shot(**changes) -> CameraShot:
    eyes = [(0.5, -0.3, 0.4), (-0.2, -0.6, 0.25)]
    cameras = np.stack([look_at(np.array(eye), np.array([0.0, 0.0, 0.05])) for eye in eyes])
    made = CameraShot(
        world=np.repeat(np.arange(WORLDS, dtype=np.int32), 2),
        extrinsics=np.concatenate([cameras] * WORLDS),
        intrinsics=intrinsics(WIDTH, HEIGHT),
        width=WIDTH,
        height=HEIGHT,
        samples=1,
        toward_lamp=TOWARD_LAMP,
        turn=np.zeros(WORLDS),
        lamps=[Lamp()] * WORLDS,
        normals=True,
    )
    return replace(made, **changes)


def of_one(camera: np.ndarray) -> CameraShot:
    one = {"world": np.zeros(1, np.int32), "turn": np.zeros(1), "lamps": [Lamp()], "samples": 12}
    return shot(extrinsics=camera[None], **one)


def traced(solids: list[Solid | Box], poses: np.ndarray, what: CameraShot, looks: Sequence[Appearance] = LOOKS):
    tracer = Tracer(solids, "cpu")
    tracer.place(poses, [[*looks, *[Appearance((1.0, 1.0, 1.0))] * (len(solids) - len(looks))]] * len(poses))
    return tracer.render(what)


def box_distance(box: Box, pose: np.ndarray, origin: np.ndarray, rays: np.ndarray) -> np.ndarray:
    """Distances (H, W) along rays (H, W, 3) to a box that they begin outside of, by slabs; inf where they miss it."""
    start, along = apply(invert(pose), origin), quat_rotate(quat_conjugate(pose[3:]), rays)
    ends = np.sort(np.stack([(side * np.array(box.size) - start) / along for side in (-0.5, 0.5)]), axis=0)
    first, last = ends[0].max(axis=-1), ends[1].min(axis=-1)
    return np.where((first <= last) & (first > 0), first, np.inf)


def test_turned_boxes_and_their_shadows_are_where_closed_forms_have_them(poses: np.ndarray) -> None:
    what, plain = shot(), Appearance((0.5, 0.5, 0.5), roughness=1.0)
    seen, shadowed, brightness = traced([FLOOR, WALL, BALL], poses[:, :3], what, [plain] * 3), [], []
    for view, places in enumerate(poses[what.world]):
        camera = np.linalg.inv(what.extrinsics[view])
        rays = pixel_rays(what.intrinsics, WIDTH, HEIGHT) @ camera[:3, :3].T
        far = [box_distance(box, pose, camera[:3, 3], rays) for box, pose in zip((FLOOR, WALL), places, strict=False)]
        shape = np.where(np.isfinite(far).any(axis=0), np.argmin(far, axis=0), -1)
        same, ball = seen.shape[view] == shape, seen.shape[view] == 2
        assert np.mean(~same & ~ball) <= OUTLINE and set(np.unique(shape)) == {-1, 0, 1}
        # float32 over a metre: a few of its steps of 6e-8; along a grazing ray they grow.
        met = same & (shape >= 0)
        assert np.quantile(np.abs(seen.depth[view][met] - np.min(far, axis=0)[met]), 0.999) < 5e-6
        points = camera[:3, 3] + np.where(met, seen.depth[view], 0)[..., None] * rays
        on_wall, on_floor = same & (shape == 1), same & (shape == 0) & (np.abs(points[..., 2]) < 1e-5)
        normal, point = seen.normal[view][on_wall], apply(invert(places[1]), points[on_wall])
        normal = quat_rotate(quat_conjugate(places[1, 3:]), normal)
        np.testing.assert_allclose((normal * point).sum(axis=1), np.abs(normal) @ WALL.size / 2, atol=1e-5)
        np.testing.assert_allclose(np.abs(normal).max(axis=1), 1.0, atol=1e-6)
        from_ball = np.linalg.norm(np.cross(points[on_floor] - places[2, :3], TOWARD_LAMP), axis=-1)
        behind_wall = np.isfinite(box_distance(WALL, places[1], points[on_floor], TOWARD_LAMP))
        shadowed += (behind_wall | (from_ball < RADIUS)).tolist()
        brightness += seen.rgb[view][on_floor].mean(axis=-1).tolist()
    lit = np.array(brightness) > 0.8 * np.median(brightness)
    # The lamp is no point: where the shadow ends it is seen in part.
    assert 0.02 < np.mean(shadowed) < 0.5 and np.mean(lit == shadowed) < 0.01


def test_open_faces_look_as_if_every_ray_were_traced(poses: np.ndarray) -> None:
    # More than 64 solids, all but four of them far below: no pixel is known to meet one face.
    others = [Box((0.01, 0.01, 0.01))] * 64
    below = np.zeros((WORLDS, 64, 7))
    below[..., 2], below[..., 3] = -50.0, 1.0
    what = shot(samples=6, normals=True)
    short, whole = traced(SOLIDS, poses, what), traced([*SOLIDS, *others], np.concatenate([poses, below], 1), what)
    np.testing.assert_array_equal(short.shape, whole.shape)
    np.testing.assert_array_equal(short.depth, whole.depth)
    levels = np.abs(short.rgb.astype(int) - whole.rgb)
    # Where a line of the tiles or a shadow ends, rounding may move a ray of six past it.
    assert np.mean(levels > 1) < 1e-4


def test_turning_worlds_is_turning_the_lamp_the_other_way(poses: np.ndarray) -> None:
    angle = 0.7
    back = quat_rotate(quat_from_axis_angle(np.array([0.0, 0.0, 1.0]), np.asarray(-angle)), TOWARD_LAMP)
    # A pass of one sample has the lamp alone.
    turned = traced(SOLIDS, poses, shot(turn=np.full(WORLDS, angle)))
    other = traced(SOLIDS, poses, shot(toward_lamp=back))
    np.testing.assert_array_equal(turned.shape, other.shape)
    # The lamp's only sample lies off its centre, on a side that the two choose differently: outlines of shadows move.
    assert np.mean(np.abs(turned.rgb.astype(int) - other.rgb).max(axis=-1) > 12) < 0.02


def test_a_pixel_on_an_outline_has_the_colours_of_both_sides() -> None:
    red, green = Appearance((0.6, 0.0, 0.0), roughness=1.0), Appearance((0.0, 0.6, 0.0), roughness=1.0)
    poses = np.array([[[0, 0, -0.05, 1, 0, 0, 0], [0, 0, 0.05, 1, 0, 0, 0.0]]])
    what = of_one(look_at(np.array([0.3, -0.2, 0.3]), np.array([0, 0, 0.05])))
    seen = traced([FLOOR, BALL], poses, what, [red, green])
    floor, ball = seen.shape[0] == 0, seen.shape[0] == 1
    beside = floor & (np.roll(ball, 1, axis=1) | np.roll(ball, -1, axis=1))
    assert beside.sum() > 10
    greener = seen.rgb[0, ..., 1].astype(int) - seen.rgb[0, ..., 0]
    assert np.median(greener[floor]) < -50 < 50 < np.median(greener[ball])
    # Rays through such a pixel's other half meet the ball: in one of them at least by a third.
    assert greener[beside].max() > 0


def test_a_mesh_is_not_seen_from_inside() -> None:
    around = solid(trimesh.creation.icosphere(subdivisions=3, radius=2.0))
    poses = np.zeros((1, 2, 7))
    poses[..., 3] = 1.0
    poses[0, 0, 2] = -0.05
    assert set(np.unique(traced([FLOOR, around], poses, of_one(shot().extrinsics[0]), LOOKS[:2]).shape)) == {-1, 0}


def test_lines_of_tiles_thinner_than_a_pixel_darken_it_a_little() -> None:
    tiles = Appearance((0.8,) * 3, (0.0,) * 3, shading.TILES, 2.0)
    pose, camera = np.array([[[0, 0, -0.05, 1, 0, 0, 0.0]]]), look_at(np.array([1.5, -1.0, 2.0]), np.zeros(3))
    seen = traced([FLOOR], pose, of_one(camera), [tiles])
    inside = seen.shape[0] == 0
    for axis in (0, 1):
        inside &= np.roll(inside, 1, axis) & np.roll(inside, -1, axis)
    brightness = seen.rgb[0].mean(axis=-1)[inside]
    assert len(brightness) > 100
    # The lines take a twentieth of the floor; through a pixel's centre alone every twentieth pixel would be black.
    assert brightness.min() > 0.6 * np.median(brightness)

"""The tracer against another one, Newton's camera sensor, and against itself where it takes a short cut."""

from collections.abc import Sequence
from dataclasses import replace

import newton
import numpy as np
import pytest
import trimesh
import warp as wp
from newton.sensors import SensorCamera

from graspd.service.model.pinhole import pixel_rays
from graspd.service.model.transforms import pose_from_matrix, quat_from_axis_angle, quat_rotate
from graspd.worker.rendering.cameras import intrinsics, look_at
from graspd.worker.rendering.kernels import rays, shading
from graspd.worker.rendering.scenery import Appearance, Box, CameraShot, Lamp, Solid
from graspd.worker.rendering.tracer import Tracer

WIDTH, HEIGHT = 96, 72
FLOOR, WALL = Box((0.8, 0.6, 0.1)), Box((0.3, 0.02, 0.2))
WORLDS = 3
TOWARD_LAMP = np.array([0.4, 0.3, 0.8]) / np.linalg.norm([0.4, 0.3, 0.8])
#: Of outlines, where rounding decides what a ray meets: the share of pixels that two tracers may see otherwise.
OUTLINE = 1e-3


def solid(mesh: trimesh.Trimesh) -> Solid:
    return Solid(mesh.vertices, mesh.faces, mesh.vertex_normals[mesh.faces])


BALL = solid(trimesh.creation.icosphere(subdivisions=3, radius=0.05))
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


@wp.kernel(enable_backward=False)
def _in_the_way(
    placed_in: wp.array2d[rays.PlacedSolid],
    world_in: wp.array[wp.int32],
    point_in: wp.array[wp.vec3f],
    toward: wp.vec3f,
    shadowed_out: wp.array[wp.int32],
):
    i = wp.tid()
    shadowed_out[i] = wp.int32(rays.is_occluded(placed_in, world_in[i], point_in[i], toward))


def by_newton(poses: np.ndarray, what: CameraShot) -> dict[str, np.ndarray]:
    """Shapes, depth, normals and whether the lamp's centre is seen, by Newton's camera sensor."""
    builder = newton.ModelBuilder()
    config = newton.ModelBuilder.ShapeConfig(has_shape_collision=False, has_particle_collision=False, density=0.0)
    for _ in range(WORLDS):
        builder.begin_world()
        for one in SOLIDS:
            if isinstance(one, Box):
                x, y, z = (0.5 * side for side in one.size)
                builder.add_shape_box(-1, hx=x, hy=y, hz=z, cfg=config, color=(1.0, 1.0, 1.0))
            else:
                corners = np.asarray(one.vertices, np.float32)[one.faces.ravel()]
                normals = np.asarray(one.corner_normals, np.float32).reshape(-1, 3)
                mesh = newton.Mesh(corners, np.arange(len(corners)), normals=normals, compute_inertia=False)
                builder.add_shape_mesh(-1, mesh=mesh, cfg=config, color=(1.0, 1.0, 1.0))
        builder.end_world()
    model = builder.finalize(device="cpu")
    order = [0, 1, 2, 4, 5, 6, 3]
    model.shape_transform.assign(poses.reshape(-1, 7)[:, order].astype(np.float32))
    state = model.state()
    model.bvh_refit_shapes(state)
    sensor = SensorCamera(model, load_textures=False)
    sensor.create_default_light(enable_shadows=True, direction=wp.vec3f(*-TOWARD_LAMP))
    flip = np.diag([1.0, -1.0, -1.0, 1.0])
    cameras = pose_from_matrix(np.linalg.inv(what.extrinsics) @ flip)[:, order].astype(np.float32)
    local = pixel_rays(what.intrinsics, WIDTH, HEIGHT) @ flip[:3, :3]
    bundle = np.zeros((HEIGHT, WIDTH, 1, 2, 3), np.float32)
    bundle[:, :, 0, 1] = local / np.linalg.norm(local, axis=-1, keepdims=True)
    count = len(what.world)
    light = sensor.allocate_image_color_hdr(count, WIDTH, HEIGHT)
    depth = sensor.allocate_image_depth_forward(count, WIDTH, HEIGHT)
    shape = sensor.allocate_image_shape_index(count, WIDTH, HEIGHT)
    normal = sensor.allocate_image_normal(count, WIDTH, HEIGHT)
    sensor.update(
        state,
        wp.array(cameras, dtype=wp.transformf, device="cpu"),
        wp.array(bundle, dtype=wp.vec3f, device="cpu"),
        hdr_color_image=light,
        forward_depth_image=depth,
        shape_index_image=shape,
        normal_image=normal,
        world_indices=wp.array(what.world, dtype=wp.int32, device="cpu"),
        clear_data=SensorCamera.ClearData(clear_depth=float("inf"), clear_shape_index=0xFFFFFFFF),
        render_config=SensorCamera.RenderConfig(enable_shadows=True, enable_ambient_lighting=False),
    )
    index = shape.numpy().astype(np.int64)
    cosine = normal.numpy() @ TOWARD_LAMP
    with np.errstate(divide="ignore", invalid="ignore"):
        # It lets 0.3 of the light through every shadow.
        lit = light.numpy()[..., 0] / cosine > 0.65
    nothing = index == 0xFFFFFFFF
    found = {"shape": np.where(nothing, -1, index % len(SOLIDS)), "depth": depth.numpy(), "normal": normal.numpy()}
    return found | {"lit": lit, "facing": ~nothing & (cosine > 0.05)}


@pytest.fixture(scope="module")
def theirs(poses: np.ndarray) -> dict[str, np.ndarray]:
    return by_newton(poses, shot())


def test_rays_meet_what_newtons_meet(poses: np.ndarray, theirs: dict[str, np.ndarray]) -> None:
    ours = traced(SOLIDS, poses, shot())
    assert set(np.unique(ours.shape)) == {-1, 0, 1, 2, 3}
    same = ours.shape == theirs["shape"]
    assert np.mean(~same) <= OUTLINE
    seen = same & (ours.shape >= 0)
    # float32 over a metre: a few of its steps of 6e-8; along a grazing ray they grow.
    assert np.quantile(np.abs(ours.depth[seen] - theirs["depth"][seen]), 0.999) < 5e-6
    assert np.quantile(np.abs(ours.normal[seen] - theirs["normal"][seen]), 0.999) < 1e-3


def test_shadows_lie_where_newtons_lie(poses: np.ndarray, theirs: dict[str, np.ndarray]) -> None:
    tracer = Tracer(SOLIDS, "cpu")
    tracer.place(poses, [LOOKS] * WORLDS)
    what = shot()
    inverse = np.linalg.inv(what.extrinsics)
    view, row, column = np.nonzero(theirs["facing"])
    rays_in_view = pixel_rays(what.intrinsics, WIDTH, HEIGHT)[row, column]
    inside = rays_in_view * theirs["depth"][view, row, column, None]
    points = np.einsum("nij,nj->ni", inverse[view, :3, :3], inside) + inverse[view, :3, 3]
    points += 1e-4 * theirs["normal"][view, row, column]
    shadowed = wp.zeros(len(points), dtype=wp.int32, device="cpu")
    world = wp.array(what.world[view], dtype=wp.int32, device="cpu")
    at = wp.array(points.astype(np.float32), dtype=wp.vec3f, device="cpu")
    inputs = [tracer._placed, world, at, wp.vec3f(*TOWARD_LAMP)]
    wp.launch(_in_the_way, dim=len(points), device="cpu", inputs=inputs, outputs=[shadowed])
    lit = theirs["lit"][view, row, column]
    assert 0.05 < np.mean(~lit) < 0.5
    assert np.mean((shadowed.numpy() == 0) == lit) >= 1 - OUTLINE


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

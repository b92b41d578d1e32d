"""Pictures and films of grasps; image files of views, read back by other readers, and their clouds."""

import io
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import OpenEXR
import pytest
import trimesh
from PIL import Image, ImageSequence, features

from graspd.commands.grasp_sheet import waypoints
from graspd.readers import hand_surface
from graspd.service.model.errors import InputError
from graspd.service.model.scene_spec import Box, HalfSpace, SceneSpec, scene_supports
from graspd.service.model.transforms import apply, compose, invert, quat_rotate
from graspd.service.readers import Pictures, open_shards
from graspd.service.readers.trajectories import Waypoint
from graspd.service.store.shards import Shard, write_shard
from graspd.worker.episodes.execution import POSTURES, Executions, ToolFrame, straight_paths, time_motions
from graspd.worker.grasps import Posture
from graspd.worker.hands.kinematics import body_poses
from graspd.worker.hands.load import hand_from_path, load_hand
from graspd.worker.hands.model import HandModel
from graspd.worker.hands.surface import sample_surface
from graspd.worker.rendering import Extras, render, sheets
from graspd.worker.rendering.export import PNG_STEP_M, export_images
from graspd.worker.rendering.hands import DrawnHand, drawn_bodies, hand_parts, without_visuals
from graspd.worker.rendering.pictures import THREE_SIDES, grasp_pictures
from graspd.worker.rendering.scenery import TABLE, TABLE_SIZE, slab_poses, slabs, visible_share
from graspd.worker.rendering.trajectory_pictures import KINDS, PictureScenes, encode_animation, trajectory_pictures
from graspd.worker.stages.models import hand_glb
from tests.service.readers import box_scenes
from tests.worker.hands.urdfs import joint, link, robot
from tests.worker.models import object_from_mesh, two_finger_hand

HAND = two_finger_hand()
BLOCK = object_from_mesh(trimesh.creation.box((0.05, 0.04, 0.06)), "block")
POSES = np.array([[0, 0, -0.06, 1.0, 0, 0, 0], [0, 0, 0.06, 0, 1.0, 0, 0]])
JOINTS = np.array([[0.1, 0.1], [0.3, 0.3]])
REST = np.array([[0, 0, 0.03, 1.0, 0, 0, 0]])
TABLE_SCENE = PictureScenes((HalfSpace(),), REST)
DOWN = np.array([0, 0, 0.06, 0, 1.0, 0, 0])
SECONDS = [0.5, 0.05, 1.2]
SPECS = {kind: scene_supports(SceneSpec(kind=kind)) for kind in ("table", "bin", "shelf")}
SHAPE = '<collision><geometry><box size="0.02 0.02 0.04"/></geometry></collision>'
RED = '<material name="red"><color rgba="1 0 0 1"/></material>'
SEEN = (
    f'<visual><geometry><box size="0.06 0.06 0.01"/></geometry>{RED}</visual>'
    '<visual><geometry><mesh filename="part.stl"/></geometry><material name="blue"/></visual>'
    '<visual><geometry><mesh filename="missing.stl"/></geometry></visual>'
)


@pytest.fixture(scope="module")
def pictures() -> np.ndarray:
    return grasp_pictures(HAND, BLOCK, POSES, JOINTS, (80, 64), THREE_SIDES, samples=4)


def coloured_pixels(picture: np.ndarray, low: int, high: int) -> np.ndarray:
    """Mask of the pixels of a hue between two, in 256 steps."""
    hue, saturation, value = np.moveaxis(np.asarray(Image.fromarray(picture).convert("HSV")).astype(int), -1, 0)
    return (hue > low) & (hue < high) & (saturation > 90) & (value > 30)


def orange(picture: np.ndarray) -> np.ndarray:
    return coloured_pixels(picture, 8, 30)


def test_every_side_shows_object_and_fingertips_in_their_colours(pictures) -> None:
    assert pictures.shape == (2, 3, 64, 80, 3)
    assert len({picture.tobytes() for picture in pictures.reshape(6, -1)}) == 6
    for picture in pictures.reshape(6, 64, 80, 3):
        assert orange(picture).sum() > 60, "the object"
        assert coloured_pixels(picture, 115, 135).sum() > 5, "teal fingertips"


def test_grasp_looks_the_same_whatever_grasps_are_drawn_with_it(pictures):
    alone = grasp_pictures(HAND, BLOCK, POSES[1:], JOINTS[1:], (80, 64), THREE_SIDES, samples=4)
    np.testing.assert_array_equal(alone[0], pictures[1])
    none = grasp_pictures(HAND, BLOCK, np.zeros((0, 7)), np.zeros((0, 2)), (80, 64), THREE_SIDES)
    assert none.shape == (0, 3, 64, 80, 3)


def quality(count: int) -> dict[str, np.ndarray]:
    epsilon = np.arange(count, dtype=float)[:, None] * np.array([1.0, 10.0])
    swept = {"quality/epsilon": epsilon, "quality/contact_area_cm2": epsilon}
    depth = {"quality/penetration_depth_mm": np.full(count, 0.25)}
    return swept | depth | {"quality/thresholds_m": np.array([0.001, 0.005])}


def test_best_have_the_largest_epsilon_and_captions_quote_5_mm() -> None:
    chosen = np.array([True, True, True, True, False])
    assert sheets.best_rows(quality(5), 3, chosen).tolist() == [3, 2, 1]
    assert sheets.best_rows(quality(5), 9, chosen).tolist() == [3, 2, 1, 0]
    (told,) = sheets.caption_entries(quality(5), np.array([3]))
    assert told == [("epsilon", "30.000"), ("contact", "30.0 cm^2"), ("depth", "0.25 mm")]


def opened(data: bytes) -> np.ndarray:
    return np.asarray(Image.open(io.BytesIO(data)).convert("RGB"))


def test_a_contact_sheet_holds_every_picture_unchanged(pictures):
    sheet = opened(sheets.contact_sheet(pictures[:, 0], title="block", columns=2))
    for picture in pictures[:, 0]:
        windows = np.lib.stride_tricks.sliding_window_view(sheet[..., 0], (4, 80))
        assert (windows == picture[30:34, :, 0]).all(axis=(2, 3)).any()
    assert tuple(sheet[0, 0]) == sheets.PAPER
    assert opened(sheets.three_sides_sheet(pictures, title="block")).shape[1] >= 3 * 80


@pytest.mark.parametrize(("stereo", "cells"), [(True, 5), (False, 4)])
def test_a_views_page_has_a_row_per_placement_and_a_column_for_a_hand(stereo, cells):
    views = render(BLOCK, REST, views=2, stereo=stereo, width=64, height=48, seed=0, samples=2)
    without = opened(sheets.views_page(views, title="block"))
    assert without.shape[1] > cells * 64 and without.shape[0] > 2 * 48
    views["image/rgb_hand"] = np.full((len(views["image/rgb"]), 48, 64, 3), [255, 0, 255], np.uint8)
    page = opened(sheets.views_page(views, title="block"))
    assert page.shape[1] == without.shape[1] + 64 + sheets.GAP
    shown = (page == [255, 0, 255]).all(axis=-1)
    assert shown.sum() == 2 * 48 * 64 and not shown[:, : without.shape[1] - sheets.MARGIN].any()


def test_depth_colours_darken_with_distance_and_grey_is_nothing():
    colours = sheets.depth_colours(np.array([0.2, 0.3, 0.4, 0.5, np.inf], np.float32), 0.2, 0.5).astype(int)
    assert np.all(np.diff(colours[:4] @ [0.2126, 0.7152, 0.0722]) < -20)
    assert colours[4].tolist() == [214, 214, 214]


def at(name: str, height: float = 0.0) -> Waypoint:
    rise = np.array([0, 0, height])
    return Waypoint(name, DOWN + np.append(rise, np.zeros(4)), np.full(2, 0.1), rise)


def grasped(scenes: PictureScenes, hand: HandModel = HAND, **options) -> np.ndarray:
    return trajectory_pictures(hand, BLOCK, [[at("grasp")]], scenes, (48, 48), samples=2, **options)[0, 0, 0]


def test_every_posture_of_every_grasp_is_drawn_from_every_side():
    frames = [[at("grasp"), at("lift", 0.1)]] * 2
    drawn = trajectory_pictures(HAND, BLOCK, frames, TABLE_SCENE, (48, 36), sides=3, samples=2)
    assert drawn.shape == (2, 3, 2, 36, 48, 3)
    assert all(orange(picture).sum() > 10 for picture in drawn.reshape(-1, 36, 48, 3))


def test_the_lifted_object_is_higher_in_the_picture():
    frames = [[at("grasp"), at("lift", 0.1)]]
    (low, high) = trajectory_pictures(HAND, BLOCK, frames, TABLE_SCENE, (64, 64), samples=2)[0, 0]
    assert np.argwhere(orange(high))[:, 0].mean() < np.argwhere(orange(low))[:, 0].mean() - 10
    assert orange(grasped(PictureScenes())).sum() > 20, "a free grasp floats over a floor"


def test_whole_hand_is_in_the_picture_where_that_is_asked_for():
    frames = [[replace(at("", 0.5), carried=np.zeros(3)), at("grasp")]]
    both = (trajectory_pictures(HAND, BLOCK, frames, TABLE_SCENE, (48, 48), whole=w, samples=2) for w in (False, True))
    near, whole = (seen[0, 0] for seen in both)
    # The camera steps back for the hand that is far above: the block is smaller, and what is drawn ends above the rim.
    assert 0 < orange(whole[1]).sum() < 0.5 * orange(near[1]).sum()
    assert np.abs(whole[0][:2].astype(int) - grasped(TABLE_SCENE)[0, 0]).max() < 40


@pytest.mark.parametrize("side", [0, 1, 2, 3])
def test_no_wall_stands_between_the_object_and_the_camera(side):
    x, y = np.array([(0.1, 0), (0, 0.1), (-0.1, 0), (0, -0.1)])[side]
    wall = Box(size=(0.02, 0.5, 0.5) if x else (0.5, 0.02, 0.5), pose=(x, y, 0.25, 1, 0, 0, 0))
    around = PictureScenes((HalfSpace(), wall), REST)
    assert orange(grasped(around)).sum() > 0.5 * orange(grasped(TABLE_SCENE)).sum()


def test_each_grasp_stands_in_its_own_scene():
    turned = np.array([[0, 0, 0.02, np.sqrt(0.5), np.sqrt(0.5), 0, 0]])
    around = PictureScenes((HalfSpace(),), np.concatenate([REST, turned]), np.array([0, 1]))
    first, second = trajectory_pictures(HAND, BLOCK, [[at("grasp")]] * 2, around, (48, 48), samples=2)[:, 0, 0]
    np.testing.assert_array_equal(second, grasped(PictureScenes((HalfSpace(),), turned)))
    assert (first != second).any()


def test_links_above_root_are_drawn_at_the_angles_of_the_wrist():
    # A copy of the hand behind its root serves as a forearm with two wrist joints.
    back = np.array([0, 0, -0.12])
    forearm = replace(HAND, pieces=tuple(replace(p, vertices=p.vertices + back) for p in HAND.pieces))
    mounted = replace(HAND, mounting=forearm)

    def picture(hand, wrist) -> np.ndarray:
        where = replace(TABLE_SCENE, wrist=wrist if wrist is None else np.array([wrist]))
        return grasped(where, hand, whole=True).astype(int)

    bare, straight, bent = picture(mounted, None), picture(mounted, [0.0, 0.0]), picture(mounted, [0.9, 0.9])
    assert np.array_equal(bare, picture(HAND, None))
    assert (np.abs(straight - bare).max(axis=-1) > 40).sum() > 30
    assert (np.abs(straight - bent).max(axis=-1) > 40).sum() > 5
    drawn = DrawnHand(mounted, np.array([0, -1]), np.stack([DOWN] * 2), np.zeros((2, 2)), np.array([[0.9, 0.9]] * 2))
    own, above = drawn.body_poses(), body_poses(forearm, DOWN[None], np.array([[0.9, 0.9]]))[0]
    assert len(drawn.parts) == own.shape[1] == 2 * len(drawn_bodies(HAND))
    assert own[0, len(drawn_bodies(HAND)) :] == pytest.approx(above[drawn_bodies(forearm)])
    assert (own[1, :, 2] < -10).all()


def colours() -> np.ndarray:
    return np.repeat(np.repeat(200 * np.eye(3, dtype=np.uint8)[:, None, None], 24, 1), 32, 2)


@pytest.mark.parametrize("suffix", sorted(KINDS))
def test_every_picture_is_shown_for_its_time_and_again(suffix):
    if suffix == ".webp" and not features.check("webp"):
        pytest.skip("this Pillow writes no WebP")
    with Image.open(io.BytesIO(encode_animation(colours(), SECONDS, suffix))) as film:
        assert film.n_frames == 3 and film.info.get("loop") == 0
        for frame, wanted, shown in zip(ImageSequence.Iterator(film), colours(), [500, 50, 1200], strict=True):
            # WebP is lossy: a plain colour comes back within a few of 256 steps.
            assert np.abs(np.asarray(frame.convert("RGB")).astype(int) - wanted).max() <= 6
            assert frame.info["duration"] == shown
    with pytest.raises(InputError, match="not as a file without suffix"):
        encode_animation(colours(), SECONDS, "")


def test_the_object_is_carried_with_the_hand_from_where_it_rests():
    rest = np.array([[0.3, -0.2, 0.05, np.sqrt(0.5), 0, 0, np.sqrt(0.5)]])
    heights = dict(zip(POSTURES, (0.2, 0.1, 0.1, 0.1, 0.1, 0.35), strict=True))
    poses = {name: rest + np.array([0, 0, height, 0, 0, 0, 0]) for name, height in heights.items()}
    closing = dict(zip(POSTURES, (0.0, 0.0, 0.5, 1.0, 1.2, 1.2), strict=True))
    postures = {name: Posture(poses[name], np.full((1, 1), closing[name])) for name in POSTURES}
    tool, rows = ToolFrame("palm", rest[0]), np.zeros(1, np.intp)
    found = Executions(None, None, tool, "scene", rows, rest, postures, None, {})
    way = time_motions(straight_paths(found, 0), ["joint"], np.ones(1), speed=1.0)
    points = waypoints(found, way)
    assert len(points) == len(way.time)
    (closed,) = [k for k, point in enumerate(points) if point.name == "grasp"]
    assert points[closed].joint_positions == pytest.approx(closing["grasp"])
    for k, point in enumerate(points):
        np.testing.assert_allclose(compose(rest[0], point.hand_pose), way.hand_pose[k], atol=1e-12)
        if way.phase[k] == "lift":
            # In the hand's frame the object stays where it was grasped.
            held = apply(invert(point.hand_pose), point.carried)
            np.testing.assert_allclose(held, apply(invert(points[closed].hand_pose), np.zeros(3)), atol=1e-12)
        else:
            assert not point.carried.any()
    np.testing.assert_allclose(points[-1].carried, [0, 0, 0.25], atol=1e-12)


@pytest.mark.parametrize("normal", [(0, 0, 1), (1, 0, 0), (0, -2, 0), (1, 2, 3), (0, 0, -1)])
def test_the_top_of_a_half_spaces_slab_is_its_plane(normal):
    (pose,) = slab_poses([HalfSpace(normal=normal, offset=0.12)], np.array([0.1, 0.05, 0.2]), 0.7)
    unit = np.asarray(normal, float) / np.linalg.norm(normal)
    top = pose[:3] + quat_rotate(pose[3:], np.array([0.2, -0.3, TABLE_SIZE[2] / 2]))
    # Rounding of a handful of products near 1.
    assert unit @ top == pytest.approx(0.12 / np.linalg.norm(normal), abs=1e-12)
    np.testing.assert_allclose(quat_rotate(pose[3:], np.array([0, 0, 1.0])), unit, atol=1e-12)


def test_a_box_keeps_its_size_and_hides_what_is_behind_it() -> None:
    wall = [Box(size=(0.02, 0.4, 0.2), pose=(0.12, 0, 0.1, 1, 0, 0, 0))]
    assert slabs(wall)[0].size == (0.02, 0.4, 0.2)
    np.testing.assert_array_equal(slab_poses(wall, np.zeros(3), 0.7)[0], wall[0].pose)
    points = np.array([[0, 0, 0.05], [0, 0, 0.5]])
    assert visible_share(wall, np.array([0.5, 0, 0.1]), points) == 0.5
    assert visible_share(wall, np.array([-0.5, 0, 0.1]), points) == 1.0
    assert visible_share(TABLE, np.array([0.5, 0, -0.1]), points) == 0.0
    board = [Box(size=(0.4, 0.4, 0.02), pose=(0, 0, -0.01, 1, 0, 0, 0))]
    assert visible_share(board, np.array([0.5, 0, 0.4]), np.zeros((1, 3))) == 1.0


@pytest.mark.parametrize("kind", ["bin", "shelf"])
def test_every_camera_sees_the_object_past_walls_and_boards(kind):
    extras = Extras(supports=SPECS[kind], channels=("occlusion",))
    views = render(BLOCK, REST, views=4, stereo=False, width=48, height=36, seed=3, samples=2, extras=extras)
    labels = np.asarray(views["image/segmentation"])
    assert ((labels == 2).sum(axis=(1, 2)) > 20).all()
    assert set(np.unique(labels)) <= {0, 1, 2}, "all supports are labelled as the table"
    assert (labels == 1).mean() > 0.2 and np.isfinite(views["box/occlusion_ratio"]).all()


def test_a_table_looks_the_same_named_or_not():
    options = {"views": 1, "stereo": False, "width": 48, "height": 36, "seed": 3, "samples": 2}
    named = render(BLOCK, REST, **options, extras=Extras(supports=SPECS["table"]))
    np.testing.assert_array_equal(named["image/rgb"], render(BLOCK, REST, **options)["image/rgb"])


@pytest.fixture(scope="module")
def coloured() -> HandModel:
    blue = '<material name="blue"><color rgba="0 0 1 1"/></material>'
    urdf = robot(blue, link("palm", SHAPE + SEEN), link("a", SHAPE), joint("j", "palm", "a"))
    part = bytes(trimesh.creation.icosphere(1, 0.01).export(file_type="stl"))
    return load_hand({"h.urdf": urdf, "part.stl": part}, name="h", digest="0" * 32)


def test_what_is_seen_has_its_colours_else_collision_shapes(coloured: HandModel) -> None:
    palm = [part for part in hand_parts(coloured) if part.body == 0]
    assert sorted((part.look.base, len(part.solid.faces)) for part in palm) == [((0, 0, 1), 80), ((1, 0, 0), 12)]
    (finger,) = [part for part in hand_parts(coloured) if part.body == 1]
    assert np.ptp(finger.solid.vertices, axis=0) == pytest.approx([0.02, 0.02, 0.04])


def test_collision_shapes_are_drawn_on_a_toggle(coloured: HandModel) -> None:
    bare = without_visuals(coloured)
    assert bare.pieces is coloured.pieces and bare.content != coloured.content
    assert drawn_bodies(bare) == [0, 1] and drawn_bodies(coloured) == [0, 0, 1]
    assert np.ptp(hand_parts(bare)[0].solid.vertices, axis=0) == pytest.approx([0.02, 0.02, 0.04])
    above = without_visuals(replace(coloured, mounting=coloured)).mounting
    assert above is not None and drawn_bodies(above) == [0, 1]


def test_a_model_for_viewers_has_the_colours(coloured: HandModel) -> None:
    scene = trimesh.load(trimesh.util.wrap_as_stream(hand_glb(coloured)), file_type="glb")
    meshes = [mesh for mesh in scene.geometry.values() if len(getattr(mesh, "faces", ()))]
    colours = {tuple(colour) for mesh in meshes for colour in mesh.visual.vertex_colors[:, :3].tolist()}
    assert {(255, 0, 0), (0, 0, 255)} <= colours


H, W = 6, 8
DEPTH_M = 1e-4  # what a view promises of its depth [m]: tests/worker/rendering/test_views.py


@pytest.fixture
def views() -> Shard:
    rng = np.random.default_rng(0)
    depth = rng.uniform(0.2, 0.9, (2, H, W)).astype(np.float32)
    depth[0, 0, 0], depth[1, 0, 0] = np.inf, 9.0
    eye = np.eye(4)
    eye[:3, 3] = [0, 0, 0.5]
    arrays = {
        "camera/intrinsics": np.tile(np.array([[9.0, 0, 4], [0, 9, 3], [0, 0, 1]]), (2, 1, 1)),
        "camera/extrinsics": np.tile(eye, (2, 1, 1)),
        "camera/scene_index": np.array([0, 1], np.int32),
        "camera/eye": np.array([1, 2], np.uint8),
        "camera/stereo_baseline_m": np.full(2, 0.06),
        "image/rgb": rng.integers(0, 256, (2, H, W, 3), np.uint8),
        "image/depth": depth,
        "image/segmentation": rng.integers(0, 4, (2, H, W), np.uint8),
        "image/distance": (depth * np.float32(1.1)),
        "image/normals": rng.normal(size=(2, H, W, 3)).astype(np.float16),
        "box/bounding_box_2d_tight": np.array([[1, 2, 3, 4], [np.nan] * 4], np.float32),
        "box/bounding_box_2d_loose": np.ones((2, 4), np.float32),
        "box/bounding_box_3d": np.ones((2, 8, 3), np.float32),
        "box/occlusion_ratio": np.array([0.25, np.nan], np.float32),
    }
    return Shard("views", {"object": "mug", "neighbours": ["block"]}, arrays)


def pixels(path: Path) -> np.ndarray:
    with Image.open(path) as image:
        return np.array(image)


def plane(path: Path, channel: str) -> np.ndarray:
    with OpenEXR.File(str(path), separate_channels=True) as file:
        return np.array(file.channels()[channel].pixels)


def test_an_export_comes_back_exactly_with_its_cameras_and_is_not_repeated(views, tmp_path) -> None:
    export_images(views, tmp_path)
    for view in range(2):
        for file, column in (("rgb", "rgb"), ("semantic_segmentation", "segmentation")):
            np.testing.assert_array_equal(pixels(tmp_path / f"{file}_{view:04}.png"), views[f"image/{column}"][view])
        for file, column in (("distance_to_image_plane", "depth"), ("distance_to_camera", "distance")):
            found = plane(tmp_path / f"{file}_{view:04}.exr", "Z")
            np.testing.assert_array_equal(found, views[f"image/{column}"][view])
        normals = np.stack([plane(tmp_path / f"normals_{view:04}.exr", axis) for axis in "XYZ"], axis=-1)
        assert normals.dtype == np.float16
        np.testing.assert_array_equal(normals, views["image/normals"][view])
    left, right = (json.loads((tmp_path / f"view_{view:04}.json").read_text()) for view in range(2))
    assert (left["eye"], right["eye"], right["scene"], left["width"], left["height"]) == ("left", "right", 1, W, H)
    assert left["position"] == [0, 0, -0.5] and left["intrinsics"] == [[9, 0, 4], [0, 9, 3], [0, 0, 1]]
    assert left["bounding_box_2d_tight"] == [1, 2, 3, 4] and left["occlusion_ratio"] == 0.25
    assert right["bounding_box_2d_tight"] is None and right["occlusion_ratio"] is None
    labels = json.loads((tmp_path / "labels.json").read_text())
    assert [labels[k]["class"] for k in "0123"] == ["background", "table", "mug", "block"]
    with pytest.raises(InputError, match="exported views already"):
        export_images(views, tmp_path)


def test_png_depth_is_right_to_half_a_step(views, tmp_path) -> None:
    export_images(views, tmp_path, depth="png")
    steps = pixels(tmp_path / "distance_to_image_plane_0000.png")
    assert steps.dtype in (np.uint16, np.int32)
    finite = np.isfinite(views["image/depth"][0])
    error = steps * PNG_STEP_M - np.where(finite, views["image/depth"][0], 0.0)
    # Half a step, and the rounding of float32.
    assert np.abs(error).max() <= 0.5 * PNG_STEP_M + 1e-7
    assert steps[0, 0] == 0
    assert pixels(tmp_path / "distance_to_image_plane_0001.png")[0, 0] == 65535
    assert not list(tmp_path.glob("distance*.exr"))


def test_points_of_a_rendered_object_lie_on_its_mesh(tmp_path: Path) -> None:
    mesh = trimesh.creation.capsule(height=0.05, radius=0.03, count=[24, 24])
    options = {"views": 2, "stereo": False, "width": 96, "height": 72, "seed": 1, "samples": 2}
    views = render(object_from_mesh(mesh, "box"), box_scenes.POSES, **options)
    folder = box_scenes.write(tmp_path / "set")
    said = {"hand": "claw", "object": "box", "batch": 0, "shard_id": "c" * 32, "base_shard": "b" * 32}
    (folder / "views.h5").write_bytes(write_shard("views", views, said))
    pictures = Pictures(open_shards(folder))
    for sample in (*pictures.clouds(300, frame="object"), *pictures.clouds(300, fuse=True, frame="object")):
        _, distance, face = trimesh.proximity.closest_point(mesh, sample["cloud/points"].astype(float))
        assert distance.max() < DEPTH_M
        cosine = np.einsum("pc,pc->p", mesh.face_normals[face], sample["cloud/normals"])
        # Faces turn by 7.5 degrees each, and a pixel's neighbours may lie on the next one.
        assert np.quantile(cosine, 0.1) > np.cos(np.radians(12)) and np.median(cosine) > np.cos(np.radians(4))


def test_surface_of_the_hand_of_a_shard_follows_its_kinematics() -> None:
    """All of a hand moves with its root; the points of a body that no joint carries move with nothing else."""
    hand = hand_from_path("barrett")
    joints = np.zeros((2, len(hand.joint_names)))
    joints[1] = 0.3
    pose = np.array([[0.1, 0.2, 0.3, 1, 0, 0, 0], [0, 0, 0, np.sqrt(0.5), 0, 0, np.sqrt(0.5)]])
    said = {"hand": "barrett", "hand_digest": hand.digest}
    shard = Shard("base", said, {"grasp/hand_pose": pose, "grasp/joint_positions": joints})
    found = hand_surface(shard, np.array([0, 1]))
    points = sample_surface(hand, found.shape[1])
    palm = points.body == 0
    for row in range(2):
        np.testing.assert_allclose(found[row, palm], apply(pose[row], points.position[palm]), atol=1e-12)
    still = Shard("base", said, {**shard.arrays, "grasp/joint_positions": joints[[0, 0]]})
    assert np.abs(hand_surface(still, np.array([1]))[0, ~palm] - found[1, ~palm]).max() > 0.01

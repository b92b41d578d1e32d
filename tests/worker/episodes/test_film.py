"""Films of episodes: a hand that flies to a mug, against the ray tracer and by what must be visible."""

import io
from dataclasses import replace

import numpy as np
import pytest

from graspd.service.model.errors import InputError
from graspd.service.model.scene_spec import Box as Wall
from graspd.service.model.scene_spec import HalfSpace
from graspd.service.model.transforms import apply, invert, pose_to_matrix
from graspd.worker.episodes import film
from graspd.worker.episodes.episode import PHASES, Episode, EpisodeOutcome, Robot
from graspd.worker.episodes.film import HAND, OBJECT, SUPPORT, EpisodeRenderer, FilmOptions, encode, film_options
from graspd.worker.hands.load import hand_from_path
from graspd.worker.objects.prepare import object_from_path
from graspd.worker.rendering.hands import hand_parts
from graspd.worker.rendering.scenery import Appearance, CameraShot, Lamp, Solid
from graspd.worker.rendering.tracer import Tracer

MUG = object_from_path("mug")
OPTIONS = FilmOptions(("scene", "wrist", "moving"), 96, 72, depth=True, segmentation=True)


def flight(robot: Robot, frames: int = 4) -> Episode:
    """The open hand comes from above to a mug on the table, palm down, and lifts it by 10 cm in the last frame."""
    hand = robot.hand
    down = np.array([0.0, 0.0, -1.0])
    half = hand.palm.approach + down
    half = half / np.linalg.norm(half) if np.linalg.norm(half) > 1e-6 else np.array([1.0, 0.0, 0.0])
    turned = np.append(0.0, half)  # half a turn about the middle of both directions
    # The object's lowest point is on the table.
    rest = np.append([0.0, 0.0, -MUG.vertices[:, 2].min()], [1.0, 0, 0, 0])
    above = rest[2] + MUG.vertices[:, 2].max() + np.append(np.linspace(0.25, 0.07, frames - 1), 0.17)
    roots = np.stack([np.append([0, 0, z], turned) for z in above])
    roots[:, :3] -= apply(np.append(np.zeros(3), turned), hand.palm.centre) * [1, 1, 0]
    things = np.tile(rest, (frames, 1))
    things[-1, 2] += 0.1
    state = np.concatenate([roots, np.tile(hand.preshape, (frames, 1))], axis=1)
    phase = np.full(frames, PHASES.index("approach"), np.uint8)
    return Episode(0, 0, EpisodeOutcome.SUCCEEDED, phase, state, state, things)


@pytest.fixture(scope="module", params=["barrett", "allegro", "shadow"])
def robot(request: pytest.FixtureRequest) -> Robot:
    return Robot(hand_from_path(request.param))


@pytest.fixture(scope="module")
def films(robot: Robot) -> dict:
    return EpisodeRenderer(robot, MUG, options=OPTIONS).film(flight(robot), (0, 1))


def test_the_scene_camera_sees_the_object_in_every_frame(robot: Robot, films: dict) -> None:
    # The wall hides the mug from every fourth direction or more.
    wall = Wall(size=(0.02, 0.6, 0.5), pose=(0.2, 0, 0.25, 1, 0, 0, 0))
    options = replace(OPTIONS, cameras=("scene",))
    renderer = EpisodeRenderer(robot, MUG, supports=(HalfSpace(), wall), options=options)
    for seed in range(3):
        seen = renderer.film(flight(robot), (seed,))["scene"].segmentation
        assert ((seen == OBJECT).mean(axis=(1, 2)) > 0.004).all()  # 28 of 6912 pixels
    turned = films["moving"].pose[:, :3] - films["scene"].pose[:, :3]
    # Half-way, the moving camera is at the scene camera; it turns by 12 degrees in a second.
    np.testing.assert_allclose(turned[2], 0, atol=1e-12)
    assert np.linalg.norm(turned[0]) > 0.005


def test_the_wrist_camera_is_outside_of_the_hand_and_sees_palm_side_and_object(robot: Robot, films: dict) -> None:
    wrist, episode = films["wrist"], flight(robot)
    hand, bodies = robot.poses(episode.state)[0]
    for piece in hand.pieces:
        local = apply(invert(bodies[:, piece.body]), wrist.pose[:, :3])
        triangles = piece.vertices[piece.faces]
        normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        # Some face's plane is between the camera and a convex piece.
        assert (np.einsum("tfx,fx->tf", local[:, None] - triangles[:, 0], normals).max(axis=1) > 0.005).all()
    shares = {label: (wrist.segmentation == label).mean(axis=(1, 2)) for label in (OBJECT, HAND)}
    assert (shares[HAND] > 0.02).all() and (shares[HAND] < 0.75).all() and shares[OBJECT][-2:].min() > 0.03
    fixed = [invert(root) for root in bodies[:, 0]]
    places = [apply(root, place) for root, place in zip(fixed, wrist.pose[:, :3], strict=True)]
    np.testing.assert_allclose(places, places[:1] * len(places), atol=1e-9)


@pytest.mark.parametrize("camera", OPTIONS.cameras)
def test_depth_and_labels_are_those_of_the_ray_tracer(robot: Robot, films: dict, camera: str) -> None:
    episode, ours, parts = flight(robot), films[camera], hand_parts(robot.hand)
    tracer = Tracer([Solid(MUG.vertices, MUG.faces, MUG.corner_normals), *(part.solid for part in parts)], "cpu")
    bodies = robot.poses(episode.state)[0][1][:, [part.body for part in parts]]
    count = len(episode.state)
    poses = np.concatenate([episode.object_pose[:, None], bodies], axis=1)
    tracer.place(poses, [[Appearance((1, 1, 1))] * (1 + len(parts))] * count)
    shot = CameraShot(
        world=np.arange(count, dtype=np.int32),
        extrinsics=np.linalg.inv(pose_to_matrix(ours.pose)),
        intrinsics=ours.intrinsics,
        width=OPTIONS.width,
        height=OPTIONS.height,
        samples=1,
        toward_lamp=np.array([0, 0, 1.0]),
        turn=np.zeros(count),
        lamps=[Lamp()] * count,
    )
    traced = tracer.render(shot)
    labels = np.where(traced.shape < 0, 0, np.where(traced.shape == 0, OBJECT, HAND))
    seen = np.where(ours.segmentation == SUPPORT, 0, ours.segmentation)
    # The tracer does not see faces from behind: through holes in the visual meshes, and inside of solids that overlap.
    same = seen == labels
    assert same.mean() > 0.99
    both = same & (labels > 0)
    error = np.abs(ours.depth[both] - 1000 * traced.depth[both])
    assert np.quantile(error, 0.99) < 1.0  # rounding to 0.5 mm, and float32


def test_pictures_depend_on_the_seed_alone(robot: Robot, films: dict) -> None:
    renderer, episode = EpisodeRenderer(robot, MUG, options=OPTIONS), flight(robot)
    other, again = renderer.film(episode, (0, 2)), renderer.film(episode, (0, 1))
    for camera in OPTIONS.cameras:
        np.testing.assert_array_equal(again[camera].rgb, films[camera].rgb)
        assert np.abs(again[camera].rgb.astype(int) - other[camera].rgb).mean() > 5


@pytest.mark.parametrize("walls", [(), (Wall(size=(0.02, 0.5, 0.3), pose=(0.25, 0, 0.15, 1, 0, 0, 0)),)])
def test_solids_cast_shadows_on_a_plain_table(walls: tuple, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(film, "draw_table_look", lambda rng: Appearance((0.5, 0.5, 0.5), roughness=0.9))
    robot = Robot(hand_from_path("barrett"))
    renderer = EpisodeRenderer(robot, MUG, supports=(HalfSpace(), *walls), options=replace(OPTIONS, cameras=("scene",)))
    taken = renderer.film(flight(robot), (3,))["scene"]
    light = taken.rgb[taken.segmentation == SUPPORT].astype(float).mean(axis=-1)
    # Gloss and directions change a plain table by less than a tenth.
    assert 0.02 < (light < 0.8 * np.median(light)).mean() < 0.5


def test_depth_is_lossless_and_colours_are_close() -> None:
    av = pytest.importorskip("av", reason="PyAV is not installed; pip install 'graspd[film]'")
    rng = np.random.default_rng(0)
    smooth = np.linspace(0, 255, 96)[None, None, :, None] * np.ones((12, 72, 1, 3))

    def decoded(data: bytes, format_: str) -> np.ndarray:
        with av.open(io.BytesIO(data)) as source:
            return np.stack([frame.to_ndarray(format=format_) for frame in source.decode(video=0)])

    for dtype, format_ in ((np.uint16, "gray16le"), (np.uint8, "gray")):
        values = rng.integers(0, np.iinfo(dtype).max, (5, 72, 96), dtype)
        np.testing.assert_array_equal(decoded(encode(values, 15), format_), values)
    colour = smooth.astype(np.uint8)
    seen = decoded(encode(colour, 15), "rgb24")
    assert seen.shape == colour.shape
    assert np.abs(seen.astype(int) - colour).mean() < 3


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("front",), "no 'front'"),
        (("scene", "33x20"), "two even numbers"),
        (("scene", "64x48", "normals"), "no 'normals'"),
        (("scene", "64x48", "", 12.5), "whole number"),
    ],
)
def test_options_that_are_unknown_are_refused(words: tuple, message: str) -> None:
    with pytest.raises(InputError, match=message):
        film_options(*words)

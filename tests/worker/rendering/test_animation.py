"""Films: every picture for its time in each kind of file; and the way that they show."""

from __future__ import annotations

import io

import numpy as np
import pytest
from PIL import Image, ImageSequence, features

from graspd.commands.grasp_sheet import waypoints
from graspd.exchange.robots.execution import POSTURES, Executions, ToolFrame, straight_paths, timed
from graspd.service.model.errors import InputError
from graspd.service.model.transforms import apply, compose, invert
from graspd.worker.grasps import Posture
from graspd.worker.rendering.trajectory_pictures import KINDS, animation

SECONDS = [0.5, 0.05, 1.2]


def colours() -> np.ndarray:
    """Three plain pictures: red, green, blue."""
    return np.repeat(np.repeat(200 * np.eye(3, dtype=np.uint8)[:, None, None], 24, 1), 32, 2)


@pytest.mark.parametrize("suffix", sorted(KINDS))
def test_every_picture_is_shown_for_its_time_and_the_film_begins_anew(suffix):
    if suffix == ".webp" and not features.check("webp"):
        pytest.skip("this Pillow writes no WebP")
    with Image.open(io.BytesIO(animation(colours(), SECONDS, suffix))) as film:
        assert film.n_frames == 3
        assert film.info.get("loop") == 0
        shown = []
        for frame, wanted in zip(ImageSequence.Iterator(film), colours(), strict=True):
            # WebP is lossy: a plain colour comes back within a few of 256 steps.
            assert np.abs(np.asarray(frame.convert("RGB")).astype(int) - wanted).max() <= 6
            shown.append(frame.info["duration"])
    assert shown == [500, 50, 1200]


def test_a_file_that_holds_no_animation_is_refused():
    with pytest.raises(InputError, match="not as a file without suffix"):
        animation(colours(), SECONDS, "")


def test_the_object_is_carried_with_the_hand_from_where_it_rests():
    rest = np.array([[0.3, -0.2, 0.05, np.sqrt(0.5), 0, 0, np.sqrt(0.5)]])
    heights = dict(zip(POSTURES, (0.2, 0.1, 0.1, 0.1, 0.1, 0.35), strict=True))
    poses = {name: rest + np.array([0, 0, height, 0, 0, 0, 0]) for name, height in heights.items()}
    closing = dict(zip(POSTURES, (0.0, 0.0, 0.5, 1.0, 1.2, 1.2), strict=True))
    found = Executions(
        None,
        None,
        ToolFrame("palm", rest[0]),
        "scene",
        np.zeros(1, np.intp),
        rest,
        {name: Posture(poses[name], np.full((1, 1), closing[name])) for name in POSTURES},
        None,
        {},
    )
    way = timed(straight_paths(found, 0), ["joint"], np.ones(1), speed=1.0)
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

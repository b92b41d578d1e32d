"""Models of depth cameras: the noise they say they make is the noise they make, and holes are where geometry says."""

from dataclasses import replace

import numpy as np
import pytest

from graspd.service.model.errors import InputError
from graspd.service.model.pinhole import pixel_rays
from graspd.service.readers.depth_noise import NOISES, DepthNoise, parse_depth_noise, shadow_mask

WIDTH, HEIGHT = 320, 240
K = np.array([[330.0, 0, 160], [0, 330.0, 120], [0, 0, 1]])


def plane(distance: float, tilt_deg: float = 0.0) -> np.ndarray:
    """Depth of a plane through (0, 0, distance), turned about the camera's y axis."""
    tilt = np.radians(tilt_deg)
    normal = np.array([np.sin(tilt), 0, -np.cos(tilt)])
    return np.asarray(-distance * np.cos(tilt) / (pixel_rays(K, WIDTH, HEIGHT) @ normal))


def still(noise: DepthNoise) -> DepthNoise:
    return replace(noise, lateral_px=0.0, lateral_angle_px=0.0, mixed=False)


@pytest.mark.parametrize("name", list(NOISES))
@pytest.mark.parametrize("distance", [0.4, 0.8])
def test_the_depth_of_a_wall_scatters_as_the_model_says(name: str, distance: float) -> None:
    noise = still(NOISES[name])
    seen = noise.apply(plane(distance), K, np.random.default_rng(1))
    found = seen[np.isfinite(seen)]
    # Rays within 30 degrees of the axis: Nguyen's term of the angle adds less than a hundredth there.
    expected = float(noise.sigma(np.array(distance), np.array(np.radians(10))))
    # 60,000 samples leave 0.3 % of chance; steps as wide as the noise are not quite an even spread: 5 %.
    assert found.std() == pytest.approx(expected, rel=0.05)
    assert found.mean() == pytest.approx(distance, abs=0.15 * expected)


def test_stereo_noise_grows_with_the_square_of_the_distance() -> None:
    noise, angle = NOISES["stereo"], np.zeros(3)
    found = noise.sigma(np.array([0.5, 1.0, 2.0]), angle)
    np.testing.assert_allclose(found / found[0], [1, 4, 16], rtol=1e-12)
    # z^2 p / (f B), with p the root of 0.08^2 and of steps of 1/32 px.
    assert found[1] == pytest.approx(np.hypot(0.08, 1 / 32 / np.sqrt(12)) / (424 * 0.05), rel=1e-12)


def test_structured_light_has_the_published_noise() -> None:
    noise = NOISES["structured_light"]
    for z, angle in ((0.4, 0.0), (1.0, 0.3), (1.5, 1.2)):
        published = 0.0012 + 0.0019 * (z - 0.4) ** 2 + 0.0001 / np.sqrt(z) * angle**2 / (np.pi / 2 - angle) ** 2
        assert float(noise.axial_sigma(np.array(z), np.array(angle))) == pytest.approx(published, rel=1e-12)


def test_depths_are_steps_of_disparity_and_the_same_for_the_same_seed() -> None:
    first, again, other = (NOISES["stereo"].apply(plane(0.6), K, np.random.default_rng(seed)) for seed in (2, 2, 4))
    steps = 424 * 0.05 / first[np.isfinite(first)] * 32
    np.testing.assert_allclose(steps, np.round(steps), atol=1e-9)
    np.testing.assert_array_equal(first, again)
    assert (first != other).mean() > 0.5


def test_what_the_second_eye_does_not_see_is_a_hole() -> None:
    """A board at 0.4 m before a wall at 0.8 m hides a band as wide as its disparity exceeds the wall's, on its left."""
    depth = plane(0.8)
    depth[60:180, 140:200] = 0.4
    product = 330 * 0.048  # disparities of 19.8 and 39.6 px
    hidden = shadow_mask(depth, product)
    wall, board = product / 0.8, product / 0.4
    rows = hidden[60:180]
    assert rows[:, 140:200].sum() == 0
    assert rows[:, 200:].sum() == 0
    # The wall's pixels from here to the board are carried to where the board stands: to the pixel that is rounded.
    assert rows[:, int(wall) + 1 : 140].sum(axis=1) == pytest.approx(board - wall, abs=1)
    # Where there is no board, what falls off the other picture's side: as wide as the wall's disparity.
    assert hidden[:60].sum(axis=1) == pytest.approx(wall, abs=1)
    assert not hidden[:60, int(wall) + 1 :].any()


def test_holes_are_a_share_at_random_and_where_nothing_can_be_measured() -> None:
    noise, draw = still(NOISES["stereo"]), np.random.default_rng(6)
    seen = noise.apply(plane(0.5), K, np.random.default_rng(5))
    disparity = 330 * 0.05 / 0.5
    inside = seen[:, int(disparity) + 1 :]
    chance = 4 * np.sqrt(0.01 * 0.99 / inside.size)  # four deviations of a binomial
    assert np.isnan(inside).mean() == pytest.approx(0.01, abs=chance)
    assert np.isnan(seen[:, : int(disparity) - 1]).all()
    middle = (slice(100, 140), slice(150, 170))
    assert np.isnan(noise.apply(plane(0.5, 84), K, draw)[middle]).all()
    assert np.isnan(noise.apply(plane(0.5, 70), K, draw)[middle]).mean() < 0.1
    assert np.isnan(noise.apply(plane(0.16), K, draw)).all()  # 424 px x 50 mm / 126 px = 168 mm


def test_edges_bleed_and_pixels_on_them_fly_a_little() -> None:
    depth = plane(0.8)
    depth[:, :160] = 0.4  # its shadow falls off the other side
    draw = np.random.default_rng(7)
    far = NOISES["stereo"].apply(depth, K, draw)[:, 155:165]
    bled = (np.abs(far - depth[:, 155:165]) > 0.2).mean(axis=0)
    assert bled[4:6].min() > 0.02  # beside the edge: half a pixel of 424 is 0.39 of 330
    assert bled[[0, 9]].max() == 0.0  # five pixels off
    flying = NOISES["tof"].apply(depth, K, draw)
    between = (flying > 0.45) & (flying < 0.75)
    assert between[:, 159].mean() > 0.5
    assert between.sum() == between[:, 159].sum()


def test_an_unknown_camera_is_told_the_ones_there_are() -> None:
    with pytest.raises(InputError, match="stereo, structured_light, tof"):
        parse_depth_noise("kinect")
    assert parse_depth_noise(None) is None

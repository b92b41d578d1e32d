"""The example that trains a grasp predictor: its frames, loss and table; skipped where torch is not installed."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from service.model.transforms import compose, invert, quat_to_matrix

torch = pytest.importorskip("torch", reason="torch is not installed; `pip install torch` runs these tests")

from examples.train_grasp_predictor import table  # noqa: E402
from examples.train_grasp_predictor.execution import in_object_frame, orthogonal  # noqa: E402
from examples.train_grasp_predictor.network import loss  # noqa: E402
from examples.train_grasp_predictor.samples import SIZE, Example, crop_of, targets_of  # noqa: E402
from examples.train_grasp_predictor.training import train, turned  # noqa: E402

JOINTS = 4
FOCAL = 100.0


def poses(count: int, seed: int) -> np.ndarray[Any, Any]:
    rng = np.random.default_rng(seed)
    quaternions = rng.normal(size=(count, 4))
    return np.concatenate(
        [rng.normal(size=(count, 3)), quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True)], axis=1
    )


def example(grasps: Any, *, anchor: Any = (0.0, 0.0, 1.0), object_pose: Any = (0, 0, 1.0, 1, 0, 0, 0)) -> Example:
    return Example(torch.zeros(5, SIZE, SIZE), grasps, np.array(anchor), "mug", np.array(object_pose, float))


def picture(depth: float, x: slice, y: slice) -> dict[str, Any]:
    """A camera that sees a table 1 m away and one box-like object before it."""
    far, mask = np.full((60, 80), 1.0, np.float32), np.zeros((60, 80), np.uint8)
    far[y, x], mask[y, x] = depth, 2
    return {
        "image/rgb": np.zeros((60, 80, 3), np.uint8),
        "image/depth": far,
        "image/segmentation": mask,
        "box/bounding_box_2d_tight": np.array([x.start, y.start, x.stop, y.stop]),
        "camera/intrinsics": np.array([[FOCAL, 0, 40], [0, FOCAL, 30], [0, 0, 1]], float),
    }


def test_an_answer_is_the_hand_pose_of_its_grasp_in_the_objects_frame() -> None:
    hand, placed = poses(6, 0), poses(1, 1)[0]
    anchor = np.array([0.1, -0.2, 0.7])
    rows = targets_of(hand, np.zeros((6, JOINTS)), anchor)
    shown = example(rows, anchor=anchor, object_pose=placed)
    for row, expected in zip(rows.numpy().astype(float), compose(invert(placed), hand), strict=True):
        found = in_object_frame(row, shown)
        # Targets are float32; a quaternion and its negative are one rotation.
        np.testing.assert_allclose(found[:3], expected[:3], atol=1e-5)
        np.testing.assert_allclose(quat_to_matrix(found[3:]), quat_to_matrix(expected[3:]), atol=1e-5)


def test_any_six_numbers_become_a_rotation() -> None:
    for row in np.random.default_rng(2).normal(size=(20, 6)):
        rotation = orthogonal(row)
        np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(rotation) == pytest.approx(1.0)


def test_the_anchor_is_the_middle_of_the_object_seen() -> None:
    found = crop_of(picture(0.5, slice(50, 70), slice(10, 20)))
    assert found is not None
    # Pixel (60, 15) is (20, -15) from the principal point, at 0.5 m.
    np.testing.assert_allclose(found[1], [20 / FOCAL * 0.5, -15 / FOCAL * 0.5, 0.5])


def test_the_crop_shows_the_object_in_its_middle_and_its_surroundings_farther_away() -> None:
    found = crop_of(picture(0.5, slice(50, 70), slice(10, 20)))
    assert found is not None
    image = found[0]
    assert image.shape == (5, SIZE, SIZE)
    assert image[4, SIZE // 2, SIZE // 2] == 1.0
    assert image[3, SIZE // 2, SIZE // 2] == pytest.approx(0.0, abs=1e-6)
    assert image[3, 2, SIZE // 2] == 3.0  # 0.5 m behind, cut at 3 units


def test_an_object_that_is_hardly_seen_is_left_out() -> None:
    assert crop_of(picture(0.5, slice(50, 54), slice(10, 14))) is None


def test_a_turned_picture_and_its_grasps_turn_together() -> None:
    image = torch.zeros(1, 5, SIZE, SIZE)
    image[0, 4, SIZE // 2 - 2 : SIZE // 2 + 2, SIZE - 8 : SIZE - 4] = 1.0  # seen at the right: along the camera's x
    grasp = torch.zeros(1, 1, 9 + JOINTS)
    grasp[..., 0], grasp[..., 3], grasp[..., 7] = 0.1, 1.0, 1.0  # at the right; its columns are x and y
    images, shown = turned(image, grasp, torch.tensor([torch.pi / 2]))
    rows, columns = torch.nonzero(images[0, 4] > 0.5, as_tuple=True)
    assert rows.min() >= SIZE - 9
    assert abs(columns.float().mean() - SIZE / 2) < 2  # now below: along y
    expected = torch.tensor([0, 0.1, 0, 0, 1, 0, -1, 0, 0])
    torch.testing.assert_close(shown[0, 0, :9], expected, atol=1e-6, rtol=0)


def test_of_several_answers_only_the_nearest_needs_to_be_right() -> None:
    shown = torch.zeros(1, 1, 9 + JOINTS)
    right, wrong = torch.zeros(1, 1, 9 + JOINTS), torch.ones(1, 1, 9 + JOINTS)
    logits = torch.zeros(1, 2)
    one = loss(torch.cat([right, wrong], 1), logits, shown)
    none = loss(torch.cat([wrong, wrong], 1), logits, shown)
    assert one < 0.2 * none


def test_a_network_learns_both_of_two_opposite_grasps() -> None:
    grasps = torch.zeros(2, 9 + JOINTS)
    grasps[0, 0], grasps[1, 0] = 0.1, -0.1
    network, _ = train([example(grasps)] * 4, steps=120, seed=0)
    with torch.no_grad():
        answers = network(torch.zeros(1, 5, SIZE, SIZE))[0][0]
    apart = torch.linalg.norm(answers[:, None, :3] - grasps[None, :, :3], dim=-1).min(dim=0).values
    assert apart.max() < 0.02  # their mean, 0.1 m from both, is no grasp


def test_spread_is_over_seeds_and_means_are_over_objects() -> None:
    metrics = dict.fromkeys(
        ("contact_area_cm2", "intersection_volume_cm3", "epsilon", "wrench_volume", "simulated_displacement_cm"), 1.0
    )
    rows = [
        {"source": "ours", "side": "proposed", "seed": seed, "object": name, "grasps": 8, "gsr": gsr, **metrics}
        for seed, name, gsr in [(0, "mug", 0.2), (0, "box", 0.4), (1, "mug", 0.4), (1, "box", 0.6)]
    ]
    line = table.markdown(rows).splitlines()[-1]
    assert line.startswith("| ours | 2 | – | 16 |")
    assert line.endswith("| 0.4 ± 0.14 |")  # 0.3 and 0.5

"""DexGraspNet 2.0's loader, rebuilt: what it does was read in its source and is written anew here, without its draws of
chance, its sparse tensors and torch.

yl-wang996/DexGraspNet2, src/utils/dataset.py at cc03dc65505ab47482582d4641d81b4159e8aa1d (`GraspNetDataset`), with
configs/network/train_dex_ours.yaml there. How a depth picture becomes points, and which are taken, is its
src/utils/pc.py, how graspness is made src/preprocess/dex_graspness.py, both as zcyqyq/DexTouch-sim2real has them at
7824d859a8da1d942bc38709a9d217dfb548db5d.
"""

import random
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import scipy.io
from PIL import Image

#: Of its configuration: how far a grasp's point may be from the cloud [m].
MAX_POINT_DIS = 0.006
#: Of GraspNet: what is farther from the box around the objects is cut off [m].
OUTLIER = 0.02


@dataclass
class Sample:
    """Of one view of a scene, in the camera's frame: all of it, where the loader draws."""

    point_clouds: np.ndarray
    seg: np.ndarray
    rot: np.ndarray
    """(N, 3, 3)"""
    trans: np.ndarray
    qpos: np.ndarray
    """(N, J) in the order of the joint names given"""
    point: np.ndarray
    """(N, 3)"""
    near: np.ndarray
    """(N,) whether the grasp's point is near a point of the cloud: others are not taken"""
    graspness: np.ndarray
    """logarithms, of each point of the cloud"""
    has_graspness: bool


def views_of(split: range) -> list[tuple[str, int]]:
    return [(f"scene_{number:04}", view) for number in split for view in range(256)]


def some_views(root: Path, split: range, count: int, seed: int) -> list[tuple[str, int]]:
    """Views that are drawn and are there; a scene that is missing makes it draw again."""
    draw = random.Random(seed)
    there = [view for view in views_of(split) if (root / "data" / "scenes" / view[0]).is_dir()]
    return draw.sample(there, count)


def sample(root: Path, scene: str, view: int, robot: str, joint_names: list[str]) -> Sample:
    path = root / "data" / "scenes" / scene / "realsense"
    with Image.open(path / "depth_gt" / f"{view:04}.png") as file:
        depth = np.array(file)
    with Image.open(path / "label_gt" / f"{view:04}.png") as file:
        seg = np.array(file)
    meta = scipy.io.loadmat(path / "meta" / f"{view:04}.mat")
    poses, align = np.load(path / "camera_poses.npy"), np.load(path / "cam0_wrt_table.npy")
    cloud = _points(depth, meta["intrinsic_matrix"], meta["factor_depth"])
    assert seg.any(), "a view without objects is drawn anew"
    mask = (depth > 0) & _workspace(cloud, seg, align @ poses[view])
    cloud, seg = cloud[mask], seg[mask]
    parts = [np.load(file) for file in sorted((root / "data" / "dex_grasps_new" / scene / robot).iterdir())]
    grasps = {key: np.concatenate([part[key] for part in parts]) for key in parts[0].files}
    turn, place = poses[view][:3, :3], poses[view][:3, 3]
    point = (grasps["point"] - place) @ turn
    values = root / "data" / "dex_graspness_new" / scene / "realsense" / f"{view:04}.npy"
    graspness = np.zeros(len(cloud), np.float32)
    if values.exists():
        graspness = np.log(np.load(values).reshape(-1) + 1e-3)
        # It draws points by number and takes the same numbers here: another length is another cloud.
        assert len(graspness) == len(cloud)
    return Sample(
        cloud,
        seg,
        np.einsum("ji,njk->nik", turn, grasps["rotation"]),
        (grasps["translation"] - place) @ turn,
        np.stack([grasps[name] for name in joint_names], axis=-1),
        point,
        np.linalg.norm(cloud[None] - point[:, None], axis=2).min(axis=1) <= MAX_POINT_DIS,
        graspness,
        values.exists(),
    )


def _points(depth: np.ndarray, intrinsics: np.ndarray, factor: np.ndarray) -> np.ndarray:
    u, v = np.meshgrid(np.arange(depth.shape[1]), np.arange(depth.shape[0]))
    z = depth / factor
    x, y = ((at - intrinsics[k, 2]) * z / intrinsics[k, k] for k, at in enumerate((u, v)))
    return np.stack([x, y, z], axis=-1)


def _workspace(cloud: np.ndarray, seg: np.ndarray, trans: np.ndarray) -> np.ndarray:
    """The box around what is labelled, in the table's frame."""
    flat = np.concatenate([cloud.reshape(-1, 3), np.ones((seg.size, 1))], axis=-1)
    there = np.einsum("ab,nb->na", trans, flat)[:, :3].reshape(cloud.shape)
    low, high = there[seg > 0].min(axis=0) - OUTLIER, there[seg > 0].max(axis=0) + OUTLIER
    return ((there > low) & (there < high)).all(axis=-1)


def pointed(palm: np.ndarray, middle: np.ndarray, surface: np.ndarray) -> int:
    """Of its script: which point (S, 3) of the object a grasp points at, from its palm and between its fingers."""
    line = (middle - palm) / np.linalg.norm(middle - palm)
    seen = {}
    for number, place in enumerate(surface):
        height = float((place - palm) @ line)
        angle = np.degrees(np.arccos(abs(height) / np.linalg.norm(place - palm)))
        if height > 0 and angle < 30:
            seen[number] = (height, angle)
    least = min(height for height, _ in seen.values())
    weight = {
        number: np.exp(-np.log(2) * (angle / 10 + (height - least) / 0.015))
        for number, (height, angle) in seen.items()
        if height - least < 0.02
    }
    return max(weight, key=lambda number: weight[number])


def graspness_at(place: np.ndarray, surface: np.ndarray, points: np.ndarray) -> float:
    """Of its script: graspness of one point of the cloud on the object, whose grasps point at `points` (K, 3)."""
    squares = ((surface - place) ** 2).sum(axis=1)
    nearest = int(squares.argmin())
    if squares[nearest] >= 0.015:
        return 0.0
    return float(sum(10 ** (-150 * np.linalg.norm(surface[nearest] - point)) for point in points))

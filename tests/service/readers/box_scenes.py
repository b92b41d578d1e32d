"""A box on a table as shards whose pictures are closed forms: what clouds of them are held against."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from graspd.service.model import transforms
from graspd.service.model.pinhole import pixel_rays
from graspd.service.store.shards import write_shard

Floats = NDArray[np.float64]
SIZE = np.array([0.09, 0.06, 0.05])
JOINTS, GRASPS = 4, 6
WIDTH, HEIGHT = 96, 72
K = np.array([[100.0, 0, 48], [0, 100.0, 36], [0, 0, 1]])
#: Two scenes: the box on its face, turned; and on its side.
TURNED, ON_ITS_SIDE = (np.cos(0.3), 0, 0, np.sin(0.3)), (np.sqrt(0.5), np.sqrt(0.5), 0, 0)
POSES = np.array([[0.02, -0.01, 0.025, *TURNED], [-0.01, 0.03, 0.03, *ON_ITS_SIDE]])
VALID = np.array([1, 1, 0, 1, 1, 1], np.uint8)
SCENE_OF_GRASP = np.array([0, 0, 0, 1, 1, 0], np.int32)


def look_from(eye: list[float]) -> Floats:
    """(4, 4) a camera that looks at the middle of the table, with z up in its picture."""
    forward = np.array([0, 0, 0.02]) - eye
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, [0, 0, 1.0])
    right /= np.linalg.norm(right)
    matrix = np.eye(4)
    matrix[:3, :3] = np.stack([right, np.cross(forward, right), forward])
    matrix[:3, 3] = -matrix[:3, :3] @ eye
    return matrix


EYES = ([0.3, 0.1, 0.25], [-0.2, 0.25, 0.3], [0.0, -0.35, 0.2])
#: Pictures of both scenes.
VIEWS = len(EYES) * len(POSES)


def picture(pose: Floats, extrinsics: Floats) -> tuple[Floats, NDArray[np.uint8]]:
    """Depth [m] and labels of the box and the table z = 0."""
    back = np.linalg.inv(extrinsics)
    rays = pixel_rays(K, WIDTH, HEIGHT) @ back[:3, :3].T
    with np.errstate(divide="ignore", invalid="ignore"):
        table = np.where(rays[..., 2] < 0, -back[2, 3] / rays[..., 2], np.inf)
        inside = transforms.invert(pose)
        start, along = transforms.apply(inside, back[:3, 3]), transforms.quat_rotate(inside[3:], rays)
        first, second = (-SIZE / 2 - start) / along, (SIZE / 2 - start) / along
    enter, leave = np.minimum(first, second).max(-1), np.maximum(first, second).min(-1)
    box = np.where(enter < leave, enter, np.inf)
    return np.minimum(table, box), np.where(box < table, 2, np.isfinite(table)).astype(np.uint8)


def write(folder: Path) -> Path:
    """A base shard of grasps planned in the scenes, and its views shard."""
    draw = np.random.default_rng(0)

    def poses() -> Floats:
        turn = draw.normal(size=(GRASPS, 4))
        return np.concatenate([draw.normal(0, 0.1, (GRASPS, 3)), turn / np.linalg.norm(turn, axis=1)[:, None]], 1)

    one = np.ones(GRASPS)
    base = {"quality/thresholds_m": np.array([0.002, 0.005]), "quality/valid": VALID, "quality/success": VALID}
    for posture in ("grasp", "pregrasp", "squeeze"):
        base |= {f"{posture}/hand_pose": poses(), f"{posture}/joint_positions": draw.normal(size=(GRASPS, JOINTS))}
    for name in ("contact_area_cm2", "epsilon", "wrench_volume"):
        base[f"quality/{name}"] = draw.random((GRASPS, 2))
    for name in ("intersection_volume_cm3", "penetration_depth_mm", "self_penetration_depth_mm", "stability_loss"):
        base[f"quality/{name}"] = one
    base["quality/contact_links"] = one
    base |= {"scene/object_pose": POSES, "grasp/scene_index": SCENE_OF_GRASP, "quality/lift_hard": VALID}
    coming = np.repeat(base["pregrasp/hand_pose"][:, None], 3, axis=1)
    coming[..., 2] += [0.1, 0.05, 0.0]
    base |= {"grasp/approach": coming, "grasp/lift": base["squeeze/hand_pose"]}
    base["grasp/approach_joint_positions"] = base["pregrasp/joint_positions"]
    shot = [(scene, look_from(eye)) for scene in range(len(POSES)) for eye in EYES]
    seen = [picture(POSES[scene], extrinsics) for scene, extrinsics in shot]
    views = {
        "camera/intrinsics": np.tile(K, (len(shot), 1, 1)),
        "camera/extrinsics": np.stack([extrinsics for _, extrinsics in shot]),
        "camera/scene_index": np.array([scene for scene, _ in shot]),
        "camera/eye": np.zeros(len(shot)),
        "camera/stereo_baseline_m": np.zeros(len(shot)),
        "image/rgb": draw.integers(0, 255, (len(shot), HEIGHT, WIDTH, 3)),
        "image/depth": np.stack([depth for depth, _ in seen]),
        "image/segmentation": np.stack([labels for _, labels in seen]),
        "box/bounding_box_2d_tight": np.zeros((len(shot), 4)),
        "box/bounding_box_2d_loose": np.zeros((len(shot), 4)),
        "box/bounding_box_3d": np.zeros((len(shot), 8, 3)),
    }
    said = {"hand": "claw", "object": "box", "batch": 0}
    names = [f"joint_{k}" for k in range(JOINTS)]
    folder.mkdir(exist_ok=True)
    (folder / "base.h5").write_bytes(write_shard("base", base, said | {"shard_id": "b" * 32, "joint_names": names}))
    of_views = said | {"shard_id": "c" * 32, "base_shard": "b" * 32}
    (folder / "views.h5").write_bytes(write_shard("views", views, of_views))
    return folder

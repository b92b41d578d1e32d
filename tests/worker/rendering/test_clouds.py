"""Clouds of rendered pictures against the mesh that was rendered."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import trimesh

from graspd.readers import hand_surface
from graspd.service.model.transforms import apply
from graspd.service.readers import Pictures, open_shards
from graspd.service.store.shards import Shard, write_shard
from graspd.worker.rendering import render
from tests.service.readers import box_scenes
from tests.worker.models import object_from_mesh

#: What a view promises of its depth [m]: tests/worker/rendering/test_views.py.
DEPTH_M = 1e-4


def test_points_of_a_rendered_object_lie_on_its_mesh_and_their_normals_are_its_faces(tmp_path: Path) -> None:
    mesh = trimesh.creation.capsule(height=0.05, radius=0.03, count=[24, 24])
    views = render(
        object_from_mesh(mesh, "box"), box_scenes.POSES, views=2, stereo=False, width=96, height=72, seed=1, samples=2
    )
    folder = box_scenes.write(tmp_path / "set")
    said = {"hand": "claw", "object": "box", "batch": 0, "shard_id": "c" * 32, "base_shard": "b" * 32}
    (folder / "views.h5").write_bytes(write_shard("views", views, said))
    pictures = Pictures(open_shards(folder))
    fused = pictures.clouds(300, fuse=True, frame="object")
    for sample in [*pictures.clouds(300, frame="object"), *fused]:
        _, distance, face = trimesh.proximity.closest_point(mesh, sample["cloud/points"].astype(float))
        assert distance.max() < DEPTH_M
        cosine = np.einsum("pc,pc->p", mesh.face_normals[face], sample["cloud/normals"])
        # Faces turn by 7.5 degrees each, and a pixel's neighbours may lie on the next one.
        assert np.quantile(cosine, 0.1) > np.cos(np.radians(12))
        assert np.median(cosine) > np.cos(np.radians(4))


def test_the_surface_of_the_hand_of_a_shard_follows_its_kinematics() -> None:
    """All of a hand moves with its root; the points of a body that no joint carries move with nothing else."""
    from graspd.worker.hands.load import hand_from_path
    from graspd.worker.hands.surface import sample_surface

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
    at_rest = hand_surface(
        Shard("base", said, {**shard.arrays, "grasp/joint_positions": joints[[0, 0]]}), np.array([1])
    )
    assert np.abs(at_rest[0, ~palm] - found[1, ~palm]).max() > 0.01

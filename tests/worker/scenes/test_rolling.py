"""Rest poses under 1 mm of change of the surface: boxes stand, plates on an edge topple, round things roll."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from graspd.service.model.scene_spec import SceneSpec
from graspd.service.model.transforms import quat_conjugate, quat_rotate
from graspd.worker.objects.model import ObjectModel
from graspd.worker.scenes.kinds import rest_poses
from graspd.worker.scenes.neighbours import drop_together
from graspd.worker.scenes.rest import RestingFaces, resting_faces, rolling_note, rolling_poses
from graspd.worker.scenes.simulate import drop
from tests.worker.models import object_from_mesh

UP = np.array([0.0, 0, 1])


def plate(thickness: float) -> ObjectModel:
    return object_from_mesh(trimesh.creation.box([0.06, 0.06, thickness]))


def can() -> ObjectModel:
    return object_from_mesh(trimesh.creation.cylinder(radius=0.03, height=0.1, sections=60))


def face_along(faces: RestingFaces, normal: tuple[float, float, float]) -> int:
    return int((faces.normal @ np.array(normal)).argmax())


def test_a_plate_topples_from_an_edge_whose_tilt_passes_its_middle() -> None:
    # Height 30 mm, half the thickness t / 2 inside: 1 mm of change tilts by 1 / t, so t t / 2 must pass 30 mm^2.
    for thickness, falls in ((0.0074, True), (0.0080, False)):
        faces = resting_faces(plate(thickness))
        assert faces.topples(face_along(faces, (1, 0, 0))) is falls
        assert not faces.topples(face_along(faces, (0, 0, 1)))


def test_a_can_rolls_on_its_side_and_stands_on_its_bottom() -> None:
    obj, faces = can(), resting_faces(can())
    angle, sinks = faces.looseness(face_along(faces, (1, 0, 0)))
    assert angle > np.radians(170)
    assert sinks == pytest.approx(0.0, abs=1e-6)
    assert faces.looseness(face_along(faces, (0, 0, 1)))[0] < np.radians(1)
    lying, standing = [0.0, 0, 0.03, np.sqrt(0.5), 0, np.sqrt(0.5), 0], [0.0, 0, 0.05, 1, 0, 0, 0]
    assert rolling_poses(obj, np.array([lying, standing, lying])) == 2
    assert "in 2 of 3 scenes" in str(rolling_note(2, 3))
    assert rolling_note(0, 3) is None


def test_a_can_is_put_on_its_ends_and_a_ball_stays_as_it_lies() -> None:
    # Half as high as wide: about a half of the drops end on its side.
    stout = object_from_mesh(trimesh.creation.cylinder(radius=0.03, height=0.05, sections=60))
    free = [
        drop(stout, count=12, seed=1)["scene/object_pose"],
        rest_poses(SceneSpec(kind="table", faces="all"), stout, count=1, seed=0)["scene/object_pose"],
        drop_together(plate(0.05), [stout], count=8, seed=3)["scene/neighbour_pose"][:, 0],
    ]
    for pose in np.concatenate(free):
        assert abs(quat_rotate(quat_conjugate(pose[3:]), UP)[2]) == pytest.approx(1.0, abs=1e-6)
        assert pose[2] == pytest.approx(0.025, abs=1e-6)
    ball = object_from_mesh(trimesh.creation.icosphere(2, 0.03))
    assert rolling_poses(ball, drop(ball, count=3, seed=1)["scene/object_pose"]) == 3


def test_drops_and_faces_leave_out_what_topples() -> None:
    thin = plate(0.007)
    poses = [
        drop(thin, count=12, seed=8)["scene/object_pose"],
        rest_poses(SceneSpec(kind="table", faces="all"), thin, count=1, seed=0)["scene/object_pose"],
        drop_together(plate(0.05), [thin], count=8, seed=35)["scene/neighbour_pose"][:, 0],
    ]
    for pose in np.concatenate(poses):
        assert abs(quat_rotate(quat_conjugate(pose[3:]), UP)[2]) == pytest.approx(1.0, abs=1e-6)

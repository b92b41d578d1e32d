"""The centred frame: the same bits of an object wherever the origin of its file lies."""

from __future__ import annotations

import io
from collections.abc import Callable

import numpy as np
import pytest
import trimesh

from graspd.service.model.errors import MeshError
from graspd.worker.grasps import GRID_M, GraspSet, Posture
from graspd.worker.objects.check import check_object
from graspd.worker.objects.mesh_geometry import centred, to_centre, to_file
from graspd.worker.objects.model import ObjectModel
from graspd.worker.objects.prepare import from_bytes, load_object, to_bytes

SIZE = (0.06, 0.05, 0.1)
NEAR, FAR, UTM = (0.123456, 0.05, -0.2), (5.0, -3.0, 2.0), (500_000.0, 4_500_000.0, 300.0)
PLACES = pytest.mark.parametrize("place", [NEAR, FAR, UTM], ids=["near", "6 m", "UTM"])


def box_at(place: tuple[float, ...], unit: float = 1.0) -> trimesh.Trimesh:
    box = trimesh.creation.box(SIZE)
    return trimesh.Trimesh((box.vertices + place) / unit, box.faces, process=False)


def obj_of(mesh: trimesh.Trimesh, stray: str = "") -> bytes:
    lines = ["v " + " ".join(f"{value:.6f}" for value in vertex) for vertex in mesh.vertices]
    lines += [stray] if stray else []
    return "\n".join([*lines, *("f " + " ".join(str(k + 1) for k in face) for face in mesh.faces)]).encode()


def stl_of(mesh: trimesh.Trimesh) -> bytes:
    return bytes(mesh.export(file_type="stl"))


def loaded(name: str, data: bytes, **options: object) -> ObjectModel:
    return load_object({name: data}, name="box", digest="0" * 32, face_error_m=3e-4, options=options)


@PLACES
@pytest.mark.parametrize(("unit", "name"), [(1.0, "m"), (1e-3, "mm"), (1e-2, "cm")])
def test_a_box_has_the_same_bits_wherever_its_origin_lies(place: tuple[float, ...], unit: float, name: str) -> None:
    there, here = (loaded("b.obj", obj_of(box_at(at, unit)), units=name) for at in (place, (0.0, 0.0, 0.0)))
    assert there.centred.content == here.centred.content
    np.testing.assert_allclose(there.centre, place, atol=3e-9)
    np.testing.assert_allclose(there.vertices, here.vertices + place, atol=3e-9)


def test_of_numbers_of_32_bits_too_as_far_as_they_tell() -> None:
    there, here = (loaded("b.stl", stl_of(box_at(at))) for at in (FAR, (0.0, 0.0, 0.0)))
    assert there.centred.content == here.centred.content


def test_a_box_about_its_origin_keeps_its_numbers() -> None:
    assert set(np.abs(loaded("b.obj", obj_of(box_at((0, 0, 0)))).vertices).ravel()) == {0.03, 0.025, 0.05}


def test_vertices_of_no_face_do_not_move_the_middle() -> None:
    np.testing.assert_allclose(loaded("b.obj", obj_of(box_at(FAR), "v 0 0 0")).centre, FAR, atol=3e-9)


@PLACES
def test_a_scaled_mesh_too(place: tuple[float, ...]) -> None:
    there, here = (loaded("b.obj", obj_of(box_at(at)), scale_to=0.2) for at in (place, (0.0, 0.0, 0.0)))
    assert there.centred.content == here.centred.content


def test_coordinates_of_a_scan_move_by_no_more_than_a_hundred_millionth_of_its_size() -> None:
    points = np.random.default_rng(0).uniform(-0.1, 0.1, (2000, 3)).astype(np.float32).astype(float)
    found = centred(points)
    np.testing.assert_allclose(found.points + found.centre, points, atol=2e-9)


def test_a_prepared_object_is_kept_with_its_place() -> None:
    obj = loaded("b.obj", obj_of(box_at(UTM)))
    again = from_bytes(to_bytes(obj), name=obj.name, digest=obj.digest)
    assert (again.content, again.centred.content) == (obj.content, obj.centred.content)


@PLACES
def test_poses_come_back_from_the_frame_of_the_file_with_the_same_bits(place: tuple[float, ...]) -> None:
    rng = np.random.default_rng(0)
    pose = np.hstack([rng.uniform(-0.3, 0.3, (200, 3)), rng.normal(size=(200, 4))])
    pose[:, 3:] /= np.linalg.norm(pose[:, 3:], axis=1, keepdims=True)
    centre = np.rint(np.array(place) / GRID_M) * GRID_M
    hands = GraspSet(*(Posture(pose, np.zeros((200, 1))) for _ in range(3)), np.zeros(200)).moved(np.zeros(3))
    back = hands.moved(centre).moved(-centre)
    np.testing.assert_array_equal(back.grasp.hand_pose, hands.grasp.hand_pose)
    lying = hands.grasp.hand_pose
    np.testing.assert_array_equal(to_centre(to_file(lying, centre), centre), lying)


@pytest.mark.parametrize(("place", "says"), [((0.3, 0, 0), False), (FAR, True), (UTM, True)])
def test_the_check_tells_an_origin_that_lies_far_away(place: tuple[float, ...], says: bool) -> None:
    found = check_object({"b.obj": obj_of(box_at(place))}, "box")
    assert found["facts"]["origin_distance_m"] == pytest.approx(np.linalg.norm(place), rel=1e-6)
    assert ("its origin lies" in found["message"]) == says


def refused(data: bytes) -> str:
    with pytest.raises(MeshError) as told:
        loaded("b.stl", data)
    return str(told.value)


@pytest.mark.parametrize(
    ("tell", "place"),
    [(refused, UTM), (lambda data: str(check_object({"b.stl": data}, "box")["message"]), (3000.0, 0.0, 0.0))],
    ids=["refused", "a note"],
)
def test_a_file_whose_numbers_do_not_tell_its_points_apart_is_told(
    tell: Callable[[bytes], str], place: tuple[float, ...]
) -> None:
    told = tell(stl_of(box_at(place)))
    assert "where the file's numbers are" in told and "OBJ, PLY" in told


def test_other_faults_are_not_laid_on_the_origin() -> None:
    flat = trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]], process=False)
    assert "origin" not in refused(io.BytesIO(stl_of(flat)).read())

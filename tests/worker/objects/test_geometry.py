"""Mass, normals, distances and simplification against closed forms."""

import subprocess
import sys

import numpy as np
import pytest
import trimesh
from manifold3d import Manifold

from graspd.exchange.training_export import object_families, shape_signature
from graspd.service.model.errors import MeshError
from graspd.service.model.states import AssetKind
from graspd.service.store.assets import builtin_files, builtin_names
from graspd.worker.grasps import GRID_M, GraspSet, Posture
from graspd.worker.objects import mesh_geometry, topology
from graspd.worker.objects.check import check_object
from graspd.worker.objects.convex import WorkLimitExceeded, coacd_parts
from graspd.worker.objects.distance import MeshDistance, deviation, point_triangle_distance, sample_faces
from graspd.worker.objects.mesh_geometry import corner_normals, mass_properties, signed_volume
from graspd.worker.objects.model import ObjectModel
from graspd.worker.objects.prepare import from_bytes, load_object, object_from_path, simplify, to_bytes
from graspd.worker.objects.topology import components, is_closed
from tests.worker.models import object_from_mesh
from tests.worker.objects.shapes import box, cylinder, sphere, stl

SIZE = (0.06, 0.05, 0.1)
NEAR, FAR, UTM = (0.123456, 0.05, -0.2), (5.0, -3.0, 2.0), (500_000.0, 4_500_000.0, 300.0)
PLACES = pytest.mark.parametrize("place", [NEAR, FAR, UTM], ids=["near", "6 m", "UTM"])
_CORNERS, _FACES = np.eye(4, 3), np.array([[0, 1, 2], [0, 1, 3], [0, 2, 3], [1, 2, 3]])


def test_mass_properties_are_exact_anywhere_and_turn_with_body() -> None:
    x, y, z = 0.06, 0.05, 0.04
    at = np.array([3.0, -2.0, 1.0])
    vertices, faces = box(x, y, z, at=tuple(at))
    mass = mass_properties(vertices, faces)
    assert mass.volume == pytest.approx(x * y * z, rel=1e-12)
    np.testing.assert_allclose(mass.centre_of_mass, at, atol=1e-12)
    np.testing.assert_allclose(mass.inertia, np.diag([y * y + z * z, z * z + x * x, x * x + y * y]) / 12, atol=1e-12)
    vertices, faces = box()
    turn, _ = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))
    turn *= np.sign(np.linalg.det(turn))
    expected = turn @ mass_properties(vertices, faces).inertia @ turn.T
    np.testing.assert_allclose(mass_properties(vertices @ turn.T, faces).inertia, expected, atol=1e-14)
    mass = mass_properties(*sphere(0.04, 256))
    # An inscribed sphere of 256 segments is short of the ball by (pi / 256)^2 in volume, to a small factor.
    assert mass.volume == pytest.approx(4 / 3 * np.pi * 0.04**3, rel=1e-3)
    np.testing.assert_allclose(mass.inertia, 0.4 * 0.04**2 * np.eye(3), rtol=2e-3, atol=1e-9)


def test_corner_normals_are_those_of_the_shape() -> None:
    vertices, faces = box()
    normals = corner_normals(vertices, faces.astype(np.int32))
    a, b, c = np.moveaxis(vertices[faces], 1, 0)
    face = np.cross(b - a, c - a)
    face /= np.linalg.norm(face, axis=1, keepdims=True)
    np.testing.assert_allclose(normals, np.repeat(face[:, None], 3, axis=1), atol=1e-12)
    vertices, faces = sphere(0.04, 128)
    normals = corner_normals(vertices, faces.astype(np.int32))
    exact = vertices[faces] / np.linalg.norm(vertices[faces], axis=2, keepdims=True)
    assert np.einsum("ijk,ijk->ij", normals, exact).min() > np.cos(np.deg2rad(2))
    vertices, faces = cylinder()
    normals = corner_normals(vertices, faces.astype(np.int32))
    corners = vertices[faces]
    wall = np.abs(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])[:, 2]) < 1e-12
    np.testing.assert_allclose(np.abs(normals[~wall][:, :, 2]), 1.0, atol=1e-12)
    radial = corners[wall] * [1, 1, 0]
    radial /= np.linalg.norm(radial, axis=2, keepdims=True)
    # Three faces of a quad strip meet at a wall corner with unequal angles: half a segment's angle at most.
    assert np.einsum("ijk,ijk->ij", normals[wall], radial).min() > np.cos(np.pi / 48)


def test_distances_are_those_of_a_fine_grid_and_of_spheres() -> None:
    rng = np.random.default_rng(5)
    triangles, points = rng.random((40, 3, 3)), 2 * rng.random((40, 3)) - 0.5
    steps = 120
    grid = np.array([(i, j, steps - i - j) for i in range(steps + 1) for j in range(steps + 1 - i)]) / steps
    inside = np.einsum("gk,tkd->tgd", grid, triangles)
    brute = np.linalg.norm(inside - points[:, None], axis=2).min(axis=1)
    exact = point_triangle_distance(points, triangles)
    # A grid of 1/120 misses the foot by at most a cell of 1.7 / 120.
    assert (exact <= brute + 1e-12).all() and (brute - exact).max() < 0.015
    # Chords of 128 segments lie up to r (pi / 128)^2 / 2 = 0.012 mm inside.
    assert deviation(sphere(0.04, 128), sphere(0.041, 128)) == pytest.approx(1e-3, abs=3e-5)


def test_mesh_distance_equals_the_minimum_over_all_triangles(shared_data) -> None:
    model = object_from_path(shared_data / "objects" / "024_bowl" / "clean.stl", 0.0)
    faces = model.faces.astype(np.int64)
    points = sample_faces(model.vertices, faces, 60)[0] + np.random.default_rng(0).normal(scale=0.01, size=(60, 3))
    brute = point_triangle_distance(points[:, None], model.vertices[faces][None]).min(axis=1)
    np.testing.assert_allclose(MeshDistance(model.vertices, faces)(points), brute, atol=1e-12)


@pytest.mark.parametrize("error", [1e-4, 3e-4, 1e-3])
@pytest.mark.parametrize("name", ["mug", "bottle"])
def test_simplification_keeps_its_bound_and_the_mesh_closed(name: str, error: float) -> None:
    whole, model = object_from_path(name, 0.0), object_from_path(name, error)
    before = (whole.vertices, whole.faces.astype(np.int64))
    after = (model.vertices, model.faces.astype(np.int64))
    assert len(after[1]) < 0.8 * len(before[1])
    assert is_closed(after[1]) and signed_volume(*after) > 0 and components(after[1]).max() == 0
    # Measured again with other, more points: a maximum over points may lie a little above the one that was bounded.
    assert deviation(before, after, samples=20_000) <= 1.05 * error
    assert model.deviation_m <= error


def test_simplification_is_monotone_and_exact_at_zero() -> None:
    counts = [len(object_from_path("bottle", error).faces) for error in (1e-4, 3e-4, 1e-3)]
    assert counts == sorted(counts, reverse=True)
    vertices, faces = sphere(segments=128)
    same = simplify(vertices, faces, 0.0)
    assert same[0] is vertices and same[1] is faces and same[2] == 0.0
    vertices, faces = topology.from_manifold(Manifold.cube((0.06, 0.05, 0.04), True).refine_to_length(0.002))
    assert len(faces) > 5000
    assert len(simplify(vertices, faces, 1e-5)[1]) < 100


def test_the_model_of_a_box_has_its_hull_and_radius() -> None:
    model = load_object(stl(box()), name="b", digest="d", face_error_m=3e-4)
    assert model.name == "b" and model.digest == "d"
    assert len(model.hull_vertices) == 8 and len(model.hull_faces) == 12
    assert model.radius == pytest.approx(np.linalg.norm([0.03, 0.025, 0.02]), rel=1e-6)
    assert signed_volume(model.hull_vertices, model.hull_faces) == pytest.approx(model.volume, rel=1e-6)


def box_at(place: tuple[float, ...], unit: float = 1.0) -> trimesh.Trimesh:
    box = trimesh.creation.box(SIZE)
    return trimesh.Trimesh((box.vertices + place) / unit, box.faces, process=False)


def obj_of(mesh: trimesh.Trimesh, stray: str = "") -> bytes:
    return (mesh.export(file_type="obj", digits=6) + f"\n{stray}").encode()


def stl_of(mesh: trimesh.Trimesh) -> bytes:
    return bytes(mesh.export(file_type="stl"))


def loaded(name: str, data: bytes, **options: object) -> ObjectModel:
    return load_object({name: data}, name="box", digest="0" * 32, face_error_m=3e-4, options=options)


@PLACES
@pytest.mark.parametrize(
    ("unit", "options"),
    [(1.0, {"units": "m"}), (1e-3, {"units": "mm"}), (1e-2, {"units": "cm"}), (1.0, {"scale_to": 0.2})],
)
def test_a_box_has_the_same_bits_wherever_its_origin_lies(place, unit: float, options: dict[str, object]) -> None:
    there, here = (loaded("b.obj", obj_of(box_at(at, unit)), **options) for at in (place, (0.0, 0.0, 0.0)))
    assert there.centred.content == here.centred.content
    if "units" in options:
        np.testing.assert_allclose(there.centre, place, atol=3e-9)
        np.testing.assert_allclose(there.vertices, here.vertices + place, atol=3e-9)


def test_what_belongs_to_no_face_moves_nothing() -> None:
    there, here = (loaded("b.stl", stl_of(box_at(at))) for at in (FAR, (0.0, 0.0, 0.0)))
    assert there.centred.content == here.centred.content
    assert set(np.abs(loaded("b.obj", obj_of(box_at((0, 0, 0)))).vertices).ravel()) == {0.03, 0.025, 0.05}
    np.testing.assert_allclose(loaded("b.obj", obj_of(box_at(FAR), "v 0 0 0")).centre, FAR, atol=3e-9)


def test_an_object_keeps_its_place_and_a_scan_its_points() -> None:
    obj = loaded("b.obj", obj_of(box_at(UTM)))
    again = from_bytes(to_bytes(obj), name=obj.name, digest=obj.digest)
    assert (again.content, again.centred.content) == (obj.content, obj.centred.content)
    points = np.random.default_rng(0).uniform(-0.1, 0.1, (2000, 3)).astype(np.float32).astype(float)
    found = mesh_geometry.centre_points(points)
    np.testing.assert_allclose(found.points + found.centre, points, atol=2e-9)


@PLACES
def test_poses_come_back_from_frame_of_file_with_the_same_bits(place: tuple[float, ...]) -> None:
    rng = np.random.default_rng(0)
    pose = np.hstack([rng.uniform(-0.3, 0.3, (200, 3)), rng.normal(size=(200, 4))])
    pose[:, 3:] /= np.linalg.norm(pose[:, 3:], axis=1, keepdims=True)
    centre = np.rint(np.array(place) / GRID_M) * GRID_M
    hands = GraspSet(*(Posture(pose, np.zeros((200, 1))) for _ in range(3)), np.zeros(200)).moved(np.zeros(3))
    np.testing.assert_array_equal(hands.moved(centre).moved(-centre).grasp.hand_pose, hands.grasp.hand_pose)
    lying = hands.grasp.hand_pose
    np.testing.assert_array_equal(
        mesh_geometry.to_centred_frame(mesh_geometry.to_file_frame(lying, centre), centre), lying
    )


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
def test_file_whose_numbers_do_not_tell_its_points_apart_is_told(tell, place) -> None:
    told = tell(stl_of(box_at(place)))
    assert "where the file's numbers are" in told and "OBJ, PLY" in told


def test_other_faults_are_not_laid_on_the_origin() -> None:
    flat = trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]], process=False)
    assert "origin" not in refused(stl_of(flat))


def ending(code: str, monkeypatch: pytest.MonkeyPatch) -> None:
    run = subprocess.run

    def other(command: list[str], **options: object) -> object:
        return run([sys.executable, "-c", f"import os, signal\n{code}"], **options)  # type: ignore[call-overload]

    monkeypatch.setattr("graspd.worker.objects.convex.subprocess.run", other)


def test_too_much_computing_or_a_lost_child_makes_no_other_shape(monkeypatch: pytest.MonkeyPatch) -> None:
    endless = "import resource; resource.setrlimit(resource.RLIMIT_CPU, (1, 9))\nwhile True: pass"
    ending(endless, monkeypatch)
    with pytest.raises(WorkLimitExceeded, match="more than 1 s"):
        coacd_parts(_CORNERS, _FACES, {}, 1)
    monkeypatch.undo()
    ending("os.kill(os.getpid(), signal.SIGKILL)", monkeypatch)
    with pytest.raises(OSError, match="was killed"):
        coacd_parts(_CORNERS, _FACES, {}, 1)
    monkeypatch.setattr(sys, "executable", "/nowhere")
    with pytest.raises(OSError, match="nowhere"):
        coacd_parts(_CORNERS, _FACES, {}, 1)


def named(mesh: trimesh.Trimesh, digest: str) -> tuple[str, np.ndarray]:
    return digest, shape_signature(object_from_mesh(mesh, digest))


@pytest.fixture(scope="module")
def flask() -> trimesh.Trimesh:
    outline = np.array([[0, 0], [0.03, 0], [0.035, 0.05], [0.03, 0.12], [0.012, 0.15], [0.012, 0.18], [0, 0.18]])
    return trimesh.creation.revolve(outline, sections=24)


def test_copies_turned_scaled_or_meshed_anew_are_of_one_family(flask: trimesh.Trimesh) -> None:
    turned = flask.copy().apply_transform(trimesh.transformations.rotation_matrix(1.1, [1, 2, 3], [0.1, 0, 0]))
    finer, larger = flask.subdivide(), flask.copy().apply_scale(1.4)
    ball = named(trimesh.creation.icosphere(3, 0.05), "a")
    others = {"box": named(trimesh.creation.box((0.05, 0.07, 0.18)), "b"), "ball": ball}
    copies = {"bottle": flask, "turned": turned, "finer": finer, "larger": larger}
    found = object_families(others | {name: named(mesh, f"c{k}") for k, (name, mesh) in enumerate(copies.items())})
    assert {found[name] for name in copies} == {"c0"} and (found["box"], found["ball"]) == ("b", "a")
    assert object_families({"jar": named(flask, "x"), "bottle": named(flask, "x")}) == {"jar": "x", "bottle": "x"}
    assert object_families({}) == {}


def test_whoever_is_like_two_families_makes_them_one() -> None:
    at = {"a": 0.0, "b": 0.009, "c": 0.0045, "d": 1.0}
    found = object_families({name: (name, np.full(50, value)) for name, value in at.items()})
    assert found == {"a": "a", "b": "a", "c": "a", "d": "d"}


def test_the_signature_of_a_ball_is_that_of_chords() -> None:
    # Of two random points of a sphere of radius R the chord l has the density l / (2 R^2): F(l) = (l / 2R)^2, and its
    # root mean square is R sqrt 2. 40,000 draws are off by 0.005 at most, the icosphere's chords by less.
    share = np.linspace(0.01, 0.99, 50)
    found = shape_signature(object_from_mesh(trimesh.creation.icosphere(4, 0.04)))
    np.testing.assert_allclose(found, np.sqrt(2.0 * share), atol=0.01)


@pytest.mark.parametrize("name", builtin_names(AssetKind.OBJECT))
def test_a_built_in_object_needs_no_repair(name: str) -> None:
    report = check_object(builtin_files(AssetKind.OBJECT, name), name)
    assert report["verdict"] == "accept" and report["facts"]["mass_kg"] > 0.05

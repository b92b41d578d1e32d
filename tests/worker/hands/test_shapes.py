"""Convex pieces: hulls, distances, and where meshes are sought."""

from __future__ import annotations

import numpy as np
import pytest

from graspd.service.model.errors import HandError
from graspd.worker.hands import primitives
from graspd.worker.hands.collisions import hull_distance
from graspd.worker.hands.load import load_hand
from graspd.worker.hands.shapes import MAX_HULL_VERTICES, find_mesh, reduce_hull
from graspd.worker.objects.builtin import stl_bytes
from tests.worker.hands.urdfs import joint, link, robot

SIZES = {"box": (0.1, 0.06, 0.03), "sphere": (0.04,), "cylinder": (0.02, 0.1), "capsule": (0.02, 0.1)}
#: Chords of a circle of 32 corners lose up to 0.5 % of the radius, so volumes lose up to 2 %.
TESSELLATION = 0.03


@pytest.mark.parametrize("kind", sorted(SIZES))
def test_a_tessellation_is_closed_outward_and_inside_the_true_solid(kind: str) -> None:
    vertices, faces = primitives.tessellate(kind, SIZES[kind])
    volume = primitives.volume("hull", (), vertices, faces)
    true = primitives.volume(kind, SIZES[kind], vertices, faces)
    assert (1 - TESSELLATION) * true < volume <= true * (1 + 1e-9)
    assert np.abs(primitives.signed_distance(kind, SIZES[kind], vertices, faces, vertices)).max() < 1e-9


@pytest.mark.parametrize("kind", sorted(SIZES))
def test_samples_lie_on_the_surface_and_their_normals_are_its_gradient(kind: str) -> None:
    vertices, faces = primitives.tessellate(kind, SIZES[kind])
    points, normals = primitives.sample(kind, SIZES[kind], vertices, faces, 500, np.random.default_rng(0))
    distance = [
        primitives.signed_distance(kind, SIZES[kind], vertices, faces, points + step * normals)
        for step in (-1e-5, 0, 1e-5)
    ]
    np.testing.assert_allclose(distance[1], 0, atol=1e-12)
    np.testing.assert_allclose(distance[2], 1e-5, atol=1e-9)
    assert (distance[0] < 0).all()


@pytest.mark.parametrize("kind", ["sphere", "cylinder", "capsule"])
def test_samples_of_round_solids_are_uniform_in_area(kind: str) -> None:
    """The mean of x^2 over the surface, in closed form."""
    vertices, faces = primitives.tessellate(kind, SIZES[kind])
    points, _ = primitives.sample(kind, SIZES[kind], vertices, faces, 40_000, np.random.default_rng(0))
    r, length = SIZES[kind][0], SIZES[kind][-1]
    side, caps, ball = 2 * np.pi * r * length, 2 * np.pi * r * r, 4 * np.pi * r * r
    expected = {
        "sphere": r * r / 3,
        "cylinder": (side * r * r / 2 + caps * r * r / 4) / (side + caps),
        "capsule": (side * r * r / 2 + ball * r * r / 3) / (side + ball),
    }[kind]
    # Standard error of 40,000 samples of a value of order r^2.
    assert (points[:, 0] ** 2).mean() == pytest.approx(expected, abs=5 * r * r / np.sqrt(40_000))


def test_a_reduced_hull_keeps_its_volume_and_stays_close() -> None:
    rng = np.random.default_rng(3)
    points = rng.normal(size=(800, 3))
    points *= 0.012 / np.linalg.norm(points, axis=1, keepdims=True)
    vertices, faces = reduce_hull(points)
    assert len(vertices) <= MAX_HULL_VERTICES and len(faces) <= 2 * MAX_HULL_VERTICES - 4
    full = primitives.hull(points)
    assert primitives.volume("hull", (), vertices, faces) == pytest.approx(primitives.volume("hull", (), *full))
    # Half of 96 equal triangles' edge is 0.19 r, their circumradius 0.37 r, so a face's middle lies up to 0.07 r deep;
    # growing the hull to its volume shares that between the two sides.
    outside = primitives.signed_distance("hull", (), vertices, faces, points).max()
    beyond = np.linalg.norm(vertices, axis=1).max() - 0.012
    assert outside < 0.06 * 0.012 and beyond < 0.06 * 0.012


def test_flat_points_have_no_hull() -> None:
    with pytest.raises(HandError, match="flat"):
        primitives.hull(np.random.default_rng(0).random((10, 3)) * [1, 1, 0])


@pytest.mark.parametrize(
    ("offset", "expected"), [((0.3, 0, 0), 0.1), ((0.3, 0.3, 0), 0.1 * np.sqrt(2)), ((0.1, 0.05, 0), 0.0)]
)
def test_distance_of_two_boxes(offset: tuple[float, float, float], expected: float) -> None:
    box, _ = primitives.tessellate("box", (0.2, 0.2, 0.2))
    # The sums of the weights are held to 1 in 1e6 of the size.
    assert hull_distance(box, box + np.array(offset)) == pytest.approx(expected, abs=1e-5)


@pytest.mark.parametrize(
    ("filename", "found"),
    [
        ("meshes/a.stl", "urdf/meshes/a.stl"),
        ("package://hand/meshes/b.stl", "meshes/b.stl"),
        ("package://hand/c.stl", "hand/c.stl"),
        ("../meshes/b.stl", "meshes/b.stl"),
    ],
)
def test_meshes_are_found_beside_the_urdf_and_in_the_package(filename: str, found: str) -> None:
    files = dict.fromkeys(["urdf/meshes/a.stl", "meshes/b.stl", "hand/c.stl"], b"")
    assert find_mesh(filename, files, "urdf", "l") == found


@pytest.mark.parametrize("filename", ["../../etc/passwd", "/etc/passwd", "file:///../x", "C:\\x.stl", "http://h/x.stl"])
def test_a_mesh_outside_the_upload_is_refused(filename: str) -> None:
    with pytest.raises(HandError):
        find_mesh(filename, {"etc/passwd": b""} if "etc" not in filename else {}, "urdf", "l")


def hand_with_mesh(scale: str, size: float) -> dict[str, bytes]:
    vertices, faces = primitives.tessellate("box", (size, size, size))
    mesh = f'<collision><geometry><mesh filename="m.stl"{scale}/></geometry></collision>'
    urdf = robot(link("palm"), link("a", mesh), joint("j", "palm", "a"))
    return {"h.urdf": urdf, "m.stl": stl_bytes(vertices, faces.astype(np.int64))}


def test_the_scale_of_a_mesh_turns_millimetres_into_metres() -> None:
    hand = load_hand(hand_with_mesh(' scale="0.001 0.001 0.001"', 20.0), name="h", digest="0" * 32)
    np.testing.assert_allclose(np.ptp(hand.pieces[-1].vertices, axis=0), 0.02, rtol=1e-6)


def test_a_mesh_in_millimetres_without_scale_is_refused_with_the_mend() -> None:
    with pytest.raises(HandError, match=r"0\.001"):
        load_hand(hand_with_mesh("", 20.0), name="h", digest="0" * 32)


def test_a_hand_may_touch_with_what_it_looks_like() -> None:
    thin, fat = (
        '<geometry><cylinder radius="0.007" length="0.04"/></geometry>',
        '<geometry><cylinder radius="0.009" length="0.05"/></geometry>',
    )
    seen = link("b", f"<visual>{fat}</visual><collision>{thin}</collision>")
    # A link that touches nothing does not begin to, and one that shows nothing keeps its shapes.
    bare = link("c", f"<visual>{fat}</visual>")
    text = robot(
        link("palm"), link("a"), seen, bare, joint("j1", "palm", "a"), joint("j2", "a", "b"), joint("j3", "b", "c")
    )
    sizes = {}
    for shapes in ("collision", "visual"):
        hand = load_hand({"hand.urdf": text}, name="hand", digest="0" * 32, options={"shapes": shapes})
        sizes[shapes] = {piece.link: piece.size for piece in hand.pieces}
    assert sizes["collision"]["b"] == (0.007, 0.04)
    assert sizes["visual"] == {**sizes["collision"], "b": (0.009, 0.05)}

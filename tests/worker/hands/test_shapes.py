"""Convex pieces, meshes that become several, and samples of their surface."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from scipy.spatial import cKDTree

from graspd.service.model.errors import HandError
from graspd.service.model.transforms import IDENTITY_POSE, apply
from graspd.worker.hands import primitives, surface
from graspd.worker.hands.collisions import hull_distance
from graspd.worker.hands.kinematics import body_poses
from graspd.worker.hands.load import hand_from_path, load_hand
from graspd.worker.hands.model import HandModel
from graspd.worker.hands.shapes import MAX_HULL_VERTICES, convex_parts, reduce_hull
from graspd.worker.hands.surface import piece_distance, sample_surface
from graspd.worker.objects.convex import union_volume
from tests.worker.hands.urdfs import joint, link, load, robot

SIZES = {"box": (0.1, 0.06, 0.03), "sphere": (0.04,), "cylinder": (0.02, 0.1), "capsule": (0.02, 0.1)}
#: Chords of a circle of 32 corners lose up to 0.5 % of the radius, so volumes lose up to 2 %.
TESSELLATION = 0.03
BESIDE = [((0.3, 0, 0), 0.1), ((0.3, 0.3, 0), 0.1 * np.sqrt(2)), ((0.1, 0.05, 0), 0.0)]
#: A housing with a cavity inside: nothing gets there.
HOUSING = trimesh.creation.box((0.06, 0.06, 0.06)) + trimesh.creation.box((0.04, 0.04, 0.04))
FILLED = [trimesh.creation.box((0.02, 0.03, 0.04)), trimesh.creation.icosphere(2, 0.02), HOUSING]
#: Area is measured by at least 30,000 random candidates: the standard error of a share p is sqrt(p (1-p) / 30000), here
#: below 0.3 %; four of these.
AREA_TOLERANCE = 0.012
ON_SURFACE_M = 1e-9
BALL, CUBE, SLAB = '<sphere radius="0.04"/>', '<box size="0.04 0.04 0.04"/>', '<box size="0.08 0.08 0.04"/>'


@pytest.mark.parametrize("kind", sorted(SIZES))
def test_tessellation_is_closed_outward_and_inside_true_solid(kind: str) -> None:
    vertices, faces = primitives.tessellate(kind, SIZES[kind])
    volume = primitives.volume("hull", (), vertices, faces)
    true = primitives.volume(kind, SIZES[kind], vertices, faces)
    assert (1 - TESSELLATION) * true < volume <= true * (1 + 1e-9)
    assert np.abs(primitives.signed_distance(kind, SIZES[kind], vertices, faces, vertices)).max() < 1e-9


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
    points = np.random.default_rng(3).normal(size=(800, 3))
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


@pytest.mark.parametrize(("offset", "expected"), BESIDE)
def test_distance_of_two_boxes(offset: tuple[float, float, float], expected: float) -> None:
    box, _ = primitives.tessellate("box", (0.2, 0.2, 0.2))
    # The sums of the weights are held to 1 in 1e6 of the size.
    assert hull_distance(box, box + np.array(offset)) == pytest.approx(expected, abs=1e-5)


@pytest.mark.parametrize(("points", "told"), [(np.eye(4, 3) * [1, 1, 0], "flat"), (np.ones((4, 3)), "no volume")])
def test_points_without_a_volume_have_no_hull(points: np.ndarray, told: str) -> None:
    with pytest.raises(HandError, match=told):
        primitives.hull(points)


def hand_with_mesh(scale: str) -> HandModel:
    mesh = f'<collision><geometry><mesh filename="m.stl" {scale}/></geometry></collision>'
    urdf = robot(link("palm"), link("a", mesh), joint("j", "palm", "a"))
    box = trimesh.creation.box((20.0, 20.0, 20.0)).export(file_type="stl")
    return load_hand({"h.urdf": urdf, "m.stl": bytes(box)}, name="h", digest="0" * 32)


def test_millimetres_are_scaled_and_asked_for_where_missing() -> None:
    hand = hand_with_mesh('scale="0.001 0.001 0.001"')
    np.testing.assert_allclose(np.ptp(hand.pieces[-1].vertices, axis=0), 0.02, rtol=1e-6)
    with pytest.raises(HandError, match=r"0\.001"):
        hand_with_mesh("")


def test_a_hand_may_touch_with_what_it_looks_like() -> None:
    thin, fat = (f'<geometry><cylinder radius="{r}" length="0.04"/></geometry>' for r in (0.007, 0.009))
    seen = link("b", f"<visual>{fat}</visual><collision>{thin}</collision>")
    # A link that touches nothing does not begin to, and one that shows nothing keeps its shapes.
    bare = link("c", f"<visual>{fat}</visual>")
    joints = joint("j1", "palm", "a"), joint("j2", "a", "b"), joint("j3", "b", "c")
    text = robot(link("palm"), link("a"), seen, bare, *joints)
    hands = (load(text, shapes=shapes) for shapes in ("collision", "visual"))
    touching, looks = ({piece.link: piece.size for piece in hand.pieces} for hand in hands)
    assert touching["b"] == (0.007, 0.04)
    assert looks == {**touching, "b": (0.009, 0.04)}


@pytest.fixture(autouse=True)
def own_cache(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.getbasetemp() / "hollows"))


def fork(gap: float) -> trimesh.Trimesh:
    """A U of three boxes: two prongs 40 mm high, `gap` [m] apart, on a bar."""
    prong = trimesh.creation.box((0.008, 0.02, 0.04))
    parts = [prong.copy().apply_translation((side * (gap / 2 + 0.004), 0, 0.024)) for side in (-1, 1)]
    bar = trimesh.creation.box((gap + 0.016, 0.02, 0.008))
    return trimesh.boolean.union([*parts, bar], engine="manifold")


def measured(mesh: trimesh.Trimesh) -> tuple[int, float]:
    parts = convex_parts(np.asarray(mesh.vertices, float), np.asarray(mesh.faces, np.int32))
    return len(parts), union_volume(parts) / mesh.volume


def test_a_fork_is_taken_apart_and_its_gap_is_empty() -> None:
    mesh = fork(0.04)
    assert mesh.convex_hull.volume > 2 * mesh.volume
    count, share = measured(mesh)
    assert count > 1 and share == pytest.approx(1.0, abs=0.05)


@pytest.mark.parametrize("mesh", FILLED)
def test_what_its_hull_shows_well_enough_stays_one_hull(mesh: trimesh.Trimesh) -> None:
    vertices = np.asarray(mesh.vertices, float)
    (part,) = convex_parts(vertices, np.asarray(mesh.faces, np.int32))
    assert part is vertices


def test_a_failed_decomposition_leaves_the_hull_and_is_not_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("graspd.worker.hands.shapes.coacd_parts", lambda *_: ())
    mesh = fork(0.05)
    assert measured(mesh)[0] == 1
    monkeypatch.undo()
    assert measured(mesh)[0] > 1


def test_real_hands_keep_their_hulls_but_for_barretts_palm(shared_data) -> None:
    counts = {"allegro/allegro_hand_right.urdf": 23, "barrett_bh280/bh280.urdf": 14, "barrett/bhand_model.urdf": 33}
    for file, count in counts.items():
        assert len(hand_from_path(shared_data / "hands" / file).pieces) == count, file


def shape(geometry: str, xyz: str = "0 0 0") -> str:
    return f'<collision><origin xyz="{xyz}"/><geometry>{geometry}</geometry></collision>'


def hand_of(*palm_shapes: str, finger: str = shape('<sphere radius="0.01"/>', "0 0 1")) -> HandModel:
    """A hand whose palm has the given shapes and whose only finger is a sphere far away."""
    urdf = robot(link("palm", "".join(palm_shapes)), link("a", finger), joint("j", "palm", "a"))
    return load_hand({"h.urdf": urdf}, name="h", digest="".join(palm_shapes) + finger)


def palm_area(hand: HandModel, count: int = 1500) -> float:
    points = sample_surface(hand, count)
    return float(points.area[points.body == 0].sum())


@pytest.mark.parametrize(
    ("geometry", "area"),
    [
        ('<box size="0.1 0.06 0.02"/>', 2 * (0.006 + 0.0012 + 0.002)),
        ('<sphere radius="0.05"/>', 4 * np.pi * 0.0025),
        ('<cylinder radius="0.03" length="0.1"/>', 2 * np.pi * 0.03 * 0.13),
        ('<capsule radius="0.03" length="0.1"/>', 2 * np.pi * 0.03 * 0.16),
    ],
)
def test_areas_of_a_lone_primitive_sum_to_its_closed_form(geometry: str, area: float) -> None:
    assert palm_area(hand_of(shape(geometry))) == pytest.approx(area, rel=1e-3)


@pytest.mark.parametrize(
    ("shapes", "area"),
    [
        # Two spheres of radius r whose centres are r apart: each loses a cap of height r/2, a quarter of its area.
        ([shape(BALL), shape(BALL, "0 0 0.04")], 2 * 0.75 * 4 * np.pi * 0.04**2),
        # Two cubes glued face to face are one box.
        ([shape(CUBE), shape(CUBE, "0 0 0.04")], 10 * 0.04**2),
        # A box inside a larger one, flush with its top.
        ([shape(SLAB), shape('<box size="0.04 0.04 0.02"/>', "0 0 0.01")], 2 * 0.08**2 + 4 * 0.08 * 0.04),
    ],
)
def test_what_pieces_share_or_hide_is_no_surface(shapes: list[str], area: float) -> None:
    assert palm_area(hand_of(*shapes)) == pytest.approx(area, rel=AREA_TOLERANCE)


def test_a_point_inside_another_body_at_rest_is_dropped() -> None:
    hand = hand_of(shape('<box size="0.1 0.1 0.1"/>'), finger=shape('<sphere radius="0.02"/>', "0 0 0"))
    points = sample_surface(hand, 300)
    finger = points.position[points.body == 1]
    world = apply(body_poses(hand, IDENTITY_POSE, hand.expand(hand.preshape))[0, 1], finger)
    (palm,) = (piece for piece in hand.pieces if piece.body == 0)
    assert len(finger) and piece_distance(palm, world).min() >= -surface.BURIED_M


def test_shapes_that_hide_each_other_are_told() -> None:
    """Each ball outside the one before it by less than the distance at which two faces count as one."""
    ball = hand_of(shape(BALL))
    balls = tuple(replace(ball.pieces[0], size=(0.04 + 0.7 * k * surface.COINCIDENT_M,)) for k in range(3))
    with pytest.raises(HandError, match="lie inside one another"):
        sample_surface(replace(ball, pieces=balls), 1)


@pytest.mark.parametrize("count", [16, 400, 2000])
def test_a_thin_plate_has_exactly_the_count_on_both_sides(count: int) -> None:
    points = sample_surface(hand_of(shape('<box size="0.2 0.2 0.0005"/>')), count)
    assert len(points) == count
    top, bottom = ((side * points.normal[points.body == 0, 2] > 0.9).sum() for side in (1, -1))
    assert count < 400 or 0.8 < top / bottom < 1.25


def test_samples_follow_their_seed_and_are_drawn_once_pre_shape() -> None:
    hand = hand_from_path("allegro")
    points = sample_surface(hand, 300)
    assert not np.array_equal(points.position, sample_surface(hand, 300, seed=4).position)
    assert sample_surface(replace(hand, closing=-hand.closing), 300) is points
    assert sample_surface(replace(hand, preshape=0.5 * (hand.lower + hand.upper)), 300) is not points


@pytest.mark.parametrize("name", ["allegro", "barrett", "shadow"])
def test_points_lie_on_the_surface_with_outward_unit_normals(name: str) -> None:
    hand = hand_from_path(name)
    points = sample_surface(hand, 800)
    np.testing.assert_allclose(np.linalg.norm(points.normal, axis=1), 1.0, atol=1e-9)
    for body in range(hand.bodies):
        mine = points.body == body
        pieces = [piece for piece in hand.pieces if piece.body == body]
        if not mine.any():
            continue
        nearest = np.min([piece_distance(p, points.position[mine]) for p in pieces], axis=0)
        outside = points.position[mine] + surface.COINCIDENT_M * points.normal[mine]
        above = np.min([piece_distance(p, outside) for p in pieces], axis=0)
        assert np.abs(nearest).max() < ON_SURFACE_M
        assert (above >= 0).all()


def test_points_spread_more_evenly_than_random_ones() -> None:
    """Blue noise keeps the nearest neighbours apart: random points come arbitrarily close."""
    points = sample_surface(hand_of(shape('<sphere radius="0.05"/>')), 600)
    mine = points.position[points.body == 0]
    gaps = cKDTree(mine).query(mine, k=2)[0][:, 1]
    spacing = np.sqrt(4 * np.pi * 0.05**2 / len(mine))
    assert gaps.min() > 0.5 * spacing


def test_seats_follow_weights_and_farthest_points_are_distinct() -> None:
    seats = surface.apportion(np.array([3.0, 1.0, 0.0]), 8, np.array([100, 100, 100]))
    assert seats.tolist() == [6, 2, 0]
    assert surface.apportion(np.array([3.0, 1.0]), 8, np.array([2, 100])).tolist() == [2, 6]
    assert len(set(surface.farthest_points(np.random.default_rng(0).random((50, 3)), 50).tolist())) == 50

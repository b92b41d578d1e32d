"""Kinematics against float64 NumPy; gradients of penalties and obstacles against central differences of energies."""

from collections.abc import Callable
from dataclasses import replace
from typing import get_args

import numpy as np
import pytest

from graspd.service.model.errors import InputError
from graspd.service.model.fidelity import Fidelity
from graspd.service.model.transforms import apply, compose, invert, quat_from_axis_angle, quat_multiply, quat_rotate
from graspd.worker.grasps import Posture
from graspd.worker.hands.kinematics import body_poses
from graspd.worker.hands.load import hand_from_path
from graspd.worker.hands.model import ConvexPiece, HandModel
from graspd.worker.hands.surface import piece_distance, sample_surface
from graspd.worker.scenes.placement import enclosing_solid
from graspd.worker.simulation.data import HandState, Schedule
from graspd.worker.simulation.environment import Environment, Obstacle
from graspd.worker.simulation.model import REFERENCE_POINTS, REFERENCE_SAMPLES, REFERENCE_SELF_POINTS, LossOptions
from graspd.worker.simulation.obstacles import DeviceObstacles, PosedFeatures
from graspd.worker.simulation.projection import Projection, ProjectionOptions
from graspd.worker.simulation.record import OPTIMIZERS, record_evaluation, record_iteration, record_placement
from graspd.worker.simulation.sampling import object_samples
from tests.worker.models import unit_vectors
from tests.worker.simulation.rigs import ball, rig, still

_GOLDEN = (np.sqrt(5) - 1) / 2
HANDS = ("allegro", "barrett", "shadow")
EACH_HAND = pytest.mark.parametrize("name", HANDS)
Energy = Callable[[HandState], float]
#: float32 depths of 1e-3 m from coordinates of 0.1 m are good to 1e-5 relative; points that enter or leave within the
#: difference add the rest.
RELATIVE = 2e-3
#: Penalties without a simulation of contacts.
ALONE = LossOptions(simulate=False, leak=0.0, range_weight=0.0)
MARGIN = 0.004


def least_along(f: Callable[[np.ndarray], np.ndarray], edges: np.ndarray) -> np.ndarray:
    """(E,) least value of a convex function of points (E, 3) on edges (E, 2, 3)."""
    low, high = np.zeros((len(edges), 1)), np.ones((len(edges), 1))
    for _ in range(45):
        a, b = high - _GOLDEN * (high - low), low + _GOLDEN * (high - low)
        one, other = (f(edges[:, 0] + at * (edges[:, 1] - edges[:, 0])) for at in (a, b))
        left = (one < other)[:, None]
        low, high = np.where(left, low, a), np.where(left, b, high)
    middle = edges[:, 0] + (low + high) / 2 * (edges[:, 1] - edges[:, 0])
    return np.minimum(f(middle), np.minimum(f(edges[:, 0]), f(edges[:, 1])))


def link_distance(piece: ConvexPiece, points: np.ndarray) -> np.ndarray:
    """(N,) signed distance of points (N, 3) in the body frame: as `piece_distance`, and outside of boxes and cylinders
    the true one."""
    local = apply(invert(piece.pose), points)
    if piece.kind == "box":
        beyond = np.abs(local) - np.array(piece.size) / 2
    elif piece.kind == "cylinder":
        beyond = np.stack([np.hypot(local[:, 0], local[:, 1]), np.abs(local[:, 2])], -1)
        beyond -= [piece.size[0], piece.size[1] / 2]
    else:
        return piece_distance(piece, points)
    return np.linalg.norm(np.maximum(beyond, 0.0), axis=1) + np.minimum(beyond.max(axis=1), 0.0)


def nearest_edges(hand: HandModel, bodies: np.ndarray, obstacle: Obstacle, far: float) -> np.ndarray:
    """(P,) distance of the nearest of the obstacle's edges from each piece, or how deep an edge of the piece is in the
    obstacle; `far` where that is more. `bodies` (L, 7)."""
    out = np.full(len(hand.pieces), far)
    features = hand.features
    for number, piece in enumerate(hand.pieces):
        pose = bodies[piece.body]
        middle = piece.vertices.mean(axis=0)
        reach = np.linalg.norm(piece.vertices - middle, axis=1).max()
        if obstacle.distance(apply(pose, middle)) > reach + far:
            continue
        edges = apply(invert(pose), obstacle.corners)[obstacle.edges]
        half = np.linalg.norm(edges[:, 1] - edges[:, 0], axis=1) / 2
        edges = edges[link_distance(piece, edges.mean(axis=1)) - half < far]  # no distance falls faster than one to one
        if len(edges):
            out[number] = min(far, least_along(lambda x, p=piece: link_distance(p, x), edges).min())
        mine = slice(features.first_edge[number], features.first_edge[number + 1])
        edges = apply(pose, features.edges[mine])
        pierce = (least_along(obstacle.distance, edges) - features.thickness[mine]).min()
        if pierce < min(out[number], 0.0):
            out[number] = pierce
    return out


def root_poses(hand: HandModel, state: HandState) -> np.ndarray:
    return np.concatenate([state.pivot - quat_rotate(state.rotation, hand.palm.centre), state.rotation], axis=1)


def bodies_of(hand: HandModel, state: HandState) -> np.ndarray:
    return body_poses(hand, root_poses(hand, state), hand.expand(state.q))


def moved(state: HandState, column: int, step: float) -> HandState:
    pivot, rotation, q = state.pivot.copy(), state.rotation.copy(), state.q.copy()
    if column < 3:
        pivot[0, column] += step
    elif column < 6:
        rotation[0] = quat_multiply(quat_from_axis_angle(np.eye(3)[column - 3], np.array(step)), rotation[0])
    else:
        q[0, column - 6] += step
    return HandState(pivot, rotation, q)


def differences(energy: Energy, state: HandState, columns: int, step: float) -> np.ndarray:
    """Central differences by the columns of a gradient: root translation, root rotation, dofs."""
    ends = [[energy(moved(state, c, s)) for s in (step, -step)] for c in range(columns)]
    return np.array([(high - low) / (2 * step) for high, low in ends])


def fist_in_ball(hand: HandModel) -> HandState:
    """A hand whose palm is 5 mm inside the ball, fingers half closed into it."""
    q = hand.lower + np.where(hand.closing >= 0, 0.6, 0.4) * (hand.upper - hand.lower)
    return HandState(np.array([[0.03, 0.002, -0.001]]), np.array([[0.0, 0.0, 0.0, 1.0]]), q[None])


def check_gradient(simulation, state: HandState, energy: Energy, *, least=0.0, relative=RELATIVE, **weights) -> None:
    """The gradient at a state with these weights of the schedule, all others 0, is that of the energy."""
    (model, data), schedule = simulation, still()
    for name, value in weights.items():
        getattr(schedule, name)[:] = value
    data.set_schedule(schedule)
    data.set_state(state)
    record_evaluation(model, data).run()
    found = data.gradient.numpy()[0]
    expected = differences(energy, state, len(found), step=1e-7)
    assert np.linalg.norm(expected) > least, "the state has a gradient"
    np.testing.assert_allclose(found, expected, atol=relative * np.abs(expected).max())


@pytest.mark.parametrize("name", ["allegro", "shadow"])
def test_object_points_inside_links_push_along_the_gradient(name: str) -> None:
    hand, obj = hand_from_path(name), ball()
    state = fist_in_ball(hand)
    samples = object_samples(obj, 1000) - obj.centre_of_mass

    def energy(at: HandState) -> float:
        (poses,) = bodies_of(hand, at)
        depths = (-piece_distance(piece, apply(invert(poses[piece.body]), samples)) for piece in hand.pieces)
        return sum(float((np.maximum(depth, 0) ** 2).sum()) for depth in depths) * REFERENCE_SAMPLES / len(samples)

    simulation = rig(hand, obj, capacity=1, options=ALONE)
    check_gradient(simulation, state, energy, least=0.01, object_penetration=1.0)


@pytest.mark.parametrize("name", ["allegro", "shadow"])
def test_links_inside_links_are_parted_along_the_true_gradient(name: str) -> None:
    hand = hand_from_path(name)
    points = sample_surface(hand, 300)
    pairs = {(piece.body, int(body)) for piece in hand.pieces for body in set(points.body)}
    counts = {(a, b): a != b and (min(a, b), max(a, b)) not in hand.neighbours for a, b in pairs}

    def energy(at: HandState) -> float:
        (poses,) = bodies_of(hand, at)
        world = apply(poses[points.body], points.position)
        total = 0.0
        for piece in hand.pieces:
            other = np.array([counts[piece.body, int(body)] for body in points.body])
            depth = -piece_distance(piece, apply(invert(poses[piece.body]), world[other]))
            total += float((np.maximum(depth, 0) ** 2).sum())
        return total * REFERENCE_SELF_POINTS / len(points)

    draws = hand.lower + np.random.default_rng(0).random((20, 1, hand.dofs)) * (hand.upper - hand.lower)
    states = [HandState(np.array([[0.5, 0.0, 0.0]]), np.array([[1.0, 0.0, 0.0, 0.0]]), q) for q in draws]
    state = max(states, key=energy)
    simulation = rig(hand, ball(), capacity=1, options=replace(ALONE, self_margin=0.0))
    check_gradient(simulation, state, energy, least=1e-4, self_penetration=1.0)


def beside_a_ball(hand: HandModel, gap: float) -> HandState:
    """A hand whose palm looks at the ball from so far [m], fingers as they set out."""
    return HandState(np.array([[0.035 + gap, 0.002, -0.001]]), np.array([[0.0, 0.0, 0.0, 1.0]]), hand.preshape[None])


@pytest.mark.parametrize("name", ["allegro", "barrett"])
def test_points_that_touch_nothing_are_pulled_by_the_gradient(name: str) -> None:
    """Against the energy -2 w d l sum w_i exp(-rho_i / l) over points beyond the surface of a ball in closed form."""
    hand, radius = hand_from_path(name), 0.035
    points, weight, pull, length, band = sample_surface(hand, 300), 40.0, 3e-4, 0.013, 0.2
    share = points.area / points.area.sum() * REFERENCE_POINTS
    state = beside_a_ball(hand, 0.05)

    def energy(at: HandState) -> float:
        gap = np.linalg.norm(apply(bodies_of(hand, at)[0, points.body], points.position), axis=1) - radius
        assert gap.min() > 0 and gap.max() < band, "all points take part, none penetrates"
        return float(-2 * weight * pull * length * (share * np.exp(-gap / length)).sum())

    options = replace(ALONE, band=band, exact_below=band, pull=pull, pull_length=length)
    # A fine ball, faces as they are: its distances are those of a sphere to 0.02 mm.
    simulation = rig(hand, ball(radius, subdivisions=5), capacity=1, options=options, alpha=0.0)
    # Normals of faces are off by 0.3 degrees.
    check_gradient(simulation, state, energy, relative=1e-2, penetration=weight)


def test_share_of_a_hand_that_is_near_is_its_area_over_the_whole() -> None:
    hand, radius, reach = hand_from_path("allegro"), 0.035, 0.02
    points = sample_surface(hand, 300)
    states = [beside_a_ball(hand, gap) for gap in (0.012, 0.03, 1.0)]
    state = HandState(*(np.concatenate([getattr(s, n) for s in states]) for n in ("pivot", "rotation", "q")))
    model, data = rig(hand, ball(radius, subdivisions=5), capacity=3, options=LossOptions(simulate=False))
    data.set_state(state)
    record_evaluation(model, data).run()
    gaps = np.linalg.norm(apply(bodies_of(hand, state)[:, points.body], points.position), axis=2) - radius
    expected = (points.area * (gaps < reach)).sum(axis=1) / points.area.sum()
    assert expected[0] > expected[1] > expected[2] == 0.0
    # Distances of the mesh are those of the ball to 0.02 mm: at most one point of 300 is on the other side.
    np.testing.assert_allclose(data.near_share(reach, 3), expected, atol=1 / 200)


def test_range_and_limit_penalties_have_closed_form_gradients() -> None:
    hand = hand_from_path("barrett")
    q = hand.upper + 0.1
    state = HandState(np.array([[0.5, 0.0, 0.0]]), np.array([[1.0, 0.0, 0.0, 0.0]]), q[None])
    options = LossOptions(simulate=False, leak=0.0, range_weight=0.3, limit_weight=7.0)
    model, data = rig(hand, ball(), capacity=1, options=options)
    data.set_state(state)
    record_evaluation(model, data).run()
    half = 0.5 * (hand.upper - hand.lower)
    expected = 2 * 0.3 * (half + 0.1) / half**2 + 2 * 7.0 * 0.1
    np.testing.assert_allclose(data.gradient.numpy()[0, 6:], expected, rtol=1e-5)


def test_unknown_solvers_and_optimizers_are_refused_in_a_line() -> None:
    with pytest.raises(InputError, match="unknown contact solver 'newton'; choose one of direct"):
        rig(hand_from_path("allegro"), ball(), capacity=1, options=LossOptions(contact_solver="newton"))
    model, data = rig(hand_from_path("barrett"), ball(), capacity=1, options=LossOptions())
    for name in ("lbfgs", "Adam", ""):
        with pytest.raises(InputError, match=r"unknown optimizer '.*'; choose one of adam, gd$"):
            record_iteration(model, data, name)
    assert get_args(Fidelity.model_fields["optimizer"].annotation) == OPTIMIZERS


@pytest.mark.parametrize("slivers", [False, True])
@pytest.mark.parametrize("solver", ["direct", "gauss_seidel"])
def test_loss_and_gradient_are_finite_wherever_the_hand_is(solver: str, slivers: bool) -> None:
    """At the ball's centre, on the ball, far away; also with corner normals of length 0, as a sliver face has them."""
    hand, obj = hand_from_path("allegro"), ball()
    places = np.array([(0.0, 0.0, 0.0), (0.035, 0.0, 0.0), (3.0, 2.0, 1.0)])
    if slivers:
        obj = replace(obj, corner_normals=np.zeros_like(obj.corner_normals))
    model, data = rig(hand, obj, capacity=3, options=LossOptions(contact_solver=solver))
    data.set_schedule(still(dilation=0.01, weight=1e4))
    data.set_state(HandState(places, np.tile([1.0, 0.0, 0.0, 0.0], (3, 1)), np.tile(hand.preshape, (3, 1))))
    record_evaluation(model, data).run()
    assert np.all(np.isfinite(data.loss.numpy())) and np.all(np.isfinite(data.gradient.numpy()))


def test_small_descent_steps_never_raise_the_loss() -> None:
    """L_stable of a hand in contact, plain descent without leak: the descent direction is one."""
    hand, steps = hand_from_path("allegro"), 30
    none = np.zeros(steps)
    model, data = rig(hand, ball(), capacity=1, options=LossOptions(leak=0.0, range_weight=0.0))
    data.set_schedule(Schedule(none + 0.004, none, none, none, np.tile([1e-10, 1e-8, 1e-8], (steps, 1))))
    data.set_state(beside_a_ball(hand, 0.002))
    launches = record_iteration(model, data, "gd")
    losses = []
    for _ in range(steps):
        launches.run()
        losses.append(float(data.loss.numpy().mean()))
    assert losses[-1] < losses[0]
    # float32 sums of losses of size 1.
    assert max(np.diff(losses)) < 1e-5


@pytest.mark.parametrize("optimizer", OPTIMIZERS)
def test_a_step_moves_and_turns_a_hand_against_its_gradient(optimizer: str) -> None:
    """The first step of Adam is as long as its rate; that of plain descent is the rate times the gradient."""
    hand, one = hand_from_path("allegro"), np.ones(1)
    state = fist_in_ball(hand)
    model, data = rig(hand, ball(), capacity=1, options=LossOptions(leak=0.0, range_weight=0.0))
    rates = np.array([1e-3, 2e-3, 3e-3] if optimizer == "adam" else [1e-6, 1e-4, 1e-5])
    data.set_schedule(Schedule(0.004 * one, one, one, one, rates[None]))
    data.set_state(state)
    record_iteration(model, data, optimizer).run()
    gradient = data.gradient.numpy()[0].astype(float)
    step = -np.repeat(rates, [3, 3, hand.dofs]) * (np.sign(gradient) if optimizer == "adam" else gradient)
    angle = np.linalg.norm(step[3:6])
    assert angle > 1e-4 and np.abs(step[:3]).max() > 1e-5
    found = data.state(1)
    np.testing.assert_allclose(found.pivot[0], state.pivot[0] + step[:3], atol=1e-6)
    turned = quat_multiply(quat_from_axis_angle(step[3:6] / angle, np.asarray(angle)), state.rotation[0])
    np.testing.assert_allclose(found.rotation[0], turned, atol=1e-6)
    np.testing.assert_allclose(found.q[0], np.clip(state.q[0] + step[6:], hand.lower, hand.upper), atol=1e-6)


BALL = unit_vectors(np.random.default_rng(5), 300) * 0.04 + [0.33, 0.02, 0.02]
SCENES = {
    "table": (Obstacle.half_space([0.1, -0.2, 1.0], -0.02),),
    "a table to press into": (replace(Obstacle.half_space([0.1, -0.2, 1.0], -0.02), tips_m=-0.001),),
    "corner of two walls": (
        Obstacle.half_space([0, 0, 1], -0.03),
        Obstacle.box([0.327, 0.013, 0.011, 0.9, 0.1, 0.2, 0.3], [0.11, 0.6, 0.4]),
    ),
    "a stick and a board": (
        Obstacle.box([0.30, 0.02, 0.02, 0.9, 0.1, 0.2, 0.3], [0.012, 0.3, 0.011]),
        Obstacle.box([0.33, 0.03, 0.05, 0.6, 0.5, -0.2, 0.3], [0.4, 0.5, 0.006]),
    ),
    "a round neighbour": (enclosing_solid(BALL)[0],),
}


def distances(hand: HandModel, state: HandState, obstacle: Obstacle) -> np.ndarray:
    """(F,) signed distance of each feature from an obstacle in float64, the object's centre being the origin."""
    posture = Posture(root_poses(hand, state), hand.expand(state.q))
    return PosedFeatures.create(hand, posture).distance(obstacle)[0]


def kept(hand: HandModel, obstacle: Obstacle) -> np.ndarray:
    """(F,) distance that features keep."""
    tip = np.isin(hand.features.body, hand.fingertips)
    return np.where(tip & (obstacle.tips_m is not None), obstacle.tips_m or 0.0, MARGIN)


def simulation_in(hand: HandModel, obstacles: tuple[Obstacle, ...]):
    obj = ball()
    model, data = rig(hand, obj, capacity=1, options=ALONE)
    scene = Environment(obstacles, np.array([0.0, 0, 1]))
    solids = DeviceObstacles.create(hand, [scene], obj.centre_of_mass, "cpu", margin=MARGIN)
    data.set_scenes(np.zeros(1, int))
    return replace(model, obstacles=solids), data


def reaching(hand: HandModel) -> HandState:
    """A hand beside the ball whose fingers reach into the obstacles; it does not touch the ball."""
    q = hand.lower + 0.45 * (hand.upper - hand.lower)
    rotation = np.array([0.4, 0.5, -0.3, 0.7])
    return HandState(np.array([[0.3, 0.02, 0.0]]), (rotation / np.linalg.norm(rotation))[None], q[None])


@pytest.mark.parametrize(
    ("name", "scene"),
    [
        *((name, "table") for name in HANDS),
        ("barrett", "a table to press into"),
        ("barrett", "a stick and a board"),
        pytest.param("allegro", "corner of two walls", marks=pytest.mark.slow),
        pytest.param("shadow", "corner of two walls", marks=pytest.mark.slow),
        pytest.param("allegro", "a stick and a board", marks=pytest.mark.slow),
        pytest.param("shadow", "a round neighbour", marks=pytest.mark.slow),
    ],
)
def test_obstacles_push_the_hand_along_the_true_gradient(name: str, scene: str) -> None:
    hand, obstacles = hand_from_path(name), SCENES[scene]
    state = reaching(hand)

    def energy(at: HandState) -> float:
        short = [np.minimum(distances(hand, at, o) - kept(hand, o), 0.0) for o in obstacles]
        solids = [o for o in obstacles if len(o.corners)]
        short += [nearest_edges(hand, bodies_of(hand, at)[0], o, MARGIN) - MARGIN for o in solids]
        return float(sum((s**2).sum() for s in short))

    simulation = simulation_in(hand, obstacles)
    check_gradient(simulation, state, energy, least=1e-3, penetration=1.0)
    assert simulation[1].depths.points.numpy()[0] == 0.0, "the object pushes nothing here"


@pytest.mark.parametrize("room", [0.0, 0.006])
@pytest.mark.parametrize(
    ("name", "scene"), [*((name, "table") for name in HANDS), ("barrett", "a table to press into")]
)
def test_depth_is_what_the_nearest_feature_lacks_of_its_margin(name: str, scene: str, room: float) -> None:
    """A start keeps a quarter of its room under fingertips that may touch."""
    hand, (table,) = hand_from_path(name), SCENES[scene]
    model, data = simulation_in(hand, (table,))
    data.set_state(reaching(hand))
    record_placement(model, data, room=room).run()
    may_touch = np.isin(hand.features.body, hand.fingertips) & (table.tips_m is not None)
    lack = kept(hand, table) + np.where(may_touch, room / 4, room) - distances(hand, reaching(hand), table)
    # float32 coordinates of 0.1 m.
    np.testing.assert_allclose(data.deepest_penetration(1)[0], max(0.0, float(lack.max())), atol=1e-6)
    data.set_scenes(np.full(1, -1))
    data.set_state(reaching(hand))
    record_placement(model, data, room=room).run()
    assert data.depths.obstacles.numpy()[0] == 0.0, "a hand without a scene has no obstacle"


def projected(hand: HandModel, state: HandState, obstacle: Obstacle) -> HandState:
    return Projection(*simulation_in(hand, (obstacle,)), ProjectionOptions()).run(state, 60)[0]


@EACH_HAND
def test_projection_brings_hands_out_of_tables_and_sticks(name: str) -> None:
    """The stick is pushed into the largest face of the palm: no corner of the hand is near it."""
    hand, (table,) = hand_from_path(name), SCENES["table"]
    state = reaching(hand)
    state.pivot += (-0.003 - distances(hand, state, table).min()) * table.planes[0, :3]
    assert distances(hand, projected(hand, state, table), table).min() > MARGIN
    state = reaching(hand)
    (bodies,) = bodies_of(hand, state)
    palm = max((p for p in hand.pieces if p.kind == "box"), key=lambda p: sorted(p.size)[1])
    frame = compose(bodies[palm.body], palm.pose)
    thin = int(np.argmin(palm.size))
    middle = np.zeros(3)
    middle[thin] = 0.5 * palm.size[thin] + 0.004
    size = np.full(3, 0.01)
    size[(thin + 1) % 3] = 0.5
    pose = compose(frame, np.concatenate([middle, [np.cos(0.2), *(np.sin(0.2) * np.eye(3)[thin])]]))
    stick = Obstacle.box(pose, size)
    assert nearest_edges(hand, bodies, stick, MARGIN).min() < -5e-4
    found = projected(hand, state, stick)
    (posed,) = bodies_of(hand, found)
    assert min(nearest_edges(hand, posed, stick, 0.1).min(), distances(hand, found, stick).min()) > MARGIN - 1e-4

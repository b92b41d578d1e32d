"""The penalty against obstacles: its gradient against central differences of a float64 energy, its depth, its rows."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from graspd.service.model.transforms import compose, quat_rotate
from graspd.worker.hands.load import hand_from_path
from graspd.worker.hands.model import HandModel
from graspd.worker.scenes.placement import outer_solid
from graspd.worker.simulation.data import Data, HandState
from graspd.worker.simulation.environment import Environment, Obstacle
from graspd.worker.simulation.model import LossOptions, Model
from graspd.worker.simulation.obstacles import DeviceObstacles
from graspd.worker.simulation.projection import Projection, ProjectionOptions
from graspd.worker.simulation.record import record_evaluation, record_placement
from tests.worker.simulation.rigs import ball, rig, still
from tests.worker.simulation.solids import nearest_edges
from tests.worker.simulation.test_penalties import RELATIVE, bodies_of, differences

MARGIN = 0.004
BALL = np.random.default_rng(5).normal(size=(300, 3))
BALL = 0.04 * BALL / np.linalg.norm(BALL, axis=1, keepdims=True) + [0.33, 0.02, 0.02]
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
    "a round neighbour": (outer_solid(BALL)[0],),
}


def distances(hand: HandModel, state: HandState, obstacle: Obstacle) -> np.ndarray:
    """(F,) signed distance of each feature from an obstacle in float64, the object's centre being the origin."""
    features, poses = hand.features, bodies_of(hand, state)[hand.features.body]
    centre = quat_rotate(poses[:, 3:], features.centre) + poses[:, :3]
    axis = quat_rotate(poses[:, 3:], features.axis)
    rim = np.linalg.norm(axis, axis=1) > 0.5
    per_plane = []
    for plane in obstacle.planes:
        sine = np.sqrt(np.maximum(0, 1 - (axis @ plane[:3]) ** 2))
        per_plane.append(centre @ plane[:3] - plane[3] - features.radius * np.where(rim, sine, 1.0))
    return np.max(per_plane, axis=0)


def kept(hand: HandModel, obstacle: Obstacle) -> np.ndarray:
    """(F,) distance that features keep."""
    tip = np.isin(hand.features.body, hand.fingertips)
    return np.where(tip & (obstacle.tips_m is not None), obstacle.tips_m or 0.0, MARGIN)


def simulation_in(hand: HandModel, obstacles: tuple[Obstacle, ...]) -> tuple[Model, Data]:
    obj = ball()
    model, data = rig(hand, obj, capacity=1, options=LossOptions(simulate=False, leak=0.0, range_weight=0.0))
    up = np.array([0.0, 0, 1])
    solids = DeviceObstacles.create(hand, [Environment(obstacles, up)], obj.centre_of_mass, "cpu", margin=MARGIN)
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
        *((name, "table") for name in ("allegro", "barrett", "shadow")),
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
        short += [nearest_edges(hand, bodies_of(hand, at), o, MARGIN) - MARGIN for o in solids]
        return float(sum((s**2).sum() for s in short))

    model, data = simulation_in(hand, obstacles)
    schedule = still()
    schedule.penetration[:] = 1.0
    data.set_schedule(schedule)
    data.set_state(state)
    record_evaluation(model, data).run()
    assert data.depths.points.numpy()[0] == 0.0, "the object pushes nothing here"
    found = data.gradient.numpy()[0]
    expected = differences(energy, state, len(found))
    assert np.linalg.norm(expected) > 1e-3, "the state is too near"
    np.testing.assert_allclose(found, expected, atol=RELATIVE * np.abs(expected).max())


@pytest.mark.parametrize("name", ["allegro", "barrett", "shadow"])
def test_the_depth_is_what_the_nearest_feature_lacks_of_its_margin(name: str) -> None:
    hand, obstacles = hand_from_path(name), SCENES["table"]
    model, data = simulation_in(hand, obstacles)
    data.set_state(reaching(hand))
    record_placement(model, data).run()
    expected = max(0.0, MARGIN - distances(hand, reaching(hand), obstacles[0]).min())
    # float32 coordinates of 0.1 m.
    np.testing.assert_allclose(data.deepest(1)[0], expected, atol=1e-6)


def test_a_start_keeps_a_quarter_of_its_room_under_fingertips_that_may_touch() -> None:
    hand, (table,) = hand_from_path("barrett"), SCENES["a table to press into"]
    model, data = simulation_in(hand, (table,))
    data.set_state(reaching(hand))
    record_placement(model, data, room=0.006).run()
    tip = np.isin(hand.features.body, hand.fingertips)
    lack = kept(hand, table) + np.where(tip, 0.0015, 0.006) - distances(hand, reaching(hand), table)
    np.testing.assert_allclose(data.deepest(1)[0], max(0.0, float(lack.max())), atol=1e-6)


@pytest.mark.parametrize("name", ["allegro", "barrett", "shadow"])
def test_the_projection_brings_a_hand_out_of_an_obstacle(name: str) -> None:
    hand, obstacles = hand_from_path(name), SCENES["table"]
    state = reaching(hand)
    state.pivot += (-0.003 - distances(hand, state, obstacles[0]).min()) * obstacles[0].planes[0, :3]
    model, data = simulation_in(hand, obstacles)
    found, _ = Projection(model, data, ProjectionOptions()).run(state, 40)
    assert distances(hand, found, obstacles[0]).min() > MARGIN


def test_a_hand_without_a_scene_feels_no_obstacle() -> None:
    hand = hand_from_path("allegro")
    model, data = simulation_in(hand, SCENES["table"])
    data.set_scenes(np.full(1, -1))
    data.set_state(reaching(hand))
    record_placement(model, data).run()
    assert data.depths.obstacles.numpy()[0] == 0.0


@pytest.mark.parametrize("name", ["allegro", "barrett", "shadow"])
def test_the_projection_brings_a_hand_out_of_a_stick_between_its_corners(name: str) -> None:
    """The stick is pushed into the largest face of the palm: no corner of the hand is near it."""
    hand = hand_from_path(name)
    state = reaching(hand)
    bodies = bodies_of(hand, state)
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
    model, data = simulation_in(hand, (stick,))
    found, _ = Projection(model, data, ProjectionOptions()).run(state, 60)
    posed = bodies_of(hand, found)
    assert min(nearest_edges(hand, posed, stick, 0.1).min(), distances(hand, found, stick).min()) > MARGIN - 1e-4

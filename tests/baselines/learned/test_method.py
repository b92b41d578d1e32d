"""Seeds from a network: proposals are those of the architecture, and each grasp is its own whatever else is made."""

import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

from graspd.baselines.learned import network as net
from graspd.baselines.learned.method import ELEVATION, NEAREST_M, RETREATS, NetworkStarts, SurfaceView
from graspd.baselines.learned.network import Proposals, encode, save
from graspd.service.model.errors import InputError
from graspd.service.model.fidelity import resolve_fidelity
from graspd.service.model.transforms import apply, compose, quat_from_axis_angle, quat_from_matrix, quat_rotate
from graspd.service.store.network_file import ProposalNetwork
from graspd.worker.execution_context import ExecutionContext
from graspd.worker.grasps import GraspSet
from graspd.worker.hands.load import hand_from_path
from graspd.worker.hands.model import HandModel
from graspd.worker.objects.model import ObjectModel
from graspd.worker.objects.prepare import object_from_path
from graspd.worker.planners import BatchRequest, PlanRequest, method, planner, synthesize
from graspd.worker.planners.fast_graspd.pairs import Pair, pair_of
from graspd.worker.planners.fast_graspd.scene_starts import ROOM, free_directions
from graspd.worker.planners.fast_graspd.starts import CLEAR, Probe, start_generator
from graspd.worker.planners.network_cache import cache_file
from graspd.worker.planners.registry import local_options
from graspd.worker.simulation.data import HandState
from graspd.worker.simulation.environment import Obstacle, PlacedGrasps
from graspd.worker.simulation.obstacles import DeviceObstacles
from tests.networks import random_network
from tests.worker.models import assert_same_grasps, on_tables, unit_vectors

FEW = {"coarse_iterations": 20, "fine_iterations": 6, "polish_iterations": 2}
QUICK = resolve_fidelity("draft").model_copy(update=FEW)
MUG = object_from_path("mug")
BLOCK = object_from_path("block", face_error_m=QUICK.face_error_m)
POSE = np.concatenate([[0.2, -0.1, 0.05], quat_from_axis_angle(np.array([0.0, 0, 1]), np.asarray(0.7))])
Floats = np.ndarray[Any, np.dtype[np.float64]]


@pytest.fixture(scope="module")
def hand() -> HandModel:
    return hand_from_path("barrett")


@pytest.fixture(scope="module")
def network(hand: HandModel) -> ProposalNetwork:
    return random_network(hand.joint_names, hand=hand.name, digest=hand.digest)


def on_table(obj: ObjectModel, count: int, seed: int = 0) -> PlacedGrasps:
    return on_tables(obj, seed=seed).placed(np.arange(count) % 2)


def keep(network: ProposalNetwork) -> str:
    """A network's digest, its file read by this process."""
    with tempfile.TemporaryDirectory() as folder:
        save(network, Path(folder) / "net.npz")
        return cache_file(Path(folder) / "net.npz")


def made(hand: HandModel, obj: ObjectModel, network: ProposalNetwork, count: int, **given: Any) -> GraspSet:
    wanted = PlanRequest(count, QUICK, given.pop("seed", 1), placed=given.pop("placed", on_table(obj, count)))
    run, options = ExecutionContext(threads=given.pop("threads", 1)), {"network": keep(network), "starts": 2}
    return synthesize(hand, obj, wanted, run, method="learned", options=options)


@pytest.mark.slow
def test_a_grasp_depends_on_seed_and_index_alone(hand, network) -> None:
    small, large = made(hand, BLOCK, network, 2), made(hand, BLOCK, network, 8, threads=2)
    assert_same_grasps(small, large.take(slice(0, 2)))
    assert not np.allclose(small.grasp.hand_pose, made(hand, BLOCK, network, 2, seed=2).grasp.hand_pose)
    q = hand.reduce(large.grasp.joint_positions)
    assert (q >= hand.lower - 1e-5).all() and (q <= hand.upper + 1e-5).all()


def test_joined_batches_are_those_of_separate_launches(hand, network) -> None:
    options = {"network": keep(network), "starts": 2}
    wanted = [PlanRequest(2, QUICK, 1, batch, placed=on_table(BLOCK, 2)) for batch in (0, 1)]
    joins = method("learned").joined
    asked = [BatchRequest(one, ExecutionContext(threads=1)) for one in wanted]
    found = joins(method("learned").options(**options))(hand, BLOCK, asked)
    for one, alone in zip(found, wanted, strict=True):
        expected = synthesize(hand, BLOCK, alone, ExecutionContext(threads=1), method="learned", options=options)
        assert_same_grasps(one, expected)


def proposing(network: ProposalNetwork, found: Proposals, anchor: np.ndarray) -> ProposalNetwork:
    """A network that proposes one grasp, whatever it sees; its noise is a tenth of a millimetre or milliradian."""
    rows = encode(found, anchor)[0].astype(np.float32)
    zero = {name: np.zeros_like(w) for name, w in network.weights.items() if name.startswith("flow.out")}
    return replace(network, weights=network.weights | zero, mean=rows, std=np.full_like(rows, 1e-4))


def started(pair: Pair, network: ProposalNetwork, height: float, placed: PlacedGrasps) -> HandState:
    """Clear starts, two a grasp, from a network that proposes a palm at a height above the anchor [m]."""
    hand, obj, each = pair.hand.model, pair.coarse.obj.model, 2
    seeds = NetworkStarts(proposing(network, down(hand, height), np.zeros(3)), each)
    obstacles = DeviceObstacles.create(hand, placed.scenes, obj.centre_of_mass, "cpu")
    model = pair.model(pair.coarse, obstacles)
    generators = [start_generator(0, 0, i, k) for i in range(len(placed.index)) for k in range(each)]
    ways = [free_directions(scene, obj) for scene in placed.scenes]
    state, depth = seeds(model, generators, each=each, placed=placed, ways=ways)
    probe = Probe(model, len(generators), room=ROOM)
    probe.data.set_scenes(np.repeat(placed.index, each))
    assert (depth <= CLEAR).all() and (probe.depths(state) <= CLEAR).all()
    return state


def down(hand: HandModel, height: float) -> Proposals:
    """A hand whose open palm looks down from a height above the origin [m]."""
    z = hand.palm.approach
    x = np.cross(np.eye(3)[np.argmin(np.abs(z))], z)
    x /= np.linalg.norm(x)
    own = np.stack([x, np.cross(z, x), z], axis=1)
    turn = quat_from_matrix(np.array([[1.0, 0, 0], [0, -1, 0], [0, 0, -1]]) @ own.T)
    root = np.array([0, 0, height]) - quat_rotate(turn, hand.palm.centre)
    joints = hand.expand(hand.preshape)[None]
    way = np.array([[0.0, 0, -1]])
    return Proposals(np.concatenate([root, turn])[None], way, joints, joints, joints)


def test_hands_set_out_as_proposed_backed_off_until_clear(hand, network) -> None:
    pair, placed = pair_of(hand, BLOCK, QUICK, "cpu"), on_table(BLOCK, 2)
    state = started(pair, network, 0.1, placed)
    for row, scene in enumerate(np.repeat(placed.index, 2)):
        pose = placed.object_pose[scene]
        palm = quat_rotate(pose[3:], state.pivot[row] + BLOCK.centre_of_mass) + pose[:3]
        looks = quat_rotate(pose[3:], quat_rotate(state.rotation[row], hand.palm.approach))
        np.testing.assert_allclose(looks, [0, 0, -1], atol=2e-3)
        np.testing.assert_allclose(state.q[row], hand.preshape, atol=2e-3)
        # The anchor is the mean of what is seen: within the block, above half of its height on the camera's side.
        assert 0.1 < palm[2] < 0.1 + 2 * BLOCK.radius
        assert np.linalg.norm(palm[:2] - compose(pose, np.array([*BLOCK.centre_of_mass, 1, 0, 0, 0]))[:2]) < 0.03
    # From within the block it comes out the way it came, no farther than it must.
    deeper = started(pair, network, 0.0, placed)
    up = np.array([s.up for s in placed.scenes])[np.repeat(placed.index, 2)]
    lower = ((state.pivot - deeper.pivot) * up).sum(axis=1)
    assert ((lower > 0.1 - max(RETREATS) - 1e-3) & (lower < 0.1)).all()
    np.testing.assert_allclose(deeper.rotation, state.rotation, atol=2e-3)


@pytest.mark.parametrize("height", [-0.5, 1e30])
def test_with_no_proposal_clear_hands_set_out_without_a_network(hand, network, height) -> None:
    pair, placed = pair_of(hand, BLOCK, QUICK, "cpu"), on_table(BLOCK, 2)
    assert (np.linalg.norm(started(pair, network, height, placed).pivot, axis=1) < BLOCK.radius + 0.15).all()


def test_what_it_cannot_do_is_said_in_a_line(hand, network, tmp_path: Path) -> None:
    def refused(words: str, **given: Any) -> None:
        with pytest.raises(InputError, match=words) as error:
            made(given.pop("hand", hand), BLOCK, given.pop("network", network), 1, **given)
        assert "\n" not in str(error.value)

    refused("in scenes only", placed=None)
    refused("proposes grasps of barrett .*, not of allegro", hand=hand_from_path("allegro"))
    refused("not of barrett", network=replace(network, hand_digest="f" * 32))
    board = Obstacle.box([0, 0, -0.01, 1, 0, 0, 0], [1, 1, 0.02])
    refused("choose fast_graspd", placed=replace(on_table(BLOCK, 1), supports=(board,)))
    with pytest.raises(InputError, match="not known here"):
        plan = planner("learned", {"network": "e" * 32}, in_scenes=True)
        plan(hand, BLOCK, PlanRequest(1, QUICK), ExecutionContext())
    # A worker that is told a path reads no file.
    save(network, tmp_path / "net.npz")
    with pytest.raises(InputError, match="option of learned: network"):
        planner("learned", {"network": str(tmp_path / "net.npz")}, in_scenes=True)
    assert local_options("learned", {"network": str(tmp_path / "net.npz")}) == {"network": keep(network)}
    assert local_options("graspit", {"steps": "3"}) == {"steps": "3"}
    with pytest.raises(InputError, match="cannot be read"):
        local_options("learned", {"network": str(tmp_path / "none.npz")})


def test_points_lie_on_the_surface_and_are_seen_by_the_camera() -> None:
    seen, rng = SurfaceView.from_object(MUG), np.random.default_rng(3)
    mesh = trimesh.Trimesh(apply(POSE, MUG.vertices), MUG.faces, process=False)
    for _ in range(3):
        camera = seen.camera(POSE, rng)
        points, normals = seen.cloud(POSE, camera, 400, rng)
        assert points.shape == normals.shape == (400, 3)
        rays = points - camera
        assert ((rays * normals).sum(axis=1) < 0).all()
        far = np.linalg.norm(rays, axis=1)
        # The exact first hit of the ray through each point.
        where, ray, _ = mesh.ray.intersects_location(np.tile(camera, (400, 1)), rays, multiple_hits=False)
        gap = far[ray] - np.linalg.norm(where - camera, axis=1)
        assert len(set(ray.tolist())) >= 396  # a ray along an edge may miss
        # A pixel whose front no sample fell into shows what is behind: inside of the mug, the wall behind the handle.
        assert (np.abs(gap) < 1e-3).mean() > 0.97
    points, _ = seen.cloud(POSE, camera, 8192, rng)  # more than the pixels that see the mug
    assert points.shape == (8192, 3) and np.isfinite(points).all()


def test_cameras_stand_where_pictures_have_them() -> None:
    seen, rng = SurfaceView.from_object(MUG), np.random.default_rng(0)
    middle = apply(POSE, MUG.centre_of_mass)
    out = np.array([seen.camera(POSE, rng) - middle for _ in range(200)])
    distance = np.linalg.norm(out, axis=1)
    elevation = np.arcsin(out[:, 2] / distance)
    assert (elevation >= ELEVATION[0] - 1e-9).all() and (elevation <= ELEVATION[1] + 1e-9).all()
    assert (distance >= NEAREST_M + MUG.radius - 1e-9).all() and (distance < 0.8).all()
    assert np.linalg.norm((out[:, :2] / distance[:, None]).mean(axis=0)) < 0.15  # from all sides


def cloud(count: int = 64, seed: int = 1) -> tuple[Floats, Floats]:
    normals = unit_vectors(np.random.default_rng(seed), count)
    return 0.05 * normals + [0.3, -0.2, 0.5], normals


def proposed(network: ProposalNetwork, count: int, **given: Any) -> net.Proposals:
    points, normals = cloud()
    rng = np.random.default_rng(7)
    return net.propose(network, points, normals, table_height=0.45, count=count, rng=rng, **given)


def assert_near(one: net.Proposals, other: net.Proposals, atol: float) -> None:
    for name, values in vars(one).items():
        np.testing.assert_allclose(values, getattr(other, name), atol=atol, err_msg=name)


def float64_rows(network: ProposalNetwork, noise: Floats, label: float) -> Floats:
    """The definition, point by point and row by row, in double precision."""
    w = {name: np.asarray(array, float) for name, array in network.weights.items()}
    points, normals = cloud()
    anchor = points.mean(axis=0)
    features = []
    for p, n in zip(points, normals, strict=True):
        h = np.array([*(p - anchor) / 0.1, *n, (p[2] - 0.45) / 0.1])
        for i in range(3):
            h = np.maximum(w[f"encoder.{i}.weight"] @ h + w[f"encoder.{i}.bias"], 0)
        features.append(h)
    feature = np.maximum(w["encoder.out.weight"] @ np.max(features, axis=0) + w["encoder.out.bias"], 0)
    condition = [*feature, (anchor[2] - 0.45) / 0.1, label]

    def silu(x: Floats) -> Floats:
        return x / (1 + np.exp(-x))

    rows = []
    for x in noise:
        for step in range(network.steps):
            t = step / network.steps
            angles = [2 * np.pi * 2**k * t for k in range(4)]
            h = np.array([*x, *np.sin(angles), *np.cos(angles), *condition])
            h = silu(w["flow.in.weight"] @ h + w["flow.in.bias"])
            for b in "01":
                inner = silu(w[f"flow.{b}.a.weight"] @ h + w[f"flow.{b}.a.bias"])
                h = h + w[f"flow.{b}.b.weight"] @ inner + w[f"flow.{b}.b.bias"]
            x = x + (w["flow.out.weight"] @ h + w["flow.out.bias"]) / network.steps
        rows.append(x * network.std + network.mean)
    return np.array(rows)


@pytest.mark.parametrize("label", [1.0, 0.0])
def test_proposals_are_those_of_definition_in_double_precision(label: float) -> None:
    network = random_network(["a", "b", "c"])
    noise = np.random.default_rng(7).standard_normal((3, network.row_size))
    expected = net.decode(float64_rows(network, noise, label), cloud()[0].mean(axis=0))
    # Single precision: 16 steps of sums over 512 numbers of order 1, each rounded at 6e-8.
    assert_near(proposed(network, 3, label=label), expected, 2e-5)


def test_a_proposal_depends_on_no_order_of_points_height_or_count() -> None:
    network = random_network()
    points, normals = cloud()

    def seen(points: Floats, normals: Floats, table_height: float = 0.45) -> net.Proposals:
        rng = np.random.default_rng(0)
        return net.propose(network, points, normals, table_height=table_height, count=4, rng=rng)

    first = seen(points, normals)
    assert_near(seen(points[::-1], normals[::-1]), first, 1e-5)  # sums in single precision
    shift = np.array([0.2, 0.1, -0.3])
    moved = seen(points + shift, normals, 0.45 + shift[2])
    np.testing.assert_allclose(moved.hand_pose[:, :3], first.hand_pose[:, :3] + shift, atol=1e-5)
    np.testing.assert_allclose(moved.joints, first.joints, atol=1e-5)
    one, many = proposed(network, 1), proposed(network, 70)
    for name, values in vars(one).items():
        assert np.array_equal(values[0], getattr(many, name)[0])
    assert len(np.unique(many.hand_pose[:, 0])) == 70


def test_a_grasp_survives_its_row_and_a_bad_row_is_a_rotation() -> None:
    network = random_network(["a", "b", "c"])
    found = proposed(network, 5)
    np.testing.assert_allclose(np.linalg.norm(found.hand_pose[:, 3:], axis=1), 1, atol=1e-12)
    assert_near(net.decode(net.encode(found, [0.1, 0.2, 0.3]), [0.1, 0.2, 0.3]), found, 1e-12)
    flat = np.zeros((3, network.row_size))
    flat[1, 3:9] = [0, 2, 0, 0, -1, 0]  # columns on one line
    flat[2, 3:9] = [3, 0, 0, 1, 2, 0]
    made = net.decode(flat, np.zeros(3))
    np.testing.assert_allclose(np.linalg.norm(made.hand_pose[:, 3:], axis=1), 1, atol=1e-12)
    np.testing.assert_allclose(made.hand_pose[2, 3:], [1, 0, 0, 0], atol=1e-12)
    np.testing.assert_allclose(made.approach, [[0, 0, -1]] * 3, atol=1e-12)


def test_clouds_that_are_none_and_wild_numbers_are_refused() -> None:
    network = random_network()
    points, normals = cloud()
    for p, n in ((points[:0], normals[:0]), (points, normals[:-1]), (points * np.nan, normals), (points.T, normals.T)):
        with pytest.raises(InputError, match="cloud"):
            net.propose(network, p, n, table_height=0, count=1, rng=np.random.default_rng(0))
    wild = random_network()
    wild.weights["flow.out.weight"][:] = 3e38
    with pytest.raises(InputError, match="not finite"):
        proposed(wild, 1)

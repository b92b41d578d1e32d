"""Execution of motions in MuJoCo: two pads lift a box off a table, flying and on an arm."""

from dataclasses import replace

import numpy as np
import pytest

from graspd.service.model.matter import ACCELERATION
from graspd.service.model.transforms import IDENTITY_POSE, compose, invert
from graspd.service.store.columns import EPISODE_OUTCOMES, EPISODE_PHASES
from graspd.worker.episodes.episode import PHASES, EpisodeOutcome, Robot
from graspd.worker.episodes.execution import Executions, ToolFrame, build_executions
from graspd.worker.episodes.motion import Motion, MotionPlanner
from graspd.worker.episodes.robots import read_robot
from graspd.worker.episodes.simulation import Simulation
from graspd.worker.simulation.environment import RISE_M
from graspd.worker.validation.model import FRICTION
from tests.worker.quality.helpers import pad_hand
from tests.worker.validation.test_lift import BOX, TOUCH, WHOLE, grasp, placed

HAND = replace(pad_hand(), velocity=np.full(2, 0.1))  # [m/s]
FIRM = 0.02  # squeeze of each pad [m]
#: Mass [kg] whose weight friction of both pads holds: 2 mu k d = m g.
PAYLOAD = 2 * FRICTION[0] * float(HAND.stiffness[0]) * FIRM / ACCELERATION


def executions(squeeze: float = FIRM, mass: float = 0.1, friction: float = BOX.friction) -> Executions:
    tool, one = ToolFrame("palm", IDENTITY_POSE), np.zeros(1, int)
    obj = BOX.with_mass(mass=mass, friction=friction)
    return build_executions(HAND, obj, grasp(squeeze), rows=one, placed=placed(1), tool=tool, quality={})


def motion_of(found: Executions, robot: Robot) -> Motion:
    motion = MotionPlanner(robot, found, WHOLE).plan(0)
    assert isinstance(motion, Motion)
    return motion


def simulation_of(found: Executions, robot: Robot | None = None, fps: float = 15.0) -> Simulation:
    return Simulation(robot or Robot(HAND), found.obj, WHOLE, found.placed, fps=fps)


@pytest.mark.parametrize("arm", [None, "franka", "ur10e"])
def test_a_lifted_box_follows_the_hand(arm: str | None) -> None:
    robot, found = read_robot(HAND, arm), executions()
    episode = simulation_of(found, robot).execute(motion_of(found, robot), 0)
    assert (episode.outcome, episode.row) == (EpisodeOutcome.SUCCEEDED, 0)
    assert episode.object_pose[-1, 2] - episode.object_pose[0, 2] == pytest.approx(RISE_M, abs=2e-3)
    # From the squeeze on, the box stays where it is in the hand. Critically damped drives lag by about 20 ms.
    held = episode.phase > PHASES.index("squeeze")
    roots = robot.poses(episode.state[held])[0][1][:, 0]
    assert np.ptp(compose(invert(roots), episode.object_pose[held])[:, :3], axis=0).max() < 2e-3
    commanded = robot.poses(episode.action[:-1])[0][1][:, 0, :3]
    assert np.abs(robot.poses(episode.state[1:])[0][1][:, 0, :3] - commanded).max() < 0.03
    assert np.abs(robot.poses(episode.state[-1:])[0][1][:, 0, :3] - commanded[-1]).max() < 1e-3


@pytest.mark.parametrize(
    ("change", "outcome"),
    [
        ({"mass": 0.7 * PAYLOAD}, EpisodeOutcome.SUCCEEDED),
        ({"mass": 1.4 * PAYLOAD}, EpisodeOutcome.NOT_LIFTED),
        ({"friction": 1e-3}, EpisodeOutcome.NOT_LIFTED),
    ],
)
def test_friction_and_mass_decide_whether_the_box_rises(change: dict[str, float], outcome: EpisodeOutcome) -> None:
    found = executions(**change)
    assert simulation_of(found).execute(motion_of(found, Robot(HAND)), 0).outcome is outcome


def altered(motion: Motion, name: str) -> Motion:
    """The motion with open pads at the end, with a push before they close, or with a leap to far away."""
    targets, of_hand = motion.targets.copy(), slice(7, None)
    if name == "opens":
        targets[motion.phase == PHASES.index("hold"), of_hand] = TOUCH - 0.03
    elif name == "pushes":
        targets[motion.phase == PHASES.index("shape"), 0] += 0.05
    else:
        targets[motion.phase == PHASES.index("lift"), :3] += 1e9
    return replace(motion, targets=targets)


@pytest.mark.parametrize(
    ("name", "outcome"),
    [("opens", EpisodeOutcome.DROPPED), ("pushes", EpisodeOutcome.TOUCHED), ("leaps", EpisodeOutcome.DIVERGED)],
)
def test_failures_have_their_reasons_and_repeat(name: str, outcome: EpisodeOutcome) -> None:
    found = executions()
    episode = simulation_of(found).execute(altered(motion_of(found, Robot(HAND)), name), 0)
    assert episode.outcome is outcome and len(episode.state) == len(episode.action) == len(episode.phase)
    again = simulation_of(found).replay(episode)
    assert again.outcome is outcome and np.array_equal(again.state, episode.state)


def test_arms_are_gravity_compensated_and_as_strong_as_their_drives() -> None:
    robot, found = read_robot(HAND, "ur10e"), executions()
    motion = motion_of(found, robot)
    still = np.repeat(motion.targets[:1], len(motion.time), axis=0)
    # A contact that no posture avoids, here of the shoulder inside the table, counts for nothing.
    for low in (0.0, 0.1):
        simulation = simulation_of(found, replace(robot, base=robot.base - [0, 0, low, 0, 0, 0, 0]))
        states = simulation.execute(replace(motion, targets=still), 0).state
        assert np.abs(states - still[0]).max() < 1e-4
        bodies = simulation.model.geom_bodyid[simulation.data.contact.geom].ravel()
        assert not [name for body in bodies if (name := simulation.model.body(body).name).startswith("arm")]
    weak = replace(robot, arm=replace(robot.arm, model=replace(robot.arm.model, effort=np.full(6, 0.2))))
    assert simulation_of(found, weak).execute(motion, 0).outcome is EpisodeOutcome.NOT_LIFTED


@pytest.mark.parametrize("fps", [10.0, 30.0])
def test_frames_are_at_equal_times_and_the_step_divides_them(fps: float) -> None:
    found = executions()
    simulation, motion = simulation_of(found, fps=fps), motion_of(found, Robot(HAND))
    episode = simulation.execute(motion, 0)
    assert episode.outcome is EpisodeOutcome.SUCCEEDED
    assert (len(episode.phase) - 1) / fps == pytest.approx(motion.time[-1], abs=1 / fps)
    assert simulation.scene.model.opt.timestep * simulation.steps * fps == pytest.approx(1)
    assert simulation.data.time == pytest.approx((len(episode.phase) - 1) / fps)


def test_files_name_all_outcomes_and_phases() -> None:
    assert tuple(EPISODE_PHASES.values()) == PHASES
    assert list(EPISODE_OUTCOMES.values()) == [one.name.lower().replace("_", " ") for one in EpisodeOutcome]


def test_a_policy_that_repeats_stored_actions_repeats_the_episode() -> None:
    found = executions()
    simulation = simulation_of(found)
    episode = simulation.execute(motion_of(found, Robot(HAND)), 0)
    again = simulation.follow(lambda frame, *_: episode.action[frame], replace(episode, action=0 * episode.action))
    assert again.outcome is EpisodeOutcome.SUCCEEDED
    assert np.array_equal(again.state, episode.state) and np.array_equal(again.action[:-1], episode.action[:-1])

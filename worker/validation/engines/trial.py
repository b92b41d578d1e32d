"""One protocol for all engines: closing to the squeeze, then six pushes, or a lift with its hold.

As in DexGraspBench, the hand closes, and each push of 2 s starts from the closed hand. In scenes the hand rises
smoothly and holds for 2 s. Except at level dexgraspbench, pushes and holds end early by the rule of level standard.
Pregrasps that penetrate, and approaches that collide, are rejected by geometry alone, so equally for all engines."""

import math
from typing import Any, Final

import mujoco
import numpy as np

from graspd.service.model.transforms import Floats, compose, quat_conjugate, quat_multiply, quat_rotate, quat_to_matrix
from graspd.worker.grasps import GraspSet
from graspd.worker.hands.model import HandModel, JointType
from graspd.worker.simulation.environment import RISE_M, UP, PlacedGrasps
from graspd.worker.validation import protocol
from graspd.worker.validation.decomposition import ConvexPieces
from graspd.worker.validation.engines import port
from graspd.worker.validation.lift import RISING, RISING_S, SMOOTHLY
from graspd.worker.validation.model import Scene, interpolate_postures

_COUNT: Final = round(protocol.HOLD_S / protocol.INTERVAL_S)


def engine_model(scene: Scene, pieces: ConvexPieces, supports: PlacedGrasps | None = None) -> port.EngineModel:
    """Return the model for all engines, with all numbers of MuJoCo's compiled model."""
    model, hand = scene.model, scene.hand
    at = scene.object_body
    friction = model.geom_friction[model.body_geomadr[at]]
    obj = port.RigidObject(
        tuple(np.asarray(corners - scene.centre) for corners in pieces.vertices),
        float(model.body_mass[at]),
        _inertia(model, at),
        scene.centre,
    )
    # Children collide with their parents in no engine.
    parents = {(int(hand.parent[b]), b) for b in range(1, hand.bodies)}
    drives, couplings = _drives(model), _couplings(model)
    return port.EngineModel(
        links=tuple(_link(model, hand, b) for b in range(hand.bodies)),
        drives=drives,
        couplings=couplings,
        ignored=frozenset(hand.neighbours | parents),
        obj=obj,
        friction=float(friction[0]),
        torsional_friction_m=float(friction[1]),
        supports=() if supports is None else supports.supports,
    )


def _inertia(model: Any, body: int) -> Floats:
    axes = quat_to_matrix(model.body_iquat[body])
    return np.asarray(axes * model.body_inertia[body] @ axes.T)


def _link(model: Any, hand: HandModel, b: int) -> port.Link:
    body = model.body(f"body{b}").id
    joint = model.joint(f"joint{b}") if b else None
    at = -1 if joint is None else int(joint.dofadr[0])
    lower, upper = (0.0, 0.0) if joint is None else joint.range
    damping, armature, dry = (
        0.0 if joint is None else float(values[at])
        for values in (model.dof_damping, model.dof_armature, model.dof_frictionloss)
    )
    return port.Link(
        parent=int(hand.parent[b]),
        joint=JointType(int(hand.joint_type[b])),
        origin=hand.origin[b],
        axis=hand.axis[b],
        limits=(float(lower), float(upper)),
        damping=damping,
        armature=armature,
        dry_friction=dry,
        mass=float(model.body_mass[body]),
        centre=np.array(model.body_ipos[body]),
        inertia=_inertia(model, body),
        pieces=tuple(piece for piece in hand.pieces if piece.body == b),
    )


def _number(model: Any, joint: int) -> int:
    return int(model.joint(int(joint)).name.removeprefix("joint"))


def _drives(model: Any) -> tuple[port.Drive, ...]:
    found = []
    for a in range(model.nu):
        target = int(model.actuator_trnid[a, 0])
        joints, pulls = (target,), (1.0,)
        if model.actuator_trntype[a] == mujoco.mjtTrn.mjTRN_TENDON:
            wraps = slice(model.tendon_adr[target], model.tendon_adr[target] + model.tendon_num[target])
            joints, pulls = model.wrap_objid[wraps], model.wrap_prm[wraps]
        numbers = tuple(_number(model, joint) for joint in joints)
        gain, effort = float(model.actuator_gainprm[a, 0]), float(model.actuator_forcerange[a, 1])
        found.append(port.Drive(numbers, tuple(float(pull) for pull in pulls), gain, effort))
    return tuple(found)


def _couplings(model: Any) -> tuple[port.Coupling, ...]:
    return tuple(
        port.Coupling(
            _number(model, model.eq_obj1id[e]),
            _number(model, model.eq_obj2id[e]),
            ratio=float(model.eq_data[e, 1]),
            offset=float(model.eq_data[e, 0]),
        )
        for e in np.flatnonzero(model.eq_type == mujoco.mjtEq.mjEQ_JOINT)
    )


def trial_of(scene: Scene, grasps: GraspSet, row: int, placed: PlacedGrasps | None = None) -> port.Trial:
    """Return the trial of one grasp: pushes if it is free, a lift in its scene otherwise."""
    world = np.array([0, 0, 0, 1.0, 0, 0, 0])
    if placed is not None:
        world = np.asarray(placed.object_pose[placed.index[row]], float)
    parts = ((grasps.pregrasp, grasps.grasp), (grasps.grasp, grasps.squeeze))
    path = [
        interpolate_postures(a, b, row, k / protocol.STAGES) for a, b in parts for k in range(1, protocol.STAGES + 1)
    ]
    root, joints = _targets(scene.hand, world, [(grasps.pregrasp.hand_pose[row], grasps.pregrasp.joint_positions[row])])
    roots, targets = _targets(scene.hand, world, path)
    weight = scene.push_force * (np.zeros(3) if placed is None else -UP)
    closing = port.Motion(roots, targets, np.full(len(path), protocol.STAGE_S), weight, np.zeros((len(path), 3)))
    hold = np.full(_COUNT, protocol.INTERVAL_S)
    if placed is None:
        forces = scene.push_force * np.array(protocol.DIRECTIONS, float)
        tests = tuple(_rest(closing, np.zeros((_COUNT, 3)), hold, force) for force in forces)
    else:
        rise = np.concatenate([SMOOTHLY, np.ones(_COUNT)])[:, None] * RISE_M * UP
        tests = (_rest(closing, rise, np.concatenate([np.full(RISING, RISING_S), hold]), weight),)
    centre = compose(world, np.array([*scene.centre, 1, 0, 0, 0]))
    return port.Trial(centre, root[0], joints[0], closing, tests)


def _targets(hand: HandModel, world: Floats, path: list[tuple[Floats, Floats]]) -> tuple[Floats, Floats]:
    """Return root poses (T, 7) in the world and joint positions (T, L) by link."""
    joints = np.zeros((len(path), hand.bodies))
    joints[:, hand.joint_body] = [positions for _, positions in path]
    return np.asarray(compose(world, np.array([pose for pose, _ in path]))), joints


def _rest(closed: port.Motion, raised: Floats, seconds: Floats, force: Floats) -> port.Motion:
    """Keep the last posture, with the root displaced by `raised` (T, 3)."""
    root = np.repeat(closed.root[-1:], len(raised), axis=0)
    root[:, :3] += raised
    return port.Motion(root, np.repeat(closed.joints[-1:], len(raised), axis=0), seconds, force, raised)


def run_trial(
    simulation: port.Simulation, trial: port.Trial, centre: Floats, *, early: bool = True
) -> protocol.Rollout:
    """Simulate one trial up to its first loss; `centre` (3,) is the object's centre of mass.
    With `early`, a test ends as soon as motion at `AHEAD` times the present rate would stay inside the limits."""
    rollout = protocol.Rollout([protocol.Outcome.NOT_TRIED] * len(trial.tests))
    checks = _Checks(simulation, trial, centre, rollout, early)
    simulation.reset(trial.object_pose, trial.root, trial.joints)
    if (outcome := checks.run(trial.closing, last=True)) is not protocol.Outcome.HELD:
        return rollout.fail(
            protocol.Outcome.DIVERGED if outcome is protocol.Outcome.DIVERGED else protocol.Outcome.LOST_WHILE_CLOSING
        )
    closed = simulation.save()
    for number, test in enumerate(trial.tests):
        if number:
            simulation.restore(closed)
        rollout.outcomes[number] = checks.run(test)
        if rollout.outcomes[number] is not protocol.Outcome.HELD:
            break
    return rollout


class _Checks:
    def __init__(
        self, simulation: port.Simulation, trial: port.Trial, centre: Floats, rollout: protocol.Rollout, early: bool
    ) -> None:
        self._early = early
        self._simulation, self._centre, self._rollout = simulation, centre, rollout
        self._start, self._place = trial.object_pose, self._position(trial.object_pose)

    def run(self, motion: port.Motion, *, last: bool = False) -> protocol.Outcome:
        """Run a motion up to a loss or to its early end; with `last`, check only its end."""
        parts = zip(motion.root, motion.joints, motion.seconds, motion.displacement, strict=True)
        changes = np.flatnonzero(np.diff(motion.displacement, axis=0).any(axis=1))
        resting = int(changes[-1]) + 2 if len(changes) else 0  # first target through which the object should rest
        left, outcome, before = float(motion.seconds.sum()), protocol.Outcome.HELD, np.zeros(4)
        for number, (root, joints, seconds, displacement) in enumerate(parts):
            self._rollout.steps += self._simulation.run(root, joints, motion.force, float(seconds))
            left -= float(seconds)
            if last and number < len(motion.seconds) - 1:
                continue
            moved = self._motion(displacement)
            if (outcome := self._outcome(moved)) is not protocol.Outcome.HELD:
                break
            ahead = moved + protocol.AHEAD * left / float(seconds) * (moved - before)
            if self._early and number > resting and _excess(ahead) < protocol.SURE:
                break
            before = moved
        return outcome

    def _position(self, pose: Floats) -> Floats:
        return np.asarray(pose[:3] - quat_rotate(pose[3:], self._centre))

    def _motion(self, displacement: Floats) -> Floats:
        """Return the object's deviation (3,) from an expected displacement, and its rotation since the start."""
        pose = self._simulation.object_pose()
        q = quat_multiply(pose[3:], quat_conjugate(self._start[3:]))
        turned = 2 * math.atan2(float(np.linalg.norm(q[1:])), abs(float(q[0])))
        return np.append(self._position(pose) - self._place - displacement, turned)

    def _outcome(self, moved: Floats) -> protocol.Outcome:
        if not np.isfinite(moved).all():
            return protocol.Outcome.DIVERGED
        self._rollout.margin = max(self._rollout.margin, _excess(moved))
        if not np.linalg.norm(moved[:3]) < protocol.MAX_DISPLACEMENT_M:
            return protocol.Outcome.DISPLACED
        return protocol.Outcome.HELD if moved[3] < protocol.MAX_ROTATION else protocol.Outcome.ROTATED


def _excess(moved: Floats) -> float:
    """Return the larger ratio of displacement or rotation to its limit."""
    displacement, turn = float(np.linalg.norm(moved[:3])), float(moved[3])
    return max(displacement / protocol.MAX_DISPLACEMENT_M, turn / protocol.MAX_ROTATION)

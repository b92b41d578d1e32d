"""Schedule of level standard for many worlds: close, push six ways, check, take the next grasp.

A tick is the simulation between two checks (`protocol.INTERVAL_S`), after which each world checks its own object.
Worlds do not wait for each other. Quaternions are w x y z in `wp.quat`, as in MuJoCo Warp."""

from typing import Final

import warp as wp

from graspd.worker.validation import protocol
from graspd.worker.validation.protocol import Outcome

wp.set_module_options({"enable_backward": False})

#: A verdict is clear if the worst motion is below the first share of its limit, or above the second. Margins of held
#: grasps differ by 0.11 between the engines, at the 99th percentile (benchmarks.prefilter).
BAND: Final = (0.8, 1.2)
#: Ticks of a push after its motion exceeds a limit. If the motion is then still in the band, the verdict is not clear.
PATIENCE: Final = 5
#: Number of ticks (of `protocol.INTERVAL_S`) after which a grasp stays undecided. Grasps that hold take at least 32; 1
#: in 100 takes more than 47. A few slow grasps would delay the whole launch.
MOST_TICKS: Final = 48
#: Ticks of one stage of closing; stages of each motion; ticks until the first check of a push, and of a whole push.
STAGE = wp.constant(round(protocol.STAGE_S / protocol.INTERVAL_S))
STAGES = wp.constant(protocol.STAGES)
FIRST_LOOK = wp.constant(round(protocol.FIRST_LOOK_S / protocol.INTERVAL_S))
HOLD = wp.constant(round(protocol.HOLD_S / protocol.INTERVAL_S))
PUSHES = wp.constant(len(protocol.DIRECTIONS))
MOVED = wp.constant(protocol.MAX_DISPLACEMENT_M)
TURNED = wp.constant(protocol.MAX_ROTATION)
SURE = wp.constant(protocol.SURE)
AHEAD = wp.constant(protocol.AHEAD)
LOST_TURN = wp.constant(protocol.LOST_ROTATION)
HELD = wp.constant(int(Outcome.HELD))
LOST = wp.constant(int(Outcome.LOST_WHILE_CLOSING))
DISPLACED = wp.constant(int(Outcome.DISPLACED))
ROTATED = wp.constant(int(Outcome.ROTATED))
DIVERGED = wp.constant(int(Outcome.DIVERGED))
#: Ratio of motion to its limit above which a failure is clear; most ticks after a failure; most ticks of a grasp.
CLEAR = wp.constant(BAND[1])
PATIENT = wp.constant(PATIENCE)
MOST = wp.constant(MOST_TICKS)
PARKED = wp.constant(10.0)  # position of the object in worlds without a grasp, out of reach of the hand [m]


@wp.struct
class GraspCommands:
    """Commands of N grasps."""

    queue: wp.array(dtype=wp.int32)  # the grasps to validate, in turn
    start: wp.array2d(dtype=wp.float32)  # (N, nq) state in the pregrasp
    position: wp.array2d(dtype=wp.vec3)  # (N, 3) root positions in pregrasp, grasp and squeeze [m]
    turn: wp.array2d(dtype=wp.vec4)  # (N, 3) root quaternions
    control: wp.array3d(dtype=wp.float32)  # (N, 3, nu) commands of the actuators


@wp.struct
class Engine:
    """Arrays of W simulations that are set and read."""

    qpos: wp.array2d(dtype=wp.float32)
    qvel: wp.array2d(dtype=wp.float32)
    warmstart: wp.array2d(dtype=wp.float32)
    ctrl: wp.array2d(dtype=wp.float32)
    mocap_pos: wp.array2d(dtype=wp.vec3)
    mocap_quat: wp.array2d(dtype=wp.quat)
    force: wp.array2d(dtype=wp.spatial_vector)
    overflow: wp.array(dtype=wp.int32)


@wp.struct
class Worlds:
    """State of the schedule in each of W worlds."""

    grasp: wp.array(dtype=wp.int32)  # -1 if no grasp is left for the world
    ticks: wp.array(dtype=wp.int32)  # ticks since the hand began to close
    push: wp.array(dtype=wp.int32)  # -1 while closing
    looks: wp.array(dtype=wp.int32)  # ticks of the present push
    broken: wp.array(dtype=wp.int32)  # outcome for the limit that the present push exceeded; 0 if it exceeded none
    before: wp.array(dtype=wp.vec3)
    turned_before: wp.array(dtype=wp.float32)
    qpos: wp.array2d(dtype=wp.float32)  # closed state from which every push starts; the next two arrays belong to it
    qvel: wp.array2d(dtype=wp.float32)
    warmstart: wp.array2d(dtype=wp.float32)


@wp.struct
class WorldVerdicts:
    """Verdicts on N grasps."""

    outcome: wp.array2d(dtype=wp.int32)  # (N, 6)
    margin: wp.array(dtype=wp.float32)  # largest ratio of displacement or rotation to its limit so far
    ticks: wp.array(dtype=wp.int32)
    overflow: wp.array(dtype=wp.int32)


@wp.struct
class TestConstants:
    """Constants of all worlds."""

    object_qpos: wp.int32
    object_body: wp.int32
    push: wp.float32  # [N]
    centre: wp.vec3  # centre of mass of the object in its frame [m]


@wp.func
def slerp(a: wp.vec4, b: wp.vec4, share: wp.float32):
    """Interpolate unit quaternions a and b at `share`, by slerp along the shorter arc."""
    cosine = wp.dot(a, b)
    if cosine < 0.0:
        b = -b
        cosine = -cosine
    angle = wp.acos(wp.min(cosine, 1.0))
    first, second = 1.0 - share, share
    if angle > 1.0e-3:  # below, linear interpolation is accurate
        first, second = wp.sin(first * angle) / wp.sin(angle), wp.sin(second * angle) / wp.sin(angle)
    return wp.normalize(first * a + second * b)


@wp.func
def command(w: wp.int32, g: wp.int32, ticks: wp.int32, grasps: GraspCommands, engine: Engine):
    """Set the target posture of the stage that begins after `ticks` ticks of closing."""
    stage = wp.min(ticks / STAGE, 2 * STAGES - 1)
    part = stage / STAGES
    share = float(stage % STAGES + 1) / float(STAGES)
    q = slerp(grasps.turn[g, part], grasps.turn[g, part + 1], share)
    engine.mocap_pos[w, 0] = (1.0 - share) * grasps.position[g, part] + share * grasps.position[g, part + 1]
    engine.mocap_quat[w, 0] = wp.quat(q[0], q[1], q[2], q[3])
    for k in range(engine.ctrl.shape[1]):
        engine.ctrl[w, k] = (1.0 - share) * grasps.control[g, part, k] + share * grasps.control[g, part + 1, k]


@wp.func
def offset(w: wp.int32, terms: TestConstants, engine: Engine):
    """Return the displacement of the object's frame since the start [m]."""
    at = terms.object_qpos
    position = wp.vec3(engine.qpos[w, at], engine.qpos[w, at + 1], engine.qpos[w, at + 2])
    turn = wp.quat(engine.qpos[w, at + 4], engine.qpos[w, at + 5], engine.qpos[w, at + 6], engine.qpos[w, at + 3])
    return position - wp.quat_rotate(turn, terms.centre)


@wp.func
def rotation_angle(w: wp.int32, terms: TestConstants, engine: Engine):
    """Return the rotation of the object since the start [rad]."""
    at = terms.object_qpos + 3
    axis = wp.vec3(engine.qpos[w, at + 1], engine.qpos[w, at + 2], engine.qpos[w, at + 3])
    return 2.0 * wp.atan2(wp.length(axis), wp.abs(engine.qpos[w, at]))


@wp.func
def push(w: wp.int32, number: wp.int32, terms: TestConstants, worlds: Worlds, engine: Engine):
    """Begin a push from the closed state."""
    for k in range(engine.qpos.shape[1]):
        engine.qpos[w, k] = worlds.qpos[w, k]
    for k in range(engine.qvel.shape[1]):
        engine.qvel[w, k] = worlds.qvel[w, k]
        engine.warmstart[w, k] = worlds.warmstart[w, k]
    way = float(1 - 2 * (number % 2)) * terms.push
    axis = number / 2
    force = wp.vec3(0.0)
    force[axis] = way
    engine.force[w, terms.object_body] = wp.spatial_vector(force, wp.vec3(0.0))
    worlds.push[w] = number
    worlds.looks[w] = 0
    worlds.broken[w] = 0


@wp.func
def take_next(
    w: wp.int32,
    terms: TestConstants,
    grasps: GraspCommands,
    worlds: Worlds,
    engine: Engine,
    state: wp.array(dtype=wp.int32),
):
    """Begin with the next grasp of the queue, or stay idle."""
    place = wp.atomic_add(state, 0, 1)
    g = wp.int32(-1)
    if place < state[2]:
        g = grasps.queue[place]
    else:
        wp.atomic_sub(state, 1, 1)
    row = wp.max(g, 0)
    for k in range(engine.qpos.shape[1]):
        engine.qpos[w, k] = grasps.start[row, k]
    for k in range(engine.qvel.shape[1]):
        engine.qvel[w, k] = 0.0
        engine.warmstart[w, k] = 0.0
    if g < 0:
        engine.qpos[w, terms.object_qpos] = PARKED
    engine.force[w, terms.object_body] = wp.spatial_vector(wp.vec3(0.0), wp.vec3(0.0))
    engine.overflow[w] = 0
    worlds.grasp[w] = g
    worlds.ticks[w] = 0
    worlds.push[w] = -1
    command(w, row, 0, grasps, engine)


@wp.kernel
def begin(
    terms_in: TestConstants,
    grasps_in: GraspCommands,
    worlds_out: Worlds,
    engine_out: Engine,
    state_out: wp.array(dtype=wp.int32),
):
    take_next(wp.tid(), terms_in, grasps_in, worlds_out, engine_out, state_out)


@wp.kernel
def check_state(
    terms_in: TestConstants,
    grasps_in: GraspCommands,
    worlds_out: Worlds,
    engine_out: Engine,
    found_out: WorldVerdicts,
    state_out: wp.array(dtype=wp.int32),
):
    """Check the state after a tick.
    `state_out`: number of queue entries taken, worlds with a grasp, grasps in the queue."""
    w = wp.tid()
    g = worlds_out.grasp[w]
    if g < 0:
        return
    worlds_out.ticks[w] = worlds_out.ticks[w] + 1
    now = offset(w, terms_in, engine_out)
    angle = rotation_angle(w, terms_in, engine_out)
    moved = wp.length(now)
    excess = wp.max(moved / MOVED, angle / TURNED)
    number = worlds_out.push[w]
    over = bool(False)
    if not wp.isfinite(excess):
        found_out.outcome[g, wp.max(number, 0)] = DIVERGED
        found_out.margin[g] = wp.inf
        over = True
    elif number < 0:
        ticks = worlds_out.ticks[w]
        ended = ticks == 2 * STAGES * STAGE
        lost = ticks % STAGE == 0 and (moved > MOVED or angle > LOST_TURN)
        if lost or (ended and excess >= 1.0):
            found_out.outcome[g, 0] = LOST
            found_out.margin[g] = excess
            over = True
        elif ended:
            found_out.margin[g] = excess
            for k in range(engine_out.qpos.shape[1]):
                worlds_out.qpos[w, k] = engine_out.qpos[w, k]
            for k in range(engine_out.qvel.shape[1]):
                worlds_out.qvel[w, k] = engine_out.qvel[w, k]
                worlds_out.warmstart[w, k] = engine_out.warmstart[w, k]
            push(w, 0, terms_in, worlds_out, engine_out)
        elif ticks % STAGE == 0:
            command(w, g, ticks, grasps_in, engine_out)
    else:
        looks = worlds_out.looks[w] + 1
        if looks >= FIRST_LOOK:
            found_out.margin[g] = wp.max(found_out.margin[g], excess)
            if worlds_out.broken[w] == 0 and excess >= 1.0:
                worlds_out.broken[w] = wp.where(moved >= MOVED, DISPLACED, ROTATED)
                looks = wp.max(looks, HOLD - PATIENT)
            if worlds_out.broken[w] > 0:
                if excess > CLEAR or looks >= HOLD:
                    found_out.outcome[g, number] = worlds_out.broken[w]
                    over = True
            else:
                more = AHEAD * float(HOLD - looks)
                ahead = wp.length(now + more * (now - worlds_out.before[w]))
                turns = angle + more * (angle - worlds_out.turned_before[w])
                if looks >= HOLD or (ahead < SURE * MOVED and turns < SURE * TURNED):
                    found_out.outcome[g, number] = HELD
                    over = number + 1 == PUSHES
                    if not over:
                        push(w, number + 1, terms_in, worlds_out, engine_out)
                        looks = 0
        worlds_out.looks[w] = looks
        worlds_out.before[w] = now
        worlds_out.turned_before[w] = angle
    if over or worlds_out.ticks[w] >= MOST:
        found_out.ticks[g] = worlds_out.ticks[w]
        found_out.overflow[g] = engine_out.overflow[w]
        take_next(w, terms_in, grasps_in, worlds_out, engine_out, state_out)


@wp.kernel
def set_states(first_in: wp.int32, states_in: wp.array2d(dtype=wp.float32), engine_out: Engine):
    """Set the states from row `first_in` on, at rest."""
    w = wp.tid()
    row = wp.min(first_in + w, states_in.shape[0] - 1)
    for k in range(engine_out.qpos.shape[1]):
        engine_out.qpos[w, k] = states_in[row, k]
    for k in range(engine_out.qvel.shape[1]):
        engine_out.qvel[w, k] = 0.0


@wp.kernel
def measure_depths(
    first_in: wp.int32,
    of_hand_in: wp.array(dtype=wp.int32),
    contacts_in: wp.array(dtype=wp.int32),
    world_in: wp.array(dtype=wp.int32),
    geom_in: wp.array(dtype=wp.vec2i),
    distance_in: wp.array(dtype=wp.float32),
    depth_out: wp.array2d(dtype=wp.float32),
):
    """Compute the deepest penetration [m] of hand and object, and within the hand, from row `first_in` on."""
    i = wp.tid()
    if i >= contacts_in[0]:
        return
    row = first_in + world_in[i]
    if row < depth_out.shape[0]:
        within = of_hand_in[geom_in[i][0]] * of_hand_in[geom_in[i][1]]
        wp.atomic_max(depth_out, row, within, -distance_in[i])

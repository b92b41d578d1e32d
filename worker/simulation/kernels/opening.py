"""Opening of the fingers of a grasp, one by one: directions, and the first step with enough clearance."""

import warp as wp

from graspd.worker.simulation.kernels.chain import Bodies, Chain, joint_axis, joint_value, place_body
from graspd.worker.simulation.kernels.distance import Skin, nearest
from graspd.worker.simulation.kernels.touching import NearbySurface, Points, point_of

wp.set_module_options({"enable_backward": False, "max_unroll": 0})


@wp.struct
class Fingers:
    """F fingers of a hand with L bodies and D dofs; each finger opens as a unit."""

    of_body: wp.array(dtype=wp.int32)  # (L,) -1 without finger
    of_dof: wp.array(dtype=wp.int32)  # (D,) -1 if it does not open
    closing: wp.array(dtype=wp.float64)  # (D,)
    step: wp.array(dtype=wp.float64)  # (D,) [rad or m]
    lower: wp.array(dtype=wp.float64)
    upper: wp.array(dtype=wp.float64)


@wp.struct
class Hands:
    """B hands in their grasps."""

    position: wp.array(dtype=wp.vec3d)  # root position, about the object's centre of mass
    rotation: wp.array(dtype=wp.quatd)
    q: wp.array2d(dtype=wp.float64)  # (B, D)


@wp.struct
class Sweep:
    """Opening of B hands along `direction`, step by step."""

    going: wp.array(dtype=wp.int32)  # (B,)
    direction: wp.array2d(dtype=wp.float64)  # (B, D)
    clear: wp.array2d(dtype=wp.float32)  # (B, F) distance at the present step, at most the wanted one
    best: wp.array2d(dtype=wp.float32)  # (B, F) greatest distance so far
    chosen: wp.array2d(dtype=wp.int32)  # (B, F) first step with this distance


@wp.func
def opened_dof(
    fingers: Fingers, hands: Hands, direction: wp.array2d(dtype=wp.float64), b: wp.int32, d: wp.int32, steps: wp.int32
):
    """Return a dof's value after `steps` steps, within limits that are widened to the grasp's own value."""
    q = hands.q[b, d]
    value = q + wp.float64(steps) * fingers.step[d] * direction[b, d]
    return wp.clamp(value, wp.min(fingers.lower[d], q), wp.max(fingers.upper[d], q))


@wp.kernel
def body_wrenches(
    points_in: Points,
    bodies_in: Bodies,
    touching_in: NearbySurface,
    reach_in: wp.float32,
    force_out: wp.array2d(dtype=wp.vec3d),
    torque_out: wp.array2d(dtype=wp.vec3d),
):
    """Compute forces on bodies (B, L) along the object's normals, and their torques about the origin.
    A point's force is `reach` minus its distance, if positive. Launch over (B, L)."""
    b, body = wp.tid()
    force = wp.vec3d(wp.float64(0.0))
    torque = wp.vec3d(wp.float64(0.0))
    for i in range(points_in.first[body], points_in.first[body + 1]):
        weight = wp.float64(reach_in) - wp.float64(touching_in.distance[b, i])
        if weight > wp.float64(0.0):
            f = weight * wp.vec3d(touching_in.normal[b, i])
            force += f
            torque += wp.cross(point_of(points_in, bodies_in, b, i), f)
    force_out[b, body] = force
    torque_out[b, body] = torque


@wp.kernel
def opening_directions(
    chain_in: Chain,
    fingers_in: Fingers,
    plain_in: wp.float64,
    bodies_in: Bodies,
    force_inout: wp.array2d(dtype=wp.vec3d),
    torque_inout: wp.array2d(dtype=wp.vec3d),
    away_out: wp.array2d(dtype=wp.float64),
    sweep_out: Sweep,
):
    """Compute opening directions (B, D): a share `plain` of -`closing`, the rest along the forces.
    The motion along the forces has speed 1 at each finger's fastest dof. Reset the sweep. Launch over B."""
    b = wp.tid()
    dofs = away_out.shape[1]
    for d in range(dofs):
        away_out[b, d] = wp.float64(0.0)
    count = chain_in.parent.shape[0]
    for back in range(1, count):
        body = count - back
        force = force_inout[b, body]
        torque = torque_inout[b, body]
        axis = joint_axis(chain_in, bodies_in, b, body)
        work = wp.dot(axis, force)
        if chain_in.turns[body] == 1:
            work = wp.dot(axis, torque - wp.cross(bodies_in.position[b, body], force))
        d = chain_in.dof[body]
        away_out[b, d] = away_out[b, d] + chain_in.multiplier[body] * work
        parent = chain_in.parent[body]
        force_inout[b, parent] = force_inout[b, parent] + force
        torque_inout[b, parent] = torque_inout[b, parent] + torque
    for d in range(dofs):
        # A finger hooked around an edge would leave the object by closing further, but it must open.
        if away_out[b, d] * fingers_in.closing[d] > wp.float64(0.0):
            away_out[b, d] = wp.float64(0.0)
        sweep_out.direction[b, d] = -fingers_in.closing[d]
    for d in range(dofs):
        finger = fingers_in.of_dof[d]
        fastest = wp.float64(0.0)
        if finger >= 0:
            for other in range(dofs):
                if fingers_in.of_dof[other] == finger:
                    fastest = wp.max(fastest, wp.abs(away_out[b, other]))
        if fastest > wp.float64(0.0):
            sweep_out.direction[b, d] = (
                plain_in * sweep_out.direction[b, d] + (wp.float64(1.0) - plain_in) * away_out[b, d] / fastest
            )
    sweep_out.going[b] = 1
    for f in range(sweep_out.best.shape[1]):
        sweep_out.best[b, f] = -1.0e9
        sweep_out.chosen[b, f] = 0


@wp.kernel
def open_against_closing(
    fingers_in: Fingers, stuck_in: wp.float32, first_in: Sweep, sweep_out: Sweep, step_out: wp.array(dtype=wp.int32)
):
    """Restart hands against `closing` if a finger has less clearance than `stuck`. Launch over B."""
    b = wp.tid()
    step_out[0] = 0
    sweep_out.going[b] = 0
    for f in range(sweep_out.best.shape[1]):
        sweep_out.best[b, f] = -1.0e9
        sweep_out.chosen[b, f] = 0
        if first_in.best[b, f] < stuck_in:
            sweep_out.going[b] = 1
    for d in range(sweep_out.direction.shape[1]):
        sweep_out.direction[b, d] = -fingers_in.closing[d]


@wp.kernel
def place_opening(
    chain_in: Chain,
    fingers_in: Fingers,
    hands_in: Hands,
    wanted_in: wp.float32,
    step_in: wp.array(dtype=wp.int32),
    sweep_inout: Sweep,
    bodies_out: Bodies,
):
    """Place bodies of opening hands at the present step. Launch over B."""
    b = wp.tid()
    if sweep_inout.going[b] == 0:
        return
    for f in range(sweep_inout.clear.shape[1]):
        sweep_inout.clear[b, f] = wanted_in
    bodies_out.position[b, 0] = hands_in.position[b]
    bodies_out.rotation[b, 0] = hands_in.rotation[b]
    for body in range(1, chain_in.parent.shape[0]):
        q = opened_dof(fingers_in, hands_in, sweep_inout.direction, b, chain_in.dof[body], step_in[0])
        place_body(chain_in, bodies_out, b, body, joint_value(chain_in, body, q))


@wp.kernel
def finger_clearance(
    skin_in: Skin,
    points_in: Points,
    fingers_in: Fingers,
    lane_in: wp.int32,
    wanted_in: wp.float32,
    bodies_in: Bodies,
    sweep_inout: Sweep,
):
    """Compute the least distance of each finger that is not clear yet. Launch over (B, N / lane)."""
    b, part = wp.tid()
    if sweep_inout.going[b] == 0:
        return
    for i in range(part * lane_in, wp.min((part + 1) * lane_in, points_in.body.shape[0])):
        finger = fingers_in.of_body[points_in.body[i]]
        if finger >= 0:
            if sweep_inout.best[b, finger] < wanted_in:
                found = nearest(skin_in, wp.vec3(point_of(points_in, bodies_in, b, i)), wanted_in)
                if found.distance < wanted_in:
                    wp.atomic_min(sweep_inout.clear, b, finger, found.distance)


@wp.kernel
def select_opening(wanted_in: wp.float32, step_in: wp.array(dtype=wp.int32), sweep_inout: Sweep):
    """Select each finger's first clear step, else the step with the largest distance.
    Stop hands with all fingers clear. Launch over B."""
    b = wp.tid()
    if sweep_inout.going[b] == 0:
        return
    going = wp.int32(0)
    for f in range(sweep_inout.clear.shape[1]):
        if sweep_inout.best[b, f] < wanted_in:
            if sweep_inout.clear[b, f] > sweep_inout.best[b, f]:
                sweep_inout.best[b, f] = sweep_inout.clear[b, f]
                sweep_inout.chosen[b, f] = step_in[0]
            if sweep_inout.best[b, f] < wanted_in:
                going = 1
    sweep_inout.going[b] = going


@wp.kernel
def write_opening(
    fingers_in: Fingers,
    hands_in: Hands,
    stuck_in: wp.float32,
    first_in: Sweep,
    plain_in: Sweep,
    open_out: wp.array2d(dtype=wp.float64),
):
    """Write dofs (B, D) of the first opening, or of the restarted one if its finger has more clearance.
    A clearance above `stuck` in the first opening counts as `stuck`. Launch over (B, D)."""
    b, d = wp.tid()
    open_out[b, d] = hands_in.q[b, d]
    finger = fingers_in.of_dof[d]
    if finger < 0:
        return
    # `plain` is the restarted opening; its clearance is -1e9 for a hand that was not restarted.
    if plain_in.best[b, finger] > wp.min(first_in.best[b, finger], stuck_in):
        open_out[b, d] = opened_dof(fingers_in, hands_in, plain_in.direction, b, d, plain_in.chosen[b, finger])
    else:
        open_out[b, d] = opened_dof(fingers_in, hands_in, first_in.direction, b, d, first_in.chosen[b, finger])

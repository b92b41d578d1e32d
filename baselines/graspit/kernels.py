"""Simulated annealing over hand poses and eigengrasps, one chain per thread.

GraspIt!'s schedule with default parameters is a very fast re-annealing (Ingber 1989):

    T(k) = T0 exp(-C k^(1/D)),   C = 7, D = 8, T0 = 1e6, k from 30,000
    neighbour: x + sgn(u - 1/2) T ((1 + 1/T)^|2u - 1| - 1) jump,   u uniform
    accept with probability 1 if E' < E, else exp(1e-6 (E - E') / T)"""

import warp as wp

from graspd.worker.simulation.kernels.kinematics import Tree
from graspd.worker.simulation.kernels.pieces import (
    BodyPoints,
    Pieces,
    piece_centre,
    piece_distance,
    piece_rotation,
    world_extent,
)
from graspd.worker.simulation.kernels.surface import Surface, field_distance

wp.set_module_options({"enable_backward": False})

#: Initial value of the counter k: a chain that ends at 70,000 makes 40,000 moves.
FIRST_STEP = 30_000
VARIABLES = wp.constant(8)
T0 = wp.constant(1e6)
C = wp.constant(7.0)
ROOT = wp.constant(1.0 / 8)
SCALE = wp.constant(1e-6)
TRIES = wp.constant(11)  # largest number of neighbours drawn per step; if all collide, the step does not count
REDRAWS = wp.constant(100)  # largest number of draws of a variable until its value is inside its bounds
#: Largest distance that is computed [m].
FAR = wp.constant(1.0)
vec8 = wp.types.vector(length=8, dtype=wp.float32)


@wp.struct
class Problem:
    """Data that the chains of one hand and object share."""

    tree: Tree
    surface: Surface
    pieces: Pieces
    points: BodyPoints  # against the object
    samples: wp.array(dtype=wp.vec3)
    bvh: wp.uint64
    contact_body: wp.array(dtype=wp.int32)
    contact_position: wp.array(dtype=wp.vec3)
    contact_normal: wp.array(dtype=wp.vec3)
    low: vec8  # Tx Ty Tz [m], theta phi alpha [rad], amplitudes
    high: vec8
    jump: vec8
    circular: wp.int32  # the periodic variable
    palm: wp.quat  # from the approach frame (z ahead) to the root frame
    origin: wp.array(dtype=wp.float32)  # (D,)
    eigen: wp.array2d(dtype=wp.float32)  # (2, D)
    lower: wp.array(dtype=wp.float32)
    upper: wp.array(dtype=wp.float32)
    clash: wp.array2d(dtype=wp.int32)  # over a grid of amplitudes: 1 for self-collision


@wp.func
def temperature(step: wp.float32):
    return T0 * wp.exp(-C * wp.pow(step, ROOT))


@wp.func
def jump_share(u: wp.float32, t: wp.float32):
    size = t * (wp.pow(1.0 + 1.0 / t, wp.abs(2.0 * u - 1.0)) - 1.0)
    if u < 0.5:
        size = -size
    return size


@wp.func
def acceptance(rise: wp.float32, t: wp.float32):
    return wp.exp(-SCALE * wp.max(rise, 0.0) / t)


@wp.func
def rotation_of(problem: Problem, x: vec8):
    """Return the root's rotation: by alpha about the axis (theta, phi), then approach frame to root frame."""
    axis = wp.vec3(wp.sin(x[3]) * wp.cos(x[4]), wp.sin(x[3]) * wp.sin(x[4]), wp.cos(x[3]))
    return wp.quat_from_axis_angle(axis, x[5]) * wp.quat_inverse(problem.palm)


@wp.func
def joint_value(problem: Problem, x: vec8, d: wp.int32):
    value = problem.origin[d] + x[6] * problem.eigen[0, d] + x[7] * problem.eigen[1, d]
    return wp.clamp(value, problem.lower[d], problem.upper[d])


@wp.func
def pose_bodies(
    problem: Problem, b: wp.int32, x: vec8, body_p: wp.array2d(dtype=wp.vec3), body_q: wp.array2d(dtype=wp.quat)
):
    """Compute the poses of all bodies."""
    rotation = rotation_of(problem, x)
    body_q[b, 0] = rotation
    body_p[b, 0] = wp.vec3(x[0], x[1], x[2]) - wp.quat_rotate(rotation, problem.tree.pivot)
    for body in range(1, problem.tree.parent.shape[0]):
        parent = problem.tree.parent[body]
        pq = body_q[b, parent]
        p = body_p[b, parent] + wp.quat_rotate(pq, problem.tree.origin_p[body])
        q = pq * problem.tree.origin_q[body]
        value = (
            problem.tree.multiplier[body] * joint_value(problem, x, problem.tree.dof[body]) + problem.tree.offset[body]
        )
        if problem.tree.joint_type[body] == 1:
            q = q * wp.quat_from_axis_angle(problem.tree.axis[body], value)
        else:
            p = p + value * wp.quat_rotate(q, problem.tree.axis[body])
        body_p[b, body] = p
        body_q[b, body] = q
    return 1


@wp.func
def has_self_collision(problem: Problem, x: vec8):
    """Return 1 if the nearest posture of the grid has a self-collision."""
    rows = problem.clash.shape[0] - 1
    columns = problem.clash.shape[1] - 1
    i = int(float(rows) * (x[6] - problem.low[6]) / wp.max(problem.high[6] - problem.low[6], 1.0e-6) + 0.5)
    j = int(float(columns) * (x[7] - problem.low[7]) / wp.max(problem.high[7] - problem.low[7], 1.0e-6) + 0.5)
    return problem.clash[wp.clamp(i, 0, rows), wp.clamp(j, 0, columns)]


@wp.func
def is_inside_object(problem: Problem, point: wp.vec3):
    """Return 1 for a point inside the object; query the mesh only near the surface."""
    coarse = field_distance(problem.surface, point).distance
    if coarse > problem.surface.field_error:
        return 0
    query = wp.mesh_query_point_sign_normal(problem.surface.mesh, point, FAR)
    if query.result and query.sign < 0.0:
        return 1
    return 0


@wp.func
def points_collide(problem: Problem, b: wp.int32, body_p: wp.array2d(dtype=wp.vec3), body_q: wp.array2d(dtype=wp.quat)):
    """Return 1 if a hand point is inside the object."""
    for body in range(body_p.shape[1]):
        first = problem.points.first[body]
        last = problem.points.first[body + 1]
        if last > first:
            p = body_p[b, body]
            q = body_q[b, body]
            gap = field_distance(problem.surface, p + wp.quat_rotate(q, problem.points.centre[body])).distance
            if gap < problem.points.radius[body] + problem.surface.field_error:
                for i in range(first, last):
                    if is_inside_object(problem, p + wp.quat_rotate(q, problem.points.position[i])) == 1:
                        return 1
    return 0


@wp.func
def samples_collide(
    problem: Problem, b: wp.int32, body_p: wp.array2d(dtype=wp.vec3), body_q: wp.array2d(dtype=wp.quat)
):
    """Return 1 if a sample of the object is inside a piece of the hand."""
    for piece in range(problem.pieces.body.shape[0]):
        q = piece_rotation(problem.pieces, piece, b, body_q)
        p = piece_centre(problem.pieces, piece, b, body_p, body_q)
        half = problem.pieces.half[piece]
        if field_distance(problem.surface, p).distance < wp.length(half) + problem.surface.field_error:
            extent = world_extent(wp.quat_to_matrix(q), half)
            query = wp.bvh_query_aabb(problem.bvh, p - extent, p + extent)
            index = wp.int32(0)
            while wp.bvh_query_next(query, index):
                nd = piece_distance(problem.pieces, piece, wp.quat_rotate_inv(q, problem.samples[index] - p))
                if nd[3] < 0.0:
                    return 1
    return 0


@wp.func
def virtual_contact_energy(gap: wp.float32, cosine: wp.float32):
    """Return the energy of a virtual contact: distance in mm, plus up to 100 for an opposite normal."""
    return 1.0e3 * wp.abs(gap) + 50.0 * (1.0 - cosine)


@wp.func
def contact_energy(problem: Problem, b: wp.int32, body_p: wp.array2d(dtype=wp.vec3), body_q: wp.array2d(dtype=wp.quat)):
    """Return the mean energy of the virtual contacts [mm]."""
    total = float(0.0)
    for i in range(problem.contact_body.shape[0]):
        body = problem.contact_body[i]
        q = body_q[b, body]
        point = body_p[b, body] + wp.quat_rotate(q, problem.contact_position[i])
        normal = wp.quat_rotate(q, problem.contact_normal[i])
        gap = float(FAR)
        cosine = float(-1.0)
        coarse = field_distance(problem.surface, point)
        if coarse.distance < FAR and coarse.distance > 0.004 + problem.surface.field_error:
            gap = coarse.distance
            cosine = -wp.dot(normal, coarse.normal)
        else:
            query = wp.mesh_query_point_sign_normal(problem.surface.mesh, point, FAR)
            if query.result:
                offset = wp.mesh_eval_position(problem.surface.mesh, query.face, query.u, query.v) - point
                gap = wp.length(offset)
                if gap > 1.0e-6:
                    cosine = query.sign * wp.dot(normal, offset) / gap
                else:
                    cosine = -wp.dot(normal, wp.mesh_eval_face_normal(problem.surface.mesh, query.face))
        total += virtual_contact_energy(gap, cosine)
    return total / float(problem.contact_body.shape[0])


@wp.func
def is_collision_free(
    problem: Problem, b: wp.int32, x: vec8, body_p: wp.array2d(dtype=wp.vec3), body_q: wp.array2d(dtype=wp.quat)
):
    """Return 1 if a state has no collision; its body poses stay in the arrays."""
    if has_self_collision(problem, x) == 1:
        return 0
    pose_bodies(problem, b, x, body_p, body_q)
    if points_collide(problem, b, body_p, body_q) == 1:
        return 0
    if samples_collide(problem, b, body_p, body_q) == 1:
        return 0
    return 1


@wp.func
def neighbour_state(problem: Problem, x: vec8, t: wp.float32, rng: wp.uint32):
    """Return a neighbour state at temperature t with all variables in bounds, and the random state."""
    y = vec8()
    state = wp.uint32(rng)
    for i in range(VARIABLES):
        low = problem.low[i]
        high = problem.high[i]
        value = float(high + 1.0)
        draws = wp.int32(0)
        while (value > high or value < low) and draws < REDRAWS:
            value = x[i] + jump_share(wp.randf(state), t) * problem.jump[i]
            if i == problem.circular:
                if value > high:
                    value -= high - low
                elif value < low:
                    value += high - low
            draws += 1
        y[i] = wp.clamp(value, low, high)
    return y, state


@wp.kernel
def draw_start(
    problem: Problem,
    tries_in: wp.int32,
    rng_inout: wp.array(dtype=wp.uint32),
    state_out: wp.array(dtype=vec8),
    energy_out: wp.array(dtype=wp.float32),
    body_p_out: wp.array2d(dtype=wp.vec3),
    body_q_out: wp.array2d(dtype=wp.quat),
):
    """Draw a uniformly random legal state; energy < 0 if none is found. Launch over the chains."""
    b = wp.tid()
    rng = rng_inout[b]
    energy_out[b] = -1.0
    found = wp.int32(0)
    tries = wp.int32(0)
    while found == 0 and tries < tries_in:
        x = vec8()
        for i in range(VARIABLES):
            x[i] = problem.low[i] + wp.randf(rng) * (problem.high[i] - problem.low[i])
        if is_collision_free(problem, b, x, body_p_out, body_q_out) == 1:
            found = 1
            state_out[b] = x
            energy_out[b] = contact_energy(problem, b, body_p_out, body_q_out)
        tries += 1
    rng_inout[b] = rng


@wp.func
def state_difference(problem: Problem, x: vec8, y: vec8):
    """Return the mean difference of two states, relative to the largest jumps."""
    total = float(0.0)
    for i in range(VARIABLES):
        apart = wp.abs(x[i] - y[i])
        if i == problem.circular:
            apart = wp.min(apart, problem.high[i] - problem.low[i] - apart)
        total += apart / wp.max(problem.jump[i], 1.0e-6)
    return total / float(VARIABLES)


@wp.func
def insert_best(
    problem: Problem,
    b: wp.int32,
    x: vec8,
    e: wp.float32,
    alike: wp.float32,
    best: wp.array2d(dtype=vec8),
    best_energy: wp.array2d(dtype=wp.float32),
):
    """Insert a state into the list of the best, in place of a worse near-duplicate or of the worst state."""
    row = wp.int32(0)
    for k in range(best_energy.shape[1]):
        if best_energy[b, k] > best_energy[b, row]:
            row = k
    for k in range(best_energy.shape[1]):
        if best_energy[b, k] < 1.0e8 and state_difference(problem, x, best[b, k]) < alike:
            row = k
    if e < best_energy[b, row]:
        best[b, row] = x
        best_energy[b, row] = e
    return row


@wp.kernel
def anneal(
    problem: Problem,
    rounds_in: wp.int32,
    last_in: wp.int32,
    alike_in: wp.float32,
    step_inout: wp.array(dtype=wp.int32),
    rng_inout: wp.array(dtype=wp.uint32),
    state_inout: wp.array(dtype=vec8),
    energy_inout: wp.array(dtype=wp.float32),
    best_inout: wp.array2d(dtype=vec8),
    best_energy_inout: wp.array2d(dtype=wp.float32),
    body_p_out: wp.array2d(dtype=wp.vec3),
    body_q_out: wp.array2d(dtype=wp.quat),
):
    """Try `rounds` moves of a chain, fewer if its step reaches `last`. Launch over the chains."""
    b = wp.tid()
    x = state_inout[b]
    e = energy_inout[b]
    rng = rng_inout[b]
    k = step_inout[b]
    rounds = wp.int32(0)
    while rounds < rounds_in and k < last_in:
        rounds += 1
        t = temperature(float(k))
        y = vec8()
        free = wp.int32(0)
        tries = wp.int32(0)
        while free == 0 and tries < TRIES:
            y, rng = neighbour_state(problem, x, t, rng)
            free = is_collision_free(problem, b, y, body_p_out, body_q_out)
            tries += 1
        if free == 1:
            energy = contact_energy(problem, b, body_p_out, body_q_out)
            if acceptance(energy - e, t) > wp.randf(rng):
                x = y
                e = energy
                insert_best(problem, b, x, e, alike_in, best_inout, best_energy_inout)
            k += 1
    state_inout[b] = x
    energy_inout[b] = e
    rng_inout[b] = rng
    step_inout[b] = k


@wp.kernel
def unpack(
    problem: Problem,
    state_in: wp.array(dtype=vec8),
    pivot_out: wp.array(dtype=wp.vec3),
    rotation_out: wp.array(dtype=wp.quat),
    q_out: wp.array2d(dtype=wp.float32),
):
    """Convert states to hands. Launch over the states."""
    b = wp.tid()
    x = state_in[b]
    pivot_out[b] = wp.vec3(x[0], x[1], x[2])
    rotation_out[b] = rotation_of(problem, x)
    for d in range(q_out.shape[1]):
        q_out[b, d] = joint_value(problem, x, d)

"""The object's surface near points of posed hands, and the forces that hold the object there.
Poses are in double precision, distances to the mesh in single precision."""

import math

import warp as wp

from graspd.worker.simulation.kernels.chain import Bodies, Chain, joint_axis
from graspd.worker.simulation.kernels.distance import Skin, nearest

wp.set_module_options({"enable_backward": False, "max_unroll": 0})

EDGES = wp.constant(8)  # edges of a friction pyramid
TURN = wp.constant(wp.float64(math.tau / 8))  # angle between adjacent edges
FIRST_TORQUE = wp.constant(7)  # rows of a balance before the torques: the wrench and the sum of normal forces


@wp.struct
class Points:
    """N points of a hand's surface, sorted by body."""

    first: wp.array(dtype=wp.int32)  # (L + 1,)
    body: wp.array(dtype=wp.int32)
    position: wp.array(dtype=wp.vec3d)  # body frame
    normal: wp.array(dtype=wp.vec3d)  # outward


@wp.struct
class NearbySurface:
    """The object's surface near points (B, N) of B hands, within a reach."""

    distance: wp.array2d(dtype=wp.float32)  # at most the reach
    closest: wp.array2d(dtype=wp.vec3)
    normal: wp.array2d(dtype=wp.vec3)  # of the object; 0 beyond reach
    cosine: wp.array2d(dtype=wp.float64)  # of the hand's normal and the object's


@wp.func
def point_of(points: Points, bodies: Bodies, b: wp.int32, i: wp.int32):
    body = points.body[i]
    return bodies.position[b, body] + wp.quat_rotate(bodies.rotation[b, body], points.position[i])


@wp.kernel
def find_nearby_surface(
    skin_in: Skin,
    points_in: Points,
    lane_in: wp.int32,
    bodies_in: Bodies,
    reach_in: wp.float32,
    touching_out: NearbySurface,
):
    """Find the surface near all points of hands. Launch over (B, N / lane)."""
    b, part = wp.tid()
    for i in range(part * lane_in, wp.min((part + 1) * lane_in, points_in.body.shape[0])):
        found = nearest(skin_in, wp.vec3(point_of(points_in, bodies_in, b, i)), reach_in)
        touching_out.distance[b, i] = wp.min(found.distance, reach_in)
        touching_out.closest[b, i] = found.closest
        touching_out.normal[b, i] = found.normal
        outward = wp.quat_rotate(bodies_in.rotation[b, points_in.body[i]], points_in.normal[i])
        touching_out.cosine[b, i] = wp.dot(outward, wp.vec3d(found.normal))


@wp.func
def squared_separation(touching: NearbySurface, radius: wp.float64, b: wp.int32, i: wp.int32, j: wp.int32):
    """Return the squared separation of two contacts: that of places / `radius`, plus that of normals."""
    place = (wp.vec3d(touching.closest[b, i]) - wp.vec3d(touching.closest[b, j])) / radius
    turn = wp.vec3d(touching.normal[b, i]) - wp.vec3d(touching.normal[b, j])
    return wp.dot(place, place) + wp.dot(turn, turn)


@wp.kernel
def choose_contacts(
    points_in: Points,
    finger_in: wp.array(dtype=wp.int32),
    touching_in: NearbySurface,
    near_in: wp.float32,
    far_in: wp.float32,
    facing_in: wp.float64,
    radius_in: wp.float64,
    touches_out: wp.array2d(dtype=wp.bool),
    list_out: wp.array2d(dtype=wp.int32),
    least_out: wp.array2d(dtype=wp.float64),
    chosen_out: wp.array2d(dtype=wp.int32),
    count_out: wp.array(dtype=wp.int32),
):
    """Choose at most C pressing points (B, C) of each hand that are far apart. Launch over B.
    Points press if they face the object with a cosine below `facing` and are closer than `near`. On a finger without
    such points, `far` replaces `near`; `finger` has the finger of each body, or -1. Each chosen point is the
    farthest from earlier points (Gonzalez 1985). `count` (B,) is the number of chosen points. `touches` (B, F), `list`
    and `least` (B, N) are scratch."""
    b = wp.tid()
    limit = chosen_out.shape[1]
    for f in range(touches_out.shape[1]):
        touches_out[b, f] = False
    for i in range(touching_in.distance.shape[1]):
        f = finger_in[points_in.body[i]]
        if f >= 0 and touching_in.distance[b, i] < near_in and touching_in.cosine[b, i] < facing_in:
            touches_out[b, f] = True
    n = wp.int32(0)
    place = wp.vec3d(wp.float64(0.0))
    turn = wp.vec3d(wp.float64(0.0))
    for i in range(touching_in.distance.shape[1]):
        reach = near_in
        f = finger_in[points_in.body[i]]
        if f >= 0:
            if not touches_out[b, f]:
                reach = wp.max(near_in, far_in)
        if touching_in.distance[b, i] < reach and touching_in.cosine[b, i] < facing_in:
            list_out[b, n] = i
            place += wp.vec3d(touching_in.closest[b, i]) / radius_in
            turn += wp.vec3d(touching_in.normal[b, i])
            n += 1
    count_out[b] = wp.min(n, limit)
    if n <= limit:
        for k in range(n):
            chosen_out[b, k] = list_out[b, k]
        return
    place = place / wp.float64(n)
    turn = turn / wp.float64(n)
    best = wp.int32(0)
    farthest = wp.float64(-1.0)
    for k in range(n):
        i = list_out[b, k]
        x = wp.vec3d(touching_in.closest[b, i]) / radius_in - place
        y = wp.vec3d(touching_in.normal[b, i]) - turn
        square = wp.dot(x, x) + wp.dot(y, y)
        least_out[b, k] = wp.float64(1.0e30)
        if square > farthest:
            farthest = square
            best = k
    chosen_out[b, 0] = list_out[b, best]
    for c in range(1, limit):
        last = list_out[b, best]
        least_out[b, best] = wp.float64(-1.0)
        farthest = wp.float64(-2.0)
        for k in range(n):
            if least_out[b, k] >= wp.float64(0.0):
                least_out[b, k] = wp.min(
                    least_out[b, k], squared_separation(touching_in, radius_in, b, list_out[b, k], last)
                )
            if least_out[b, k] > farthest:
                farthest = least_out[b, k]
                best = k
        chosen_out[b, c] = list_out[b, best]


@wp.func
def first_tangent(n: wp.vec3d):
    """Return a unit vector perpendicular to n; it is along a coordinate axis if n is."""
    axis = wp.vec3d(wp.float64(1.0), wp.float64(0.0), wp.float64(0.0))
    if wp.abs(n[1]) < wp.abs(n[0]) and wp.abs(n[1]) <= wp.abs(n[2]):
        axis = wp.vec3d(wp.float64(0.0), wp.float64(1.0), wp.float64(0.0))
    elif wp.abs(n[2]) < wp.abs(n[0]):
        axis = wp.vec3d(wp.float64(0.0), wp.float64(0.0), wp.float64(1.0))
    return wp.normalize(wp.cross(n, axis))


@wp.kernel
def balance_columns(
    chain_in: Chain,
    effort_in: wp.array(dtype=wp.float64),
    points_in: Points,
    bodies_in: Bodies,
    touching_in: NearbySurface,
    chosen_in: wp.array2d(dtype=wp.int32),
    count_in: wp.array(dtype=wp.int32),
    friction_in: wp.float64,
    radius_in: wp.float64,
    sum_in: wp.float64,
    matrix_out: wp.array3d(dtype=wp.float64),
):
    """Compute columns (B, C * E, 7 + D) of the balance. Launch over (B, C).
    Each column is an edge of a contact's friction pyramid, with unit normal force. Its rows are the wrench (torque
    divided by `radius`), `sum`, and the torques of the dofs that exert the force, divided by their limits."""
    b, c = wp.tid()
    if c >= count_in[b]:
        return
    i = chosen_in[b, c]
    place = wp.vec3d(touching_in.closest[b, i])
    n = -wp.vec3d(touching_in.normal[b, i])
    t1 = first_tangent(n)
    t2 = wp.cross(n, t1)
    for e in range(EDGES):
        angle = wp.float64(e) * TURN
        force = n + friction_in * (wp.cos(angle) * t1 + wp.sin(angle) * t2)
        torque = wp.cross(place / radius_in, force)
        k = c * EDGES + e
        for axis in range(3):
            matrix_out[b, k, axis] = force[axis]
            matrix_out[b, k, 3 + axis] = torque[axis]
        matrix_out[b, k, 6] = sum_in
        for d in range(effort_in.shape[0]):
            matrix_out[b, k, FIRST_TORQUE + d] = wp.float64(0.0)
    # Virtual work: a joint's torque is the edge's force times the contact's motion per unit of joint motion.
    body = points_in.body[i]
    while body > 0:
        way = joint_axis(chain_in, bodies_in, b, body)
        if chain_in.turns[body] == 1:
            way = wp.cross(way, place - bodies_in.position[b, body])
        d = chain_in.dof[body]
        way = (chain_in.multiplier[body] / effort_in[d]) * way
        for e in range(EDGES):
            k = c * EDGES + e
            force = wp.vec3d(matrix_out[b, k, 0], matrix_out[b, k, 1], matrix_out[b, k, 2])
            matrix_out[b, k, FIRST_TORQUE + d] = matrix_out[b, k, FIRST_TORQUE + d] + wp.dot(force, way)
        body = chain_in.parent[body]


@wp.kernel
def scale_torques(
    weight_in: wp.float64,
    count_inout: wp.array(dtype=wp.int32),
    matrix_inout: wp.array3d(dtype=wp.float64),
    unit_out: wp.array(dtype=wp.float64),
):
    """Divide torques of a balance by `unit` (B,), so that the largest becomes `weight`. Launch over B.
    `count` (B,) becomes the number of columns instead of contacts."""
    b = wp.tid()
    count = EDGES * count_inout[b]
    count_inout[b] = count
    largest = wp.float64(1.0e-12)
    for k in range(count):
        for row in range(FIRST_TORQUE, matrix_inout.shape[2]):
            largest = wp.max(largest, wp.abs(matrix_inout[b, k, row]))
    unit = largest / weight_in
    unit_out[b] = unit
    for k in range(count):
        for row in range(FIRST_TORQUE, matrix_inout.shape[2]):
            matrix_inout[b, k, row] = matrix_inout[b, k, row] / unit


@wp.kernel
def net_wrench(
    effort_in: wp.array(dtype=wp.float64),
    matrix_in: wp.array3d(dtype=wp.float64),
    share_in: wp.array2d(dtype=wp.float64),
    count_in: wp.array(dtype=wp.int32),
    unit_in: wp.array(dtype=wp.float64),
    total_in: wp.float64,
    residual_out: wp.array(dtype=wp.float64),
    torque_out: wp.array2d(dtype=wp.float64),
):
    """Compute the norm (B,) of the net wrench of edge forces `share` (B, C * E), over their normal sum.
    Also compute the torques (B, D) that exert the normal sum `total`, scaled down to their limits. Launch over B."""
    b = wp.tid()
    whole = wp.float64(0.0)
    for k in range(count_in[b]):
        whole += share_in[b, k]
    whole = wp.max(whole, wp.float64(1.0e-12))
    square = wp.float64(0.0)
    for axis in range(6):
        net = wp.float64(0.0)
        for k in range(count_in[b]):
            net += share_in[b, k] / whole * matrix_in[b, k, axis]
        square += net * net
    residual_out[b] = wp.sqrt(square)
    if count_in[b] == 0:
        residual_out[b] = wp.float64(1.0)
    asked = wp.float64(1.0e-12)
    for d in range(effort_in.shape[0]):
        torque = wp.float64(0.0)
        for k in range(count_in[b]):
            torque += share_in[b, k] / whole * matrix_in[b, k, FIRST_TORQUE + d]
        torque_out[b, d] = total_in * unit_in[b] * effort_in[d] * torque
        asked = wp.max(asked, wp.abs(torque_out[b, d]) / effort_in[d])
    scale = wp.min(wp.float64(1.0), wp.float64(1.0) / asked)
    for d in range(effort_in.shape[0]):
        torque_out[b, d] = scale * torque_out[b, d]

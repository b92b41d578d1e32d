"""Gauss-Newton projection out of penetration: residuals of clearances, rows, normal equations.

A residual is d - target with weight w and a signed distance d. Its row is the derivative of d by (root translation,
root rotation about the pivot, dofs). Distances are of hand points from the object, of object samples from links, and of
points of a link from other links."""

import warp as wp

from graspd.worker.simulation.kernels.kinematics import Depths, Hands, Tree
from graspd.worker.simulation.kernels.packing import Contacts
from graspd.worker.simulation.kernels.pieces import (
    BodyPoints,
    Pieces,
    Samples,
    bounded_piece_distance,
    cells_around,
    in_box,
    may_touch,
    piece_centre,
    piece_rotation,
    sample_range,
    world_extent,
)

wp.set_module_options({"enable_backward": False, "max_unroll": 0})

#: Terms of the normal equations are summed as integers in units of 2^-44: entries of rows are at most of order one.
FIXED = wp.constant(2.0**44)


@wp.struct
class Residuals:
    """Packed residuals per grasp, capacity R; further ones are left to the next iteration."""

    count: wp.array(dtype=wp.int32)
    body: wp.array2d(dtype=wp.int32)
    other: wp.array2d(dtype=wp.int32)  # body that the motion is relative to, or -1 for the object
    point: wp.array2d(dtype=wp.vec3)
    direction: wp.array2d(dtype=wp.vec3)  # direction of the body's motion that increases d
    value: wp.array2d(dtype=wp.float32)  # d - target [m]
    weight: wp.array2d(dtype=wp.float32)


@wp.func
def emit_residual(
    out: Residuals,
    b: wp.int32,
    body: wp.int32,
    other: wp.int32,
    point: wp.vec3,
    direction: wp.vec3,
    value: wp.float32,
    weight: wp.float32,
):
    k = wp.atomic_add(out.count, b, 1)
    if k < out.body.shape[1]:
        out.body[b, k] = body
        out.other[b, k] = other
        out.point[b, k] = point
        out.direction[b, k] = direction
        out.value[b, k] = value
        out.weight[b, k] = weight


@wp.kernel
def point_residuals(
    lane_in: wp.int32,
    hands_in: Hands,
    contacts_in: Contacts,
    near_in: wp.float32,
    target_in: wp.float32,
    hold_in: wp.float32,
    hold_target_in: wp.float32,
    hold_weight_in: wp.float32,
    residuals_out: Residuals,
):
    """Emit residuals that move points closer than `near` to `target`; weakly hold points within `hold`.
    Launch over (B, N / lane)."""
    b, part = wp.tid()
    if hands_in.active[b] == 0:
        return
    c = contacts_in
    for i in range(part * lane_in, wp.min((part + 1) * lane_in, c.count[b])):
        rho = c.distance[b, i]
        if rho < near_in:
            emit_residual(residuals_out, b, c.body[b, i], -1, c.point[b, i], c.normal[b, i], rho - target_in, 1.0)
        elif rho < hold_in and c.weight[b, i] > 0.0:
            gap = rho - hold_target_in
            emit_residual(residuals_out, b, c.body[b, i], -1, c.point[b, i], c.normal[b, i], gap, hold_weight_in)


@wp.kernel
def sample_residuals(
    pieces_in: Pieces,
    samples_in: Samples,
    hands_in: Hands,
    near_in: wp.float32,
    target_in: wp.float32,
    residuals_out: Residuals,
):
    """Emit residuals that move object samples within `near` of a link to `target`. Launch over (B, P)."""
    b, piece = wp.tid()
    if hands_in.active[b] == 0:
        return
    body = pieces_in.body[piece]
    q = piece_rotation(pieces_in, piece, b, hands_in.body_q)
    p = piece_centre(pieces_in, piece, b, hands_in.body_p, hands_in.body_q)
    half = pieces_in.half[piece] + wp.vec3(near_in, near_in, near_in)
    turn = wp.quat_to_matrix(q)
    back = wp.transpose(turn)
    cells = cells_around(samples_in, p, world_extent(turn, half))
    for i in range(cells[0], cells[1] + 1):
        for j in range(cells[2], cells[3] + 1):
            mine = sample_range(samples_in, i, j, cells[4], cells[5])
            for index in range(mine[0], mine[1]):
                x = samples_in.position[index]
                local = back * (x - p)
                if in_box(local, half):
                    nd = bounded_piece_distance(pieces_in, piece, local, near_in)
                    if nd[3] < near_in:
                        n = wp.quat_rotate(q, wp.vec3(nd[0], nd[1], nd[2]))
                        # The link's motion along its own outward normal reduces d.
                        emit_residual(residuals_out, b, body, -1, x, -n, nd[3] - target_in, 1.0)


@wp.kernel
def self_residuals(
    pieces_in: Pieces,
    points_in: BodyPoints,
    hands_in: Hands,
    near_in: wp.float32,
    target_in: wp.float32,
    residuals_out: Residuals,
):
    """Emit residuals that move points of a link within `near` of another to `target`. Launch over (B, P)."""
    b, piece = wp.tid()
    if hands_in.active[b] == 0:
        return
    other = pieces_in.body[piece]
    q = piece_rotation(pieces_in, piece, b, hands_in.body_q)
    p = piece_centre(pieces_in, piece, b, hands_in.body_p, hands_in.body_q)
    half = pieces_in.half[piece] + wp.vec3(near_in, near_in, near_in)
    reach = wp.length(pieces_in.half[piece]) + near_in
    for own in range(hands_in.body_p.shape[1]):
        if may_touch(pieces_in, points_in, other, p, reach, own, b, hands_in.body_p, hands_in.body_q):
            # Transform from the body's frame straight into the piece's.
            turn = wp.quat_to_matrix(wp.quat_inverse(q) * hands_in.body_q[b, own])
            shift = wp.quat_rotate_inv(q, hands_in.body_p[b, own] - p)
            for i in range(points_in.first[own], points_in.first[own + 1]):
                local = turn * points_in.position[i] + shift
                if in_box(local, half):
                    nd = bounded_piece_distance(pieces_in, piece, local, near_in)
                    if nd[3] < near_in:
                        x = p + wp.quat_rotate(q, local)
                        n = wp.quat_rotate(q, wp.vec3(nd[0], nd[1], nd[2]))
                        emit_residual(residuals_out, b, own, other, x, n, nd[3] - target_in, 1.0)


@wp.func
def add_chain(
    tree: Tree,
    b: wp.int32,
    own: wp.int32,
    body: wp.int32,
    point: wp.vec3,
    direction: wp.vec3,
    sign: wp.float32,
    hands: Hands,
    row: wp.array2d(dtype=wp.float32),
):
    """Add the joints' part of a row: motion of a point of `body` along `direction`."""
    k = body
    while k > 0:
        a = hands.axis[b, k]
        g = wp.dot(a, direction)
        if tree.joint_type[k] == 1:
            g = wp.dot(wp.cross(a, point - hands.body_p[b, k]), direction)
        column = 6 + tree.dof[k]
        row[own, column] = row[own, column] + sign * tree.multiplier[k] * g
        k = tree.parent[k]


@wp.func
def to_fixed_point(x: wp.float32):
    """Return x as an integer: sums of integers are the same in any order."""
    return wp.int64(x * FIXED)


@wp.kernel
def normal_equations(
    tree_in: Tree,
    lane_in: wp.int32,
    hands_in: Hands,
    residuals_in: Residuals,
    row_out: wp.array2d(dtype=wp.float32),
    matrix_inout: wp.array3d(dtype=wp.int64),
    vector_inout: wp.array2d(dtype=wp.int64),
):
    """Add to J'WJ (B, n, n), lower half, and J'We (B, n), n = 6 + D, both `to_fixed_point`.
    Launch over (B, R / lane); `row` has a scratch row per thread."""
    b, part = wp.tid()
    count = wp.min(residuals_in.count[b], residuals_in.body.shape[1])
    if hands_in.active[b] == 0 or part * lane_in >= count:
        return
    n = row_out.shape[1]
    own = b * ((residuals_in.body.shape[1] + lane_in - 1) / lane_in) + part
    for k in range(part * lane_in, wp.min((part + 1) * lane_in, count)):
        for i in range(n):
            row_out[own, i] = 0.0
        body = residuals_in.body[b, k]
        other = residuals_in.other[b, k]
        point = residuals_in.point[b, k]
        direction = residuals_in.direction[b, k]
        add_chain(tree_in, b, own, body, point, direction, 1.0, hands_in, row_out)
        if other >= 0:
            # Both links move with the root: only the joints between them count.
            add_chain(tree_in, b, own, other, point, direction, -1.0, hands_in, row_out)
        else:
            turn = wp.cross(point - hands_in.pivot[b], direction)
            for i in range(3):
                row_out[own, i] = direction[i]
                row_out[own, 3 + i] = turn[i]
        w = residuals_in.weight[b, k]
        e = residuals_in.value[b, k]
        for i in range(n):
            ri = row_out[own, i]
            if ri != 0.0:
                wp.atomic_add(vector_inout, b, i, to_fixed_point(w * ri * e))
                for j in range(i + 1):
                    rj = row_out[own, j]
                    if rj != 0.0:
                        wp.atomic_add(matrix_inout, b, i, j, to_fixed_point(w * ri * rj))


@wp.struct
class States:
    """Hands (B,) in double precision: palm centres, rotations, dofs (B, D)."""

    pivot: wp.array(dtype=wp.vec3d)
    rotation: wp.array(dtype=wp.quatd)
    q: wp.array2d(dtype=wp.float64)


@wp.kernel
def keep_best(
    depths_in: Depths,
    better_in: wp.float64,
    now_in: States,
    active_inout: wp.array(dtype=wp.int32),
    count_out: wp.array(dtype=wp.int32),
    best_inout: States,
    depth_inout: wp.array(dtype=wp.float64),
):
    """Store states whose penetration is the least so far by more than `better` [m]. Launch over B.
    Finish hands whose least penetration is at most `better`. Reset residuals."""
    b = wp.tid()
    if active_inout[b] == 0:
        return
    count_out[b] = 0
    d = depths_in
    now = wp.max(wp.max(d.points[b], d.object[b]), wp.max(d.links[b], d.obstacles[b]))
    if wp.float64(now) < depth_inout[b] - better_in:
        depth_inout[b] = wp.float64(now)
        best_inout.pivot[b] = now_in.pivot[b]
        best_inout.rotation[b] = now_in.rotation[b]
        for k in range(now_in.q.shape[1]):
            best_inout.q[b, k] = now_in.q[b, k]
    if depth_inout[b] <= better_in:
        active_inout[b] = 0


@wp.kernel
def step(
    lower_in: wp.array(dtype=wp.float64),
    upper_in: wp.array(dtype=wp.float64),
    scale_in: wp.array(dtype=wp.float64),
    damping_in: wp.float64,
    longest_in: wp.float64,
    residuals_in: Residuals,
    factor_out: wp.array3d(dtype=wp.float64),
    move_out: wp.array2d(dtype=wp.float64),
    matrix_inout: wp.array3d(dtype=wp.int64),
    vector_inout: wp.array2d(dtype=wp.int64),
    state_inout: States,
    hands_inout: Hands,
):
    """Take a damped Gauss-Newton step, at most `longest` in units of `scale` (n,). Launch over B.
    Solve (S H S + d I) x = -S g by Cholesky and move by S x; d is `damping` times the number of residuals. Reset the
    equations."""
    b = wp.tid()
    if hands_inout.active[b] == 0:
        return
    n = vector_inout.shape[1]
    unit = wp.float64(1.0) / wp.float64(FIXED)
    count = wp.min(residuals_in.count[b], residuals_in.body.shape[1])
    for i in range(n):
        for j in range(i + 1):
            total = unit * scale_in[i] * scale_in[j] * wp.float64(matrix_inout[b, i, j])
            matrix_inout[b, i, j] = wp.int64(0)
            if i == j:
                total += damping_in * wp.float64(wp.max(count, 1))
            for k in range(j):
                total -= factor_out[b, i, k] * factor_out[b, j, k]
            if i == j:
                factor_out[b, i, i] = wp.sqrt(total)
            else:
                factor_out[b, i, j] = total / factor_out[b, j, j]
        right = -unit * scale_in[i] * wp.float64(vector_inout[b, i])
        vector_inout[b, i] = wp.int64(0)
        for k in range(i):
            right -= factor_out[b, i, k] * move_out[b, k]
        move_out[b, i] = right / factor_out[b, i, i]
    square = wp.float64(0.0)
    for back in range(n):
        i = n - 1 - back
        total = move_out[b, i]
        for k in range(i + 1, n):
            total -= factor_out[b, k, i] * move_out[b, k]
        move_out[b, i] = total / factor_out[b, i, i]
        square += move_out[b, i] * move_out[b, i]
    share = wp.min(wp.float64(1.0), longest_in / wp.max(wp.sqrt(square), wp.float64(1.0e-12)))
    for i in range(n):
        move_out[b, i] = share * scale_in[i] * move_out[b, i]
    state_inout.pivot[b] = state_inout.pivot[b] + wp.vec3d(move_out[b, 0], move_out[b, 1], move_out[b, 2])
    turn = wp.vec3d(move_out[b, 3], move_out[b, 4], move_out[b, 5])
    angle = wp.length(turn)
    axis = turn / wp.max(angle, wp.float64(1.0e-12))
    state_inout.rotation[b] = wp.normalize(wp.quat_from_axis_angle(axis, angle) * state_inout.rotation[b])
    hands_inout.pivot[b] = wp.vec3(state_inout.pivot[b])
    hands_inout.rotation[b] = wp.quat(state_inout.rotation[b])
    for d in range(n - 6):
        value = wp.clamp(state_inout.q[b, d] + move_out[b, 6 + d], lower_in[d], upper_in[d])
        state_inout.q[b, d] = value
        hands_inout.q[b, d] = wp.float32(value)

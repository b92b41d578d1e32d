"""Gauss-Newton projection out of penetration: residuals of violated clearances, their rows, the normal equations.

A residual is w (d - target) where d is a signed distance; its row is the derivative of d by (root translation, root
rotation about the pivot, dofs). d is the distance of a hand point to the object (normal n of the object), of an object
sample to a link, or of a point of one link to another link.
"""

import warp as wp

from worker.simulation.kernels.kinematics import Tree
from worker.simulation.kernels.pieces import (
    BodyPoints,
    Pieces,
    Samples,
    cell_range,
    clip_depth,
    in_box,
    may_touch,
    piece_centre,
    piece_rotation,
    world_extent,
)

wp.set_module_options({"enable_backward": False})


@wp.struct
class Residuals:
    """Packed residuals per grasp, capacity R; what does not fit is left to the next iteration."""

    count: wp.array(dtype=wp.int32)
    body: wp.array2d(dtype=wp.int32)
    other: wp.array2d(dtype=wp.int32)  # body moved against, or -1: the object
    point: wp.array2d(dtype=wp.vec3)
    direction: wp.array2d(dtype=wp.vec3)  # moving the body by it increases d
    value: wp.array2d(dtype=wp.float32)  # d - target [m]
    key: wp.array2d(dtype=wp.int64)  # order in which they are summed
    order: wp.array2d(dtype=wp.int32)  # their slots in that order
    weight: wp.array2d(dtype=wp.float32)


@wp.func
def key_of(kind: wp.int32, thread: wp.int32, serial: wp.int32):
    """Where the residual that a thread of a launch emits as its `serial`-th comes; launches have kinds 0, 1, ..."""
    return (wp.int64(kind) << wp.int64(56)) + (wp.int64(thread) << wp.int64(28)) + wp.int64(serial)


@wp.func
def emit(
    out: Residuals, b: wp.int32, key: wp.int64, body: wp.int32, other: wp.int32, point: wp.vec3, direction: wp.vec3,
    value: wp.float32, weight: wp.float32,
):  # fmt: skip
    k = wp.atomic_add(out.count, b, 1)
    if k < out.body.shape[1]:
        out.key[b, k] = key
        out.body[b, k] = body
        out.other[b, k] = other
        out.point[b, k] = point
        out.direction[b, k] = direction
        out.value[b, k] = value
        out.weight[b, k] = weight


@wp.kernel
def point_residuals(
    # Model:
    lane_in: wp.int32,
    # Data in:
    active_in: wp.array(dtype=wp.int32),
    count_in: wp.array(dtype=wp.int32),
    body_in: wp.array2d(dtype=wp.int32),
    point_in: wp.array2d(dtype=wp.vec3),
    normal_in: wp.array2d(dtype=wp.vec3),
    distance_in: wp.array2d(dtype=wp.float32),
    # In:
    near_in: wp.float32,
    target_in: wp.float32,
    hold_in: wp.float32,
    hold_target_in: wp.float32,
    hold_weight_in: wp.float32,
    # Out:
    residuals_out: Residuals,
):
    """Hand points nearer than `near` go to `target`; those nearer than `hold` are held near it, weakly.

    Launch over (B, N / lane).
    """
    b, part = wp.tid()
    if active_in[b] == 0:
        return
    for i in range(part * lane_in, wp.min((part + 1) * lane_in, count_in[b])):
        rho = distance_in[b, i]
        if rho < near_in:
            key = key_of(0, i, 0)
            emit(residuals_out, b, key, body_in[b, i], -1, point_in[b, i], normal_in[b, i], rho - target_in, 1.0)
        elif rho < hold_in:
            gap = rho - hold_target_in
            key = key_of(0, i, 0)
            emit(residuals_out, b, key, body_in[b, i], -1, point_in[b, i], normal_in[b, i], gap, hold_weight_in)


@wp.kernel
def sample_residuals(
    # Model:
    pieces_in: Pieces,
    samples_in: Samples,
    # Data in:
    active_in: wp.array(dtype=wp.int32),
    body_p_in: wp.array2d(dtype=wp.vec3),
    body_q_in: wp.array2d(dtype=wp.quat),
    # In:
    near_in: wp.float32,
    target_in: wp.float32,
    # Out:
    residuals_out: Residuals,
):
    """Object samples nearer to a link than `near` go to `target`. Launch over (B, P)."""
    b, piece = wp.tid()
    if active_in[b] == 0:
        return
    body = pieces_in.body[piece]
    q = piece_rotation(pieces_in, piece, b, body_q_in)
    p = piece_centre(pieces_in, piece, b, body_p_in, body_q_in)
    half = pieces_in.half[piece] + wp.vec3(near_in, near_in, near_in)
    extent = world_extent(q, half)
    low = samples_in.low
    size = samples_in.size
    shape = samples_in.shape
    xs = cell_range(p[0] - extent[0], p[0] + extent[0], low[0], size, shape[0])
    ys = cell_range(p[1] - extent[1], p[1] + extent[1], low[1], size, shape[1])
    zs = cell_range(p[2] - extent[2], p[2] + extent[2], low[2], size, shape[2])
    back = wp.transpose(wp.quat_to_matrix(q))
    emitted = wp.int32(0)
    if xs[0] <= xs[1] and ys[0] <= ys[1] and zs[0] <= zs[1]:
        for i in range(xs[0], xs[1] + 1):
            for j in range(ys[0], ys[1] + 1):
                row = (i * shape[1] + j) * shape[2]
                for index in range(samples_in.first[row + zs[0]], samples_in.first[row + zs[1] + 1]):
                    x = samples_in.position[index]
                    local = back * (x - p)
                    if in_box(local, half):
                        nd = clip_depth(pieces_in, piece, local, near_in)
                        if nd[3] < near_in:
                            n = wp.quat_rotate(q, wp.vec3(nd[0], nd[1], nd[2]))
                            # The link moving along its own outward normal comes nearer: d falls.
                            emit(residuals_out, b, key_of(1, piece, emitted), body, -1, x, -n, nd[3] - target_in, 1.0)
                            emitted += 1


@wp.kernel
def self_residuals(
    # Model:
    pieces_in: Pieces,
    points_in: BodyPoints,
    # Data in:
    active_in: wp.array(dtype=wp.int32),
    body_p_in: wp.array2d(dtype=wp.vec3),
    body_q_in: wp.array2d(dtype=wp.quat),
    # In:
    near_in: wp.float32,
    target_in: wp.float32,
    # Out:
    residuals_out: Residuals,
):
    """Points of one link nearer than `near` to another link go to `target`. Launch over (B, P)."""
    b, piece = wp.tid()
    if active_in[b] == 0:
        return
    other = pieces_in.body[piece]
    q = piece_rotation(pieces_in, piece, b, body_q_in)
    p = piece_centre(pieces_in, piece, b, body_p_in, body_q_in)
    half = pieces_in.half[piece] + wp.vec3(near_in, near_in, near_in)
    reach = wp.length(pieces_in.half[piece]) + near_in
    emitted = wp.int32(0)
    for own in range(body_p_in.shape[1]):
        if may_touch(pieces_in, points_in, other, p, reach, own, b, body_p_in, body_q_in):
            # From the body's frame straight into the piece's.
            turn = wp.quat_to_matrix(wp.quat_inverse(q) * body_q_in[b, own])
            shift = wp.quat_rotate_inv(q, body_p_in[b, own] - p)
            for i in range(points_in.first[own], points_in.first[own + 1]):
                local = turn * points_in.position[i] + shift
                if in_box(local, half):
                    nd = clip_depth(pieces_in, piece, local, near_in)
                    if nd[3] < near_in:
                        x = p + wp.quat_rotate(q, local)
                        n = wp.quat_rotate(q, wp.vec3(nd[0], nd[1], nd[2]))
                        emit(residuals_out, b, key_of(2, piece, emitted), own, other, x, n, nd[3] - target_in, 1.0)
                        emitted += 1


@wp.func
def add_chain(
    tree: Tree, b: wp.int32, body: wp.int32, point: wp.vec3, direction: wp.vec3, sign: wp.float32,
    body_p: wp.array2d(dtype=wp.vec3), axis: wp.array2d(dtype=wp.vec3), row: wp.array2d(dtype=wp.float32),
):  # fmt: skip
    """Add the joints' part of a row: motion along `direction` of a point of `body`."""
    k = body
    while k > 0:
        a = axis[b, k]
        g = wp.dot(a, direction)
        if tree.joint_type[k] == 1:
            g = wp.dot(wp.cross(a, point - body_p[b, k]), direction)
        column = 6 + tree.dof[k]
        row[b, column] = row[b, column] + sign * tree.multiplier[k] * g
        k = tree.parent[k]


@wp.kernel
def normal_equations(
    # Model:
    tree_in: Tree,
    # Data in:
    active_in: wp.array(dtype=wp.int32),
    pivot_in: wp.array(dtype=wp.vec3),
    body_p_in: wp.array2d(dtype=wp.vec3),
    axis_in: wp.array2d(dtype=wp.vec3),
    # In:
    residuals_in: Residuals,
    # Out:
    row_out: wp.array2d(dtype=wp.float32),
    matrix_out: wp.array3d(dtype=wp.float32),
    vector_out: wp.array2d(dtype=wp.float32),
):
    """J'WJ (B, n, n) and J'We (B, n), n = 6 + D; `row` (B, n) is scratch. Launch over B."""
    b = wp.tid()
    if active_in[b] == 0:
        return
    n = row_out.shape[1]
    for i in range(n):
        vector_out[b, i] = 0.0
        for j in range(n):
            matrix_out[b, i, j] = 0.0
    count = wp.min(residuals_in.count[b], residuals_in.body.shape[1])
    for place in range(count):
        k = residuals_in.order[b, place]
        for i in range(n):
            row_out[b, i] = 0.0
        body = residuals_in.body[b, k]
        other = residuals_in.other[b, k]
        point = residuals_in.point[b, k]
        direction = residuals_in.direction[b, k]
        add_chain(tree_in, b, body, point, direction, 1.0, body_p_in, axis_in, row_out)
        if other >= 0:
            # Both links move with the root: only the joints between them tell.
            add_chain(tree_in, b, other, point, direction, -1.0, body_p_in, axis_in, row_out)
        else:
            turn = wp.cross(point - pivot_in[b], direction)
            for i in range(3):
                row_out[b, i] = direction[i]
                row_out[b, 3 + i] = turn[i]
        w = residuals_in.weight[b, k]
        e = residuals_in.value[b, k]
        for i in range(n):
            ri = row_out[b, i]
            if ri != 0.0:
                vector_out[b, i] = vector_out[b, i] + w * ri * e
                for j in range(i + 1):
                    rj = row_out[b, j]
                    if rj != 0.0:
                        matrix_out[b, i, j] = matrix_out[b, i, j] + w * ri * rj

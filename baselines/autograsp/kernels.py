"""Distances of bodies to the object and to other bodies, and steps of closing joints without contact."""

import warp as wp

from graspd.worker.simulation.kernels.kinematics import Hands
from graspd.worker.simulation.kernels.pieces import (
    BodyPoints,
    Pieces,
    may_touch,
    piece_centre,
    piece_distance,
    piece_rotation,
    world_extent,
)
from graspd.worker.simulation.kernels.surface import Surface, distance

wp.set_module_options({"enable_backward": False})


@wp.struct
class Closing:
    """Closing motion of a hand; D dofs, L bodies."""

    direction: wp.array(dtype=wp.float32)  # (D,) -1, 0, +1
    moves: wp.array2d(dtype=wp.int32)  # (D, L): 1 if the dof moves the body
    lever: wp.array2d(dtype=wp.float32)  # (D, L): upper bound on the motion of a body's points per unit of the dof
    finger: wp.array(dtype=wp.int32)  # (D,) group number, equal for dofs that move a common body
    lower: wp.array(dtype=wp.float32)
    upper: wp.array(dtype=wp.float32)


@wp.kernel
def points_to_object(
    surface_in: Surface,
    reach_in: wp.float32,
    exact_in: wp.float32,
    body_in: wp.array(dtype=wp.int32),
    position_in: wp.array(dtype=wp.vec3),
    hands_in: Hands,
    near_inout: wp.array2d(dtype=wp.float32),
):
    """Compute the least distance of each body's points from the object. Launch over (B, N)."""
    b, i = wp.tid()
    if hands_in.active[b] == 0:
        return
    body = body_in[i]
    point = hands_in.body_p[b, body] + wp.quat_rotate(hands_in.body_q[b, body], position_in[i])
    wp.atomic_min(near_inout, b, body, distance(surface_in, point, reach_in, exact_in, reach_in).distance)


@wp.kernel
def object_to_pieces(
    pieces_in: Pieces,
    bvh_in: wp.uint64,
    sample_in: wp.array(dtype=wp.vec3),
    hands_in: Hands,
    margin_in: wp.float32,
    near_inout: wp.array2d(dtype=wp.float32),
):
    """Include the object's samples within `margin` in the least distances. Launch over (B, P).
    The samples include the object's edges."""
    b, piece = wp.tid()
    if hands_in.active[b] == 0:
        return
    q = piece_rotation(pieces_in, piece, b, hands_in.body_q)
    p = piece_centre(pieces_in, piece, b, hands_in.body_p, hands_in.body_q)
    extent = world_extent(wp.quat_to_matrix(q), pieces_in.half[piece]) + wp.vec3(margin_in, margin_in, margin_in)
    least = float(1.0e3)
    query = wp.bvh_query_aabb(bvh_in, p - extent, p + extent)
    index = wp.int32(0)
    while wp.bvh_query_next(query, index):
        nd = piece_distance(pieces_in, piece, wp.quat_rotate_inv(q, sample_in[index] - p))
        least = wp.min(least, nd[3])
    if least < 1.0e3:
        wp.atomic_min(near_inout, b, pieces_in.body[piece], least)


@wp.kernel
def bodies_to_pieces(
    pieces_in: Pieces,
    points_in: BodyPoints,
    hands_in: Hands,
    margin_in: wp.float32,
    pair_inout: wp.array3d(dtype=wp.float32),
):
    """Compute the least distance between bodies that must not touch. Launch over (B, P).
    The distance is that of one body's points from the other's pieces."""
    b, piece = wp.tid()
    if hands_in.active[b] == 0:
        return
    other = pieces_in.body[piece]
    q = piece_rotation(pieces_in, piece, b, hands_in.body_q)
    p = piece_centre(pieces_in, piece, b, hands_in.body_p, hands_in.body_q)
    reach = wp.length(pieces_in.half[piece]) + margin_in
    for own in range(hands_in.body_p.shape[1]):
        if may_touch(pieces_in, points_in, other, p, reach, own, b, hands_in.body_p, hands_in.body_q):
            least = float(margin_in)
            for i in range(points_in.first[own], points_in.first[own + 1]):
                x = hands_in.body_p[b, own] + wp.quat_rotate(hands_in.body_q[b, own], points_in.position[i])
                nd = piece_distance(pieces_in, piece, wp.quat_rotate_inv(q, x - p))
                least = wp.min(least, nd[3])
            wp.atomic_min(pair_inout, b, own, other, least)
            wp.atomic_min(pair_inout, b, other, own, least)


@wp.func
def least_gap(
    closing: Closing,
    b: wp.int32,
    d: wp.int32,
    body: wp.int32,
    near: wp.array2d(dtype=wp.float32),
    pair: wp.array3d(dtype=wp.float32),
):
    """Return the least gap of a body that dof d moves; gaps to bodies that d does not move count half."""
    least = near[b, body]
    for other in range(near.shape[1]):
        if closing.moves[d, other] == 0:
            least = wp.min(least, 0.5 * pair[b, body, other])
    return least


@wp.kernel
def close(
    closing_in: Closing,
    near_in: wp.array2d(dtype=wp.float32),
    pair_in: wp.array3d(dtype=wp.float32),
    touch_in: wp.float32,
    share_in: wp.float32,
    largest_in: wp.float32,
    hands_inout: Hands,
    stopped_inout: wp.array2d(dtype=wp.int32),
):
    """Stop dofs that move a touching body; close the others by one step. Launch over B.
    The step skips no contact. A point of body a moves by at most the sum of lever[d, a] |dq_d| over the closing dofs d.
    All dofs of a finger have the same step, share * gap / sum lever (conservative advancement)."""
    b = wp.tid()
    if hands_inout.active[b] == 0:
        return
    dofs = hands_inout.q.shape[1]
    for d in range(dofs):
        if stopped_inout[b, d] == 0:
            for body in range(near_in.shape[1]):
                if closing_in.moves[d, body] == 1:
                    if least_gap(closing_in, b, d, body, near_in, pair_in) < touch_in:
                        stopped_inout[b, d] = 1
    open_dofs = wp.int32(0)
    for d in range(dofs):
        if stopped_inout[b, d] == 0:
            open_dofs += 1
            step = float(largest_in)
            # Joints close at equal speed, so the slowest dof of a finger limits all its dofs.
            for e in range(dofs):
                if stopped_inout[b, e] == 0 and closing_in.finger[e] == closing_in.finger[d]:
                    for body in range(near_in.shape[1]):
                        if closing_in.moves[e, body] == 1:
                            travel = float(0.0)
                            for k in range(dofs):
                                if stopped_inout[b, k] == 0:
                                    travel += closing_in.lever[k, body]
                            gap = least_gap(closing_in, b, e, body, near_in, pair_in)
                            step = wp.min(step, share_in * gap / wp.max(travel, 1.0e-6))
            value = hands_inout.q[b, d] + closing_in.direction[d] * step
            if value <= closing_in.lower[d] or value >= closing_in.upper[d]:
                value = wp.clamp(value, closing_in.lower[d], closing_in.upper[d])
                stopped_inout[b, d] = 2
            hands_inout.q[b, d] = value
    if open_dofs == 0:
        hands_inout.active[b] = 0


@wp.kernel
def advance(
    near_in: wp.array2d(dtype=wp.float32),
    direction_in: wp.array(dtype=wp.vec3),
    standoff_in: wp.float32,
    share_in: wp.float32,
    hands_inout: Hands,
):
    """Move the hand along its approach until a body is `standoff` from the object. Launch over B."""
    b = wp.tid()
    if hands_inout.active[b] == 0:
        return
    gap = near_in[b, 0]
    for body in range(1, near_in.shape[1]):
        gap = wp.min(gap, near_in[b, body])
    if gap - standoff_in < 1.0e-4:
        hands_inout.active[b] = 0
        return
    hands_inout.pivot[b] = hands_inout.pivot[b] + (share_in * (gap - standoff_in)) * direction_in[b]

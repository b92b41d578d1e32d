"""Distances as metrics need them: exact in sign and value, no smoothing, no gradient.

`worker.simulation.kernels.surface` answers the optimiser's question (smoothed, cheap); this module answers the
referee's: how far is a point from the mesh itself, and how deep is it in the hand's convex pieces.
"""

import warp as wp

from worker.simulation.kernels.pieces import Pieces, piece_distance

wp.set_module_options({"enable_backward": False})


#: Gap over which the normal turns from the surface's own to the direction of the closest point [m].
BLEND = wp.constant(2.0e-4)

#: Distances between positions of some metres are off by less than this [m].
ROUNDING = wp.constant(1.0e-6)


@wp.kernel
def mesh_distance(
    # Model:
    mesh_in: wp.uint64,
    winding_in: wp.int32,
    corner_normal_in: wp.array(dtype=wp.vec3),
    low_in: wp.vec3,
    high_in: wp.vec3,
    coarse_in: wp.array3d(dtype=wp.float32),
    spacing_in: wp.float32,
    coarse_reach_in: wp.float32,
    # In:
    reach_in: wp.float32,
    point_in: wp.array(dtype=wp.vec3),
    # Out:
    distance_out: wp.array(dtype=wp.float32),
    closest_out: wp.array(dtype=wp.vec3),
    normal_out: wp.array(dtype=wp.vec3),
):
    """Signed distance, closest point and the distance's gradient, an outward unit normal. Launch over points.

    Points outside the box [low, high] are only looked up within `reach`; farther ones get distance = reach, normal 0.
    The sign is ray parity, or the winding number where `winding` is 1 (open meshes): both are right near creases.
    `coarse` has the distance at nodes `spacing` apart, the first one at `low`, at least `coarse_reach` where it is not
    exact; empty: not known. Between a node and a point the distance changes at most by the way between them: what is
    beyond reach by that is looked up no further, no face is looked for beyond it, and no sign where it cannot change.
    """
    i = wp.tid()
    p = point_in[i]
    distance_out[i] = reach_in
    closest_out[i] = p
    normal_out[i] = wp.vec3(0.0)
    # The box encloses the object, so inside it the diagonal bounds the distance: no deep point is ever missed.
    inside = (
        p[0] > low_in[0]
        and p[1] > low_in[1]
        and p[2] > low_in[2]
        and p[0] < high_in[0]
        and p[1] < high_in[1]
        and p[2] < high_in[2]
    )
    known = float(0.0)
    within = reach_in
    if inside:
        within = wp.length(high_in - low_in)
    if inside and coarse_in.shape[0] > 0:
        at = (p - low_in) / spacing_in
        x = wp.min(int(at[0] + 0.5), coarse_in.shape[0] - 1)
        y = wp.min(int(at[1] + 0.5), coarse_in.shape[1] - 1)
        z = wp.min(int(at[2] + 0.5), coarse_in.shape[2] - 1)
        way = wp.length(p - (low_in + spacing_in * wp.vec3(float(x), float(y), float(z)))) + ROUNDING
        coarse = coarse_in[x, y, z]
        if coarse - way > reach_in:
            return
        if wp.abs(coarse) > way:
            known = wp.sign(coarse)
        if coarse < coarse_reach_in:
            within = wp.min(within, wp.abs(coarse) + way)
    if not inside or known != 0.0:
        query = wp.mesh_query_point_no_sign(mesh_in, p, within)
    elif winding_in == 1:
        query = wp.mesh_query_point_sign_winding_number(mesh_in, p, within)
    else:
        query = wp.mesh_query_point(mesh_in, p, within)
    if query.result:
        closest = wp.mesh_eval_position(mesh_in, query.face, query.u, query.v)
        sign = float(1.0)
        if known != 0.0:
            sign = known
        elif inside:
            sign = query.sign
        gap = wp.length(p - closest)
        u = query.u
        v = query.v
        face = query.face
        distance_out[i] = sign * gap
        closest_out[i] = closest
        smooth = wp.normalize(
            u * corner_normal_in[3 * face]
            + v * corner_normal_in[3 * face + 1]
            + (1.0 - u - v) * corner_normal_in[3 * face + 2]
        )
        # Beside an edge the face's normal says nothing about how a body touches it; the direction to the edge does.
        share = wp.min(gap / BLEND, 1.0)
        direction = (1.0 - share) * smooth
        if gap > 1.0e-9:
            direction = direction + (share * sign / gap) * (p - closest)
        normal_out[i] = wp.normalize(direction)


@wp.kernel
def pieces_distance(
    # Model:
    pieces_in: Pieces,
    # In:
    piece_p_in: wp.array2d(dtype=wp.vec3),
    piece_q_in: wp.array2d(dtype=wp.quat),
    reach_in: wp.float32,
    point_in: wp.array(dtype=wp.vec3),
    # Out:
    distance_inout: wp.array2d(dtype=wp.float32),
):
    """Least distance of S points to each of P pieces for B grasps; what is farther than `reach` is left out.

    Launch over (B, S); `distance_inout` (B, P) holds `reach` before.
    """
    b, s = wp.tid()
    for piece in range(pieces_in.body.shape[0]):
        offset = point_in[s] - piece_p_in[b, piece]
        bound = wp.length(pieces_in.half[piece]) + reach_in
        if wp.dot(offset, offset) < bound * bound:
            nd = piece_distance(pieces_in, piece, wp.quat_rotate_inv(piece_q_in[b, piece], offset))
            wp.atomic_min(distance_inout, b, piece, nd[3])


@wp.kernel
def self_distance(
    # Model:
    pieces_in: Pieces,
    # In:
    piece_p_in: wp.array2d(dtype=wp.vec3),
    piece_q_in: wp.array2d(dtype=wp.quat),
    body_in: wp.array(dtype=wp.int32),
    point_in: wp.array2d(dtype=wp.vec3),
    # Out:
    depth_inout: wp.array2d(dtype=wp.float32),
):
    """Depth (B, L) of each body in others whose contact counts, or of others in it. Launch over points (B, N)."""
    b, i = wp.tid()
    x = point_in[b, i]
    for piece in range(pieces_in.body.shape[0]):
        if pieces_in.apart[body_in[i], pieces_in.body[piece]] == 1:
            offset = x - piece_p_in[b, piece]
            bound = wp.length(pieces_in.half[piece])
            if wp.dot(offset, offset) < bound * bound:
                nd = piece_distance(pieces_in, piece, wp.quat_rotate_inv(piece_q_in[b, piece], offset))
                if nd[3] < 0.0:
                    wp.atomic_max(depth_inout, b, body_in[i], -nd[3])
                    wp.atomic_max(depth_inout, b, pieces_in.body[piece], -nd[3])

"""Distances of points from meshes and convex pieces, exact in sign and value, for metrics.

The distances of `worker.simulation.kernels.surface`, for the optimiser, are smoothed and cheap."""

import warp as wp

from graspd.worker.simulation.kernels.pieces import Pieces, piece_distance

wp.set_module_options({"enable_backward": False})


#: Gap over which the normal turns from the surface's own to the direction of the closest point [m].
BLEND = wp.constant(2.0e-4)

ROUNDING = wp.constant(1.0e-6)  # bound on the error of distances between positions of some metres [m]


@wp.struct
class Skin:
    """An object's surface, about its centre of mass."""

    mesh: wp.uint64
    winding: wp.int32  # 1 for an open mesh: the sign is that of the winding number
    corner_normal: wp.array(dtype=wp.vec3)  # (3 F,)
    low: wp.vec3  # box around the object
    high: wp.vec3
    coarse: wp.array3d(dtype=wp.float32)  # distances at grid nodes, the first one at `low`; empty without grid
    spacing: wp.float32
    coarse_reach: wp.float32  # larger distances in `coarse` are not exact [m]


@wp.struct
class NearestPoint:
    """The nearest point of the surface."""

    distance: wp.float32
    closest: wp.vec3
    normal: wp.vec3  # unit gradient of the distance; 0 beyond reach


@wp.func
def coarse_distance(skin: Skin, p: wp.vec3):
    """Return the distance at the grid node nearest to p, and a bound on the separation of node and p."""
    at = (p - skin.low) / skin.spacing
    x = wp.min(int(at[0] + 0.5), skin.coarse.shape[0] - 1)
    y = wp.min(int(at[1] + 0.5), skin.coarse.shape[1] - 1)
    z = wp.min(int(at[2] + 0.5), skin.coarse.shape[2] - 1)
    way = wp.length(p - (skin.low + skin.spacing * wp.vec3(float(x), float(y), float(z)))) + ROUNDING
    return skin.coarse[x, y, z], way


@wp.func
def nearest(skin: Skin, p: wp.vec3, reach: wp.float32):
    """Return signed distance, closest point and gradient of the distance, an outward unit normal.
    Points outside the box [low, high] are only looked up within `reach`; farther ones get distance = reach, normal 0.
    The sign is ray parity, or the winding number for open meshes: both are right near creases. Between a node of
    `coarse` and a point the distance changes at most by their separation. With this bound, points beyond reach are not
    looked up, farther faces are not searched, and the sign is not computed where it is certain."""
    out = NearestPoint()
    out.distance = reach
    out.closest = p
    out.normal = wp.vec3(0.0)
    low = skin.low
    high = skin.high
    # The box encloses the object, so inside it the diagonal bounds the distance: no deep point is missed.
    inside = p[0] > low[0] and p[1] > low[1] and p[2] > low[2] and p[0] < high[0] and p[1] < high[1] and p[2] < high[2]
    known = float(0.0)
    within = reach
    if inside:
        within = wp.length(high - low)
    if inside and skin.coarse.shape[0] > 0:
        coarse, way = coarse_distance(skin, p)
        if coarse - way > reach:
            return out
        if wp.abs(coarse) > way:
            known = wp.sign(coarse)
        if coarse < skin.coarse_reach:
            within = wp.min(within, wp.abs(coarse) + way)
    if not inside or known != 0.0:
        query = wp.mesh_query_point_no_sign(skin.mesh, p, within)
    elif skin.winding == 1:
        query = wp.mesh_query_point_sign_winding_number(skin.mesh, p, within)
    else:
        query = wp.mesh_query_point(skin.mesh, p, within)
    if query.result:
        closest = wp.mesh_eval_position(skin.mesh, query.face, query.u, query.v)
        sign = float(1.0)
        if known != 0.0:
            sign = known
        elif inside:
            sign = query.sign
        gap = wp.length(p - closest)
        u = query.u
        v = query.v
        face = query.face
        out.distance = sign * gap
        out.closest = closest
        smooth = wp.normalize(
            u * skin.corner_normal[3 * face]
            + v * skin.corner_normal[3 * face + 1]
            + (1.0 - u - v) * skin.corner_normal[3 * face + 2]
        )
        # Beside an edge, the direction of contact is the direction to the edge, not the face's normal.
        share = wp.min(gap / BLEND, 1.0)
        direction = (1.0 - share) * smooth
        if gap > 1.0e-9:
            direction = direction + (share * sign / gap) * (p - closest)
        out.normal = wp.normalize(direction)
    return out


@wp.kernel
def mesh_distance(
    skin_in: Skin,
    reach_in: wp.float32,
    point_in: wp.array(dtype=wp.vec3),
    distance_out: wp.array(dtype=wp.float32),
    closest_out: wp.array(dtype=wp.vec3),
    normal_out: wp.array(dtype=wp.vec3),
):
    """Run `nearest` on N points. Launch over N."""
    i = wp.tid()
    found = nearest(skin_in, point_in[i], reach_in)
    distance_out[i] = found.distance
    closest_out[i] = found.closest
    normal_out[i] = found.normal


@wp.kernel
def pieces_distance(
    pieces_in: Pieces,
    piece_p_in: wp.array2d(dtype=wp.vec3),
    piece_q_in: wp.array2d(dtype=wp.quat),
    reach_in: wp.float32,
    point_in: wp.array(dtype=wp.vec3),
    distance_inout: wp.array2d(dtype=wp.float32),
):
    """Compute the least distance of S points to each of P pieces for B grasps, within `reach`.
    Launch over (B, S); before, `distance_inout` (B, P) must be filled with `reach`."""
    b, s = wp.tid()
    for piece in range(pieces_in.body.shape[0]):
        offset = point_in[s] - piece_p_in[b, piece]
        bound = wp.length(pieces_in.half[piece]) + reach_in
        if wp.dot(offset, offset) < bound * bound:
            nd = piece_distance(pieces_in, piece, wp.quat_rotate_inv(piece_q_in[b, piece], offset))
            wp.atomic_min(distance_inout, b, piece, nd[3])


@wp.kernel
def self_distance(
    pieces_in: Pieces,
    piece_p_in: wp.array2d(dtype=wp.vec3),
    piece_q_in: wp.array2d(dtype=wp.quat),
    body_in: wp.array(dtype=wp.int32),
    point_in: wp.array2d(dtype=wp.vec3),
    depth_inout: wp.array2d(dtype=wp.float32),
):
    """Compute the greatest depth (B, L) of each body in non-neighbouring bodies, or of these bodies in it.
    Launch over points (B, N)."""
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


@wp.struct
class BodyPoints:
    """Points of a hand, sorted by body."""

    first: wp.array(dtype=wp.int32)  # (L + 1,)
    position: wp.array(dtype=wp.vec3d)  # body frame
    middle: wp.array(dtype=wp.vec3d)  # (L,) centre of a ball around a body's points
    extent: wp.array(dtype=wp.float32)  # (L,) radius of this ball


@wp.func
def posed_point(origin: wp.vec3d, place: wp.vec3d, turned: wp.quatd, point: wp.vec3d):
    """Return a body's point [m] relative to `origin`, in single precision."""
    x = place + wp.quat_rotate(turned, point) - origin
    return wp.vec3(wp.float32(x[0]), wp.float32(x[1]), wp.float32(x[2]))


@wp.kernel
def body_gaps(
    skin_in: Skin,
    points_in: BodyPoints,
    origin_in: wp.vec3d,
    reach_in: wp.float32,
    body_p_in: wp.array2d(dtype=wp.vec3d),
    body_q_in: wp.array2d(dtype=wp.quatd),
    gap_inout: wp.array2d(dtype=wp.float32),
):
    """Lower `gap_inout` (P, L) to the least distance of bodies' points from the object, within `reach`.
    The distance is signed. Launch over (P, L)."""
    p, body = wp.tid()
    if points_in.first[body] == points_in.first[body + 1]:
        return
    place, turned = body_p_in[p, body], body_q_in[p, body]
    least = wp.min(gap_inout[p, body], reach_in)
    gap_inout[p, body] = least
    middle = posed_point(origin_in, place, turned, points_in.middle[body])
    beyond = wp.max(skin_in.low - middle, middle - skin_in.high)
    outside = wp.length(wp.max(beyond, wp.vec3(0.0)))
    if outside > points_in.extent[body] and reach_in <= skin_in.coarse_reach:
        return
    if outside == 0.0:
        coarse, way = coarse_distance(skin_in, middle)
        if coarse - way > reach_in + points_in.extent[body]:
            return
    for i in range(points_in.first[body], points_in.first[body + 1]):
        x = posed_point(origin_in, place, turned, points_in.position[i])
        least = wp.min(least, nearest(skin_in, x, reach_in).distance)
    gap_inout[p, body] = least


@wp.kernel
def place_pieces(
    pieces_in: Pieces,
    origin_in: wp.vec3d,
    frame_p_in: wp.array(dtype=wp.vec3d),
    frame_q_in: wp.array(dtype=wp.quatd),
    body_p_in: wp.array2d(dtype=wp.vec3d),
    body_q_in: wp.array2d(dtype=wp.quatd),
    piece_p_out: wp.array2d(dtype=wp.vec3),
    piece_q_out: wp.array2d(dtype=wp.quat),
):
    """Compute frames of the pieces from those of the bodies. Launch over (B, pieces)."""
    b, piece = wp.tid()
    body = pieces_in.body[piece]
    piece_p_out[b, piece] = posed_point(origin_in, body_p_in[b, body], body_q_in[b, body], frame_p_in[piece])
    q = body_q_in[b, body] * frame_q_in[piece]
    piece_q_out[b, piece] = wp.quat(wp.float32(q[0]), wp.float32(q[1]), wp.float32(q[2]), wp.float32(q[3]))

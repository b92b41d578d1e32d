"""Links of a hand against solid obstacles: boxes, boards, neighbours' convex pieces.

The nearest points of two separate convex bodies lie on a corner and a face or on two edges. If they overlap, a corner
or an edge of one is in the other. The tests therefore compare the link's features and edges with the obstacle, and the
obstacle's edges with the link. Along a straight edge the signed distance from a convex body is a convex function. The
intersection of two tangents is a lower bound of its minimum, so distant edges cost two evaluations. Further tangents
find the minimum."""

import warp as wp

from graspd.worker.simulation.kernels.kinematics import Hands
from graspd.worker.simulation.kernels.obstacles import (
    Features,
    Obstacles,
    lowest_point,
    obstacle_distance,
    posed_feature,
    required_clearance,
)
from graspd.worker.simulation.kernels.pieces import Pieces, piece_centre, piece_distance, piece_rotation
from graspd.worker.simulation.kernels.projection import Residuals, emit_residual
from graspd.worker.simulation.kernels.wrenches import add_wrench

wp.set_module_options({"enable_backward": False})

#: Largest number of evaluations between the ends of an edge, and tolerance of the minimum [m].
LOOKS = wp.constant(20)
EXACT = wp.constant(wp.float32(1.0e-8))
ON_FACE = wp.constant(wp.float32(1.0e-5))  # points up to this far outside a face's plane count as inside [m]


@wp.struct
class EdgeMinimum:
    """The least value of a convex function on an edge."""

    t: wp.float32
    value: wp.float32
    gradient: wp.vec3


@wp.struct
class NearestObstacle:
    """Least distance of a link from an obstacle; a motion of `point` along `direction` increases it."""

    distance: wp.float32
    point: wp.vec3
    direction: wp.vec3


@wp.func
def tangent_intersection(
    t0: wp.float32, f0: wp.float32, g0: wp.float32, t1: wp.float32, f1: wp.float32, g1: wp.float32
):
    """Return the place, t0 to t1, where tangents of a convex function with slopes g0 < 0 < g1 intersect."""
    return wp.clamp((f1 - f0 + g0 * t0 - g1 * t1) / (g0 - g1), t0, t1)


@wp.func
def edge_gradient(n0: wp.vec3, g0: wp.float32, n1: wp.vec3, g1: wp.float32):
    """Return the gradient at the minimum on an edge, from gradients n0, n1 and slopes g0 < 0 < g1 nearby.
    It is the mixture of n0 and n1 that has no slope along the edge."""
    share = g1 / (g1 - g0)
    return share * n0 + (1.0 - share) * n1


@wp.func
def farthest_plane(obstacles: Obstacles, k: wp.int32, x: wp.vec3):
    """Return (normal, value) of the plane of obstacle k with the largest signed distance of x."""
    out = wp.vec4(0.0, 0.0, 0.0, -1.0e9)
    for i in range(obstacles.first_plane[k], obstacles.first_plane[k + 1]):
        plane = obstacles.planes[i]
        value = plane[0] * x[0] + plane[1] * x[1] + plane[2] * x[2] - plane[3]
        if value > out[3]:
            out = wp.vec4(plane[0], plane[1], plane[2], value)
    return out


@wp.func
def convex_distance(pieces: Pieces, piece: wp.int32, obstacles: Obstacles, k: wp.int32, x: wp.vec3):
    """Return (gradient, signed distance) at x of a piece, in its frame; of obstacle k if `piece` is -1."""
    if piece >= 0:
        return piece_distance(pieces, piece, x)
    return farthest_plane(obstacles, k, x)


@wp.func
def least_on_edge(
    pieces: Pieces, piece: wp.int32, obstacles: Obstacles, k: wp.int32, a: wp.vec3, b: wp.vec3, limit: wp.float32
):
    """Return the place on edge a-b nearest to a piece, or deepest in an obstacle (`convex_distance`).
    A value of at least `limit` means that no place is nearer than `limit`."""
    along = b - a
    at0 = convex_distance(pieces, piece, obstacles, k, a)
    at1 = convex_distance(pieces, piece, obstacles, k, b)
    n0 = wp.vec3(at0[0], at0[1], at0[2])
    n1 = wp.vec3(at1[0], at1[1], at1[2])
    f0 = at0[3]
    f1 = at1[3]
    t0 = float(0.0)
    t1 = float(1.0)
    out = EdgeMinimum()
    if wp.dot(n0, along) >= 0.0:
        out.value = f0
        out.gradient = n0
        return out
    if wp.dot(n1, along) <= 0.0:
        out.t = 1.0
        out.value = f1
        out.gradient = n1
        return out
    for _look in range(LOOKS):
        g0 = wp.dot(n0, along)
        g1 = wp.dot(n1, along)
        t = tangent_intersection(t0, f0, g0, t1, f1, g1)
        if f0 + g0 * (t - t0) >= wp.min(limit, wp.min(f0, f1) - EXACT):
            break
        at = convex_distance(pieces, piece, obstacles, k, a + t * along)
        n = wp.vec3(at[0], at[1], at[2])
        if wp.dot(n, along) > 0.0:
            t1 = t
            f1 = at[3]
            n1 = n
        else:
            t0 = t
            f0 = at[3]
            n0 = n
            if wp.dot(n, along) == 0.0:
                break
    out.t = t1
    out.value = f1
    if f0 < f1:
        out.t = t0
        out.value = f0
    out.gradient = edge_gradient(n0, wp.dot(n0, along), n1, wp.dot(n1, along))
    return out


@wp.func
def is_in_obstacle(obstacles: Obstacles, k: wp.int32, x: wp.vec3):
    """Check whether x lies on obstacle k, or in it."""
    for i in range(obstacles.first_plane[k], obstacles.first_plane[k + 1]):
        plane = obstacles.planes[i]
        if wp.dot(wp.vec3(plane[0], plane[1], plane[2]), x) - plane[3] > ON_FACE:
            return False
    return True


@wp.func
def is_apart(pieces: Pieces, obstacles: Obstacles, hands: Hands, b: int, piece: int, k: int, reach: float):
    """Check whether the bounding spheres of a piece and an obstacle are farther than `reach` apart."""
    offset = piece_centre(pieces, piece, b, hands.body_p, hands.body_q) - obstacles.centre[k]
    r = obstacles.radius[k] + wp.length(pieces.half[piece]) + wp.max(reach, 0.0)
    return wp.dot(offset, offset) > r * r


@wp.func
def nearest_edge(
    features: Features,
    pieces: Pieces,
    obstacles: Obstacles,
    hands: Hands,
    b: int,
    piece: int,
    k: int,
    limit: wp.float32,
):
    """Return the edge of obstacle k nearest to a piece, or the piece's deepest edge in the obstacle."""
    out = NearestObstacle()
    out.distance = limit
    q = piece_rotation(pieces, piece, b, hands.body_q)
    p = piece_centre(pieces, piece, b, hands.body_p, hands.body_q)
    for e in range(obstacles.first_edge[k], obstacles.first_edge[k + 1]):
        start = obstacles.start[e]
        end = obstacles.end[e]
        local_start = wp.quat_rotate_inv(q, start - p)
        local_end = wp.quat_rotate_inv(q, end - p)
        found = least_on_edge(pieces, piece, obstacles, k, local_start, local_end, out.distance)
        if found.value < out.distance:
            out.distance = found.value
            out.point = start + found.t * (end - start)
            out.direction = -wp.quat_rotate(q, found.gradient)
    body = pieces.body[piece]
    for e in range(features.first_edge[piece], features.first_edge[piece + 1]):
        start = hands.body_p[b, body] + wp.quat_rotate(hands.body_q[b, body], features.start[e])
        end = hands.body_p[b, body] + wp.quat_rotate(hands.body_q[b, body], features.end[e])
        thickness = features.thickness[e]
        # Obstacle edges and link features give the distance of separate bodies, so only penetration counts here.
        deepest = least_on_edge(pieces, -1, obstacles, k, start, end, wp.min(out.distance, 0.0) + thickness)
        if deepest.value - thickness < wp.min(out.distance, 0.0):
            out.distance = deepest.value - thickness
            out.point = start + deepest.t * (end - start)
            out.direction = deepest.gradient
    return out


@wp.kernel
def penalty(
    features_in: Features,
    pieces_in: Pieces,
    obstacles_in: Obstacles,
    weight_in: wp.array(dtype=wp.float32),
    room_in: wp.float32,
    hands_inout: Hands,
    depth_inout: wp.array(dtype=wp.float32),
):
    """Add the gradient of w sum min(d - margin - room, 0)^2 of features and edges. Launch over (B, P)."""
    b, piece = wp.tid()
    hands = hands_inout
    if hands.active[b] == 0 or hands.scene[b] < 0 or features_in.first[piece] == features_in.first[piece + 1]:
        return
    body = pieces_in.body[piece]
    first = features_in.first[piece]
    weight = 2.0 * weight_in[hands.iteration[0]]
    for k in range(obstacles_in.first_solid[hands.scene[b]], obstacles_in.first[hands.scene[b] + 1]):
        keep = required_clearance(features_in, obstacles_in, first, k, room_in)
        if is_apart(pieces_in, obstacles_in, hands, b, piece, k, keep):
            continue
        for i in range(first, features_in.first[piece + 1]):
            f = posed_feature(features_in, hands, i, b)
            nd = obstacle_distance(obstacles_in, k, f)
            short = nd[3] - keep
            if short < 0.0:
                n = wp.vec3(nd[0], nd[1], nd[2])
                force = (weight * short) * n
                add_wrench(hands.wrench, b, body, force, wp.cross(lowest_point(f, n), force))
                wp.atomic_max(depth_inout, b, -short)
        near = nearest_edge(features_in, pieces_in, obstacles_in, hands, b, piece, k, keep)
        short = near.distance - keep
        if short < 0.0:
            force = (weight * short) * near.direction
            add_wrench(hands.wrench, b, body, force, wp.cross(near.point, force))
            wp.atomic_max(depth_inout, b, -short)


@wp.kernel
def residuals(
    features_in: Features,
    pieces_in: Pieces,
    obstacles_in: Obstacles,
    hands_in: Hands,
    near_in: wp.float32,
    target_in: wp.float32,
    residuals_out: Residuals,
):
    """Emit residuals that move features and edges near solids to margin + target. Launch over (B, P)."""
    b, piece = wp.tid()
    hands = hands_in
    if hands.active[b] == 0 or hands.scene[b] < 0 or features_in.first[piece] == features_in.first[piece + 1]:
        return
    body = pieces_in.body[piece]
    first = features_in.first[piece]
    for k in range(obstacles_in.first_solid[hands.scene[b]], obstacles_in.first[hands.scene[b] + 1]):
        margin = required_clearance(features_in, obstacles_in, first, k, 0.0)
        keep = margin + near_in
        target = margin + target_in
        if is_apart(pieces_in, obstacles_in, hands, b, piece, k, keep):
            continue
        for i in range(first, features_in.first[piece + 1]):
            f = posed_feature(features_in, hands, i, b)
            nd = obstacle_distance(obstacles_in, k, f)
            if nd[3] < keep:
                n = wp.vec3(nd[0], nd[1], nd[2])
                emit_residual(residuals_out, b, body, -1, lowest_point(f, n), n, nd[3] - target, 1.0)
        near = nearest_edge(features_in, pieces_in, obstacles_in, hands, b, piece, k, keep)
        if near.distance < keep:
            emit_residual(residuals_out, b, body, -1, near.point, near.direction, near.distance - target, 1.0)


@wp.kernel
def distances(
    features_in: Features,
    pieces_in: Pieces,
    obstacles_in: Obstacles,
    hands_in: Hands,
    reach_in: wp.float32,
    distance_inout: wp.array2d(dtype=wp.float32),
):
    """Compute the least distance (B, L) of each body from the solids of scene 0, at most `reach`.
    A feature that is not above a face is skipped: an edge of the obstacle is nearer to the link. Launch over (B, P)."""
    b, piece = wp.tid()
    body = pieces_in.body[piece]
    least = reach_in
    for k in range(obstacles_in.first_solid[0], obstacles_in.first[1]):
        if is_apart(pieces_in, obstacles_in, hands_in, b, piece, k, least):
            continue
        for i in range(features_in.first[piece], features_in.first[piece + 1]):
            f = posed_feature(features_in, hands_in, i, b)
            nd = obstacle_distance(obstacles_in, k, f)
            if nd[3] < least:
                n = wp.vec3(nd[0], nd[1], nd[2])
                if is_in_obstacle(obstacles_in, k, lowest_point(f, n) - nd[3] * n):
                    least = nd[3]
        near = nearest_edge(features_in, pieces_in, obstacles_in, hands_in, b, piece, k, least)
        least = wp.min(least, near.distance)
    wp.atomic_min(distance_inout, b, body, least)

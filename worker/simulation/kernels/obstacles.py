"""Hands against the obstacles of their scene: distances, penalties, residuals.

The hand is represented by features: balls (corners of boxes and hulls, spheres, ends of capsules) and rims of
cylinders. Their distances from half-spaces are exact; for solids see `solids`."""

import warp as wp

from graspd.worker.simulation.kernels.kinematics import Hands
from graspd.worker.simulation.kernels.projection import Residuals, emit_residual
from graspd.worker.simulation.kernels.wrenches import add_wrench

wp.set_module_options({"enable_backward": False})

#: Share of `room` that fingertips keep from obstacles that have another clearance for fingertips (`tips`).
TIP_ROOM = wp.constant(wp.float32(0.25))


@wp.struct
class Features:
    """F balls (axis zero) and rims (circles about an axis) fixed to bodies, and E edges of the P pieces."""

    body: wp.array(dtype=wp.int32)
    centre: wp.array(dtype=wp.vec3)  # body frame
    axis: wp.array(dtype=wp.vec3)  # body frame; zero for a ball
    radius: wp.array(dtype=wp.float32)
    margin: wp.array(dtype=wp.float32)  # clearance [m]; negative if it may penetrate
    tip: wp.array(dtype=wp.int32)  # 1 for fingertips
    first: wp.array(dtype=wp.int32)  # (P + 1,) first feature of each piece
    middle: wp.array(dtype=wp.vec3)  # (P,) centre of a ball around the features of a piece, body frame
    extent: wp.array(dtype=wp.float32)  # (P,) radius of this ball [m]
    first_edge: wp.array(dtype=wp.int32)  # (P + 1,) first edge of each piece
    start: wp.array(dtype=wp.vec3)  # (E,) ends of an edge, body frame
    end: wp.array(dtype=wp.vec3)
    thickness: wp.array(dtype=wp.float32)  # (E,) radius around the edge [m]


@wp.struct
class Feature:
    """A placed feature."""

    body: wp.int32
    centre: wp.vec3
    axis: wp.vec3
    radius: wp.float32


@wp.struct
class Obstacles:
    """Convex obstacles, scene by scene, half-spaces first. Scene number -1 has no obstacles."""

    first: wp.array(dtype=wp.int32)  # (S + 1,) first obstacle of each scene
    first_solid: wp.array(dtype=wp.int32)  # (S,) first obstacle with corners
    first_plane: wp.array(dtype=wp.int32)  # (O + 1,) first plane of each obstacle
    planes: wp.array(dtype=wp.vec4)  # outward unit normal and offset
    tips: wp.array(dtype=wp.float32)  # (O,) clearance of fingertips, if less than their margin [m]
    centre: wp.array(dtype=wp.vec3)  # (O,) bounding sphere
    radius: wp.array(dtype=wp.float32)  # (O,)
    first_edge: wp.array(dtype=wp.int32)  # (O + 1,)
    start: wp.array(dtype=wp.vec3)  # ends of an edge
    end: wp.array(dtype=wp.vec3)


@wp.func
def posed_feature(features: Features, hands: Hands, i: wp.int32, b: wp.int32):
    """Return feature i of hand b in the frame of the hand's bodies."""
    out = Feature()
    out.body = features.body[i]
    rotation = hands.body_q[b, out.body]
    out.centre = hands.body_p[b, out.body] + wp.quat_rotate(rotation, features.centre[i])
    out.axis = wp.quat_rotate(rotation, features.axis[i])
    out.radius = features.radius[i]
    return out


@wp.func
def feature_extent(f: Feature, n: wp.vec3):
    """Return the extent of a feature from its centre towards -n."""
    along = wp.dot(f.axis, n)
    if wp.dot(f.axis, f.axis) > 0.5:
        return f.radius * wp.sqrt(wp.max(0.0, 1.0 - along * along))
    return f.radius


@wp.func
def lowest_point(f: Feature, n: wp.vec3):
    """Return the feature's point that is farthest along -n."""
    way = n
    if wp.dot(f.axis, f.axis) > 0.5:
        way = n - wp.dot(f.axis, n) * f.axis
        length = wp.length(way)
        if length < 1.0e-9:
            return f.centre
        way = way / length
    return f.centre - f.radius * way


@wp.func
def obstacle_distance(obstacles: Obstacles, k: wp.int32, f: Feature):
    """Return (normal, distance) of a feature from obstacle k: the largest of its planes' distances."""
    d = float(-1.0e9)
    n = wp.vec3(0.0, 0.0, 1.0)
    for i in range(obstacles.first_plane[k], obstacles.first_plane[k + 1]):
        plane = obstacles.planes[i]
        normal = wp.vec3(plane[0], plane[1], plane[2])
        value = wp.dot(normal, f.centre) - plane[3] - feature_extent(f, normal)
        if value > d:
            d = value
            n = normal
    return wp.vec4(n[0], n[1], n[2], d)


@wp.func
def required_clearance(features: Features, obstacles: Obstacles, i: wp.int32, k: wp.int32, room: wp.float32):
    """Return the required clearance of feature i from obstacle k, plus `room` [m]."""
    out = features.margin[i] + room
    if features.tip[i] != 0:
        out = wp.min(out, obstacles.tips[k] + TIP_ROOM * room)
    return out


@wp.func
def is_near(features: Features, obstacles: Obstacles, hands: Hands, b: int, piece: int, more: float, room: float):
    """Check whether the ball around a piece is closer to a half-space than its clearance plus `more`."""
    if features.first[piece] == features.first[piece + 1]:
        return False
    i = features.first[piece]
    body = features.body[i]
    middle = hands.body_p[b, body] + wp.quat_rotate(hands.body_q[b, body], features.middle[piece])
    scene = hands.scene[b]
    for k in range(obstacles.first[scene], obstacles.first_solid[scene]):
        beyond = float(-1.0e9)
        for p in range(obstacles.first_plane[k], obstacles.first_plane[k + 1]):
            plane = obstacles.planes[p]
            beyond = wp.max(beyond, wp.dot(wp.vec3(plane[0], plane[1], plane[2]), middle) - plane[3])
        if beyond - features.extent[piece] < required_clearance(features, obstacles, i, k, room) + more:
            return True
    return False


@wp.kernel
def penalty(
    features_in: Features,
    obstacles_in: Obstacles,
    weight_in: wp.array(dtype=wp.float32),
    room_in: wp.float32,
    hands_inout: Hands,
    depth_inout: wp.array(dtype=wp.float32),
):
    """Add the gradient of w sum min(h_i - margin_i - room, 0)^2 over features i and half-spaces.
    Record the deepest shortfall. Launch over (B, P)."""
    b, piece = wp.tid()
    hands = hands_inout
    if hands.active[b] == 0 or hands.scene[b] < 0:
        return
    if not is_near(features_in, obstacles_in, hands, b, piece, 0.0, room_in):
        return
    for i in range(features_in.first[piece], features_in.first[piece + 1]):
        f = posed_feature(features_in, hands, i, b)
        weight = 2.0 * weight_in[hands.iteration[0]]
        for k in range(obstacles_in.first[hands.scene[b]], obstacles_in.first_solid[hands.scene[b]]):
            nd = obstacle_distance(obstacles_in, k, f)
            short = nd[3] - required_clearance(features_in, obstacles_in, i, k, room_in)
            if short < 0.0:
                n = wp.vec3(nd[0], nd[1], nd[2])
                if weight != 0.0:
                    force = (weight * short) * n
                    add_wrench(hands.wrench, b, f.body, force, wp.cross(lowest_point(f, n), force))
                wp.atomic_max(depth_inout, b, -short)


@wp.kernel
def residuals(
    features_in: Features,
    obstacles_in: Obstacles,
    hands_in: Hands,
    near_in: wp.float32,
    target_in: wp.float32,
    residuals_out: Residuals,
):
    """Emit residuals that move features near half-spaces to margin + target. Launch over (B, P)."""
    b, piece = wp.tid()
    hands = hands_in
    if hands.active[b] == 0 or hands.scene[b] < 0:
        return
    if not is_near(features_in, obstacles_in, hands, b, piece, near_in, 0.0):
        return
    for i in range(features_in.first[piece], features_in.first[piece + 1]):
        f = posed_feature(features_in, hands, i, b)
        for k in range(obstacles_in.first[hands.scene[b]], obstacles_in.first_solid[hands.scene[b]]):
            nd = obstacle_distance(obstacles_in, k, f)
            margin = required_clearance(features_in, obstacles_in, i, k, 0.0)
            if nd[3] < margin + near_in:
                n = wp.vec3(nd[0], nd[1], nd[2])
                gap = nd[3] - margin - target_in
                emit_residual(residuals_out, b, f.body, -1, lowest_point(f, n), n, gap, 1.0)

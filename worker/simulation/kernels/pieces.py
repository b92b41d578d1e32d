"""Signed distance to the hand's convex pieces, and its penalties: object in links, links in links.
A thin part of an object may pass unseen between hand points, but not through a piece."""

import warp as wp

from graspd.worker.simulation.kernels.kinematics import Hands
from graspd.worker.simulation.kernels.wrenches import add_wrench

wp.set_module_options({"enable_backward": False})

BOX = wp.constant(0)
SPHERE = wp.constant(1)
CYLINDER = wp.constant(2)
CAPSULE = wp.constant(3)
HULL = wp.constant(4)

vec6i = wp.types.vector(length=6, dtype=wp.int32)


@wp.struct
class Pieces:
    """P convex pieces on the device."""

    body: wp.array(dtype=wp.int32)
    kind: wp.array(dtype=wp.int32)
    size: wp.array(dtype=wp.vec3)  # box: half extents; sphere: r; cylinder, capsule: r, half length
    pose_p: wp.array(dtype=wp.vec3)  # frame of the piece in the body frame; origin: centre of its box
    pose_q: wp.array(dtype=wp.quat)
    half: wp.array(dtype=wp.vec3)  # half extents of the bounding box in the piece's frame
    first_plane: wp.array(dtype=wp.int32)
    planes: wp.array(dtype=wp.vec4)  # outward unit normal and offset: n.x = d on the face, piece frame
    apart: wp.array2d(dtype=wp.int32)  # (L, L): 1 where contact of two bodies counts


@wp.func
def piece_distance(pieces: Pieces, piece: wp.int32, x: wp.vec3):
    """Return (gradient, signed distance) at x (piece frame); outside a hull a lower bound of the distance."""
    kind = pieces.kind[piece]
    size = pieces.size[piece]
    n = wp.vec3(1.0, 0.0, 0.0)
    d = float(0.0)
    if kind == BOX:
        a = wp.vec3(wp.abs(x[0]) - size[0], wp.abs(x[1]) - size[1], wp.abs(x[2]) - size[2])
        outside = wp.vec3(wp.max(a[0], 0.0), wp.max(a[1], 0.0), wp.max(a[2], 0.0))
        d = wp.length(outside)
        if d > 0.0:
            n = wp.vec3(outside[0] * wp.sign(x[0]), outside[1] * wp.sign(x[1]), outside[2] * wp.sign(x[2])) / d
        elif a[0] >= a[1] and a[0] >= a[2]:
            d = a[0]
            n = wp.vec3(wp.sign(x[0]), 0.0, 0.0)
        elif a[1] >= a[2]:
            d = a[1]
            n = wp.vec3(0.0, wp.sign(x[1]), 0.0)
        else:
            d = a[2]
            n = wp.vec3(0.0, 0.0, wp.sign(x[2]))
    elif kind == SPHERE:
        length = wp.length(x)
        d = length - size[0]
        if length > 1.0e-9:
            n = x / length
    elif kind == CAPSULE:
        radial_part = wp.vec3(x[0], x[1], x[2] - wp.clamp(x[2], -size[1], size[1]))
        from_axis = wp.length(radial_part)
        d = from_axis - size[0]
        if from_axis > 1.0e-9:
            n = radial_part / from_axis
    elif kind == CYLINDER:
        radial = wp.sqrt(x[0] * x[0] + x[1] * x[1])
        side = wp.vec3(1.0, 0.0, 0.0)
        if radial > 1.0e-9:
            side = wp.vec3(x[0] / radial, x[1] / radial, 0.0)
        cap = wp.vec3(0.0, 0.0, wp.sign(x[2]))
        beside = radial - size[0]
        beyond = wp.abs(x[2]) - size[1]
        if beside > 0.0 and beyond > 0.0:
            d = wp.sqrt(beside * beside + beyond * beyond)
            n = (beside * side + beyond * cap) / d
        elif beside > beyond:
            d = beside
            n = side
        else:
            d = beyond
            n = cap
    else:
        d = float(-1.0e9)
        for k in range(pieces.first_plane[piece], pieces.first_plane[piece + 1]):
            plane = pieces.planes[k]
            normal = wp.vec3(plane[0], plane[1], plane[2])
            value = wp.dot(normal, x) - plane[3]
            if value > d:
                d = value
                n = normal
    return wp.vec4(n[0], n[1], n[2], d)


@wp.func
def piece_rotation(pieces: Pieces, piece: wp.int32, b: wp.int32, body_q: wp.array2d(dtype=wp.quat)):
    """Return the rotation of a piece's frame in the object's."""
    return body_q[b, pieces.body[piece]] * pieces.pose_q[piece]


@wp.func
def piece_centre(
    pieces: Pieces, piece: wp.int32, b: wp.int32, body_p: wp.array2d(dtype=wp.vec3), body_q: wp.array2d(dtype=wp.quat)
):
    """Return the origin of a piece's frame in the object's."""
    body = pieces.body[piece]
    return body_p[b, body] + wp.quat_rotate(body_q[b, body], pieces.pose_p[piece])


@wp.func
def in_box(x: wp.vec3, half: wp.vec3):
    """Check whether x lies strictly inside the box of these half extents about the origin."""
    return wp.abs(x[0]) < half[0] and wp.abs(x[1]) < half[1] and wp.abs(x[2]) < half[2]


@wp.func
def world_extent(turn: wp.mat33, half: wp.vec3):
    """Return half extents along the world's axes of a box turned by a matrix."""
    return wp.vec3(
        wp.abs(turn[0, 0]) * half[0] + wp.abs(turn[0, 1]) * half[1] + wp.abs(turn[0, 2]) * half[2],
        wp.abs(turn[1, 0]) * half[0] + wp.abs(turn[1, 1]) * half[1] + wp.abs(turn[1, 2]) * half[2],
        wp.abs(turn[2, 0]) * half[0] + wp.abs(turn[2, 1]) * half[1] + wp.abs(turn[2, 2]) * half[2],
    )


@wp.struct
class Samples:
    """Points on the object's surface, sorted by the cells of a grid, z changing fastest."""

    position: wp.array(dtype=wp.vec3)
    first: wp.array(dtype=wp.int32)  # (cells + 1,)
    low: wp.vec3
    size: wp.float32
    shape: wp.vec3i


@wp.func
def cell_range(low: wp.float32, high: wp.float32, origin: wp.float32, size: wp.float32, count: wp.int32):
    """Return first and last of `count` cells along an axis that an interval meets; first > last if none."""
    a = int(wp.floor((low - origin) / size))
    b = int(wp.floor((high - origin) / size))
    return wp.vec2i(wp.max(a, 0), wp.min(b, count - 1))


@wp.func
def cells_around(samples: Samples, p: wp.vec3, extent: wp.vec3):
    """Return first and last cells along x, y, z that a box about p meets; first > last if there are none."""
    low = samples.low
    size = samples.size
    shape = samples.shape
    xs = cell_range(p[0] - extent[0], p[0] + extent[0], low[0], size, shape[0])
    ys = cell_range(p[1] - extent[1], p[1] + extent[1], low[1], size, shape[1])
    zs = cell_range(p[2] - extent[2], p[2] + extent[2], low[2], size, shape[2])
    if xs[0] > xs[1] or ys[0] > ys[1] or zs[0] > zs[1]:
        return vec6i(0, -1, 0, -1, 0, -1)
    return vec6i(xs[0], xs[1], ys[0], ys[1], zs[0], zs[1])


@wp.func
def sample_range(samples: Samples, i: wp.int32, j: wp.int32, first: wp.int32, last: wp.int32):
    """Return the first sample in a run of cells along z, and the first sample after the run."""
    row = (i * samples.shape[1] + j) * samples.shape[2]
    return wp.vec2i(samples.first[row + first], samples.first[row + last + 1])


@wp.func
def bounded_piece_distance(pieces: Pieces, piece: wp.int32, x: wp.vec3, above: wp.float32):
    """Return `piece_distance`; if it exceeds `above`, the result may be any distance that does."""
    if pieces.kind[piece] != HULL:
        return piece_distance(pieces, piece, x)
    d = float(-1.0e9)
    best = pieces.first_plane[piece]
    for k in range(pieces.first_plane[piece], pieces.first_plane[piece + 1]):
        plane = pieces.planes[k]
        value = plane[0] * x[0] + plane[1] * x[1] + plane[2] * x[2] - plane[3]
        if value > d:
            d = value
            best = k
            if d > above:
                break
    plane = pieces.planes[best]
    return wp.vec4(plane[0], plane[1], plane[2], d)


@wp.kernel
def object_in_pieces(
    pieces_in: Pieces,
    samples_in: Samples,
    sample_weight_in: wp.float32,
    weight_in: wp.array(dtype=wp.float32),
    hands_inout: Hands,
    depth_inout: wp.array(dtype=wp.float32),
):
    """Add the gradient of w sum depth^2 over object samples in a piece, and the depth. Launch over (B, P).
    A motion of the body along n deepens samples below the face with outward normal n: the gradient is 2 w depth n."""
    b, piece = wp.tid()
    if hands_inout.active[b] == 0:
        return
    body = pieces_in.body[piece]
    q = piece_rotation(pieces_in, piece, b, hands_inout.body_q)
    p = piece_centre(pieces_in, piece, b, hands_inout.body_p, hands_inout.body_q)
    half = pieces_in.half[piece]
    turn = wp.quat_to_matrix(q)
    weight = 2.0 * sample_weight_in * weight_in[hands_inout.iteration[0]]
    force = wp.vec3(0.0)
    torque = wp.vec3(0.0)
    deepest = float(0.0)
    cells = cells_around(samples_in, p, world_extent(turn, half))
    for i in range(cells[0], cells[1] + 1):
        for j in range(cells[2], cells[3] + 1):
            mine = sample_range(samples_in, i, j, cells[4], cells[5])
            for index in range(mine[0], mine[1]):
                x = samples_in.position[index]
                offset = x - p
                local = wp.vec3(
                    turn[0, 0] * offset[0] + turn[1, 0] * offset[1] + turn[2, 0] * offset[2],
                    turn[0, 1] * offset[0] + turn[1, 1] * offset[1] + turn[2, 1] * offset[2],
                    turn[0, 2] * offset[0] + turn[1, 2] * offset[1] + turn[2, 2] * offset[2],
                )
                if in_box(local, half):
                    nd = bounded_piece_distance(pieces_in, piece, local, 0.0)
                    depth = -nd[3]
                    if depth > 0.0:
                        n = turn * wp.vec3(nd[0], nd[1], nd[2])
                        f = (weight * depth) * n
                        force += f
                        torque += wp.cross(x, f)
                        deepest = wp.max(deepest, depth)
    if deepest > 0.0:
        add_wrench(hands_inout.wrench, b, body, force, torque)
        wp.atomic_max(depth_inout, b, deepest)


@wp.struct
class BodyPoints:
    """Dense surface points sorted by body, with a bounding sphere for each body's set."""

    first: wp.array(dtype=wp.int32)  # (L + 1,)
    position: wp.array(dtype=wp.vec3)  # body frame
    centre: wp.array(dtype=wp.vec3)  # (L,)
    radius: wp.array(dtype=wp.float32)  # (L,)
    extent: wp.array(dtype=wp.float32)  # (L,) greatest distance from the body's origin


@wp.func
def may_touch(
    pieces: Pieces,
    points: BodyPoints,
    other: wp.int32,
    centre: wp.vec3,
    reach: wp.float32,
    own: wp.int32,
    b: wp.int32,
    body_p: wp.array2d(dtype=wp.vec3),
    body_q: wp.array2d(dtype=wp.quat),
):
    """Check whether points of body `own` may be within `reach` of a piece of `other` with this `centre`."""
    if pieces.apart[own, other] == 0 or points.first[own] == points.first[own + 1]:
        return False
    offset = body_p[b, own] - centre
    about = reach + points.extent[own]
    if wp.dot(offset, offset) >= about * about:
        return False
    offset += wp.quat_rotate(body_q[b, own], points.centre[own])
    reach += points.radius[own]
    return wp.dot(offset, offset) < reach * reach


@wp.kernel
def pieces_in_pieces(
    pieces_in: Pieces,
    points_in: BodyPoints,
    point_weight_in: wp.float32,
    margin_in: wp.float32,
    weight_in: wp.array(dtype=wp.float32),
    hands_inout: Hands,
    depth_inout: wp.array(dtype=wp.float32),
):
    """Add the gradient of w sum (depth + margin)^2 over hand points inside pieces of other bodies.
    Launch over (B, P)."""
    b, piece = wp.tid()
    if hands_inout.active[b] == 0:
        return
    other = pieces_in.body[piece]
    q = piece_rotation(pieces_in, piece, b, hands_inout.body_q)
    p = piece_centre(pieces_in, piece, b, hands_inout.body_p, hands_inout.body_q)
    weight = 2.0 * point_weight_in * weight_in[hands_inout.iteration[0]]
    half = pieces_in.half[piece] + wp.vec3(margin_in, margin_in, margin_in)
    reach = wp.length(pieces_in.half[piece]) + margin_in
    for own in range(hands_inout.body_p.shape[1]):
        if may_touch(pieces_in, points_in, other, p, reach, own, b, hands_inout.body_p, hands_inout.body_q):
            # Transform from the body's frame straight into the piece's.
            turn = wp.quat_to_matrix(wp.quat_inverse(q) * hands_inout.body_q[b, own])
            shift = wp.quat_rotate_inv(q, hands_inout.body_p[b, own] - p)
            force = wp.vec3(0.0)
            torque = wp.vec3(0.0)
            deepest = float(0.0)
            touched = wp.int32(0)
            for i in range(points_in.first[own], points_in.first[own + 1]):
                local = turn * points_in.position[i] + shift
                if in_box(local, half):
                    nd = bounded_piece_distance(pieces_in, piece, local, margin_in)
                    depth = margin_in - nd[3]
                    if depth > 0.0:
                        f = (weight * depth) * wp.vec3(nd[0], nd[1], nd[2])
                        force += f
                        torque += wp.cross(local, f)
                        deepest = wp.max(deepest, -nd[3])
                        touched = 1
            if touched == 1:
                f = wp.quat_rotate(q, force)
                # The sum was about the piece's origin; the wrench is about the object's.
                t = wp.quat_rotate(q, torque) + wp.cross(p, f)
                add_wrench(hands_inout.wrench, b, other, f, t)
                add_wrench(hands_inout.wrench, b, own, -f, -t)
                wp.atomic_max(depth_inout, b, deepest)

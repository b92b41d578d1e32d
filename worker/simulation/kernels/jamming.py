"""Jams of opening fingers, held back by other links, and the retreat of open hands still in contact."""

import warp as wp

from graspd.worker.simulation.kernels.chain import Bodies, Chain, joint_value, place_body
from graspd.worker.simulation.kernels.distance import BodyPoints, Skin, nearest, posed_point
from graspd.worker.simulation.kernels.opening import Fingers, Hands
from graspd.worker.simulation.kernels.pieces import Pieces, piece_distance
from graspd.worker.simulation.kernels.touching import Points, point_of

wp.set_module_options({"enable_backward": False, "max_unroll": 0})


@wp.struct
class FingerJams:
    """Fingers held back where they would jam: B hands, F fingers."""

    going: wp.array(dtype=wp.int32)  # (B,)
    share: wp.array2d(dtype=wp.float64)  # (B, F) share of its path that each finger moves
    limit: wp.array2d(dtype=wp.float32)  # (B, F) allowed depth
    depth: wp.array2d(dtype=wp.float32)  # (B, F) greatest depth on the path
    blocked: wp.array2d(dtype=wp.int32)  # (B, F) 1 if blocked by something else


@wp.func
def path_displacement(
    fingers: Fingers, hands: Hands, jams: FingerJams, open: wp.array2d(dtype=wp.float64), b: wp.int32, d: wp.int32
):
    """Return the displacement of a dof from the grasp."""
    move = open[b, d] - hands.q[b, d]
    finger = fingers.of_dof[d]
    if finger >= 0:
        move = move * jams.share[b, finger]
    return move


@wp.kernel
def place_on_path(
    chain_in: Chain,
    fingers_in: Fingers,
    hands_in: Hands,
    jams_in: FingerJams,
    open_in: wp.array2d(dtype=wp.float64),
    way_in: wp.float64,
    bodies_out: Bodies,
):
    """Place bodies of hands at the share `way` of their paths. Launch over B."""
    b = wp.tid()
    if jams_in.going[b] == 0:
        return
    bodies_out.position[b, 0] = hands_in.position[b]
    bodies_out.rotation[b, 0] = hands_in.rotation[b]
    for body in range(1, chain_in.parent.shape[0]):
        d = chain_in.dof[body]
        q = hands_in.q[b, d] + way_in * path_displacement(fingers_in, hands_in, jams_in, open_in, b, d)
        place_body(chain_in, bodies_out, b, body, joint_value(chain_in, body, q))


@wp.func
def record_depth(fingers: Fingers, depth: wp.array2d(dtype=wp.float32), b: wp.int32, body: wp.int32, deep: wp.float32):
    if fingers.of_body[body] >= 0:
        wp.atomic_max(depth, b, fingers.of_body[body], deep)


@wp.kernel
def finger_depth(
    pieces_in: Pieces,
    points_in: BodyPoints,
    fingers_in: Fingers,
    bodies_in: Bodies,
    piece_p_in: wp.array2d(dtype=wp.vec3),
    piece_q_in: wp.array2d(dtype=wp.quat),
    jams_inout: FingerJams,
):
    """Compute each finger's greatest depth in the rest of the hand, or vice versa. Launch over (B, L)."""
    b, body = wp.tid()
    if jams_inout.going[b] == 0 or points_in.first[body] == points_in.first[body + 1]:
        return
    place, turned = bodies_in.position[b, body], bodies_in.rotation[b, body]
    middle = posed_point(wp.vec3d(), place, turned, points_in.middle[body])
    for piece in range(pieces_in.body.shape[0]):
        other = pieces_in.body[piece]
        if pieces_in.apart[body, other] == 1:
            centre = piece_p_in[b, piece]
            bound = wp.length(pieces_in.half[piece])
            about = bound + points_in.extent[body]
            if wp.length_sq(middle - centre) < about * about:
                deepest = float(0.0)
                for i in range(points_in.first[body], points_in.first[body + 1]):
                    offset = posed_point(wp.vec3d(), place, turned, points_in.position[i]) - centre
                    if wp.dot(offset, offset) < bound * bound:
                        nd = piece_distance(pieces_in, piece, wp.quat_rotate_inv(piece_q_in[b, piece], offset))
                        deepest = wp.max(deepest, -nd[3])
                if deepest > 0.0:
                    record_depth(fingers_in, jams_inout.depth, b, body, deepest)
                    record_depth(fingers_in, jams_inout.depth, b, other, deepest)


@wp.kernel
def limit_depth(more_in: wp.float32, jams_inout: FingerJams):
    """Set the limit to the depth in the grasp plus `more`; reset depths. Launch over B."""
    b = wp.tid()
    for f in range(jams_inout.share.shape[1]):
        jams_inout.limit[b, f] = jams_inout.depth[b, f] + more_in
        jams_inout.depth[b, f] = 0.0


@wp.kernel
def shorten_paths(less_in: wp.float64, jams_inout: FingerJams):
    """Multiply paths of jammed fingers by `less`, finish hands without jams, reset depths. Launch over B."""
    b = wp.tid()
    if jams_inout.going[b] == 0:
        return
    going = wp.int32(0)
    for f in range(jams_inout.share.shape[1]):
        if jams_inout.depth[b, f] > jams_inout.limit[b, f] or jams_inout.blocked[b, f] == 1:
            jams_inout.share[b, f] = less_in * jams_inout.share[b, f]
            going = 1
        jams_inout.depth[b, f] = 0.0
    jams_inout.going[b] = going


@wp.kernel
def write_path(fingers_in: Fingers, hands_in: Hands, jams_in: FingerJams, open_inout: wp.array2d(dtype=wp.float64)):
    """Write the dofs at the ends of the shortened paths. Launch over (B, D)."""
    b, d = wp.tid()
    open_inout[b, d] = hands_in.q[b, d] + path_displacement(fingers_in, hands_in, jams_in, open_inout, b, d)


@wp.struct
class Retreat:
    """Retreat of B open hands against their palms' approach."""

    going: wp.array(dtype=wp.int32)  # (B,)
    clear: wp.array(dtype=wp.float32)
    best: wp.array(dtype=wp.float32)
    chosen: wp.array(dtype=wp.int32)


@wp.kernel
def hand_clearance(
    skin_in: Skin,
    points_in: Points,
    lane_in: wp.int32,
    approach_in: wp.vec3d,
    wanted_in: wp.float32,
    back_in: wp.float64,
    bodies_in: Bodies,
    retreat_inout: Retreat,
):
    """Compute least distances of hands moved `back` against the approach. Launch over (B, N / lane)."""
    b, part = wp.tid()
    if retreat_inout.going[b] == 0:
        return
    shift = back_in * wp.quat_rotate(bodies_in.rotation[b, 0], approach_in)
    for i in range(part * lane_in, wp.min((part + 1) * lane_in, points_in.body.shape[0])):
        found = nearest(skin_in, wp.vec3(point_of(points_in, bodies_in, b, i) - shift), wanted_in)
        if found.distance < wanted_in:
            wp.atomic_min(retreat_inout.clear, b, found.distance)


@wp.kernel
def select_retreat(wanted_in: wp.float32, step_in: wp.int32, retreat_inout: Retreat):
    """Select the first sufficient retreat, or the one with the largest distance. Launch over B."""
    b = wp.tid()
    if retreat_inout.going[b] == 0:
        return
    if retreat_inout.clear[b] > retreat_inout.best[b]:
        retreat_inout.best[b] = retreat_inout.clear[b]
        retreat_inout.chosen[b] = step_in
    if retreat_inout.best[b] >= wanted_in:
        retreat_inout.going[b] = 0
    retreat_inout.clear[b] = wanted_in

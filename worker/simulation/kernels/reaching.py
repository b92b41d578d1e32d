"""Random hand poses with the object between opposed fingers, drawn until one is clear of the object.

One thread draws for one start. A draw's numbers follow from the start's seed and the draw's number, not from other
draws. Hands are tested as sets of balls in the object's distance grid."""

import warp as wp

from graspd.worker.simulation.kernels.surface import Surface, cube_around, cube_distance

wp.set_module_options({"enable_backward": False})

WAYS = wp.constant(4)  # random directions, of which the one most perpendicular to the pair is used


@wp.struct
class Grips:
    """P pairs of places on an object (origin: centre of mass), and K opposed postures (origin: palm)."""

    middle: wp.array(dtype=wp.vec3)  # (P,)
    axis: wp.array(dtype=wp.vec3)  # (P,) unit
    width: wp.array(dtype=wp.float32)  # (P,)
    sums: wp.array(dtype=wp.float32)  # (P,) cumulative probability; the last is 1
    posture: wp.array2d(dtype=wp.float32)  # (K, D)
    between: wp.array(dtype=wp.vec3)  # (K,) centre between the pads
    frame: wp.array(dtype=wp.quat)  # (K,) x: line of the pads, y: as near as possible to the palm's approach
    opened: wp.array(dtype=wp.float32)  # (K,) width between the pads, ascending
    balls: wp.array2d(dtype=wp.vec3)  # (K, S) centres of balls in the hand
    radius: wp.float32
    pads: wp.array2d(dtype=wp.vec3)  # (K, F) pads that should be near the object; F is 0 unless fingers are in line
    beyond: wp.float32  # largest distance of these pads, in addition to half the clearance
    deep: wp.float32  # largest shift of the pair from the pads to the palm, as a share of their distance
    palm: wp.vec3  # unit, direction that the palm faces
    cone_axis: wp.vec3  # cone of the palm's approach
    cone_cos: wp.float32  # cosine of its angle; -1 without a cone
    noise: wp.array(dtype=wp.float32)  # (D,) standard deviation of dofs
    lower: wp.array(dtype=wp.float32)
    upper: wp.array(dtype=wp.float32)


@wp.struct
class HandSample:
    """A drawn hand."""

    found: wp.bool
    near: wp.bool  # whether all pads are near the object
    posture: wp.int32
    pivot: wp.vec3
    rotation: wp.quat


@wp.func
def first_above(sorted_in: wp.array(dtype=wp.float32), value: wp.float32):
    """Return the index of the first number that is at least `value`; the length if there is none."""
    low = wp.int32(0)
    high = wp.int32(sorted_in.shape[0])
    while low < high:
        middle = (low + high) / 2
        if sorted_in[middle] < value:
            low = middle + 1
        else:
            high = middle
    return low


@wp.func
def is_clear(surface: Surface, grips: Grips, posture: wp.int32, pivot: wp.vec3, rotation: wp.quat):
    """Check that no ball of a posed hand is closer to the surface than its radius."""
    for s in range(grips.balls.shape[1]):
        place = pivot + wp.quat_rotate(rotation, grips.balls[posture, s])
        if cube_distance(cube_around(surface, place)) < grips.radius:
            return False
    return True


@wp.func
def pads_near(surface: Surface, grips: Grips, hand: HandSample, gap: wp.float32):
    """Check that no pad is farther from the surface than `gap`, its expected distance, and `beyond`."""
    for f in range(grips.pads.shape[1]):
        place = hand.pivot + wp.quat_rotate(hand.rotation, grips.pads[hand.posture, f])
        if cube_distance(cube_around(surface, place)) > gap + grips.beyond:
            return False
    return True


@wp.func
def into_cone(direction: wp.vec3, axis: wp.vec3, cosine: wp.float32):
    """Return a unit vector in the cone about `axis`.
    Directions uniform on the sphere become uniform in the cone."""
    along = wp.dot(direction, axis)
    aside = direction - along * axis
    height = cosine + (1.0 - cosine) * 0.5 * (along + 1.0)
    return height * axis + wp.sqrt(wp.max(1.0 - height * height, 0.0)) * wp.normalize(aside)


@wp.func
def draw_hand(
    surface: Surface,
    grips: Grips,
    alike: wp.vec2,
    room: wp.vec2,
    retreats: wp.array(dtype=wp.float32),
    state: wp.uint32,
):
    """Draw a hand around a pair of places, at the first clear one of the `retreats`."""
    out = HandSample()
    pair = wp.min(first_above(grips.sums, wp.randf(state)), grips.sums.shape[0] - 1)
    line = grips.axis[pair]
    if wp.randf(state) < 0.5:
        line = -line
    width = grips.width[pair] + 2.0 * (room[0] + (room[1] - room[0]) * wp.randf(state))
    low = first_above(grips.opened, width - alike[0])
    high = wp.max(first_above(grips.opened, width + alike[1]), low + 1)
    out.posture = wp.min(low + int(wp.randf(state) * float(high - low)), grips.opened.shape[0] - 1)
    deep = wp.sqrt(wp.randf(state))
    way = wp.vec3(0.0)
    least = float(2.0)
    for _k in range(WAYS):
        tried = wp.normalize(wp.vec3(wp.randn(state), wp.randn(state), wp.randn(state)))
        if grips.cone_cos > -1.0:
            tried = -into_cone(tried, grips.cone_axis, grips.cone_cos)
        if wp.abs(wp.dot(tried, line)) < least:
            least = wp.abs(wp.dot(tried, line))
            way = tried
    out.found = False
    if least > 0.999:
        return out
    y = -wp.normalize(way - wp.dot(way, line) * line)
    turn = wp.quat_from_matrix(wp.matrix_from_cols(line, y, wp.cross(line, y)))
    out.rotation = wp.normalize(turn * wp.quat_inverse(grips.frame[out.posture]))
    away = -wp.quat_rotate(out.rotation, grips.palm)
    if grips.cone_cos > -1.0 and -wp.dot(away, grips.cone_axis) < grips.cone_cos:
        return out
    reach = grips.between[out.posture]
    # The depth ranges from a fingertip grasp to a palm in contact with the object.
    ahead = wp.max(wp.dot(reach, grips.palm), 0.0) * deep * grips.deep
    pivot = grips.middle[pair] - wp.quat_rotate(out.rotation, reach) - ahead * away
    for r in range(retreats.shape[0]):
        out.pivot = pivot + retreats[r] * away
        if is_clear(surface, grips, out.posture, out.pivot, out.rotation):
            out.found = True
            out.near = pads_near(surface, grips, out, 0.5 * (grips.opened[out.posture] - grips.width[pair]))
            return out
    return out


@wp.kernel
def reach(
    surface_in: Surface,
    grips_in: Grips,
    seed_in: wp.array(dtype=wp.int32),
    first_in: wp.array(dtype=wp.int32),
    draws_in: wp.int32,
    alike_in: wp.vec2,
    room_in: wp.vec2,
    retreat_in: wp.array(dtype=wp.float32),
    number_out: wp.array(dtype=wp.int32),
    pivot_out: wp.array(dtype=wp.vec3),
    rotation_out: wp.array(dtype=wp.quat),
    q_out: wp.array2d(dtype=wp.float32),
):
    """Find each start's first clear draw with a number from `first` to below `draws`; -1 if none is clear.
    Draws with all pads near the object come first. Launch over B."""
    b = wp.tid()
    number_out[b] = -1
    for k in range(first_in[b], draws_in):
        state = wp.rand_init(seed_in[b], k)
        found = draw_hand(surface_in, grips_in, alike_in, room_in, retreat_in, state)
        if found.found and (found.near or number_out[b] < 0):
            number_out[b] = k
            pivot_out[b] = found.pivot
            rotation_out[b] = found.rotation
            # This random sequence differs from the draw's.
            noise = wp.rand_init(seed_in[b] + 1, draws_in + k)
            for d in range(q_out.shape[1]):
                q = grips_in.posture[found.posture, d] + grips_in.noise[d] * wp.randn(noise)
                q_out[b, d] = wp.clamp(q, grips_in.lower[d], grips_in.upper[d])
            if found.near:
                return

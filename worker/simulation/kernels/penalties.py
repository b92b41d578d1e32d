"""Penalties on single points and joints, and the transfer of gradients from points to bodies."""

import warp as wp

from graspd.worker.simulation.kernels.wrenches import Wrenches, add_wrench

wp.set_module_options({"enable_backward": False})


@wp.kernel
def points_to_bodies(
    pull_in: wp.float32,
    pull_length_in: wp.float32,
    lane_in: wp.int32,
    active_in: wp.array(dtype=wp.int32),
    iteration_in: wp.array(dtype=wp.int32),
    penetration_weight_in: wp.array(dtype=wp.float32),
    count_in: wp.array(dtype=wp.int32),
    body_in: wp.array2d(dtype=wp.int32),
    point_in: wp.array2d(dtype=wp.vec3),
    normal_in: wp.array2d(dtype=wp.vec3),
    distance_in: wp.array2d(dtype=wp.float32),
    weight_in: wp.array2d(dtype=wp.float32),
    gradient_in: wp.array2d(dtype=wp.float32),
    wrench_inout: Wrenches,
    depth_inout: wp.array(dtype=wp.float32),
):
    """Compute the wrench gradient on bodies from dL/drho, penetration and attraction term.

    Penetration: w sum w_i min(rho, 0)^2. Attraction: -2 w d l sum w_i exp(-rho / l) of points outside, with d = `pull`
    and l = `pull_length` [m]. The distance grows along the object's outward normal (normals are taken as constant).
    Launch over (B, N / lane).
    """
    b, part = wp.tid()
    if active_in[b] == 0:
        return
    penetration = 2.0 * penetration_weight_in[iteration_in[0]]
    for i in range(part * lane_in, wp.min((part + 1) * lane_in, count_in[b])):
        rho = distance_in[b, i]
        g = gradient_in[b, i]
        if rho < 0.0:
            g += penetration * weight_in[b, i] * rho
            wp.atomic_max(depth_inout, b, -rho)
        elif pull_in > 0.0:
            g += penetration * pull_in * weight_in[b, i] * wp.exp(-rho / pull_length_in)
        if g != 0.0:
            body = body_in[b, i]
            f = g * normal_in[b, i]
            add_wrench(wrench_inout, b, body, f, wp.cross(point_in[b, i], f))


@wp.kernel
def joints(
    lower_in: wp.array(dtype=wp.float32),
    upper_in: wp.array(dtype=wp.float32),
    range_weight_in: wp.float32,
    limit_weight_in: wp.float32,
    active_in: wp.array(dtype=wp.int32),
    q_in: wp.array2d(dtype=wp.float32),
    gradient_inout: wp.array2d(dtype=wp.float32),
):
    """Add the gradient of L_range + L_limit (paper, section III-D). Launch over (B, D).
    L_range = w sum ((q - mid) / half)^2; L_limit = w sum max(lower - q, 0, q - upper)^2."""
    b, d = wp.tid()
    if active_in[b] == 0:
        return
    q = q_in[b, d]
    lower = lower_in[d]
    upper = upper_in[d]
    half = wp.max(0.5 * (upper - lower), 1.0e-6)
    g = 2.0 * range_weight_in * (q - 0.5 * (lower + upper)) / (half * half)
    g += 2.0 * limit_weight_in * (wp.max(q - upper, 0.0) - wp.max(lower - q, 0.0))
    gradient_inout[b, 6 + d] = gradient_inout[b, 6 + d] + g


@wp.kernel
def near_share(
    reach_in: wp.float32,
    whole_in: wp.float32,
    count_in: wp.array(dtype=wp.int32),
    distance_in: wp.array2d(dtype=wp.float32),
    weight_in: wp.array2d(dtype=wp.float32),
    share_out: wp.array(dtype=wp.float32),
):
    """Compute the share of the `whole` weight of a hand's points that is within `reach` [m].
    Points are summed in order, so that the sum is the same on every device. Launch over B."""
    b = wp.tid()
    total = float(0.0)
    for i in range(count_in[b]):
        if distance_in[b, i] < reach_in:
            total += weight_in[b, i]
    share_out[b] = total / whole_in


@wp.kernel
def attract(
    pull_in: wp.float32,
    length_in: wp.float32,
    active_in: wp.array(dtype=wp.int32),
    count_in: wp.array(dtype=wp.int32),
    distance_in: wp.array2d(dtype=wp.float32),
    weight_in: wp.array2d(dtype=wp.float32),
    gradient_out: wp.array2d(dtype=wp.float32),
):
    """Attract free points to the object, fading with distance: control without simulation. Over (B, N)."""
    b, i = wp.tid()
    if active_in[b] == 0 or i >= count_in[b]:
        return
    rho = distance_in[b, i]
    gradient_out[b, i] = 0.0
    if rho > 0.0:
        gradient_out[b, i] = pull_in * weight_in[b, i] * wp.exp(-rho / length_in)

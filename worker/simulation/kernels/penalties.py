"""Penalties on single points and joints, and the transfer of gradients from points to bodies."""

import warp as wp

from graspd.worker.simulation.kernels.kinematics import Hands
from graspd.worker.simulation.kernels.packing import Contacts
from graspd.worker.simulation.kernels.wrenches import add_wrench

wp.set_module_options({"enable_backward": False})


@wp.kernel
def points_to_bodies(
    pull_in: wp.float32,
    pull_length_in: wp.float32,
    lane_in: wp.int32,
    penetration_weight_in: wp.array(dtype=wp.float32),
    contacts_in: Contacts,
    hands_inout: Hands,
    depth_inout: wp.array(dtype=wp.float32),
):
    """Add wrench gradients on bodies from dL/drho, penetration and attraction. Launch over (B, N / lane).
    Penetration: w sum w_i min(rho, 0)^2. Attraction: -2 w d l sum w_i exp(-rho / l) of points outside, with d = `pull`
    and l = `pull_length` [m]. The distance grows along the object's outward normal (normals are taken as constant)."""
    b, part = wp.tid()
    if hands_inout.active[b] == 0:
        return
    penetration = 2.0 * penetration_weight_in[hands_inout.iteration[0]]
    for i in range(part * lane_in, wp.min((part + 1) * lane_in, contacts_in.count[b])):
        rho = contacts_in.distance[b, i]
        g = contacts_in.gradient[b, i]
        if rho < 0.0:
            g += penetration * wp.abs(contacts_in.weight[b, i]) * rho
            wp.atomic_max(depth_inout, b, -rho)
        elif pull_in > 0.0:
            g += penetration * pull_in * wp.max(contacts_in.weight[b, i], 0.0) * wp.exp(-rho / pull_length_in)
        if g != 0.0:
            f = g * contacts_in.normal[b, i]
            add_wrench(hands_inout.wrench, b, contacts_in.body[b, i], f, wp.cross(contacts_in.point[b, i], f))


@wp.kernel
def joint_penalties(
    lower_in: wp.array(dtype=wp.float32),
    upper_in: wp.array(dtype=wp.float32),
    range_weight_in: wp.float32,
    limit_weight_in: wp.float32,
    hands_in: Hands,
    gradient_inout: wp.array2d(dtype=wp.float32),
):
    """Add the gradient of L_range + L_limit (paper, section III-D). Launch over (B, D).
    L_range = w sum ((q - mid) / half)^2; L_limit = w sum max(lower - q, 0, q - upper)^2."""
    b, d = wp.tid()
    if hands_in.active[b] == 0:
        return
    q = hands_in.q[b, d]
    lower = lower_in[d]
    upper = upper_in[d]
    half = wp.max(0.5 * (upper - lower), 1.0e-6)
    g = 2.0 * range_weight_in * (q - 0.5 * (lower + upper)) / (half * half)
    g += 2.0 * limit_weight_in * (wp.max(q - upper, 0.0) - wp.max(lower - q, 0.0))
    gradient_inout[b, 6 + d] = gradient_inout[b, 6 + d] + g


@wp.kernel
def near_share(
    reach_in: wp.float32, whole_in: wp.float32, contacts_in: Contacts, share_out: wp.array(dtype=wp.float32)
):
    """Compute the share of the `whole` weight of hand points that is within `reach` [m]. Launch over B.
    Points are summed in order, so that the sum is the same on every device."""
    b = wp.tid()
    total = float(0.0)
    for i in range(contacts_in.count[b]):
        if contacts_in.distance[b, i] < reach_in:
            total += wp.max(contacts_in.weight[b, i], 0.0)
    share_out[b] = total / whole_in


@wp.kernel
def attract(pull_in: wp.float32, length_in: wp.float32, hands_in: Hands, contacts_inout: Contacts):
    """Attract free points to the object by a force that fades with distance. Launch over (B, N)."""
    b, i = wp.tid()
    if hands_in.active[b] == 0 or i >= contacts_inout.count[b]:
        return
    rho = contacts_inout.distance[b, i]
    contacts_inout.gradient[b, i] = 0.0
    if rho > 0.0:
        contacts_inout.gradient[b, i] = pull_in * wp.max(contacts_inout.weight[b, i], 0.0) * wp.exp(-rho / length_in)

"""DexGraspNet's energies, gradients on bodies, and Metropolis-adjusted descent.

E = E_fc + 100 E_dis + 100 E_pen + 10 E_spen + E_joints
step 0.005 * 0.95^floor(t / 50), each gradient divided by its root mean square, v <- 0.98 g^2 + 0.02 v
temperature 18 * 0.95^floor(t / 30): a proposal is accepted with probability min(1, exp((E - E') / T))"""

import warp as wp

from graspd.worker.simulation.kernels.kinematics import Hands
from graspd.worker.simulation.kernels.optimizers import turn
from graspd.worker.simulation.kernels.pieces import (
    Pieces,
    in_box,
    piece_centre,
    piece_distance,
    piece_rotation,
    world_extent,
)
from graspd.worker.simulation.kernels.surface import Surface, mesh_distance
from graspd.worker.simulation.kernels.wrenches import add_wrench

wp.set_module_options({"enable_backward": False})

N_CONTACTS = wp.constant(4)
W_DISTANCE = wp.constant(100.0)
W_PENETRATION = wp.constant(100.0)
W_SELF = wp.constant(10.0)
W_JOINTS = wp.constant(1.0)
#: Distance [m] below which two key points of the hand count as self-penetration.
GAP = wp.constant(0.02)
STEP0 = wp.constant(0.005)
STEP_EVERY = wp.constant(50.0)
T0 = wp.constant(18.0)
T_EVERY = wp.constant(30.0)
COOL = wp.constant(0.95)
MU = wp.constant(0.98)
SWAP = wp.constant(0.5)  # probability that a proposal replaces a contact
FAR = wp.constant(1.0)  # largest distance that is computed [m]


@wp.struct
class Chains:
    """Hands of B chains, and their contacts."""

    pivot: wp.array(dtype=wp.vec3)
    rotation: wp.array(dtype=wp.quat)
    q: wp.array2d(dtype=wp.float32)
    contact: wp.array2d(dtype=wp.int32)


@wp.func
def step_size(iteration: wp.int32):
    return STEP0 * wp.pow(COOL, wp.floor(float(iteration) / STEP_EVERY))


@wp.func
def temperature(iteration: wp.int32):
    return T0 * wp.pow(COOL, wp.floor(float(iteration) / T_EVERY))


@wp.kernel
def propose(
    candidates_in: wp.int32,
    iteration_in: wp.array(dtype=wp.int32),
    gradient_in: wp.array2d(dtype=wp.float32),
    present_in: Chains,
    rng_inout: wp.array(dtype=wp.uint32),
    moment_inout: wp.array2d(dtype=wp.float32),
    proposed_out: Chains,
    energy_out: wp.array2d(dtype=wp.float32),
):
    """Step down the gradient, redraw each contact with probability 1/2, reset energies. Launch over B.
    The published code divides by the root mean square over its batch. Here each grasp has its own root mean squares
    (`moment`: translation, rotation, joints), so that grasps of a batch are independent."""
    b = wp.tid()
    it = iteration_in[0]
    size = step_size(it)
    dofs = present_in.q.shape[1]
    scale = wp.vec3(0.0)
    for group in range(3):
        first = 3 * group
        last = first + 3
        if group == 2:
            last = 6 + dofs
        mean = float(0.0)
        for column in range(first, last):
            mean += gradient_in[b, column] * gradient_in[b, column]
        v = MU * mean / float(wp.max(last - first, 1)) + (1.0 - MU) * moment_inout[b, group]
        moment_inout[b, group] = v
        scale[group] = size / (wp.sqrt(v) + 1.0e-6)
    g = wp.vec3(gradient_in[b, 0], gradient_in[b, 1], gradient_in[b, 2])
    w = wp.vec3(gradient_in[b, 3], gradient_in[b, 4], gradient_in[b, 5])
    proposed_out.pivot[b] = present_in.pivot[b] - scale[0] * g
    proposed_out.rotation[b] = turn(present_in.rotation[b], -scale[1] * w)
    for d in range(dofs):
        proposed_out.q[b, d] = present_in.q[b, d] - scale[2] * gradient_in[b, 6 + d]
    rng = rng_inout[b]
    for k in range(N_CONTACTS):
        index = present_in.contact[b, k]
        if wp.randf(rng) < SWAP:
            index = wp.min(int(wp.randf(rng) * float(candidates_in)), candidates_in - 1)
        proposed_out.contact[b, k] = index
    rng_inout[b] = rng
    for term in range(energy_out.shape[1]):
        energy_out[b, term] = float(0.0)


@wp.kernel
def force_closure(
    surface_in: Surface,
    body_in: wp.array(dtype=wp.int32),
    position_in: wp.array(dtype=wp.vec3),
    contact_in: wp.array2d(dtype=wp.int32),
    energy_out: wp.array2d(dtype=wp.float32),
    hands_inout: Hands,
):
    """Compute E_fc = |sum (n, x cross n)|^2 and E_dis = sum |d| (columns 0 and 1). Launch over B.
    Gradients treat normals as constant."""
    b = wp.tid()
    f = wp.vec3(0.0)
    t = wp.vec3(0.0)
    for k in range(N_CONTACTS):
        i = contact_in[b, k]
        x = hands_inout.body_p[b, body_in[i]] + wp.quat_rotate(hands_inout.body_q[b, body_in[i]], position_in[i])
        sample = mesh_distance(surface_in, x, FAR)
        f += sample.normal
        t += wp.cross(x, sample.normal)
    distance_sum = float(0.0)
    for k in range(N_CONTACTS):
        i = contact_in[b, k]
        body = body_in[i]
        x = hands_inout.body_p[b, body] + wp.quat_rotate(hands_inout.body_q[b, body], position_in[i])
        sample = mesh_distance(surface_in, x, FAR)
        distance_sum += wp.abs(sample.distance)
        gradient = 2.0 * wp.cross(sample.normal, t) + (W_DISTANCE * wp.sign(sample.distance)) * sample.normal
        add_wrench(hands_inout.wrench, b, body, gradient, wp.cross(x, gradient))
    energy_out[b, 0] = wp.dot(f, f) + wp.dot(t, t)
    energy_out[b, 1] = distance_sum


@wp.kernel
def penetration(
    pieces_in: Pieces,
    bvh_in: wp.uint64,
    sample_in: wp.array(dtype=wp.vec3),
    energy_inout: wp.array2d(dtype=wp.float32),
    hands_inout: Hands,
):
    """Compute E_pen (column 2), the sum of depths of object samples in hand pieces. Launch over (B, P)."""
    b, piece = wp.tid()
    body = pieces_in.body[piece]
    q = piece_rotation(pieces_in, piece, b, hands_inout.body_q)
    p = piece_centre(pieces_in, piece, b, hands_inout.body_p, hands_inout.body_q)
    half = pieces_in.half[piece]
    extent = world_extent(wp.quat_to_matrix(q), half)
    force = wp.vec3(0.0)
    torque = wp.vec3(0.0)
    total = float(0.0)
    query = wp.bvh_query_aabb(bvh_in, p - extent, p + extent)
    index = wp.int32(0)
    while wp.bvh_query_next(query, index):
        x = sample_in[index]
        local = wp.quat_rotate_inv(q, x - p)
        if in_box(local, half):
            nd = piece_distance(pieces_in, piece, local)
            if nd[3] < 0.0:
                # Motion of the body along the face's normal increases the sample's depth.
                f = W_PENETRATION * wp.quat_rotate(q, wp.vec3(nd[0], nd[1], nd[2]))
                total -= nd[3]
                force += f
                torque += wp.cross(x, f)
    if total > 0.0:
        wp.atomic_add(energy_inout, b, 2, total)
        add_wrench(hands_inout.wrench, b, body, force, torque)


@wp.kernel
def self_penetration(
    first_in: wp.array(dtype=wp.int32),
    second_in: wp.array(dtype=wp.int32),
    body_in: wp.array(dtype=wp.int32),
    position_in: wp.array(dtype=wp.vec3),
    energy_inout: wp.array2d(dtype=wp.float32),
    hands_inout: Hands,
):
    """Compute E_spen (column 3), the sum of max(0, gap - distance) over pairs. Launch over (B, pairs)."""
    b, pair = wp.tid()
    i = first_in[pair]
    j = second_in[pair]
    x = hands_inout.body_p[b, body_in[i]] + wp.quat_rotate(hands_inout.body_q[b, body_in[i]], position_in[i])
    y = hands_inout.body_p[b, body_in[j]] + wp.quat_rotate(hands_inout.body_q[b, body_in[j]], position_in[j])
    apart = wp.length(x - y)
    if apart < GAP and apart > 1.0e-9:
        wp.atomic_add(energy_inout, b, 3, GAP - apart)
        f = (-W_SELF / apart) * (x - y)
        add_wrench(hands_inout.wrench, b, body_in[i], f, wp.cross(x, f))
        add_wrench(hands_inout.wrench, b, body_in[j], -f, -wp.cross(y, f))


@wp.kernel
def limit_violation(
    lower_in: wp.array(dtype=wp.float32),
    upper_in: wp.array(dtype=wp.float32),
    q_in: wp.array2d(dtype=wp.float32),
    energy_out: wp.array2d(dtype=wp.float32),
    gradient_inout: wp.array2d(dtype=wp.float32),
):
    """Compute E_joints (column 4), the sum of violations of the limits. Launch over B."""
    b = wp.tid()
    total = float(0.0)
    for d in range(q_in.shape[1]):
        above = q_in[b, d] - upper_in[d]
        below = lower_in[d] - q_in[b, d]
        if above > 0.0:
            total += above
            gradient_inout[b, 6 + d] = gradient_inout[b, 6 + d] + W_JOINTS
        elif below > 0.0:
            total += below
            gradient_inout[b, 6 + d] = gradient_inout[b, 6 + d] - W_JOINTS
    energy_out[b, 4] = total


@wp.func
def total_energy(terms: wp.array2d(dtype=wp.float32), b: wp.int32):
    return (
        terms[b, 0]
        + W_DISTANCE * terms[b, 1]
        + W_PENETRATION * terms[b, 2]
        + W_SELF * terms[b, 3]
        + W_JOINTS * terms[b, 4]
    )


@wp.func
def is_accepted(rise: wp.float32, t: wp.float32, uniform: wp.float32):
    """Return 1 if the energy falls, or with probability exp(-rise / t) if it rises; else 0 (Metropolis)."""
    if rise < 0.0 or uniform < wp.exp(-rise / t):
        return 1
    return 0


@wp.kernel
def accept(
    iteration_in: wp.array(dtype=wp.int32),
    new_terms_in: wp.array2d(dtype=wp.float32),
    new_gradient_in: wp.array2d(dtype=wp.float32),
    proposed_in: Chains,
    rng_inout: wp.array(dtype=wp.uint32),
    terms_inout: wp.array2d(dtype=wp.float32),
    gradient_inout: wp.array2d(dtype=wp.float32),
    present_inout: Chains,
    taken_inout: wp.array(dtype=wp.int32),
):
    """Accept or reject the proposals. Launch over B.
    The first proposal has no rival, because the old energy is infinite."""
    b = wp.tid()
    rng = rng_inout[b]
    uniform = wp.randf(rng)
    rng_inout[b] = rng
    rise = total_energy(new_terms_in, b) - total_energy(terms_inout, b)
    if is_accepted(rise, temperature(iteration_in[0]), uniform) == 0:
        return
    taken_inout[b] = taken_inout[b] + 1
    present_inout.pivot[b] = proposed_in.pivot[b]
    present_inout.rotation[b] = proposed_in.rotation[b]
    for d in range(present_inout.q.shape[1]):
        present_inout.q[b, d] = proposed_in.q[b, d]
    for k in range(N_CONTACTS):
        present_inout.contact[b, k] = proposed_in.contact[b, k]
    for column in range(gradient_inout.shape[1]):
        gradient_inout[b, column] = new_gradient_in[b, column]
    for term in range(terms_inout.shape[1]):
        terms_inout[b, term] = new_terms_in[b, term]

"""Force-based contact, relaxed by contact-invariant forces (Mordatch 2012), as in Grasp'D.

The hand is fixed; the object (mass m) has one of several small velocities v_j. Its surface is dilated by r. A hand
point at distance d from the surface exerts the force

    f = -k c n - min(kf |v_t|, mu k c) v_t / |v_t|,   c = max(r - d, 0).

In the relaxation every point and velocity has its own force F. Two descents alternate: F approaches the nearest forces
that stop the object (`relax`), and the hand descends sum |f - F|^2. Points without contact get a share of this gradient
(leak), which attracts them."""

import warp as wp

from graspd.worker.simulation.kernels.kinematics import Hands
from graspd.worker.simulation.kernels.surface import Surface, field_distance
from graspd.worker.simulation.kernels.wrenches import add_wrench

wp.set_module_options({"enable_backward": False})

vec6 = wp.types.vector(length=6, dtype=wp.float32)


@wp.struct
class ForceModel:
    stiffness: wp.float32  # k [N/m]
    viscous: wp.float32  # kf [N s/m]
    friction: wp.float32  # mu
    leak: wp.float32
    mismatch: wp.float32  # weight of |F - f|^2 in the update of F
    gyration: wp.float32  # length scale of torques [m]
    tolerance: wp.float32  # residual below which the object counts as stopped [N]
    damping: wp.float32
    rate: wp.float32  # of forces and multipliers
    warmup: wp.float32  # number of iterations in which rates grow to their final value


@wp.func
def contact_force(physics: ForceModel, depth: wp.float32, n: wp.vec3, v: wp.vec3):
    """Return the force on the object at a point whose depth in the dilated object is `depth`."""
    c = wp.max(depth, 0.0)
    normal = physics.stiffness * c
    tangential = v - wp.dot(v, n) * n
    speed = wp.length(tangential)
    force = -normal * n
    if speed > 1.0e-12:
        force -= (wp.min(physics.viscous * speed, physics.friction * normal) / speed) * tangential
    return force


@wp.func
def force_slope(physics: ForceModel, depth: wp.float32, n: wp.vec3, v: wp.vec3):
    """Return d f / d depth, or a share `leak` of it for a point without contact."""
    slope = -physics.stiffness * n
    tangential = v - wp.dot(v, n) * n
    speed = wp.length(tangential)
    if speed > 1.0e-12:
        # Only sliding friction grows with depth. It attracts free points, where opposite normal forces cancel.
        if physics.friction * physics.stiffness * depth < physics.viscous * speed:
            slope -= (physics.friction * physics.stiffness / speed) * tangential
    if depth <= 0.0:
        slope = physics.leak * slope
    return slope


@wp.kernel
def multipliers(
    physics: ForceModel,
    wanted_in: wp.array(dtype=vec6),
    active_in: wp.array(dtype=wp.int32),
    total_inout: wp.array2d(dtype=vec6),
    lambda_inout: wp.array2d(dtype=wp.float32),
    pull_out: wp.array2d(dtype=vec6),
    residual_out: wp.array2d(dtype=wp.float32),
):
    """Compute residuals |wanted + sum F| [N], multipliers and pulls on forces. Launch over (B, M).
    The modified differential method of multipliers (Platt & Barr 1988) enforces residual <= tolerance."""
    b, j = wp.tid()
    if active_in[b] == 0:
        return
    gap = wanted_in[j] + total_inout[b, j]
    size = wp.length(gap)
    residual_out[b, j] = size
    excess = wp.max(size - physics.tolerance, 0.0)
    multiplier = lambda_inout[b, j]
    pull = vec6()
    if excess > 0.0:
        lambda_inout[b, j] = multiplier + physics.rate
        pull = ((multiplier + physics.damping * excess) / size) * gap
    else:
        lambda_inout[b, j] = wp.max(multiplier - physics.rate, 0.0)
    pull_out[b, j] = pull
    total_inout[b, j] = vec6()


@wp.func
def force_gradient(physics: ForceModel, force: wp.vec3, wanted: wp.vec3, actual: wp.vec3):
    """Return the gradient of mismatch |F - f|^2 with respect to F, plus the pull of `multipliers`."""
    return 2.0 * physics.mismatch * (force - actual) + wanted


@wp.kernel
def relax(
    physics: ForceModel,
    surface: Surface,
    velocity_in: wp.array(dtype=wp.vec3),
    point_body_in: wp.array(dtype=wp.int32),
    point_position_in: wp.array(dtype=wp.vec3),
    dilation_in: wp.array(dtype=wp.float32),
    pull_in: wp.array2d(dtype=vec6),
    force_inout: wp.array3d(dtype=wp.vec3),
    first_inout: wp.array3d(dtype=wp.vec3),
    largest_inout: wp.array3d(dtype=wp.vec3),
    total_inout: wp.array2d(dtype=vec6),
    hands_inout: Hands,
):
    """Step every force by Adamax, then add the bodies' gradient of sum |f - F|^2. Launch over (B, N)."""
    b, i = wp.tid()
    hands = hands_inout
    if hands.active[b] == 0:
        return
    it = hands.iteration[0]
    body = point_body_in[i]
    x = hands.body_p[b, body] + wp.quat_rotate(hands.body_q[b, body], point_position_in[i])
    sample = field_distance(surface, x)
    n = sample.normal
    depth = hands.dilation_scale[b] * dilation_in[it] - sample.distance
    warm = wp.min(float(it) / physics.warmup, 1.0)
    rate = warm * physics.rate / (1.0 - wp.pow(0.9, float(it + 1)))
    slope_sum = float(0.0)
    for j in range(velocity_in.shape[0]):
        v = velocity_in[j]
        actual = contact_force(physics, depth, n, v)
        pull = pull_in[b, j]
        torque_pull = wp.vec3(pull[3], pull[4], pull[5]) / physics.gyration
        wanted = wp.vec3(pull[0], pull[1], pull[2]) + wp.cross(torque_pull, x)
        force = force_inout[b, i, j]
        g = force_gradient(physics, force, wanted, actual)
        m = 0.9 * first_inout[b, i, j] + 0.1 * g
        old = largest_inout[b, i, j]
        u = wp.vec3(
            wp.max(0.999 * old[0], wp.abs(g[0]) + 1.0e-8),
            wp.max(0.999 * old[1], wp.abs(g[1]) + 1.0e-8),
            wp.max(0.999 * old[2], wp.abs(g[2]) + 1.0e-8),
        )
        force = force - rate * wp.cw_div(m, u)
        first_inout[b, i, j] = m
        largest_inout[b, i, j] = u
        force_inout[b, i, j] = force
        t = wp.cross(x, force) / physics.gyration
        wp.atomic_add(total_inout, b, j, vec6(force[0], force[1], force[2], t[0], t[1], t[2]))
        slope_sum += 2.0 * wp.dot(actual - force, force_slope(physics, depth, n, v))
    # The depth decreases as the distance grows.
    g_distance = -slope_sum
    if g_distance != 0.0 and sample.distance < 1.0e2:
        f = g_distance * n
        add_wrench(hands.wrench, b, body, f, wp.cross(x, f))


@wp.kernel
def nearest_distance(
    surface: Surface,
    point_body_in: wp.array(dtype=wp.int32),
    point_position_in: wp.array(dtype=wp.vec3),
    hands_in: Hands,
    least_inout: wp.array(dtype=wp.float32),
):
    """Compute the least distance of each hand's points from the object, by the grid. Launch over (B, N)."""
    b, i = wp.tid()
    body = point_body_in[i]
    x = hands_in.body_p[b, body] + wp.quat_rotate(hands_in.body_q[b, body], point_position_in[i])
    wp.atomic_min(least_inout, b, field_distance(surface, x).distance)

"""One step of the object against the static hand for M velocities per grasp, and its loss gradient.

A simulation starts the object with velocity v_m; s0 = dt (v, omega) is its free motion. A hand point p has the distance
rho and the outward object normal n. After the object's motion s = (x, theta) about its centre of mass, p has the gap
rho - j.s with j = (n, p x n). The violation is C = r - rho + j.s with the dilation r. Hand and object are in frictional
contact while C > 0 (paper, eq. 1 and section III-C). The loss of one simulation is (|x| + g |theta|) / |s0| with g the
gyration radius; L_stable is the mean over m.

The result is dL/drho. On active points it is the adjoint of the solve with constant slip directions. On free points it
is the leak: `leak` times the gradient on contact, fading with distance. `one_sided` selects only the leak that attracts
the point to the object. With the paper's two-sided leak, opposite velocities cancel where nothing touches."""

import warp as wp

from graspd.worker.simulation.kernels.kinematics import Hands
from graspd.worker.simulation.kernels.packing import Contacts

wp.set_module_options({"enable_backward": False})

vec6 = wp.types.vector(length=6, dtype=wp.float32)
mat66 = wp.types.matrix(shape=(6, 6), dtype=wp.float32)

SMOOTH = wp.constant(1.0e-5)  # norms are smoothed below this length [m]: |x| has no gradient at 0


@wp.struct
class Physics:
    """Constants of the step."""

    inverse_mass: mat66  # of the object per unit of mass, about its centre of mass
    mass: mat66
    gyration: wp.float32  # [m]
    friction: wp.float32
    stiffness: wp.float32  # direct solver: contact stiffness over mass, for a point of weight 1
    leak: wp.float32
    leak_length: wp.float32  # [m]
    one_sided: wp.int32
    step: wp.float32  # |s0| of a moving simulation [m]
    radius: wp.float32  # bound on the distance of used points from the centre of mass [m]
    near_gap: wp.float32  # direct solver: largest gap of contacts in the near list [m]


@wp.func
def jacobian_row(n: wp.vec3, p: wp.vec3):
    """Return (n, p x n): its product with the object's motion is the displacement of p along n."""
    t = wp.cross(p, n)
    return vec6(n[0], n[1], n[2], t[0], t[1], t[2])


@wp.func
def point_motion(s: vec6, p: wp.vec3):
    """Return the motion of the object's material at p."""
    return wp.vec3(s[0], s[1], s[2]) + wp.cross(wp.vec3(s[3], s[4], s[5]), p)


@wp.func
def add_isotropic(a: mat66, c0: wp.float32, c1: wp.vec3, c2: wp.mat33):
    """Add the matrix of sum c |x + theta x p|^2 to `a`, from the moments sum c, sum c p, sum c p p'."""
    trace = c2[0, 0] + c2[1, 1] + c2[2, 2]
    cross = wp.skew(c1)
    for i in range(3):
        a[i, i] = a[i, i] + c0
        a[3 + i, 3 + i] = a[3 + i, 3 + i] + trace
        for j in range(3):
            a[3 + i, 3 + j] = a[3 + i, 3 + j] - c2[i, j]
            a[i, 3 + j] = a[i, 3 + j] - cross[i, j]
            a[3 + i, j] = a[3 + i, j] + cross[i, j]
    return a


@wp.func
def solve_spd(a: mat66, b: vec6):
    """Return x with a x = b for symmetric positive definite a, by Cholesky."""
    low = mat66(0.0)
    for i in range(6):
        for j in range(6):
            if j <= i:
                total = a[i, j]
                for k in range(6):
                    if k < j:
                        total = total - low[i, k] * low[j, k]
                if i == j:
                    low[i, j] = wp.sqrt(wp.max(total, 1.0e-12))
                else:
                    low[i, j] = total / low[j, j]
    y = vec6(0.0)
    for i in range(6):
        total = b[i]
        for k in range(6):
            if k < i:
                total = total - low[i, k] * y[k]
        y[i] = total / low[i, i]
    x = vec6(0.0)
    for m in range(6):
        i = 5 - m
        total = y[i]
        for k in range(6):
            if k > i:
                total = total - low[k, i] * x[k]
        x[i] = total / low[i, i]
    return x


@wp.func
def displacement_loss(s: vec6, physics: Physics):
    x = wp.vec3(s[0], s[1], s[2])
    r = physics.gyration * wp.vec3(s[3], s[4], s[5])
    return (wp.sqrt(wp.dot(x, x) + SMOOTH * SMOOTH) + wp.sqrt(wp.dot(r, r) + SMOOTH * SMOOTH)) / physics.step


@wp.func
def displacement_gradient(s: vec6, physics: Physics):
    x = wp.vec3(s[0], s[1], s[2])
    r = physics.gyration * wp.vec3(s[3], s[4], s[5])
    gx = x / (wp.sqrt(wp.dot(x, x) + SMOOTH * SMOOTH) * physics.step)
    gr = (physics.gyration / (wp.sqrt(wp.dot(r, r) + SMOOTH * SMOOTH) * physics.step)) * r
    return vec6(gx[0], gx[1], gx[2], gr[0], gr[1], gr[2])


@wp.func
def free_gradient(pull: wp.float32, gap: wp.float32, physics: Physics):
    """Return dL/drho of a free point from `pull`, its value on contact, and `gap` to the dilated surface."""
    if physics.one_sided == 1 and pull < 0.0:
        return float(0.0)
    return physics.leak * pull * wp.exp(-gap / physics.leak_length)


@wp.kernel
def direct(
    physics_in: Physics,
    motion_in: wp.array(dtype=vec6),
    passes_in: wp.int32,
    dilation_in: wp.array(dtype=wp.float32),
    hands_in: Hands,
    contacts_in: Contacts,
    loss_out: wp.array2d(dtype=wp.float32),
    end_out: wp.array2d(dtype=vec6),
    adjoint_out: wp.array2d(dtype=vec6),
):
    """Solve compliant contact as 6 x 6 systems, independent of the order of contacts. Launch over (B, M).
    Minimises 1/2 (s - s0)' M (s - s0) + k/2 sum w_i max(0, C_i)^2 with friction of at most mu k w_i C_i, by iteratively
    reweighted least squares. A sliding contact is a spring of stiffness k w_i mu C_i / |u_t|, a sticking one of k w_i.
    `near` (B, N) lists the contacts with a gap of at most `near_gap`: other contacts are ignored unless the object
    moves farther. `adjoint` (B, M) is the derivative of the loss by forces on the object."""
    b, m = wp.tid()
    if hands_in.active[b] == 0:
        return
    r = hands_in.dilation_scale[b] * dilation_in[hands_in.iteration[0]]
    s0 = motion_in[m]
    s = s0
    k = physics_in.stiffness
    a = physics_in.mass
    for _pass in range(passes_in):
        a = physics_in.mass
        rhs = physics_in.mass * s0
        # Isotropic springs c at p act as c (I, -[p]; [p], |p|^2 I - p p'): summed as three small moments.
        c0 = float(0.0)
        c1 = wp.vec3(0.0)
        c2 = wp.mat33(0.0)
        # Bound on the motion of all points; points farther from the surface are skipped.
        motion = wp.length(wp.vec3(s[0], s[1], s[2])) + wp.length(wp.vec3(s[3], s[4], s[5])) * physics_in.radius
        all_near = motion <= physics_in.near_gap
        count = contacts_in.count[b]
        if all_near:
            count = contacts_in.near_count[b]
        for listed in range(count):
            i = listed
            if all_near:
                i = contacts_in.near[b, listed]
            rho = contacts_in.distance[b, i]
            if rho - r > motion:
                continue
            n = contacts_in.normal[b, i]
            p = contacts_in.point[b, i]
            u = point_motion(s, p)
            c = r - rho + wp.dot(n, u)
            if c > 0.0:
                kw = k * wp.max(contacts_in.weight[b, i], 0.0)
                tangent = u - wp.dot(n, u) * n
                slide = wp.min(kw, kw * physics_in.friction * c / wp.max(wp.length(tangent), 1.0e-9))
                j = jacobian_row(n, p)
                a += wp.outer((kw - slide) * j, j)
                rhs -= (kw * (r - rho)) * j
                c0 += slide
                c1 += slide * p
                c2 += wp.outer(slide * p, p)
        a = add_isotropic(a, c0, c1, c2)
        s = solve_spd(a, rhs)
    loss_out[b, m] = displacement_loss(s, physics_in)
    end_out[b, m] = s
    adjoint_out[b, m] = solve_spd(a, displacement_gradient(s, physics_in))


@wp.kernel
def direct_gradient(
    physics_in: Physics,
    lane_in: wp.int32,
    dilation_in: wp.array(dtype=wp.float32),
    hands_in: Hands,
    end_in: wp.array2d(dtype=vec6),
    adjoint_in: wp.array2d(dtype=vec6),
    contacts_inout: Contacts,
):
    """Compute each contact's dL/drho after `direct`, over simulations in order. Launch over (B, N / lane)."""
    b, part = wp.tid()
    if hands_in.active[b] == 0:
        return
    r = hands_in.dilation_scale[b] * dilation_in[hands_in.iteration[0]]
    share = 1.0 / float(end_in.shape[1])
    for i in range(part * lane_in, wp.min((part + 1) * lane_in, contacts_inout.count[b])):
        rho = contacts_inout.distance[b, i]
        n = contacts_inout.normal[b, i]
        p = contacts_inout.point[b, i]
        j = jacobian_row(n, p)
        kw = physics_in.stiffness * wp.max(contacts_inout.weight[b, i], 0.0)
        fade = physics_in.leak * wp.exp((r - rho) / physics_in.leak_length)
        total = float(0.0)
        for m in range(end_in.shape[1]):
            s = end_in[b, m]
            y = adjoint_in[b, m]
            g = wp.dot(j, y)
            c = r - rho + wp.dot(j, s)
            if c > 0.0:
                u = point_motion(s, p)
                tangent = u - wp.dot(n, u) * n
                length = wp.length(tangent)
                if physics_in.friction * c < length:
                    g += physics_in.friction * wp.dot(jacobian_row(tangent / length, p), y)
            elif physics_in.one_sided == 1 and g < 0.0:
                g = 0.0
            else:
                g = g * fade
            total += g
        contacts_inout.gradient[b, i] = share * kw * total


@wp.func
def inverse_mass_along(physics: Physics, j: vec6):
    """Return w = j M^-1 j', the generalised inverse mass of the object along a row."""
    return wp.dot(j, physics.inverse_mass * j)


@wp.kernel
def gauss_seidel(
    physics_in: Physics,
    motion_in: wp.array(dtype=vec6),
    passes_in: wp.int32,
    dilation_in: wp.array(dtype=wp.float32),
    hands_in: Hands,
    contacts_inout: Contacts,
    states_out: wp.array3d(dtype=vec6),
    loss_out: wp.array2d(dtype=wp.float32),
    end_out: wp.array2d(dtype=vec6),
):
    """Take the paper's step: one sweep of position-based dynamics (Deul 2016), contact by contact.
    Contact i moves the object by -M^-1 j C / w along the normal. Friction then opposes the slip of the contact's point,
    with an impulse of at most mu C / w. `states` (B, M, N) stores the object's motion before each contact
    for the reverse sweep. `passes_in` is ignored, since `states` has room for one sweep. Launch over (B, M)."""
    b, m = wp.tid()
    if hands_in.active[b] == 0:
        return
    r = hands_in.dilation_scale[b] * dilation_in[hands_in.iteration[0]]
    s = motion_in[m]
    count = contacts_inout.count[b]
    for i in range(count):
        states_out[b, m, i] = s
        n = contacts_inout.normal[b, i]
        p = contacts_inout.point[b, i]
        j = jacobian_row(n, p)
        c = r - contacts_inout.distance[b, i] + wp.dot(j, s)
        if c > 0.0:
            impulse = c / inverse_mass_along(physics_in, j)
            s = s - impulse * (physics_in.inverse_mass * j)
            u = point_motion(s, p)
            tangent = u - wp.dot(n, u) * n
            length = wp.length(tangent)
            if length > 1.0e-9:
                jt = jacobian_row(tangent / length, p)
                stop = length / inverse_mass_along(physics_in, jt)
                s = s - wp.min(stop, physics_in.friction * impulse) * (physics_in.inverse_mass * jt)
    loss_out[b, m] = displacement_loss(s, physics_in)
    end_out[b, m] = s
    y = displacement_gradient(s, physics_in)
    share = 1.0 / float(motion_in.shape[0])
    for back in range(count):
        i = count - 1 - back
        before = states_out[b, m, i]
        n = contacts_inout.normal[b, i]
        p = contacts_inout.point[b, i]
        j = jacobian_row(n, p)
        mj = physics_in.inverse_mass * j
        w = wp.dot(j, mj)
        c = r - contacts_inout.distance[b, i] + wp.dot(j, before)
        if c > 0.0:
            impulse = c / w
            middle = before - impulse * mj
            u = point_motion(middle, p)
            tangent = u - wp.dot(n, u) * n
            length = wp.length(tangent)
            slip = float(0.0)
            if length > 1.0e-9:
                # The slip direction is taken as constant.
                jt = jacobian_row(tangent / length, p)
                mjt = physics_in.inverse_mass * jt
                wt = wp.dot(jt, mjt)
                along = wp.dot(mjt, y)
                if length / wt <= physics_in.friction * impulse:
                    y = y - (along / wt) * jt
                else:
                    # lambda_t = mu C / w: it grows with C, hence falls with the distance.
                    slip = physics_in.friction * along / w
            g = wp.dot(mj, y) / w + slip
            y = y - g * j
            wp.atomic_add(contacts_inout.gradient, b, i, share * g)
        else:
            g = free_gradient(wp.dot(mj, y) / w, -c, physics_in)
            if g != 0.0:
                wp.atomic_add(contacts_inout.gradient, b, i, share * g)

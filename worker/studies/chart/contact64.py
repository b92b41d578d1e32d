"""The compliant contact solve of `worker.simulation.kernels.contact.direct` in float64: what float32 costs.

The same arrays come in, and what the next kernels read goes out in float32 again; all between is float64: the
reweighted least squares, the Cholesky factorisation and the adjoint. Warp's mesh and BVH queries know float32 only, so
points, normals and distances are float32 numbers in both. See the kernel's twin for the method; a kernel of its own,
because one source for both would give production's kernels other keys in the cache.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})

vec6d = wp.types.vector(length=6, dtype=wp.float64)
mat66d = wp.types.matrix(shape=(6, 6), dtype=wp.float64)

#: As in the twin [m].
SMOOTH = wp.constant(wp.float64(1.0e-5))
#: Slip below which a contact sticks [m].
LEAST = wp.constant(wp.float64(1.0e-9))
#: Less than any pivot of a mass matrix of an object of a tenth of a millimetre.
PIVOT = wp.constant(wp.float64(1.0e-24))
ZERO = wp.constant(wp.float64(0.0))
ONE = wp.constant(wp.float64(1.0))


@wp.struct
class Physics64:
    """Constants of the step; see `contact.Physics`."""

    mass: mat66d
    gyration: wp.float64  # [m]
    friction: wp.float64
    stiffness: wp.float64
    leak: wp.float64
    leak_length: wp.float64  # [m]
    one_sided: wp.int32
    step: wp.float64  # [m]
    radius: wp.float64  # [m]


@wp.func
def wide(v: wp.vec3):
    return wp.vec3d(wp.float64(v[0]), wp.float64(v[1]), wp.float64(v[2]))


@wp.func
def row(n: wp.vec3d, p: wp.vec3d):
    t = wp.cross(p, n)
    return vec6d(n[0], n[1], n[2], t[0], t[1], t[2])


@wp.func
def point_motion(s: vec6d, p: wp.vec3d):
    return wp.vec3d(s[0], s[1], s[2]) + wp.cross(wp.vec3d(s[3], s[4], s[5]), p)


@wp.func
def add_isotropic(a: mat66d, c0: wp.float64, c1: wp.vec3d, c2: wp.mat33d):
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
def solve_spd(a: mat66d, b: vec6d):
    """x with a x = b for symmetric positive definite a: Cholesky."""
    low = mat66d(ZERO)
    for i in range(6):
        for j in range(6):
            if j <= i:
                total = a[i, j]
                for k in range(6):
                    if k < j:
                        total = total - low[i, k] * low[j, k]
                if i == j:
                    low[i, j] = wp.sqrt(wp.max(total, PIVOT))
                else:
                    low[i, j] = total / low[j, j]
    y = vec6d(ZERO)
    for i in range(6):
        total = b[i]
        for k in range(6):
            if k < i:
                total = total - low[i, k] * y[k]
        y[i] = total / low[i, i]
    x = vec6d(ZERO)
    for m in range(6):
        i = 5 - m
        total = y[i]
        for k in range(6):
            if k > i:
                total = total - low[k, i] * x[k]
        x[i] = total / low[i, i]
    return x


@wp.func
def length_of(v: wp.vec3d):
    return wp.sqrt(wp.dot(v, v) + SMOOTH * SMOOTH)


@wp.kernel
def direct64(
    physics_in: Physics64,
    motion_in: wp.array(dtype=vec6d),
    passes_in: wp.int32,
    active_in: wp.array(dtype=wp.int32),
    iteration_in: wp.array(dtype=wp.int32),
    dilation_in: wp.array(dtype=wp.float32),
    dilation_scale_in: wp.array(dtype=wp.float32),
    count_in: wp.array(dtype=wp.int32),
    point_in: wp.array2d(dtype=wp.vec3),
    normal_in: wp.array2d(dtype=wp.vec3),
    distance_in: wp.array2d(dtype=wp.float32),
    weight_in: wp.array2d(dtype=wp.float32),
    loss_out: wp.array2d(dtype=wp.float64),
    end_out: wp.array2d(dtype=vec6d),
    gradient_inout: wp.array2d(dtype=wp.float64),
):
    """One compliant step and its adjoint; `gradient` is added to. Launch over (B, M)."""
    b, m = wp.tid()
    if active_in[b] == 0:
        return
    r = wp.float64(dilation_scale_in[b]) * wp.float64(dilation_in[iteration_in[0]])
    s0 = motion_in[m]
    s = s0
    k = physics_in.stiffness
    count = count_in[b]
    a = physics_in.mass
    for _pass in range(passes_in):
        a = physics_in.mass
        rhs = physics_in.mass * s0
        c0 = wp.float64(0.0)
        c1 = wp.vec3d(ZERO)
        c2 = wp.mat33d(ZERO)
        motion = wp.length(wp.vec3d(s[0], s[1], s[2])) + wp.length(wp.vec3d(s[3], s[4], s[5])) * physics_in.radius
        for i in range(count):
            rho = wp.float64(distance_in[b, i])
            if rho - r > motion:
                continue
            n = wide(normal_in[b, i])
            p = wide(point_in[b, i])
            u = point_motion(s, p)
            c = r - rho + wp.dot(n, u)
            if c > ZERO:
                kw = k * wp.float64(weight_in[b, i])
                tangent = u - wp.dot(n, u) * n
                slide = wp.min(kw, kw * physics_in.friction * c / wp.max(wp.length(tangent), LEAST))
                j = row(n, p)
                a += wp.outer((kw - slide) * j, j)
                rhs -= (kw * (r - rho)) * j
                c0 += slide
                c1 += slide * p
                c2 += wp.outer(slide * p, p)
        a = add_isotropic(a, c0, c1, c2)
        s = solve_spd(a, rhs)
    x = wp.vec3d(s[0], s[1], s[2])
    turn = physics_in.gyration * wp.vec3d(s[3], s[4], s[5])
    loss_out[b, m] = (length_of(x) + length_of(turn)) / physics_in.step
    end_out[b, m] = s
    gx = x / (length_of(x) * physics_in.step)
    gr = (physics_in.gyration / (length_of(turn) * physics_in.step)) * turn
    y = solve_spd(a, vec6d(gx[0], gx[1], gx[2], gr[0], gr[1], gr[2]))
    share = ONE / wp.float64(motion_in.shape[0])
    for i in range(count):
        rho = wp.float64(distance_in[b, i])
        n = wide(normal_in[b, i])
        p = wide(point_in[b, i])
        u = point_motion(s, p)
        c = r - rho + wp.dot(n, u)
        kw = k * wp.float64(weight_in[b, i])
        g = kw * wp.dot(row(n, p), y)
        if c > ZERO:
            tangent = u - wp.dot(n, u) * n
            length = wp.length(tangent)
            if physics_in.friction * c < length:
                g += kw * physics_in.friction * wp.dot(row(tangent / length, p), y)
        elif physics_in.one_sided == 1 and g < ZERO:
            g = ZERO
        else:
            g = physics_in.leak * g * wp.exp(-(rho - r) / physics_in.leak_length)
        if g != ZERO:
            wp.atomic_add(gradient_inout, b, i, share * g)


@wp.kernel
def narrow(
    active_in: wp.array(dtype=wp.int32),
    count_in: wp.array(dtype=wp.int32),
    loss_in: wp.array2d(dtype=wp.float64),
    gradient_inout: wp.array2d(dtype=wp.float64),
    loss_out: wp.array2d(dtype=wp.float32),
    gradient_out: wp.array2d(dtype=wp.float32),
):
    """Hand losses and gradients on in float32, and clear the gradients. Launch over (B, N) with N >= M."""
    b, i = wp.tid()
    if active_in[b] == 0:
        return
    if i < loss_in.shape[1]:
        loss_out[b, i] = wp.float32(loss_in[b, i])
    if i < count_in[b]:
        gradient_out[b, i] = wp.float32(gradient_inout[b, i])
        gradient_inout[b, i] = wp.float64(0.0)

"""One optimiser step per grasp; the root turns about the palm centre by exp of a world rotation."""

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.func
def turn(rotation: wp.quat, w: wp.vec3):
    """Apply exp(w) to a rotation, renormalised."""
    angle = wp.length(w)
    if angle < 1.0e-12:
        return rotation
    return wp.normalize(wp.quat_from_axis_angle(w / angle, angle) * rotation)


@wp.func
def move(
    b: wp.int32,
    column: wp.int32,
    step: wp.float32,
    lower: wp.array(dtype=wp.float32),
    upper: wp.array(dtype=wp.float32),
    clamp: wp.int32,
    q: wp.array2d(dtype=wp.float32),
):
    """Add a step to a dof, inside its limits where `clamp` is 1."""
    d = column - 6
    value = q[b, d] + step
    if clamp == 1:
        value = wp.clamp(value, lower[d], upper[d])
    q[b, d] = value


@wp.kernel
def adam(
    lower_in: wp.array(dtype=wp.float32),
    upper_in: wp.array(dtype=wp.float32),
    active_in: wp.array(dtype=wp.int32),
    iteration_in: wp.array(dtype=wp.int32),
    rate_in: wp.array2d(dtype=wp.float32),
    gradient_in: wp.array2d(dtype=wp.float32),
    beta1_in: wp.float32,
    beta2_in: wp.float32,
    first_inout: wp.array2d(dtype=wp.float32),
    second_inout: wp.array2d(dtype=wp.float32),
    pivot_inout: wp.array(dtype=wp.vec3),
    rotation_inout: wp.array(dtype=wp.quat),
    q_inout: wp.array2d(dtype=wp.float32),
):
    """Take a step of Adam (Kingma & Ba 2015); rates of translation, rotation, every dof. Over B."""
    b = wp.tid()
    if active_in[b] == 0:
        return
    it = iteration_in[0]
    t = float(it + 1)
    correct1 = 1.0 / (1.0 - wp.pow(beta1_in, t))
    correct2 = 1.0 / (1.0 - wp.pow(beta2_in, t))
    dx = wp.vec3(0.0)
    dw = wp.vec3(0.0)
    for column in range(gradient_in.shape[1]):
        g = gradient_in[b, column]
        m = beta1_in * first_inout[b, column] + (1.0 - beta1_in) * g
        v = beta2_in * second_inout[b, column] + (1.0 - beta2_in) * g * g
        first_inout[b, column] = m
        second_inout[b, column] = v
        step = -m * correct1 / (wp.sqrt(v * correct2) + 1.0e-8)
        if column < 3:
            dx[column] = rate_in[it, 0] * step
        elif column < 6:
            dw[column - 3] = rate_in[it, 1] * step
        else:
            move(b, column, rate_in[it, column - 4] * step, lower_in, upper_in, 1, q_inout)
    pivot_inout[b] = pivot_inout[b] + dx
    rotation_inout[b] = turn(rotation_inout[b], dw)


@wp.kernel
def gradient_descent(
    lower_in: wp.array(dtype=wp.float32),
    upper_in: wp.array(dtype=wp.float32),
    active_in: wp.array(dtype=wp.int32),
    iteration_in: wp.array(dtype=wp.int32),
    rate_in: wp.array2d(dtype=wp.float32),
    gradient_in: wp.array2d(dtype=wp.float32),
    clamp_in: wp.int32,
    pivot_inout: wp.array(dtype=wp.vec3),
    rotation_inout: wp.array(dtype=wp.quat),
    q_inout: wp.array2d(dtype=wp.float32),
):
    """Take a step of the paper's plain gradient descent. Launch over B."""
    b = wp.tid()
    if active_in[b] == 0:
        return
    it = iteration_in[0]
    dx = wp.vec3(0.0)
    dw = wp.vec3(0.0)
    for column in range(gradient_in.shape[1]):
        step = -gradient_in[b, column]
        if column < 3:
            dx[column] = rate_in[it, 0] * step
        elif column < 6:
            dw[column - 3] = rate_in[it, 1] * step
        else:
            move(b, column, rate_in[it, column - 4] * step, lower_in, upper_in, clamp_in, q_inout)
    pivot_inout[b] = pivot_inout[b] + dx
    rotation_inout[b] = turn(rotation_inout[b], dw)


@wp.kernel
def advance(iteration_inout: wp.array(dtype=wp.int32)):
    """Count an iteration on the device: schedules are read there, so a captured graph is replayed. Over 1."""
    iteration_inout[0] = iteration_inout[0] + 1


@wp.kernel
def converge(
    loss_in: wp.array2d(dtype=wp.float32),
    point_depth_in: wp.array(dtype=wp.float32),
    object_depth_in: wp.array(dtype=wp.float32),
    self_depth_in: wp.array(dtype=wp.float32),
    patience_in: wp.int32,
    best_inout: wp.array(dtype=wp.float32),
    waited_inout: wp.array(dtype=wp.int32),
    active_inout: wp.array(dtype=wp.int32),
):
    """Switch off a grasp whose merit has not improved by 1 % for `patience` iterations. Launch over B.
    The merit is L_stable plus the penetration depths in millimetres, without the changing weights of a schedule."""
    b = wp.tid()
    if active_inout[b] == 0:
        return
    total = float(0.0)
    for m in range(loss_in.shape[1]):
        total += loss_in[b, m]
    depth = point_depth_in[b] + object_depth_in[b] + self_depth_in[b]
    merit = total / float(loss_in.shape[1]) + 1.0e3 * depth
    if merit < 0.99 * best_inout[b]:
        best_inout[b] = merit
        waited_inout[b] = 0
    else:
        waited_inout[b] = waited_inout[b] + 1
        if waited_inout[b] >= patience_in:
            active_inout[b] = 0

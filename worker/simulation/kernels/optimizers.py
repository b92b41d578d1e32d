"""One optimiser step per grasp; the root turns about the palm centre by a world rotation vector."""

import warp as wp

from graspd.worker.simulation.kernels.kinematics import Depths, Hands

wp.set_module_options({"enable_backward": False})


@wp.func
def turn(rotation: wp.quat, w: wp.vec3):
    """Apply exp(w) to a rotation, renormalised."""
    angle = wp.length(w)
    if angle < 1.0e-12:
        return rotation
    return wp.normalize(wp.quat_from_axis_angle(w / angle, angle) * rotation)


@wp.kernel
def descend(
    lower_in: wp.array(dtype=wp.float32),
    upper_in: wp.array(dtype=wp.float32),
    rate_in: wp.array2d(dtype=wp.float32),
    gradient_in: wp.array2d(dtype=wp.float32),
    adam_in: wp.int32,
    clamp_in: wp.int32,
    beta1_in: wp.float32,
    beta2_in: wp.float32,
    first_inout: wp.array2d(dtype=wp.float32),
    second_inout: wp.array2d(dtype=wp.float32),
    hands_inout: Hands,
):
    """Take a step of Adam (Kingma & Ba 2015), or of the paper's gradient descent if `adam` is 0.
    Rates: translation, rotation, every dof. With `clamp` 1, dofs stay inside their limits. Launch over B."""
    b = wp.tid()
    if hands_inout.active[b] == 0:
        return
    it = hands_inout.iteration[0]
    t = float(it + 1)
    correct1 = 1.0 / (1.0 - wp.pow(beta1_in, t))
    correct2 = 1.0 / (1.0 - wp.pow(beta2_in, t))
    dx = wp.vec3(0.0)
    dw = wp.vec3(0.0)
    for column in range(gradient_in.shape[1]):
        g = gradient_in[b, column]
        step = -g
        if adam_in == 1:
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
            d = column - 6
            value = hands_inout.q[b, d] + rate_in[it, column - 4] * step
            if clamp_in == 1:
                value = wp.clamp(value, lower_in[d], upper_in[d])
            hands_inout.q[b, d] = value
    hands_inout.pivot[b] = hands_inout.pivot[b] + dx
    hands_inout.rotation[b] = turn(hands_inout.rotation[b], dw)


@wp.kernel
def advance(iteration_inout: wp.array(dtype=wp.int32)):
    """Increase the iteration counter on the device, for replays of a captured graph. Launch over 1."""
    iteration_inout[0] = iteration_inout[0] + 1


@wp.kernel
def stop_converged(
    loss_in: wp.array2d(dtype=wp.float32),
    depths_in: Depths,
    patience_in: wp.int32,
    best_inout: wp.array(dtype=wp.float32),
    waited_inout: wp.array(dtype=wp.int32),
    active_inout: wp.array(dtype=wp.int32),
):
    """Switch off a grasp whose merit has not improved by 1 % for `patience` iterations. Launch over B.
    The merit is L_stable plus the sum of penetration depths [mm], without the changing weights of a schedule."""
    b = wp.tid()
    if active_inout[b] == 0:
        return
    total = float(0.0)
    for m in range(loss_in.shape[1]):
        total += loss_in[b, m]
    depth = depths_in.points[b] + depths_in.object[b] + depths_in.links[b]
    merit = total / float(loss_in.shape[1]) + 1.0e3 * depth
    if merit < 0.99 * best_inout[b]:
        best_inout[b] = merit
        waited_inout[b] = 0
    else:
        waited_inout[b] = waited_inout[b] + 1
        if waited_inout[b] >= patience_in:
            active_inout[b] = 0

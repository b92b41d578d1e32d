"""Forward kinematics and its transpose: joints to body poses, body wrenches to joint gradients."""

import warp as wp

from graspd.worker.simulation.kernels.wrenches import Wrenches, clear_wrench, force_on, torque_on

wp.set_module_options({"enable_backward": False})


@wp.struct
class Tree:
    """The hand's joint tree; arrays of length L (bodies). See `worker.hands.model.HandModel`."""

    parent: wp.array(dtype=wp.int32)
    joint_type: wp.array(dtype=wp.int32)
    origin_p: wp.array(dtype=wp.vec3)
    origin_q: wp.array(dtype=wp.quat)
    axis: wp.array(dtype=wp.vec3)
    dof: wp.array(dtype=wp.int32)
    multiplier: wp.array(dtype=wp.float32)
    offset: wp.array(dtype=wp.float32)
    pivot: wp.vec3  # palm centre in the root frame: the point the root turns about


@wp.kernel
def forward(
    tree_in: Tree,
    active_in: wp.array(dtype=wp.int32),
    pivot_in: wp.array(dtype=wp.vec3),
    rotation_in: wp.array(dtype=wp.quat),
    q_in: wp.array2d(dtype=wp.float32),
    body_p_out: wp.array2d(dtype=wp.vec3),
    body_q_out: wp.array2d(dtype=wp.quat),
    axis_out: wp.array2d(dtype=wp.vec3),
    wrench_out: Wrenches,
    count_out: wp.array(dtype=wp.int32),
    near_count_out: wp.array(dtype=wp.int32),
    point_depth_out: wp.array(dtype=wp.float32),
    object_depth_out: wp.array(dtype=wp.float32),
    self_depth_out: wp.array(dtype=wp.float32),
):
    """Compute poses of all bodies (B, L) and world axes of their joints; reset accumulators. Over B."""
    b = wp.tid()
    if active_in[b] == 0:
        return
    count_out[b] = 0
    near_count_out[b] = 0
    point_depth_out[b] = 0.0
    object_depth_out[b] = 0.0
    self_depth_out[b] = 0.0
    body_q_out[b, 0] = rotation_in[b]
    body_p_out[b, 0] = pivot_in[b] - wp.quat_rotate(rotation_in[b], tree_in.pivot)
    clear_wrench(wrench_out, b, 0)
    for body in range(1, tree_in.parent.shape[0]):
        parent = tree_in.parent[body]
        pq = body_q_out[b, parent]
        p = body_p_out[b, parent] + wp.quat_rotate(pq, tree_in.origin_p[body])
        q = pq * tree_in.origin_q[body]
        value = tree_in.multiplier[body] * q_in[b, tree_in.dof[body]] + tree_in.offset[body]
        axis = wp.quat_rotate(q, tree_in.axis[body])
        if tree_in.joint_type[body] == 1:
            q = q * wp.quat_from_axis_angle(tree_in.axis[body], value)
        else:
            p = p + axis * value
        body_p_out[b, body] = p
        body_q_out[b, body] = q
        axis_out[b, body] = axis
        clear_wrench(wrench_out, b, body)


@wp.kernel
def backward(
    tree_in: Tree,
    active_in: wp.array(dtype=wp.int32),
    pivot_in: wp.array(dtype=wp.vec3),
    body_p_in: wp.array2d(dtype=wp.vec3),
    axis_in: wp.array2d(dtype=wp.vec3),
    wrench_inout: Wrenches,
    gradient_out: wp.array2d(dtype=wp.float32),
):
    """Compute the gradient (B, 6 + D) of a loss from its gradient at bodies, wrenches.

    Wrenches are (force, torque about the object's origin). Columns: root translation, root rotation about the pivot
    (world axes), dofs. Launch over B.
    """
    b = wp.tid()
    if active_in[b] == 0:
        return
    for column in range(gradient_out.shape[1]):
        gradient_out[b, column] = float(0.0)
    count = tree_in.parent.shape[0]
    for k in range(1, count):
        body = count - k
        f = force_on(wrench_inout, b, body)
        t = torque_on(wrench_inout, b, body)
        axis = axis_in[b, body]
        g = wp.dot(axis, f)
        if tree_in.joint_type[body] == 1:
            g = wp.dot(axis, t - wp.cross(body_p_in[b, body], f))
        column = 6 + tree_in.dof[body]
        gradient_out[b, column] = gradient_out[b, column] + tree_in.multiplier[body] * g
        parent = tree_in.parent[body]
        for i in range(6):
            wrench_inout[b, parent, i] = wrench_inout[b, parent, i] + wrench_inout[b, body, i]
    f = force_on(wrench_inout, b, 0)
    t = torque_on(wrench_inout, b, 0) - wp.cross(pivot_in[b], f)
    for i in range(3):
        gradient_out[b, i] = f[i]
        gradient_out[b, 3 + i] = t[i]

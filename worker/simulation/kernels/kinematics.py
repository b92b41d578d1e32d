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


@wp.struct
class Hands:
    """B hands with L bodies and D dofs, in an iteration."""

    active: wp.array(dtype=wp.int32)
    iteration: wp.array(dtype=wp.int32)  # (1,)
    dilation_scale: wp.array(dtype=wp.float32)  # factor on the schedule's dilation
    scene: wp.array(dtype=wp.int32)  # -1 without scene
    pivot: wp.array(dtype=wp.vec3)  # palm centre
    rotation: wp.array(dtype=wp.quat)
    q: wp.array2d(dtype=wp.float32)
    body_p: wp.array2d(dtype=wp.vec3)  # (B, L)
    body_q: wp.array2d(dtype=wp.quat)
    axis: wp.array2d(dtype=wp.vec3)  # of each body's joint
    wrench: Wrenches


@wp.struct
class Depths:
    """Deepest penetrations (B,) at the last evaluation [m]."""

    points: wp.array(dtype=wp.float32)  # hand points in the object
    object: wp.array(dtype=wp.float32)  # the object in links
    links: wp.array(dtype=wp.float32)  # links in links
    obstacles: wp.array(dtype=wp.float32)  # shortfall of the distance from obstacles


@wp.kernel
def forward(
    tree_in: Tree,
    hands_inout: Hands,
    count_out: wp.array(dtype=wp.int32),
    near_count_out: wp.array(dtype=wp.int32),
    depths_out: Depths,
):
    """Compute poses (B, L) of all bodies and world axes of joints; reset accumulators. Launch over B."""
    b = wp.tid()
    hands = hands_inout
    if hands.active[b] == 0:
        return
    count_out[b] = 0
    near_count_out[b] = 0
    depths_out.points[b] = 0.0
    depths_out.object[b] = 0.0
    depths_out.links[b] = 0.0
    depths_out.obstacles[b] = 0.0
    hands.body_q[b, 0] = hands.rotation[b]
    hands.body_p[b, 0] = hands.pivot[b] - wp.quat_rotate(hands.rotation[b], tree_in.pivot)
    clear_wrench(hands.wrench, b, 0)
    for body in range(1, tree_in.parent.shape[0]):
        parent = tree_in.parent[body]
        pq = hands.body_q[b, parent]
        p = hands.body_p[b, parent] + wp.quat_rotate(pq, tree_in.origin_p[body])
        q = pq * tree_in.origin_q[body]
        value = tree_in.multiplier[body] * hands.q[b, tree_in.dof[body]] + tree_in.offset[body]
        axis = wp.quat_rotate(q, tree_in.axis[body])
        if tree_in.joint_type[body] == 1:
            q = q * wp.quat_from_axis_angle(tree_in.axis[body], value)
        else:
            p = p + axis * value
        hands.body_p[b, body] = p
        hands.body_q[b, body] = q
        hands.axis[b, body] = axis
        clear_wrench(hands.wrench, b, body)


@wp.kernel
def backward(tree_in: Tree, hands_inout: Hands, gradient_out: wp.array2d(dtype=wp.float32)):
    """Compute the gradient (B, 6 + D) of a loss from its gradients by bodies, the wrenches. Launch over B.
    Columns: root translation, root rotation about the pivot (world axes), dofs."""
    b = wp.tid()
    hands = hands_inout
    if hands.active[b] == 0:
        return
    for column in range(gradient_out.shape[1]):
        gradient_out[b, column] = float(0.0)
    count = tree_in.parent.shape[0]
    for k in range(1, count):
        body = count - k
        f = force_on(hands.wrench, b, body)
        t = torque_on(hands.wrench, b, body)
        axis = hands.axis[b, body]
        g = wp.dot(axis, f)
        if tree_in.joint_type[body] == 1:
            g = wp.dot(axis, t - wp.cross(hands.body_p[b, body], f))
        column = 6 + tree_in.dof[body]
        gradient_out[b, column] = gradient_out[b, column] + tree_in.multiplier[body] * g
        parent = tree_in.parent[body]
        for i in range(6):
            hands.wrench[b, parent, i] = hands.wrench[b, parent, i] + hands.wrench[b, body, i]
    f = force_on(hands.wrench, b, 0)
    t = torque_on(hands.wrench, b, 0) - wp.cross(hands.pivot[b], f)
    for i in range(3):
        gradient_out[b, i] = f[i]
        gradient_out[b, 3 + i] = t[i]

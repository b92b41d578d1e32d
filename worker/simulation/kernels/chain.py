"""Poses of a hand's bodies from root and joints, in double precision, and distances from half-spaces."""

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.struct
class Chain:
    """A hand's joint tree (L bodies), and F balls and rims sorted by body."""

    parent: wp.array(dtype=wp.int32)
    turns: wp.array(dtype=wp.int32)  # 1 for revolute joints
    joint: wp.array(dtype=wp.int32)  # column of the joint positions
    origin_p: wp.array(dtype=wp.vec3d)
    origin_q: wp.array(dtype=wp.quatd)
    axis: wp.array(dtype=wp.vec3d)
    dof: wp.array(dtype=wp.int32)
    multiplier: wp.array(dtype=wp.float64)  # factor from the dof's value to the joint's value
    offset: wp.array(dtype=wp.float64)  # added to this product
    tip: wp.array(dtype=wp.int32)  # 1 for fingertips
    first: wp.array(dtype=wp.int32)  # (L + 1,) first feature of each body
    centre: wp.array(dtype=wp.vec3d)  # (F,) body frame
    about: wp.array(dtype=wp.vec3d)  # (F,) axis of a rim; zero for a ball
    radius: wp.array(dtype=wp.float64)


@wp.struct
class Bodies:
    """Poses of the L bodies of P hands, (P, L)."""

    position: wp.array2d(dtype=wp.vec3d)
    rotation: wp.array2d(dtype=wp.quatd)


@wp.func
def place_body(chain: Chain, bodies: Bodies, p: wp.int32, body: wp.int32, value: wp.float64):
    """Compute the pose of a body from its parent's pose and the value of its joint [rad or m]."""
    turned = bodies.rotation[p, chain.parent[body]]
    place = bodies.position[p, chain.parent[body]] + wp.quat_rotate(turned, chain.origin_p[body])
    turned = turned * chain.origin_q[body]
    if chain.turns[body] == 1:
        turned = turned * wp.quat_from_axis_angle(chain.axis[body], value)
    else:
        place = place + value * wp.quat_rotate(turned, chain.axis[body])
    bodies.position[p, body] = place
    bodies.rotation[p, body] = turned


@wp.func
def joint_value(chain: Chain, body: wp.int32, q: wp.float64):
    return chain.multiplier[body] * q + chain.offset[body]


@wp.func
def joint_axis(chain: Chain, bodies: Bodies, p: wp.int32, body: wp.int32):
    """Return the axis of a body's joint in the frame of the poses; the joint's motion does not change it."""
    return wp.quat_rotate(bodies.rotation[p, body], chain.axis[body])


@wp.kernel
def pose(
    chain_in: Chain, root_in: wp.array2d(dtype=wp.float64), joints_in: wp.array2d(dtype=wp.float64), bodies_out: Bodies
):
    """Compute poses (P, L) of bodies from roots (P, 7), w x y z, and joints (P, J). Launch over P."""
    p = wp.tid()
    bodies_out.position[p, 0] = wp.vec3d(root_in[p, 0], root_in[p, 1], root_in[p, 2])
    bodies_out.rotation[p, 0] = wp.quatd(root_in[p, 4], root_in[p, 5], root_in[p, 6], root_in[p, 3])
    for body in range(1, chain_in.parent.shape[0]):
        place_body(chain_in, bodies_out, p, body, joints_in[p, chain_in.joint[body]])


@wp.struct
class HalfSpaces:
    """Half-spaces n.x <= d of S scenes, in sequence."""

    first: wp.array(dtype=wp.int32)  # (S + 1,)
    planes: wp.array(dtype=wp.vec4d)
    more: wp.array(dtype=wp.float64)  # added distance of fingertips [m]


@wp.kernel
def half_space_clearance(
    chain_in: Chain,
    spaces_in: HalfSpaces,
    scene_in: wp.array(dtype=wp.int32),
    body_p_in: wp.array2d(dtype=wp.vec3d),
    body_q_in: wp.array2d(dtype=wp.quatd),
    room_inout: wp.array2d(dtype=wp.float64),
):
    """Lower `room_inout` (P, L) to the signed distance of bodies from the half-spaces of their scene (P,).
    Launch over (P, L)."""
    p, body = wp.tid()
    place, turned = body_p_in[p, body], body_q_in[p, body]
    least = room_inout[p, body]
    for k in range(spaces_in.first[scene_in[p]], spaces_in.first[scene_in[p] + 1]):
        plane = spaces_in.planes[k]
        n = wp.vec3d(plane[0], plane[1], plane[2])
        height = wp.dot(n, place) - plane[3]
        if chain_in.tip[body] == 1:
            height = height + spaces_in.more[k]
        along = wp.quat_rotate_inv(turned, n)
        for f in range(chain_in.first[body], chain_in.first[body + 1]):
            cosine = wp.dot(chain_in.about[f], along)
            reach = chain_in.radius[f] * wp.sqrt(wp.max(wp.float64(0.0), wp.float64(1.0) - cosine * cosine))
            least = wp.min(least, height + wp.dot(chain_in.centre[f], along) - reach)
    room_inout[p, body] = least

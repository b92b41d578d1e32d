"""A hand's bodies from its root and joint positions on, in double precision, and how far they are from half-spaces."""

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.struct
class Chain:
    """A hand's joint tree (L bodies), and its features in the order of their bodies."""

    parent: wp.array(dtype=wp.int32)
    turns: wp.array(dtype=wp.int32)  # 1: revolute
    joint: wp.array(dtype=wp.int32)  # column of the joint positions
    origin_p: wp.array(dtype=wp.vec3d)
    origin_q: wp.array(dtype=wp.quatd)
    axis: wp.array(dtype=wp.vec3d)
    tip: wp.array(dtype=wp.int32)  # 1: a fingertip
    first: wp.array(dtype=wp.int32)  # (L + 1,) features of a body
    centre: wp.array(dtype=wp.vec3d)  # (F,) body frame
    about: wp.array(dtype=wp.vec3d)  # (F,) axis of a rim; zero: a ball
    radius: wp.array(dtype=wp.float64)


@wp.kernel
def pose(
    # Model:
    chain_in: Chain,
    # Inputs:
    root_in: wp.array2d(dtype=wp.float64),
    joints_in: wp.array2d(dtype=wp.float64),
    # Outputs:
    body_p_out: wp.array2d(dtype=wp.vec3d),
    body_q_out: wp.array2d(dtype=wp.quatd),
):
    """Poses of the bodies (P, L) of hands with roots (P, 7), quaternions w x y z, and joints (P, J). Launch over P."""
    p = wp.tid()
    body_p_out[p, 0] = wp.vec3d(root_in[p, 0], root_in[p, 1], root_in[p, 2])
    body_q_out[p, 0] = wp.quatd(root_in[p, 4], root_in[p, 5], root_in[p, 6], root_in[p, 3])
    for body in range(1, chain_in.parent.shape[0]):
        turned = body_q_out[p, chain_in.parent[body]]
        place = body_p_out[p, chain_in.parent[body]] + wp.quat_rotate(turned, chain_in.origin_p[body])
        turned = turned * chain_in.origin_q[body]
        value = joints_in[p, chain_in.joint[body]]
        if chain_in.turns[body] == 1:
            turned = turned * wp.quat_from_axis_angle(chain_in.axis[body], value)
        else:
            place = place + value * wp.quat_rotate(turned, chain_in.axis[body])
        body_p_out[p, body] = place
        body_q_out[p, body] = turned


@wp.struct
class HalfSpaces:
    """Half-spaces n.x <= d of S scenes, one after the other."""

    first: wp.array(dtype=wp.int32)  # (S + 1,)
    planes: wp.array(dtype=wp.vec4d)
    more: wp.array(dtype=wp.float64)  # by what fingertips count as farther [m]


@wp.kernel
def rooms(
    # Model:
    chain_in: Chain,
    spaces_in: HalfSpaces,
    # Inputs:
    scene_in: wp.array(dtype=wp.int32),
    body_p_in: wp.array2d(dtype=wp.vec3d),
    body_q_in: wp.array2d(dtype=wp.quatd),
    # Outputs:
    room_inout: wp.array2d(dtype=wp.float64),
):
    """Lower `room_inout` (P, L) to the signed distance of each body from the half-spaces of its scene (P,).

    Launch over (P, L).
    """
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

"""Intersection of mesh faces with convex pieces."""

import warp as wp

wp.set_module_options({"enable_backward": False})

#: Separations below this may be overlaps [m]: positions of some decimetres have rounding errors of a tenth of this.
SLACK = wp.constant(wp.float32(1.0e-7))


@wp.struct
class Solids:
    """Convex solids, each in the frame of its body: outward planes n x <= d, corners, and a bounding box."""

    plane: wp.array(dtype=wp.vec4)
    first_plane: wp.array(dtype=wp.int32)
    corner: wp.array(dtype=wp.vec3)
    first_corner: wp.array(dtype=wp.int32)
    middle: wp.array(dtype=wp.vec3)
    half: wp.array(dtype=wp.vec3)


@wp.func
def is_apart(solids: Solids, s: int, a: wp.vec3, b: wp.vec3, c: wp.vec3):
    """Check whether a face plane of the solid, or the triangle's plane, separates triangle and solid."""
    apart = wp.bool(False)
    i = solids.first_plane[s]
    while i < solids.first_plane[s + 1] and not apart:
        plane = solids.plane[i]
        n = wp.vec3(plane[0], plane[1], plane[2])
        apart = wp.min(wp.min(wp.dot(n, a), wp.dot(n, b)), wp.dot(n, c)) > plane[3] + SLACK
        i = i + 1
    if not apart:
        n = wp.normalize(wp.cross(b - a, c - a))
        low = float(1.0e9)
        high = float(-1.0e9)
        for i in range(solids.first_corner[s], solids.first_corner[s + 1]):
            height = wp.dot(n, solids.corner[i] - a)
            low = wp.min(low, height)
            high = wp.max(high, height)
        apart = low > SLACK or high < -SLACK
    return apart


@wp.kernel
def faces_in_solids(
    mesh_in: wp.uint64,
    solids_in: Solids,
    solid_in: wp.array(dtype=wp.int32),
    pose_in: wp.array(dtype=wp.transform),
    crossed_out: wp.array(dtype=wp.int32),
):
    """Write 1 if a face of the mesh may reach into solid `solid_in` with its body at `pose_in`, else 0."""
    k = wp.tid()
    s = solid_in[k]
    pose = pose_in[k]
    turn = wp.quat_to_matrix(wp.transform_get_rotation(pose))
    half = solids_in.half[s]
    reach = wp.vec3(SLACK)
    for i in range(3):
        for j in range(3):
            reach[i] = reach[i] + wp.abs(turn[i, j]) * half[j]
    middle = wp.transform_point(pose, solids_in.middle[s])
    back = wp.transform_inverse(pose)
    query = wp.mesh_query_aabb(mesh_in, middle - reach, middle + reach)
    mesh = wp.mesh_get(mesh_in)
    face = wp.int32(0)
    crossed = wp.int32(0)
    while wp.mesh_query_aabb_next(query, face):
        if crossed == 0:
            a = wp.transform_point(back, mesh.points[mesh.indices[3 * face]])
            b = wp.transform_point(back, mesh.points[mesh.indices[3 * face + 1]])
            c = wp.transform_point(back, mesh.points[mesh.indices[3 * face + 2]])
            if not is_apart(solids_in, s, a, b, c):
                crossed = 1
    crossed_out[k] = crossed

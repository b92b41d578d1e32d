"""Signed distance of hand points to the mesh, smoothed by Phong projection (paper, section III-B).

The inputs are the closest point b on a face, barycentric weights w_k, and corner normals n_k. The projection onto the
tangent plane of corner k is pi_k(b) = b - ((b - v_k).n_k) n_k. The smoothed surface point is
    r* = (1 - alpha) b + alpha sum_k w_k pi_k(b)   (Boubekeur & Alexa 2008; the paper's formula drops the first b).
The distance of a point r is sign |r - b| + (b - r*).n with the interpolated normal n. Unlike sign |r - r*| it is
continuous across the surface. Normals are not averaged across creases, so boxes and cylinders keep their edges."""

import warp as wp

from graspd.worker.simulation.kernels.kinematics import Hands
from graspd.worker.simulation.kernels.nearest import Cells, closest_in_cell
from graspd.worker.simulation.kernels.packing import Contacts

wp.set_module_options({"enable_backward": False})


@wp.struct
class Surface:
    """The object's surface on the device."""

    mesh: wp.uint64
    corner_normals: wp.array(dtype=wp.vec3)  # (3 F,)
    alpha: wp.float32
    field: wp.array3d(dtype=wp.float32)  # coarse grid of distances; empty if not used
    field_origin: wp.vec3
    field_cell: wp.float32
    field_error: wp.float32  # grid distances above `exact_below` + this are used without the mesh
    cells: Cells  # faces near each cell of the grid; without lists the mesh's tree is used


@wp.struct
class ContactRegions:
    """Regions of the object: intersections of half-spaces (K,), and voxels without contact.
    Half-spaces are n.x <= d as (n, d); the origin is the centre of mass."""

    allowed: wp.array(dtype=wp.vec4)  # contact only inside; empty: everywhere
    forbidden: wp.array(dtype=wp.vec4)  # no contact inside; empty: nowhere
    closed: wp.array3d(dtype=wp.uint8)  # 1: no contact; empty: contact everywhere
    origin: wp.vec3  # lowest corner of the first voxel
    cell: wp.float32  # edge of a voxel [m]
    clearance: wp.float32  # distance that points without contact keep from the surface [m]


@wp.struct
class SurfaceSample:
    """Distance and outward unit normal of the object at a point."""

    distance: wp.float32
    normal: wp.vec3


@wp.func
def smoothed_distance(
    surface: Surface, point: wp.vec3, closest: wp.vec3, face: wp.int32, u: wp.float32, v: wp.float32, sign: wp.float32
):
    """Return distance and normal at a point whose closest point has weights u, v, 1 - u - v of a face."""
    out = SurfaceSample()
    w = 1.0 - u - v
    n0 = surface.corner_normals[3 * face]
    n1 = surface.corner_normals[3 * face + 1]
    n2 = surface.corner_normals[3 * face + 2]
    # Corners from the closest point: v_0 = b - v ab - w ac, and so on.
    sides = surface.cells.faces.face[face]
    ab = sides.ab
    ac = sides.ac
    from0 = v * ab + w * ac
    smooth = wp.normalize(u * n0 + v * n1 + w * n2)
    # b - r* = alpha sum_k w_k ((b - v_k).n_k) n_k
    lift = (u * wp.dot(from0, n0)) * n0 + (v * wp.dot(from0 - ab, n1)) * n1 + (w * wp.dot(from0 - ac, n2)) * n2
    offset = point - closest
    gap = wp.length(offset)
    out.distance = sign * gap + surface.alpha * wp.dot(lift, smooth)
    # Far from the surface the gradient is the direction to the closest point; on the surface this direction is 0/0.
    share = wp.min(gap / 1.0e-3, 1.0)
    direction = (1.0 - share) * smooth
    if gap > 1.0e-9:
        direction = direction + (share * sign / gap) * offset
    length = wp.length(direction)
    if length > 1.0e-6:
        out.normal = direction / length
    else:
        out.normal = smooth
    return out


@wp.func
def mesh_distance(surface: Surface, point: wp.vec3, reach: wp.float32):
    """Return smoothed signed distance and normal; distance = reach and normal 0 beyond `reach`."""
    out = SurfaceSample()
    out.distance = reach
    out.normal = wp.vec3(0.0)
    query = wp.mesh_query_point_sign_normal(surface.mesh, point, reach)
    if query.result:
        closest = wp.mesh_eval_position(surface.mesh, query.face, query.u, query.v)
        out = smoothed_distance(surface, point, closest, query.face, query.u, query.v, query.sign)
    return out


@wp.func
def cell_at(surface: Surface, x: wp.vec3):
    """Return the cell of a place x (from the grid's origin, in cells), and whether the grid has this cell."""
    i = int(wp.floor(x[0]))
    j = int(wp.floor(x[1]))
    k = int(wp.floor(x[2]))
    nx = surface.field.shape[0] - 1
    ny = surface.field.shape[1] - 1
    nz = surface.field.shape[2] - 1
    return i, j, k, i >= 0 and j >= 0 and k >= 0 and i < nx and j < ny and k < nz


@wp.func
def near_distance(surface: Surface, point: wp.vec3, reach: wp.float32):
    """Return the result of `mesh_distance`, from the list of the point's cell if the cell has one."""
    i, j, k, inside = cell_at(surface, (point - surface.field_origin) / surface.field_cell)
    if inside:
        ny = surface.field.shape[1] - 1
        nz = surface.field.shape[2] - 1
        centre = surface.field_origin + surface.field_cell * wp.vec3(float(i) + 0.5, float(j) + 0.5, float(k) + 0.5)
        found = closest_in_cell(surface.cells, (i * ny + j) * nz + k, centre, point)
        if found.face >= 0:
            out = smoothed_distance(
                surface, point, found.point, found.face, 1.0 - found.v - found.w, found.v, found.sign
            )
            if found.gap >= reach:
                out.distance = reach
                out.normal = wp.vec3(0.0)
            return out
    return mesh_distance(surface, point, reach)


@wp.struct
class Cube:
    """Distances at the corners of a point's cell of the grid, and the point's place in it."""

    inside: wp.bool
    at: wp.vec3  # 0 to 1 along each axis
    f000: wp.float32
    f100: wp.float32
    f010: wp.float32
    f110: wp.float32
    f001: wp.float32
    f101: wp.float32
    f011: wp.float32
    f111: wp.float32


@wp.func
def cube_around(surface: Surface, point: wp.vec3):
    """Return the cell of a point; `inside` is whether the grid has one."""
    cube = Cube()
    x = (point - surface.field_origin) / surface.field_cell
    i, j, k, inside = cell_at(surface, x)
    cube.inside = inside
    if inside:
        cube.at = wp.vec3(x[0] - float(i), x[1] - float(j), x[2] - float(k))
        cube.f000 = surface.field[i, j, k]
        cube.f100 = surface.field[i + 1, j, k]
        cube.f010 = surface.field[i, j + 1, k]
        cube.f110 = surface.field[i + 1, j + 1, k]
        cube.f001 = surface.field[i, j, k + 1]
        cube.f101 = surface.field[i + 1, j, k + 1]
        cube.f011 = surface.field[i, j + 1, k + 1]
        cube.f111 = surface.field[i + 1, j + 1, k + 1]
    return cube


@wp.func
def cube_distance(cube: Cube):
    """Interpolate trilinearly; 1e3 m outside the grid."""
    if not cube.inside:
        return float(1.0e3)
    a = cube.at[0]
    b = cube.at[1]
    f00 = cube.f000 + a * (cube.f100 - cube.f000)
    f10 = cube.f010 + a * (cube.f110 - cube.f010)
    f01 = cube.f001 + a * (cube.f101 - cube.f001)
    f11 = cube.f011 + a * (cube.f111 - cube.f011)
    f0 = f00 + b * (f10 - f00)
    f1 = f01 + b * (f11 - f01)
    return f0 + cube.at[2] * (f1 - f0)


@wp.func
def cube_normal(cube: Cube):
    """Return the direction of the exact gradient of the interpolation; 0 outside the grid."""
    if not cube.inside:
        return wp.vec3(0.0)
    a = cube.at[0]
    b = cube.at[1]
    c = cube.at[2]
    x00 = cube.f100 - cube.f000
    x10 = cube.f110 - cube.f010
    x01 = cube.f101 - cube.f001
    x11 = cube.f111 - cube.f011
    f00 = cube.f000 + a * x00
    f10 = cube.f010 + a * x10
    f01 = cube.f001 + a * x01
    f11 = cube.f011 + a * x11
    x0 = x00 + b * (x10 - x00)
    x1 = x01 + b * (x11 - x01)
    y = (f10 - f00) + c * ((f11 - f01) - (f10 - f00))
    z = (f01 + b * (f11 - f01)) - (f00 + b * (f10 - f00))
    return wp.normalize(wp.vec3(x0 + c * (x1 - x0), y, z))


@wp.func
def field_distance(surface: Surface, point: wp.vec3):
    """Interpolate the grid trilinearly, with exact gradient; distance 1e3 m outside the grid."""
    cube = cube_around(surface, point)
    out = SurfaceSample()
    out.distance = cube_distance(cube)
    out.normal = cube_normal(cube)
    return out


@wp.func
def distance(surface: Surface, point: wp.vec3, reach: wp.float32, exact_below: wp.float32, keep: wp.float32):
    """Return the mesh's distance near the surface, else the grid's; `reach` outside the grid.
    Grid distances of at least `keep` (at least `exact_below`) also become `reach`."""
    if surface.field.shape[0] > 0:
        cube = cube_around(surface, point)
        coarse = cube_distance(cube)
        if coarse > exact_below + surface.field_error:
            out = SurfaceSample()
            out.distance = reach
            out.normal = wp.vec3(0.0)
            if coarse < keep:
                out.distance = coarse
                out.normal = cube_normal(cube)
            return out
        return near_distance(surface, point, reach)
    return mesh_distance(surface, point, reach)


@wp.kernel
def sample_field(
    surface_in: Surface,
    origin_in: wp.vec3,
    cell_in: wp.float32,
    reach_in: wp.float32,
    field_out: wp.array3d(dtype=wp.float32),
):
    """Fill a grid with mesh distances. Launch over the grid."""
    i, j, k = wp.tid()
    point = origin_in + cell_in * wp.vec3(float(i), float(j), float(k))
    field_out[i, j, k] = mesh_distance(surface_in, point, reach_in).distance


@wp.func
def is_inside(planes: wp.array(dtype=wp.vec4), x: wp.vec3):
    for k in range(planes.shape[0]):
        plane = planes[k]
        if plane[0] * x[0] + plane[1] * x[1] + plane[2] * x[2] > plane[3]:
            return False
    return True


@wp.func
def in_voxels(voxels: wp.array3d(dtype=wp.uint8), x: wp.vec3):
    """Return the value of the voxel nearest to a place in units of voxels."""
    i = wp.clamp(wp.int32(wp.floor(x[0])), 0, voxels.shape[0] - 1)
    j = wp.clamp(wp.int32(wp.floor(x[1])), 0, voxels.shape[1] - 1)
    k = wp.clamp(wp.int32(wp.floor(x[2])), 0, voxels.shape[2] - 1)
    return voxels[i, j, k] != wp.uint8(0)


@wp.func
def is_forbidden(regions: ContactRegions, x: wp.vec3):
    """Check whether a place on the surface must not be touched."""
    if regions.closed.shape[0] > 0 and in_voxels(regions.closed, (x - regions.origin) / regions.cell):
        return True
    if regions.allowed.shape[0] > 0 and not is_inside(regions.allowed, x):
        return True
    return regions.forbidden.shape[0] > 0 and is_inside(regions.forbidden, x)


@wp.kernel
def gather(
    surface_in: Surface,
    regions_in: ContactRegions,
    band_in: wp.float32,
    exact_in: wp.float32,
    keep_in: wp.float32,
    near_gap_in: wp.float32,
    lane_in: wp.int32,
    body_in: wp.array(dtype=wp.int32),
    position_in: wp.array(dtype=wp.vec3),
    weight_in: wp.array(dtype=wp.float32),
    dilation_in: wp.array(dtype=wp.float32),
    hands_in: Hands,
    contacts_inout: Contacts,
):
    """Pack each grasp's candidate contacts: points closer than dilation + keep. Launch over (B, N / lane).
    `near` lists contacts with a gap of at most `near_gap`. If `mark` is not empty, each point is written with a mark
    to its own index, for `packing.pack`. Points that must not touch keep the clearance of `regions`: their weights are
    negative, and their distances are those from the surface moved outwards by the clearance."""
    b, part = wp.tid()
    if hands_in.active[b] == 0:
        return
    dilation = hands_in.dilation_scale[b] * dilation_in[hands_in.iteration[0]]
    reach = dilation + band_in
    keep = dilation + keep_in
    apart = contacts_inout.mark.shape[0] > 0
    for i in range(part * lane_in, wp.min((part + 1) * lane_in, body_in.shape[0])):
        body = body_in[i]
        point = hands_in.body_p[b, body] + wp.quat_rotate(hands_in.body_q[b, body], position_in[i])
        sample = distance(surface_in, point, reach, wp.max(exact_in, regions_in.clearance), keep + regions_in.clearance)
        kept = sample.distance < keep
        weight = weight_in[i]
        if weight > 0.0 and is_forbidden(regions_in, point - sample.distance * sample.normal):
            weight = -weight
        if weight < 0.0:
            kept = sample.distance < wp.min(reach, keep + regions_in.clearance)
            sample.distance = sample.distance - regions_in.clearance
        near = kept and weight > 0.0 and sample.distance - dilation <= near_gap_in
        k = i
        if apart:
            contacts_inout.mark[b, i] = wp.int32(kept) + wp.int32(near)
        elif kept:
            k = wp.atomic_add(contacts_inout.count, b, 1)
            if near:
                contacts_inout.near[b, wp.atomic_add(contacts_inout.near_count, b, 1)] = k
        if kept:
            contacts_inout.body[b, k] = body
            contacts_inout.point[b, k] = point
            contacts_inout.normal[b, k] = sample.normal
            contacts_inout.distance[b, k] = sample.distance
            contacts_inout.weight[b, k] = weight
            contacts_inout.gradient[b, k] = 0.0

"""Rays against solids, as Warp functions: the first hit, and occlusion.

A world is a few solids in their own poses: meshes with trees that all worlds share, and boxes in closed form. Solids
are so few that a ray tests the bounds of each."""

import warp as wp

FAR = wp.constant(100.0)  # maximum length of rays [m]
#: Offset of shadow rays from their surface, along its normal [m].
CLEAR = wp.constant(1.0e-4)
_TINY = wp.constant(1.0e-15)


@wp.struct
class PlacedSolid:
    """A solid in a world."""

    lower: wp.vec3f  # bounds along the axes of the world [m]
    upper: wp.vec3f
    place: wp.vec3f  # origin of the solid [m]
    turn: wp.mat33f  # rotation from the world's axes to the solid's
    mesh: wp.uint64  # id of a `wp.Mesh` in its own frame; 0 for a box around its origin
    half: wp.vec3f  # half the extents of the box [m]
    first_corner: wp.int32  # first index of the mesh's corner normals


@wp.struct
class RayHit:
    """First hit of a ray."""

    shape: wp.int32  # index of the solid; -1 without a hit
    distance: wp.float32  # in lengths of the ray's direction
    normal: wp.vec3f  # unit normal in the world's frame; on meshes interpolated between corner normals


@wp.func
def inverse_of(direction: wp.vec3f):
    """Return the reciprocal of each component, finite."""
    inverse = wp.vec3f()
    for k in range(3):
        d = direction[k]
        inverse[k] = 1.0 / wp.where(wp.abs(d) < _TINY, _TINY, d)
    return inverse


@wp.func
def bit_of(k: wp.int32):
    return wp.uint64(1) << wp.uint64(k & 63)


@wp.func
def passes_through(lower: wp.vec3f, upper: wp.vec3f, origin: wp.vec3f, inverse: wp.vec3f, far: wp.float32):
    """Check whether a ray passes through bounds before `far`."""
    a = wp.cw_mul(lower - origin, inverse)
    b = wp.cw_mul(upper - origin, inverse)
    low = wp.min(a, b)
    high = wp.max(a, b)
    enters = wp.max(wp.max(low[0], low[1]), wp.max(low[2], 0.0))
    leaves = wp.min(wp.min(high[0], high[1]), wp.min(high[2], far))
    return enters <= leaves


@wp.func
def box_distance(half: wp.vec3f, origin: wp.vec3f, direction: wp.vec3f):
    """Return the distance to the first face of a box, or from inside to the exit face; -1 without a hit.
    Also return the axis of the face's normal."""
    inverse = inverse_of(direction)
    a = wp.cw_mul(-half - origin, inverse)
    b = wp.cw_mul(half - origin, inverse)
    low = wp.min(a, b)
    high = wp.max(a, b)
    enters = wp.max(low)
    leaves = wp.min(high)
    if enters > leaves or leaves < 0.0:
        return wp.float32(-1.0), wp.int32(0)
    if enters >= 0.0:
        return enters, wp.where(low[0] == enters, 0, wp.where(low[1] == enters, 1, 2))
    return leaves, wp.where(high[0] == leaves, 0, wp.where(high[1] == leaves, 1, 2))


@wp.func
def hit_mask(
    placed: wp.array2d[PlacedSolid], world: wp.int32, origin: wp.vec3f, direction: wp.vec3f, spread: wp.float32
):
    """Return a mask with bit k set if a unit ray within `spread` of this one may hit solid k.
    Solids from the 64th on share bits."""
    inverse = inverse_of(direction)
    near = wp.uint64(0)
    for k in range(placed.shape[1]):
        there = placed[world, k]
        # Inside the bounds, a ray deviates most at their farthest corner.
        off = spread * wp.length(wp.max(wp.abs(there.lower - origin), wp.abs(there.upper - origin)))
        wide = wp.vec3f(off, off, off)
        if passes_through(there.lower - wide, there.upper + wide, origin, inverse, FAR):
            near = near | bit_of(k)
    return near


@wp.func
def is_on_one_face(there: PlacedSolid, hit: RayHit, point: wp.vec3f, direction: wp.vec3f, spread: wp.float32):
    """Check whether all rays within `spread` of this one hit the same plane, unless another solid is hit.
    The plane is the face of a box, away from its edges."""
    if there.mesh != wp.uint64(0):
        return False
    reach = 2.0 * spread * hit.distance / wp.max(-wp.dot(hit.normal, direction), 0.01)
    inside = there.half - wp.abs(there.turn * (point - there.place))
    normal = wp.abs(there.turn * hit.normal)
    for k in range(3):
        if inside[k] < reach and normal[k] < 0.5:
            return False
    return True


@wp.func
def first_hit(
    placed: wp.array2d[PlacedSolid],
    corner_normals: wp.array[wp.vec3f],
    world: wp.int32,
    near: wp.uint64,
    origin: wp.vec3f,
    direction: wp.vec3f,
):
    """Return the first hit of a ray among solids that it `hit_mask`; meshes hit from inside are ignored."""
    hit = RayHit()
    hit.shape = wp.int32(-1)
    hit.distance = FAR
    face = wp.int32(-1)
    u = wp.float32(0.0)
    v = wp.float32(0.0)
    smooth = wp.vec3f()
    inverse = inverse_of(direction)
    for k in range(placed.shape[1]):
        there = placed[world, k]
        if near & bit_of(k) != wp.uint64(0) and passes_through(there.lower, there.upper, origin, inverse, hit.distance):
            start = there.turn * (origin - there.place)
            along = there.turn * direction
            if there.mesh != wp.uint64(0):
                query = wp.mesh_query_ray(there.mesh, start, along, hit.distance)
                if query.result and wp.dot(along, query.normal) < 0.0:
                    hit.shape = k
                    hit.distance = query.t
                    face = query.face
                    u = query.u
                    v = query.v
            else:
                distance, axis = box_distance(there.half, start, along)
                if distance >= 0.0 and distance < hit.distance:
                    hit.shape = k
                    hit.distance = distance
                    # Towards the ray's origin, also for a hit from inside.
                    smooth = wp.vec3f()
                    smooth[axis] = -wp.sign(along[axis])
    if hit.shape >= 0:
        there = placed[world, hit.shape]
        if there.mesh != wp.uint64(0):
            corner = there.first_corner + 3 * face
            smooth = corner_normals[corner] * u + corner_normals[corner + 1] * v
            smooth = wp.normalize(smooth + corner_normals[corner + 2] * (1.0 - u - v))
        hit.normal = wp.transpose(there.turn) * smooth
    return hit


@wp.func
def is_occluded(placed: wp.array2d[PlacedSolid], world: wp.int32, origin: wp.vec3f, direction: wp.vec3f):
    """Check whether a ray hits anything."""
    inverse = inverse_of(direction)
    for k in range(placed.shape[1]):
        there = placed[world, k]
        if passes_through(there.lower, there.upper, origin, inverse, FAR):
            start = there.turn * (origin - there.place)
            along = there.turn * direction
            if there.mesh != wp.uint64(0):
                if wp.mesh_query_ray_anyhit(there.mesh, start, along, FAR):
                    return True
            else:
                distance, _axis = box_distance(there.half, start, along)
                if distance >= 0.0:
                    return True
    return False

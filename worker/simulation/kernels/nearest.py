"""The closest point of a triangle mesh by lists: grid cells near the surface list their nearest faces.

No tree is traversed. Let D be the distance of a cell's centre from the surface, and h half the cell's diagonal. The
nearest face to a point of the cell is at most D + 2 h from the centre. Faces are sorted by their distance k from the
centre. A point at distance e from the centre skips faces with k - e above its least distance so far. The sign is that
of the angle-weighted normal of the feature with the closest point (Baerentzen & Aanaes 2005)."""

import warp as wp

wp.set_module_options({"enable_backward": False})

#: Features of a face for `Faces.normal`: its inside, the edges ab, bc, ca, the corners a, b, c.
FEATURES = wp.constant(7)


@wp.struct
class Face:
    """A triangle a, b, c with the data of its distance, contiguous in memory."""

    a: wp.vec3
    ab: wp.vec3
    ac: wp.vec3
    square: wp.vec3  # ab.ab, ab.ac, ac.ac


@wp.struct
class Faces:
    """F triangles."""

    face: wp.array(dtype=Face)
    normal: wp.array(dtype=wp.vec3)  # (7 F,) outward, angle-weighted


@wp.struct
class Cells:
    """Faces listed by cells; without lists all arrays are empty."""

    faces: Faces
    first: wp.array(dtype=wp.int32)  # (cells + 1,)
    face: wp.array(dtype=wp.int32)
    key: wp.array(dtype=wp.float32)  # distance of the face from the cell's centre, ascending in a cell


@wp.struct
class ClosestPoint:
    """A closest point of the mesh: a + v ab + w ac."""

    face: wp.int32  # -1 without face
    v: wp.float32
    w: wp.float32
    point: wp.vec3
    gap: wp.float32  # unsigned
    sign: wp.float32


@wp.func
def closest_on_face(face: Face, p: wp.vec3):
    """Return weights v, w of a face's nearest point to p, and its feature (Ericson 2005, section 5.1.5)."""
    ab = face.ab
    ac = face.ac
    square = face.square
    ap = p - face.a
    d1 = wp.dot(ab, ap)
    d2 = wp.dot(ac, ap)
    if d1 <= 0.0 and d2 <= 0.0:
        return wp.vec3(0.0, 0.0, 4.0)
    d3 = d1 - square[0]
    d4 = d2 - square[1]
    if d3 >= 0.0 and d4 <= d3:
        return wp.vec3(1.0, 0.0, 5.0)
    vc = d1 * d4 - d3 * d2
    if vc <= 0.0 and d1 >= 0.0 and d3 <= 0.0:
        return wp.vec3(d1 / (d1 - d3), 0.0, 1.0)
    d5 = d1 - square[1]
    d6 = d2 - square[2]
    if d6 >= 0.0 and d5 <= d6:
        return wp.vec3(0.0, 1.0, 6.0)
    vb = d5 * d2 - d1 * d6
    if vb <= 0.0 and d2 >= 0.0 and d6 <= 0.0:
        return wp.vec3(0.0, d2 / (d2 - d6), 3.0)
    va = d3 * d6 - d5 * d4
    if va <= 0.0 and d4 - d3 >= 0.0 and d5 - d6 >= 0.0:
        w = (d4 - d3) / ((d4 - d3) + (d5 - d6))
        return wp.vec3(1.0 - w, w, 2.0)
    total = va + vb + vc
    return wp.vec3(vb / total, vc / total, 0.0)


@wp.func
def closest_in_cell(cells: Cells, cell: wp.int32, centre: wp.vec3, p: wp.vec3):
    """Return the closest point of the mesh to p, in the cell with this centre; face -1 if none is listed."""
    out = ClosestPoint()
    out.face = -1
    off = wp.length(p - centre)
    best = float(1.0e30)
    feature = float(0.0)
    least = float(1.0e15)
    for k in range(cells.first[cell], cells.first[cell + 1]):
        if cells.key[k] - off > least:
            break
        index = cells.face[k]
        face = cells.faces.face[index]
        at = closest_on_face(face, p)
        point = face.a + at[0] * face.ab + at[1] * face.ac
        offset = p - point
        square = wp.dot(offset, offset)
        if square < best:
            best = square
            least = wp.sqrt(square)
            feature = at[2]
            out.face = index
            out.v = at[0]
            out.w = at[1]
            out.point = point
    if out.face >= 0:
        out.gap = least
        out.sign = 1.0
        if wp.dot(cells.faces.normal[7 * out.face + int(feature)], p - out.point) < 0.0:
            out.sign = -1.0
    return out


@wp.func
def face_key(face: Face, centre: wp.vec3):
    """Return the distance of a face from a cell's centre."""
    at = closest_on_face(face, centre)
    return wp.length(face.a + at[0] * face.ab + at[1] * face.ac - centre)


@wp.func
def cell_indices(cell: wp.int32, shape: wp.vec3i):
    """Return a cell's indices along the axes from its linear index."""
    return wp.vec3i(cell // (shape[1] * shape[2]), (cell // shape[2]) % shape[1], cell % shape[2])


@wp.func
def cell_centre(place: wp.vec3i, low: wp.vec3, size: wp.float32):
    return low + size * wp.vec3(float(place[0]) + 0.5, float(place[1]) + 0.5, float(place[2]) + 0.5)


@wp.kernel
def count_faces(
    mesh_in: wp.uint64,
    faces_in: Faces,
    low_in: wp.vec3,
    size_in: wp.float32,
    field_in: wp.array3d(dtype=wp.float32),
    within_in: wp.float32,
    radius_out: wp.array(dtype=wp.float32),
    count_out: wp.array(dtype=wp.int32),
):
    """Count the faces to list for each cell with a corner within `within`; store their largest distance.
    Launch over the cells, in the order of their index."""
    cell = wp.tid()
    place = cell_indices(cell, wp.vec3i(field_in.shape[0] - 1, field_in.shape[1] - 1, field_in.shape[2] - 1))
    least = float(1.0e3)
    low = float(1.0e3)
    high = float(-1.0e3)
    for corner in range(8):
        value = field_in[place[0] + corner // 4, place[1] + (corner // 2) % 2, place[2] + corner % 2]
        least = wp.min(least, wp.abs(value))
        low = wp.min(low, value)
        high = wp.max(high, value)
    count_out[cell] = 0
    if least > within_in and low * high > 0.0:
        return
    centre = cell_centre(place, low_in, size_in)
    query = wp.mesh_query_point_no_sign(mesh_in, centre, 1.0e3)
    if not query.result:
        return
    # Half a diagonal is 0.866 of the cell's size; slightly more is used because of rounding.
    radius = wp.length(wp.mesh_eval_position(mesh_in, query.face, query.u, query.v) - centre) + 1.74 * size_in
    radius_out[cell] = radius
    extent = wp.vec3(radius, radius, radius)
    near = wp.mesh_query_aabb(mesh_in, centre - extent, centre + extent)
    index = wp.int32(0)
    count = wp.int32(0)
    while wp.mesh_query_aabb_next(near, index):
        if face_key(faces_in.face[index], centre) <= radius:
            count += 1
    count_out[cell] = count


@wp.kernel
def list_faces(
    mesh_in: wp.uint64,
    faces_in: Faces,
    low_in: wp.vec3,
    size_in: wp.float32,
    shape_in: wp.vec3i,
    radius_in: wp.array(dtype=wp.float32),
    first_in: wp.array(dtype=wp.int32),
    face_out: wp.array(dtype=wp.int32),
    key_out: wp.array(dtype=wp.float32),
):
    """Fill the lists counted by `count_faces`, nearest faces first. Launch over the cells."""
    cell = wp.tid()
    start = first_in[cell]
    if first_in[cell + 1] == start:
        return
    centre = cell_centre(cell_indices(cell, shape_in), low_in, size_in)
    radius = radius_in[cell]
    extent = wp.vec3(radius, radius, radius)
    near = wp.mesh_query_aabb(mesh_in, centre - extent, centre + extent)
    index = wp.int32(0)
    count = wp.int32(0)
    while wp.mesh_query_aabb_next(near, index):
        key = face_key(faces_in.face[index], centre)
        if key <= radius and start + count < first_in[cell + 1]:
            place = start + count
            # Equal keys are ordered by face index: the nearest face does not depend on the tree.
            while place > start and (
                key_out[place - 1] > key or (key_out[place - 1] == key and face_out[place - 1] > index)
            ):
                key_out[place] = key_out[place - 1]
                face_out[place] = face_out[place - 1]
                place -= 1
            key_out[place] = key
            face_out[place] = index
            count += 1

"""Warp kernels that rasterise triangles, with a shadow map per direction of light.

Pictures have 2 x 2 samples per pixel. A film has so many pixels that rays cost too much. Triangles are tested with
homogeneous edge functions (Olano and Greer 1997), so none is clipped. A sample's key has its depth in the upper 32 bits
and its face in the lower ones."""

import warp as wp

from graspd.worker.rendering.kernels import exposure, shading

wp.set_module_options({"enable_backward": False})

NONE = wp.constant(wp.int64(2**63 - 1))  # key of a sample without a face
_NEAR = wp.constant(1.0e-3)  # [m]
_CREASE = wp.constant(0.9)  # cosine of normals below which samples of a pixel have their own colours


@wp.struct
class Triangles:
    """All solids as one mesh; parts of it move."""

    point: wp.array[wp.vec3f]  # in the scene's frame
    corner: wp.array2d[wp.int32]  # (F, 3) indices of points
    normal: wp.array2d[wp.vec3f]  # (F, 3) in the frame of the face's part
    part: wp.array[wp.int32]  # (F,)
    pose: wp.array[wp.transformf]  # of each part
    material: wp.array[shading.Material]  # of each part


@wp.struct
class View:
    """A pinhole camera, or the parallel projection of a shadow map; z points forward."""

    place: wp.transformf  # pose in the scene
    inverse: wp.transformf
    focal: wp.float32  # [samples], for a parallel projection [samples/m]
    parallel: wp.bool
    still: wp.bool  # whether the picture's background was rendered before


@wp.kernel
def move(
    part_in: wp.array[wp.int32], point_in: wp.array[wp.vec3f], pose_in: wp.array[wp.transformf], out: wp.array[wp.vec3f]
):
    k = wp.tid()
    out[k] = wp.transform_point(pose_in[part_in[k]], point_in[k])


@wp.func
def projected(view: View, width: wp.int32, height: wp.int32, local: wp.vec3f):
    """Return homogeneous coordinates in samples of a point in the view's frame."""
    w = wp.where(view.parallel, 1.0, local[2])
    x = view.focal * local[0] + 0.5 * wp.float32(width) * w
    return wp.vec3f(x, view.focal * local[1] + 0.5 * wp.float32(height) * w, w)


@wp.kernel
def cover(
    scene: Triangles, supports: wp.int32, first_part: wp.int32, view_in: wp.array[View], key_out: wp.array3d[wp.int64]
):
    """Write keys of the nearest faces, without parts before `first_part` and back faces of supports."""
    k, face = wp.tid()
    if scene.part[face] < first_part:
        return
    view = view_in[k]
    height = key_out.shape[1]
    width = key_out.shape[2]
    h = wp.mat33f()
    depth = wp.vec3f()
    for i in range(3):
        local = wp.transform_point(view.inverse, scene.point[scene.corner[face, i]])
        h[i] = projected(view, width, height, local)
        depth[i] = local[2]
    n0 = wp.cross(h[1], h[2])
    n1 = wp.cross(h[2], h[0])
    n2 = wp.cross(h[0], h[1])
    side = wp.sign(wp.dot(h[0], n0))
    if side > 0.0 and scene.part[face] < supports:
        return
    low = wp.vec2f(1.0e9, 1.0e9)
    high = wp.vec2f(-1.0e9, -1.0e9)
    for i in range(3):
        a = h[i]
        b = h[(i + 1) % 3]
        if a[2] > _NEAR:
            at = wp.vec2f(a[0], a[1]) / a[2]
            low = wp.min(low, at)
            high = wp.max(high, at)
        if (a[2] > _NEAR) != (b[2] > _NEAR):
            c = a + (b - a) * ((_NEAR - a[2]) / (b[2] - a[2]))
            at = wp.vec2f(c[0], c[1]) / _NEAR
            low = wp.min(low, at)
            high = wp.max(high, at)
    left = wp.max(wp.int32(wp.ceil(wp.max(low[0] - 0.5, 0.0))), 0)
    right = wp.min(wp.int32(wp.floor(wp.min(high[0] - 0.5, wp.float32(width - 1)))), width - 1)
    top = wp.max(wp.int32(wp.ceil(wp.max(low[1] - 0.5, 0.0))), 0)
    bottom = wp.min(wp.int32(wp.floor(wp.min(high[1] - 0.5, wp.float32(height - 1)))), height - 1)
    across = wp.vec3f(n0[0], n1[0], n2[0]) * side
    down = wp.vec3f(n0[1], n1[1], n2[1]) * side
    corner = wp.vec3f(n0[2], n1[2], n2[2]) * side + 0.5 * (across + down)
    for row in range(top, bottom + 1):
        start = corner + wp.float32(row) * down
        first = left
        last = right
        if right - left > 8:
            # Samples outside of an edge are skipped, except one on each side because of rounding.
            for i in range(3):
                if across[i] > 0.0:
                    first = wp.max(first, wp.int32(wp.clamp(-start[i] / across[i], 0.0, 1.0e5)) - 1)
                elif across[i] < 0.0:
                    last = wp.min(last, wp.int32(wp.clamp(-start[i] / across[i], -2.0, 1.0e5)) + 1)
        for column in range(first, last + 1):
            e = start + wp.float32(column) * across
            if e[0] >= 0.0 and e[1] >= 0.0 and e[2] >= 0.0:
                z = wp.dot(e, depth) / (e[0] + e[1] + e[2])
                if z > _NEAR:
                    key = (wp.int64(wp.cast(z, wp.int32)) << wp.int64(32)) | wp.int64(face)
                    wp.atomic_min(key_out, k, row, column, key)


@wp.func
def face_of(key: wp.int64):
    return wp.int32(key & wp.int64(0x7FFFFFFF))


@wp.func
def depth_of(key: wp.int64):
    return wp.cast(wp.int32(key >> wp.int64(32)), wp.float32)


@wp.func
def ray_through(view: View, size: wp.vec2f, row: wp.int32, column: wp.int32):
    """Return the direction through a sample, of length 1 along the optical axis."""
    x = (wp.float32(column) + 0.5 - 0.5 * size[0]) / view.focal
    y = (wp.float32(row) + 0.5 - 0.5 * size[1]) / view.focal
    return wp.transform_vector(view.place, wp.vec3f(x, y, 1.0))


@wp.func
def normal_at(scene: Triangles, face: wp.int32, eye: wp.vec3f, direction: wp.vec3f):
    """Return the interpolated normal towards the eye."""
    a = scene.point[scene.corner[face, 0]] - eye
    b = scene.point[scene.corner[face, 1]] - eye
    c = scene.point[scene.corner[face, 2]] - eye
    smooth = scene.normal[face, 0] * wp.dot(direction, wp.cross(b, c))
    smooth += scene.normal[face, 1] * wp.dot(direction, wp.cross(c, a))
    smooth += scene.normal[face, 2] * wp.dot(direction, wp.cross(a, b))
    normal = wp.normalize(wp.transform_vector(scene.pose[scene.part[face]], smooth))
    return wp.where(wp.dot(normal, direction) > 0.0, -normal, normal)


@wp.func
def is_dark(view: View, key_in: wp.array3d[wp.int64], k: wp.int32, point: wp.vec3f, normal: wp.vec3f, toward: wp.vec3f):
    """Check whether a solid is nearer to the light; points outside of the map are lit."""
    texel = 1.0 / view.focal
    # The map's samples differ by their size: the point is moved out of its own surface.
    local = wp.transform_point(view.inverse, point + (normal + toward) * (1.2 * texel))
    at = projected(view, key_in.shape[2], key_in.shape[1], local)
    if not (at[0] >= 0.0 and at[1] >= 0.0):
        return False
    row = wp.int32(at[1])
    column = wp.int32(at[0])
    if row >= key_in.shape[1] or column >= key_in.shape[2]:
        return False
    key = key_in[k, row, column]
    return key != NONE and depth_of(key) < local[2]


@wp.kernel
def shade(
    scene: Triangles,
    view_in: wp.array[View],
    key_in: wp.array3d[wp.int64],
    light: shading.Light,
    lamp: wp.vec3f,
    pass_in: wp.array[exposure.LightPass],
    toward_in: wp.array[wp.vec3f],
    shadow_view_in: wp.array[View],
    shadow_in: wp.array3d[wp.int64],
    supports: wp.int32,
    still_in: wp.array4d[wp.uint8],
    rgb_out: wp.array4d[wp.uint8],
):
    k, row, column = wp.tid()
    view = view_in[k]
    eye = wp.transform_get_translation(view.place)
    size = wp.vec2f(wp.float32(key_in.shape[2]), wp.float32(key_in.shape[1]))
    # A background without moving solids and their shadows is known.
    known = view.still
    for s in range(4):
        key = key_in[k, 2 * row + s // 2, 2 * column + s % 2]
        if key != NONE and scene.part[face_of(key)] >= supports:
            known = False
    for s in range(2):
        i = 2 * row + s
        j = 2 * column + s
        key = key_in[k, i, j]
        if known and key != NONE:
            direction = ray_through(view, size, i, j)
            normal = normal_at(scene, face_of(key), eye, direction)
            for n in range(pass_in.shape[0]):
                point = eye + direction * depth_of(key)
                if wp.dot(normal, toward_in[n]) > 0.0 and is_dark(
                    shadow_view_in[n], shadow_in, n, point, normal, toward_in[n]
                ):
                    known = False
    if known:
        for c in range(3):
            rgb_out[k, row, column, c] = still_in[k, row, column, c]
        return
    total = wp.vec3f()
    colour = wp.vec3f()
    last = wp.int32(-2)
    last_normal = wp.vec3f()
    for s in range(4):
        i = 2 * row + s // 2
        j = 2 * column + s % 2
        key = key_in[k, i, j]
        direction = ray_through(view, size, i, j)
        if key == NONE:
            if last != -1:
                last = wp.int32(-1)
                colour = shading.backdrop(light, wp.normalize(direction))
            total += colour
            continue
        face = face_of(key)
        part = scene.part[face]
        m = scene.material[part]
        tiles = m.pattern == shading.TILES
        if face == last and not tiles:
            total += colour
            continue
        normal = normal_at(scene, face, eye, direction)
        # Samples of a pixel on the same smooth surface have one colour.
        if tiles or last < 0 or scene.part[wp.max(last, 0)] != part or wp.dot(normal, last_normal) < _CREASE:
            point = eye + direction * depth_of(key)
            from_lamp = wp.float32(0.0)
            from_sky = wp.float32(0.0)
            for n in range(pass_in.shape[0]):
                arrived = wp.dot(normal, toward_in[n]) / wp.float32(pass_in.shape[0])
                if arrived > 0.0 and not is_dark(shadow_view_in[n], shadow_in, n, point, normal, toward_in[n]):
                    from_lamp += arrived * pass_in[n].lamp_weight
                    from_sky += arrived * pass_in[n].sky_weight
            albedo = m.base
            if m.pattern != shading.PLAIN:
                albedo = shading.surface_colour(m, wp.transform_point(wp.transform_inverse(scene.pose[part]), point))
            colour = shading.radiance(m, light, albedo, normal, wp.normalize(direction), lamp, 1.0, from_lamp, from_sky)
            last_normal = normal
        last = face
        total += colour
    for c in range(3):
        rgb_out[k, row, column, c] = wp.uint8(wp.int32(255.0 * shading.encode(0.25 * total[c]) + 0.5))

"""The Warp kernel that renders pictures: all passes of a pixel, one after the other."""

import warp as wp

from graspd.worker.rendering.kernels import rays, shading

wp.set_module_options({"enable_backward": False})


@wp.struct
class LightPass:
    """One directional light, one ray through every pixel."""

    shift: wp.vec2f  # offset of the ray from the pixel's centre [px]
    lamp_weight: wp.float32
    sky_weight: wp.float32


@wp.kernel
def expose(
    # Worlds:
    placed_in: wp.array2d[rays.PlacedSolid],
    corner_normal_in: wp.array[wp.vec3f],
    material_in: wp.array2d[shading.Material],
    # Views:
    world_in: wp.array[wp.int32],
    camera_in: wp.array[wp.transformf],
    light_in: wp.array[shading.Light],
    focal: wp.vec2f,
    centre: wp.vec2f,
    # Passes:
    pass_in: wp.array[LightPass],
    toward_in: wp.array2d[wp.vec3f],
    shaded: wp.bool,
    # Rows of this launch:
    row_step: wp.int32,
    first_row: wp.int32,
    # Out:
    rgb_out: wp.array4d[wp.uint8],
    depth_out: wp.array3d[wp.float32],
    shape_out: wp.array3d[wp.int32],
    normal_out: wp.array3d[wp.vec3f],
):
    view, row, column = wp.tid()
    row = first_row + row * row_step
    world = world_in[view]
    camera = camera_in[view]
    light = light_in[view]
    eye = wp.transform_get_translation(camera)
    total = wp.vec3f()
    albedo = wp.vec3f()
    seen = wp.int32(-1)
    spread = 0.75 / wp.min(focal[0], focal[1])
    near = wp.uint64(0)
    hit = rays.RayHit()
    flat = wp.bool(False)
    offset = wp.float32(0.0)
    for k in range(pass_in.shape[0]):
        one = pass_in[k]
        x = (wp.float32(column) + 0.5 + one.shift[0] - centre[0]) / focal[0]
        y = (wp.float32(row) + 0.5 + one.shift[1] - centre[1]) / focal[1]
        local = wp.normalize(wp.vec3f(x, y, 1.0))
        direction = wp.transform_vector(camera, local)
        if k == 0:
            near = rays.hit_mask(placed_in, world, eye, direction, spread)
        if flat:
            # Only the point where the ray meets the plane changes between passes.
            hit.distance = offset / wp.dot(hit.normal, direction)
        else:
            hit = rays.first_hit(placed_in, corner_normal_in, world, near, eye, direction)
        if k == 0:
            shape_out[view, row, column] = hit.shape
            depth_out[view, row, column] = wp.where(hit.shape < 0, wp.inf, hit.distance * local[2])
            if normal_out.shape[0] > 0:
                normal_out[view, row, column] = hit.normal
        if hit.shape < 0:
            total += shading.backdrop(light, direction)
            continue
        toward = toward_in[world, k]
        point = eye + direction * hit.distance
        if k == 0 and near == rays.bit_of(hit.shape) and placed_in.shape[1] <= 64:
            flat = rays.is_on_one_face(placed_in[world, hit.shape], hit, point, direction, spread)
            offset = wp.dot(hit.normal, point - eye)
        cosine = wp.max(wp.dot(hit.normal, toward), 0.0)
        visible = wp.float32(0.0)
        if cosine > 0.0 and not rays.is_occluded(placed_in, world, point + hit.normal * rays.CLEAR, toward):
            visible = wp.float32(1.0)
        if not shaded:
            total += wp.vec3f(visible)
            continue
        m = material_in[world, hit.shape]
        # Noise is the largest cost: it is computed once per pixel and reused for passes that hit the same shape.
        colour = albedo
        if k == 0 or m.pattern == shading.TILES or seen != hit.shape:
            there = placed_in[world, hit.shape]
            colour = shading.surface_colour(m, there.turn * (point - there.place))
            if k == 0:
                seen = hit.shape
                albedo = colour
        total += shading.radiance(
            m, light, colour, hit.normal, direction, toward, cosine * visible, one.lamp_weight, one.sky_weight
        )
    if shaded:
        total = total / wp.float32(pass_in.shape[0])
        for c in range(3):
            rgb_out[view, row, column, c] = wp.uint8(wp.int32(255.0 * shading.encode(total[c]) + 0.5))

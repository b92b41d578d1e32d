"""Warp kernels that turn traced rays into pixels: materials, soft light, tone curve.

The ray tracer gives, for a white surface, the share of one light that arrives (cosine times visibility), the normal
and the depth. Here that becomes colour, so materials and lights differ per picture without a new trace.
"""

import warp as wp

PLAIN, GRAIN, SPECKLE, TILES, CATCHER = 0, 1, 2, 3, 4


@wp.struct
class Material:
    """Surface of one shape. Colours are linear."""

    base: wp.vec3f
    second: wp.vec3f
    pattern: wp.int32
    scale: wp.float32
    roughness: wp.float32
    metalness: wp.float32


@wp.struct
class Light:
    """Light of one picture. Colours are linear radiance."""

    key: wp.vec3f
    sky: wp.vec3f
    ground: wp.vec3f
    backdrop_low: wp.vec3f
    backdrop_high: wp.vec3f


@wp.func
def mix(a: wp.vec3f, b: wp.vec3f, t: wp.float32):
    return a + (b - a) * t


@wp.func
def fractal_noise(p: wp.vec3f, octaves: wp.int32):
    state = wp.rand_init(7)
    total = wp.float32(0.0)
    weight = wp.float32(0.5)
    q = p
    for _ in range(octaves):
        total += weight * wp.noise(state, q)
        q = q * 2.03
        weight = weight * 0.5
    return total


@wp.func
def surface_colour(m: Material, p: wp.vec3f):
    if m.pattern == GRAIN:
        # Long fibres along x with slow bends: rings of a trunk cut lengthwise.
        q = wp.vec3f(p[0] * 2.0, p[1] * 16.0, p[2] * 16.0) * m.scale
        rings = q[1] * 1.2 + 2.5 * fractal_noise(wp.vec3f(q[0] * 0.6, q[1] * 0.25, q[2] * 0.25), 3)
        band = 0.5 + 0.5 * wp.sin(6.2831853 * rings)
        fibre = 0.5 + fractal_noise(wp.vec3f(q[0] * 2.0, q[1] * 9.0, q[2] * 9.0), 2)
        return mix(m.base, m.second, wp.clamp(0.6 * band + 0.5 * fibre - 0.15, 0.0, 1.0))
    if m.pattern == SPECKLE:
        grain = fractal_noise(p * (420.0 * m.scale), 2)
        cloud = fractal_noise(p * (35.0 * m.scale), 2)
        fleck = wp.smoothstep(0.1, 0.35, grain)
        return mix(m.base, m.second, wp.clamp(0.3 + 0.55 * cloud + 0.6 * fleck, 0.0, 1.0))
    if m.pattern == TILES:
        u = p[0] * m.scale * 8.0
        v = p[1] * m.scale * 8.0
        u = wp.abs(u - wp.floor(u) - 0.5)
        v = wp.abs(v - wp.floor(v) - 0.5)
        return mix(m.base, m.second, wp.smoothstep(0.478, 0.49, wp.max(u, v)))
    return m.base


@wp.func
def backdrop(light: Light, direction: wp.vec3f):
    return mix(light.backdrop_low, light.backdrop_high, wp.smoothstep(-0.35, 0.55, direction[2]))


@wp.func
def surroundings(light: Light, direction: wp.vec3f, roughness: wp.float32):
    # A room in one line: bright ceiling panel, dim floor, edge softened by the surface's roughness.
    soft = 0.12 + 0.6 * roughness
    room = mix(light.ground * 1.8, light.sky * 1.4, wp.smoothstep(-soft, soft, direction[2] - 0.05))
    panel = wp.smoothstep(0.82 - 0.5 * soft, 0.82 + 0.5 * soft, direction[2])
    return room + light.key * (0.5 * panel)


@wp.kernel(enable_backward=False)
def accumulate(
    # Model:
    shape_pose_in: wp.array[wp.transformf],
    material_in: wp.array[Material],
    # In:
    rays_in: wp.array4d[wp.vec3f],
    camera_in: wp.array[wp.transformf],
    irradiance_in: wp.array3d[wp.vec3f],
    depth_in: wp.array3d[wp.float32],
    normal_in: wp.array3d[wp.vec3f],
    shape_in: wp.array3d[wp.uint32],
    light_in: wp.array[Light],
    toward_light_in: wp.vec3f,
    key_weight: wp.float32,
    sky_weight: wp.float32,
    first_pass: wp.bool,
    # Out:
    seen_out: wp.array3d[wp.uint32],
    albedo_out: wp.array3d[wp.vec3f],
    sum_out: wp.array3d[wp.vec3f],
):
    view, row, column = wp.tid()
    camera = camera_in[view]
    light = light_in[view]
    direction = wp.transform_vector(camera, rays_in[row, column, 0, 1])
    shape = shape_in[view, row, column]
    if shape >= wp.uint32(material_in.shape[0]):
        sum_out[view, row, column] = sum_out[view, row, column] + backdrop(light, direction)
        return
    index = wp.int32(shape)
    m = material_in[index]
    n = wp.normalize(normal_in[view, row, column])
    # The tracer lets 0.3 of the light through every shadow; here a shadow is dark and the sky lights it.
    cosine = wp.max(wp.dot(n, toward_light_in), 0.0)
    visible = wp.clamp((irradiance_in[view, row, column][0] / wp.max(cosine, 1.0e-4) - 0.3) / 0.7, 0.0, 1.0)
    arrived = cosine * visible
    if m.pattern == CATCHER:
        # The studio floor shows the backdrop, darkened where the light does not arrive.
        shade = 1.0 - (1.0 - visible) * wp.min(1.0, 2.0 * cosine) * (0.16 * key_weight + 0.14 * sky_weight)
        sum_out[view, row, column] = sum_out[view, row, column] + backdrop(light, direction) * shade
        return
    # Depth is forward: rays are unit, and the camera looks down its -z.
    distance = depth_in[view, row, column] / -rays_in[row, column, 0, 1][2]
    point = wp.transform_get_translation(camera) + direction * distance
    # Noise is most of the cost: it is drawn once per pixel and kept for the passes that hit the same shape.
    albedo = albedo_out[view, row, column]
    if first_pass or m.pattern == TILES or seen_out[view, row, column] != shape:
        albedo = surface_colour(m, wp.transform_point(wp.transform_inverse(shape_pose_in[index]), point))
        if first_pass:
            seen_out[view, row, column] = shape
            albedo_out[view, row, column] = albedo
    # A normal that is interpolated may turn away from the eye at silhouettes.
    facing = wp.max(-wp.dot(n, direction), 0.02)
    half = wp.normalize(toward_light_in - direction)
    exponent = 2.0 / wp.max(wp.pow(m.roughness, 4.0), 1.0e-4)
    # Blinn-Phong lobe with the energy norm (n + 8) / 8, Schlick's Fresnel term.
    gloss = (exponent + 8.0) * 0.125 * wp.pow(wp.max(wp.dot(n, half), 0.0), exponent)
    f0 = mix(wp.vec3f(0.04), albedo, m.metalness)
    grazing = wp.pow(1.0 - wp.min(facing, 1.0), 5.0) * (1.0 - m.roughness)
    fresnel = f0 + (wp.vec3f(1.0) - f0) * grazing
    diffuse = albedo * (1.0 - m.metalness)
    up = 0.5 + 0.5 * n[2]
    mirror = direction - n * (2.0 * wp.dot(n, direction))
    colour = wp.cw_mul(diffuse + fresnel * wp.min(gloss, 12.0), light.key) * (arrived * key_weight)
    colour += wp.cw_mul(diffuse, light.sky) * (arrived * sky_weight)
    colour += wp.cw_mul(diffuse, light.ground) * (1.0 - up)
    colour += wp.cw_mul(fresnel, surroundings(light, mirror, m.roughness)) * (1.0 - 0.6 * m.roughness)
    sum_out[view, row, column] = sum_out[view, row, column] + colour


@wp.func
def encode(c: wp.float32):
    # Extended Reinhard curve with white at 4, then the sRGB transfer function (IEC 61966-2-1).
    x = wp.max(c, 0.0)
    x = wp.min(x * (1.0 + x / 16.0) / (1.0 + 0.55 * x), 1.0)
    if x <= 0.0031308:
        return 12.92 * x
    return 1.055 * wp.pow(x, 1.0 / 2.4) - 0.055


@wp.kernel(enable_backward=False)
def develop(
    # In:
    sum_in: wp.array3d[wp.vec3f],
    scale: wp.float32,
    # Out:
    rgb_out: wp.array4d[wp.uint8],
):
    view, row, column = wp.tid()
    c = sum_in[view, row, column] * scale
    for k in range(3):
        rgb_out[view, row, column, k] = wp.uint8(wp.int32(255.0 * encode(c[k]) + 0.5))

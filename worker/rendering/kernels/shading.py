"""Materials, light and the tone curve, as Warp functions: the light reflected along a ray."""

import warp as wp

PLAIN, GRAIN, SPECKLE, TILES = 0, 1, 2, 3


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
def environment_light(light: Light, direction: wp.vec3f, roughness: wp.float32):
    # A simple room: bright ceiling panel, dim floor, edge softened by the surface's roughness.
    soft = 0.12 + 0.6 * roughness
    room = mix(light.ground * 1.8, light.sky * 1.4, wp.smoothstep(-soft, soft, direction[2] - 0.05))
    panel = wp.smoothstep(0.82 - 0.5 * soft, 0.82 + 0.5 * soft, direction[2])
    return room + light.key * (0.5 * panel)


@wp.func
def radiance(
    m: Material,
    light: Light,
    albedo: wp.vec3f,
    n: wp.vec3f,
    direction: wp.vec3f,
    toward: wp.vec3f,
    arrived: wp.float32,
    lamp_weight: wp.float32,
    sky_weight: wp.float32,
):
    """Return the light reflected along a ray: Blinn-Phong, energy norm (n + 8) / 8, Schlick's Fresnel."""
    # An interpolated normal may face away from the eye at silhouettes.
    facing = wp.max(-wp.dot(n, direction), 0.02)
    slant = 1.0 - wp.min(facing, 1.0)
    f0 = mix(wp.vec3f(0.04), albedo, m.metalness)
    fresnel = f0 + (wp.vec3f(1.0) - f0) * (slant * slant * slant * slant * slant * (1.0 - m.roughness))
    diffuse = albedo * (1.0 - m.metalness)
    mirror = direction + n * (2.0 * -wp.dot(n, direction))
    colour = wp.cw_mul(diffuse, light.ground) * (0.5 - 0.5 * n[2])
    colour += wp.cw_mul(fresnel, environment_light(light, mirror, m.roughness)) * (1.0 - 0.6 * m.roughness)
    if arrived > 0.0:
        colour += wp.cw_mul(diffuse, light.sky) * (arrived * sky_weight)
        if lamp_weight > 0.0:
            sharpness = 2.0 / wp.max(m.roughness * m.roughness * m.roughness * m.roughness, 1.0e-4)
            half = wp.normalize(toward - direction)
            gloss = (sharpness + 8.0) * 0.125 * wp.pow(wp.max(wp.dot(n, half), 0.0), sharpness)
            colour += wp.cw_mul(diffuse + fresnel * wp.min(gloss, 12.0), light.key) * (arrived * lamp_weight)
    return colour


@wp.func
def encode(c: wp.float32):
    # Extended Reinhard curve with white at 4, then the sRGB transfer function (IEC 61966-2-1).
    x = wp.max(c, 0.0)
    x = wp.min(x * (1.0 + x / 16.0) / (1.0 + 0.55 * x), 1.0)
    if x <= 0.0031308:
        return 12.92 * x
    return 1.055 * wp.pow(x, 1.0 / 2.4) - 0.055

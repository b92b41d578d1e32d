"""Wrenches on bodies, summed as integers, so that results do not depend on thread order.

A wrench is six counts of `UNIT`: force and torque about the object's origin."""

import warp as wp

wp.set_module_options({"enable_backward": False})

#: Value of one count: 2^-36, about the rounding error of a float32 near 1e-4. Sums may reach 1.3e8.
UNIT = wp.constant(1.0 / 68719476736.0)
PER_UNIT = wp.constant(68719476736.0)
MOST = wp.constant(1.0e6)  # largest component that one thread may add: hands far inside an object reach about 1e4

Wrenches = wp.array3d(dtype=wp.int64)  # (B, L, 6)


@wp.func
def to_counts(x: wp.float32):
    """Return a component in counts of `UNIT`, at most `MOST` in size; 0 if it is not finite."""
    if not wp.isfinite(x):
        return wp.int64(0)
    return wp.int64(wp.clamp(x, -MOST, MOST) * PER_UNIT)


@wp.func
def add_wrench(wrench: Wrenches, b: wp.int32, body: wp.int32, force: wp.vec3, torque: wp.vec3):
    for i in range(3):
        wp.atomic_add(wrench, b, body, i, to_counts(force[i]))
        wp.atomic_add(wrench, b, body, 3 + i, to_counts(torque[i]))


@wp.func
def clear_wrench(wrench: Wrenches, b: wp.int32, body: wp.int32):
    for i in range(6):
        wrench[b, body, i] = wp.int64(0)


@wp.func
def force_on(wrench: Wrenches, b: wp.int32, body: wp.int32):
    return UNIT * wp.vec3(float(wrench[b, body, 0]), float(wrench[b, body, 1]), float(wrench[b, body, 2]))


@wp.func
def torque_on(wrench: Wrenches, b: wp.int32, body: wp.int32):
    """Return the torque about the object's origin."""
    return UNIT * wp.vec3(float(wrench[b, body, 3]), float(wrench[b, body, 4]), float(wrench[b, body, 5]))

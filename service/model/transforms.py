"""Rigid transforms in NumPy, with broadcasting. Pose (7,): position x y z, unit quaternion w x y z."""

from typing import Final

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]

IDENTITY_POSE: Floats = np.array([0.0, 0, 0, 1, 0, 0, 0])
POSE_PARTS: Final = ("x", "y", "z", "qw", "qx", "qy", "qz")


def quat_multiply(a: Floats, b: Floats) -> Floats:
    """Return the Hamilton product (..., 4), w x y z."""
    w1, x1, y1, z1 = np.moveaxis(np.asarray(a, float), -1, 0)
    w2, x2, y2, z2 = np.moveaxis(np.asarray(b, float), -1, 0)
    return np.stack(
        [
            w1 * w2 - x1 * x2 - y1 * y2 - z1 * z2,
            w1 * x2 + x1 * w2 + y1 * z2 - z1 * y2,
            w1 * y2 - x1 * z2 + y1 * w2 + z1 * x2,
            w1 * z2 + x1 * y2 - y1 * x2 + z1 * w2,
        ],
        axis=-1,
    )


def quat_conjugate(q: Floats) -> Floats:
    """Return the inverse of a unit quaternion (..., 4)."""
    return np.asarray(q, float) * np.array([1.0, -1, -1, -1])


def quat_rotate(q: Floats, v: Floats) -> Floats:
    """Rotate vectors (..., 3) by unit quaternions (..., 4)."""
    q, v = np.asarray(q, float), np.asarray(v, float)
    u = q[..., 1:]
    t = 2.0 * cross(u, v)
    return v + q[..., :1] * t + cross(u, t)


def cross(a: Floats, b: Floats) -> Floats:
    """Return the cross product (..., 3); bitwise equal to `numpy.cross`, but faster on small arrays."""
    ax, ay, az = a[..., 0], a[..., 1], a[..., 2]
    bx, by, bz = b[..., 0], b[..., 1], b[..., 2]
    return np.stack([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx], axis=-1)


def quat_from_axis_angle(axis: Floats, angle: Floats) -> Floats:
    """Return the unit quaternion (..., 4) of a rotation by angle (...) [rad] about a unit axis (..., 3)."""
    half = 0.5 * np.asarray(angle, float)[..., None]
    return np.concatenate([np.cos(half), np.asarray(axis, float) * np.sin(half)], axis=-1)


def quat_from_rpy(angles: Floats) -> Floats:
    """Return the quaternion of roll, pitch and yaw (3,): rotations about the fixed axes x, then y, then z."""
    x, y, z = quat_from_axis_angle(np.eye(3), angles)
    return quat_multiply(z, quat_multiply(y, x))


def slerp(a: Floats, b: Floats, share: float) -> Floats:
    """Interpolate unit quaternions (4,) from `a` (share 0) to `b` (share 1) along the shorter arc."""
    a, b = np.asarray(a, float), np.asarray(b, float)
    cosine = float(a @ b)
    b, cosine = (-b, -cosine) if cosine < 0 else (b, cosine)
    angle = float(np.arccos(min(cosine, 1.0)))
    # Nearly parallel quaternions: the chord equals the arc.
    weights = (1 - share, share) if angle < 1e-6 else np.sin([(1 - share) * angle, share * angle]) / np.sin(angle)
    turned = weights[0] * a + weights[1] * b
    return np.asarray(turned / np.linalg.norm(turned))


def quat_from_matrix(matrix: Floats) -> Floats:
    """Convert rotation matrices (..., 3, 3) to unit quaternions (..., 4) with w >= 0, by Shepperd (1978)."""
    m = np.asarray(matrix, float)
    trace = np.trace(m, axis1=-2, axis2=-1)
    d = np.diagonal(m, axis1=-2, axis2=-1)
    k = np.argmax(np.concatenate([trace[..., None], d], axis=-1), axis=-1)
    # Rows of the symmetric matrix 4 q q^T are parallel to q; the row with the largest diagonal is most accurate.
    outer = np.empty((*m.shape[:-2], 4, 4))
    outer[..., 0, 0] = 1 + trace
    for i in range(3):
        outer[..., i + 1, i + 1] = 1 + 2 * d[..., i] - trace
    outer[..., 0, 1] = outer[..., 1, 0] = m[..., 2, 1] - m[..., 1, 2]
    outer[..., 0, 2] = outer[..., 2, 0] = m[..., 0, 2] - m[..., 2, 0]
    outer[..., 0, 3] = outer[..., 3, 0] = m[..., 1, 0] - m[..., 0, 1]
    outer[..., 1, 2] = outer[..., 2, 1] = m[..., 0, 1] + m[..., 1, 0]
    outer[..., 1, 3] = outer[..., 3, 1] = m[..., 0, 2] + m[..., 2, 0]
    outer[..., 2, 3] = outer[..., 3, 2] = m[..., 1, 2] + m[..., 2, 1]
    q = np.take_along_axis(outer, k[..., None, None], axis=-2)[..., 0, :]
    q = q / np.linalg.norm(q, axis=-1, keepdims=True)
    return np.where(q[..., :1] < 0, -q, q)


def quat_to_matrix(q: Floats) -> Floats:
    """Convert unit quaternions (..., 4) to rotation matrices (..., 3, 3)."""
    w, x, y, z = np.moveaxis(np.asarray(q, float), -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def pose_from_matrix(matrix: Floats) -> Floats:
    """Convert homogeneous matrices (..., 4, 4) to poses (..., 7)."""
    m = np.asarray(matrix, float)
    return np.concatenate([m[..., :3, 3], quat_from_matrix(m[..., :3, :3])], axis=-1)


def pose_to_matrix(pose: Floats) -> Floats:
    """Convert poses (..., 7) to homogeneous matrices (..., 4, 4)."""
    p = np.asarray(pose, float)
    m = np.zeros((*p.shape[:-1], 4, 4))
    m[..., :3, :3] = quat_to_matrix(p[..., 3:])
    m[..., :3, 3] = p[..., :3]
    m[..., 3, 3] = 1.0
    return m


def compose(a: Floats, b: Floats) -> Floats:
    """Return pose `b` (..., 7), given in the frame of pose `a` (..., 7), in the parent frame of `a`."""
    a, b = np.asarray(a, float), np.asarray(b, float)
    position = a[..., :3] + quat_rotate(a[..., 3:], b[..., :3])
    rotation = quat_multiply(a[..., 3:], b[..., 3:])
    return np.concatenate([position, np.broadcast_to(rotation, (*position.shape[:-1], 4))], axis=-1)


def invert(pose: Floats) -> Floats:
    """Invert poses (..., 7)."""
    p = np.asarray(pose, float)
    conjugate = quat_conjugate(p[..., 3:])
    return np.concatenate([-quat_rotate(conjugate, p[..., :3]), conjugate], axis=-1)


def apply(pose: Floats, points: Floats) -> Floats:
    """Transform points (..., 3) from the frame of a pose (..., 7) to the parent frame."""
    p = np.asarray(pose, float)
    return quat_rotate(p[..., 3:], points) + p[..., :3]


def spread_directions(count: int) -> Floats:
    """Return evenly spread unit vectors (count, 3) on a golden spiral."""
    k = np.arange(count)
    z = 1 - (2 * k + 1) / count
    turn, across = np.pi * (3 - np.sqrt(5)) * k, np.sqrt(1 - z**2)
    return np.column_stack([across * np.cos(turn), across * np.sin(turn), z])

"""Packing of contacts in the order of their points, independent of thread order.

On a CPU a launch runs its threads one after another, so a counter assigns slots in the order of points. On a GPU each
point writes to its own index, with a mark; slots follow from counts of marks.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})

#: Marks of points: no contact, a contact, a contact that the object may reach in its step.
NONE = wp.constant(0)
KEPT = wp.constant(1)
NEAR = wp.constant(2)
CHUNK = wp.constant(32)  # marks counted per thread


@wp.kernel
def count_marks(
    active_in: wp.array(dtype=wp.int32),
    mark_in: wp.array2d(dtype=wp.int32),
    kept_out: wp.array2d(dtype=wp.int32),
    near_out: wp.array2d(dtype=wp.int32),
):
    """Count contacts, and near ones, of every `CHUNK` points of a hand. Launch over (B, N / CHUNK)."""
    b, chunk = wp.tid()
    if active_in[b] == 0:
        return
    kept = wp.int32(0)
    near = wp.int32(0)
    for i in range(chunk * CHUNK, wp.min((chunk + 1) * CHUNK, mark_in.shape[1])):
        if mark_in[b, i] >= KEPT:
            kept += 1
        if mark_in[b, i] == NEAR:
            near += 1
    kept_out[b, chunk] = kept
    near_out[b, chunk] = near


@wp.func
def before(
    counts: wp.array2d(dtype=wp.int32), mark: wp.array2d(dtype=wp.int32), least: wp.int32, b: wp.int32, i: wp.int32
):
    """Return the number of points before the i-th whose mark is at least `least`."""
    chunk = i // CHUNK
    total = wp.int32(0)
    for c in range(chunk):
        total += counts[b, c]
    for k in range(chunk * CHUNK, i):
        if mark[b, k] >= least:
            total += 1
    return total


@wp.kernel
def pack(
    active_in: wp.array(dtype=wp.int32),
    mark_in: wp.array2d(dtype=wp.int32),
    kept_in: wp.array2d(dtype=wp.int32),
    near_in: wp.array2d(dtype=wp.int32),
    body_in: wp.array2d(dtype=wp.int32),
    point_in: wp.array2d(dtype=wp.vec3),
    normal_in: wp.array2d(dtype=wp.vec3),
    distance_in: wp.array2d(dtype=wp.float32),
    weight_in: wp.array2d(dtype=wp.float32),
    count_out: wp.array(dtype=wp.int32),
    body_out: wp.array2d(dtype=wp.int32),
    point_out: wp.array2d(dtype=wp.vec3),
    normal_out: wp.array2d(dtype=wp.vec3),
    distance_out: wp.array2d(dtype=wp.float32),
    weight_out: wp.array2d(dtype=wp.float32),
    gradient_out: wp.array2d(dtype=wp.float32),
    near_count_out: wp.array(dtype=wp.int32),
    near_out: wp.array2d(dtype=wp.int32),
):
    """Move marked points to their slots; `near` lists the slots of near ones. Launch over (B, N)."""
    b, i = wp.tid()
    if active_in[b] == 0:
        return
    mark = mark_in[b, i]
    last = i == mark_in.shape[1] - 1
    if mark == NONE and not last:
        return
    k = before(kept_in, mark_in, KEPT, b, i)
    near = wp.int32(0)
    if mark == NEAR or last:
        near = before(near_in, mark_in, NEAR, b, i)
    if mark == NEAR:
        near_out[b, near] = k
    if mark != NONE:
        body_out[b, k] = body_in[b, i]
        point_out[b, k] = point_in[b, i]
        normal_out[b, k] = normal_in[b, i]
        distance_out[b, k] = distance_in[b, i]
        weight_out[b, k] = weight_in[b, i]
        gradient_out[b, k] = 0.0
    if last:
        count_out[b] = k + wp.min(mark, 1)
        near_count_out[b] = near + mark // 2

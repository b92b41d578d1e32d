"""Packing of contacts in the order of their points, independent of thread order.

On a CPU a launch runs its threads one after another, so a counter assigns slots in the order of points. On a GPU each
point writes to its own index, with a mark; counts of marks determine the slots."""

import warp as wp

wp.set_module_options({"enable_backward": False})

#: Marks of points: no contact, a contact, a contact that the object may reach in its step.
NONE = wp.constant(0)
KEPT = wp.constant(1)
NEAR = wp.constant(2)
CHUNK = wp.constant(32)  # marks counted per thread


@wp.struct
class Contacts:
    """Candidate contacts (B, N), packed at the front per hand in the order of its points."""

    count: wp.array(dtype=wp.int32)
    body: wp.array2d(dtype=wp.int32)
    point: wp.array2d(dtype=wp.vec3)
    normal: wp.array2d(dtype=wp.vec3)
    distance: wp.array2d(dtype=wp.float32)
    weight: wp.array2d(dtype=wp.float32)
    gradient: wp.array2d(dtype=wp.float32)  # dL/d distance
    near_count: wp.array(dtype=wp.int32)
    near: wp.array2d(dtype=wp.int32)  # indices of contacts that the object may reach in its step
    mark: wp.array2d(dtype=wp.int32)  # mark of each point if contacts are not packed yet; else empty


@wp.kernel
def count_marks(
    active_in: wp.array(dtype=wp.int32),
    mark_in: wp.array2d(dtype=wp.int32),
    kept_out: wp.array2d(dtype=wp.int32),
    near_out: wp.array2d(dtype=wp.int32),
):
    """Count contacts and near contacts among every `CHUNK` points of a hand. Launch over (B, N / CHUNK)."""
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
def marked_before(
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
    marked_in: Contacts,
    kept_in: wp.array2d(dtype=wp.int32),
    near_in: wp.array2d(dtype=wp.int32),
    packed_out: Contacts,
):
    """Move marked points to their slots; `near` lists the slots of near ones. Launch over (B, N)."""
    b, i = wp.tid()
    if active_in[b] == 0:
        return
    mark = marked_in.mark[b, i]
    last = i == marked_in.mark.shape[1] - 1
    if mark == NONE and not last:
        return
    k = marked_before(kept_in, marked_in.mark, KEPT, b, i)
    near = wp.int32(0)
    if mark == NEAR or last:
        near = marked_before(near_in, marked_in.mark, NEAR, b, i)
    if mark == NEAR:
        packed_out.near[b, near] = k
    if mark != NONE:
        packed_out.body[b, k] = marked_in.body[b, i]
        packed_out.point[b, k] = marked_in.point[b, i]
        packed_out.normal[b, k] = marked_in.normal[b, i]
        packed_out.distance[b, k] = marked_in.distance[b, i]
        packed_out.weight[b, k] = marked_in.weight[b, i]
        packed_out.gradient[b, k] = 0.0
    if last:
        packed_out.count[b] = k + wp.min(mark, 1)
        packed_out.near_count[b] = near + mark // 2

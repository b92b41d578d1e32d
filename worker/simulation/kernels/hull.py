"""Convex hulls in six dimensions, grown point by point (beneath-beyond), for wrench spaces.

A facet is a simplex of 6 points with its plane n x = d, n outward, and the 6 facets across its ridges:
`neighbour[f, k]` shares all corners of f but `vertex[f, k]`. A new point sees the facets whose plane it is above; they
go, and every ridge between a seen and an unseen facet spans a new one with the point. Its plane is the positive
combination of the two old planes that holds the point; its area follows from the simplex that the point and an old
facet span. No system of equations is solved.
"""

import warp as wp

wp.set_module_options({"enable_backward": False, "max_unroll": 0})

vec6 = wp.types.vector(length=6, dtype=wp.float64)

DEAD = wp.constant(0)
LIVE = wp.constant(1)
SEEN = wp.constant(2)
FRESH = wp.constant(3)
UNKNOWN = wp.constant(-1)


@wp.struct
class Hull:
    """Working arrays of one hull: F facets at most, and a hash table of ridges."""

    vertex: wp.array2d(dtype=wp.int32)
    neighbour: wp.array2d(dtype=wp.int32)
    normal: wp.array(dtype=vec6)
    offset: wp.array(dtype=wp.float64)
    area: wp.array(dtype=wp.float64)
    height: wp.array(dtype=wp.float64)
    state: wp.array(dtype=wp.int32)
    seen: wp.array(dtype=wp.int32)
    fresh: wp.array(dtype=wp.int32)
    spare: wp.array(dtype=wp.int32)
    ridge: wp.array(dtype=wp.int64)
    holder: wp.array(dtype=wp.int32)
    stamp: wp.array(dtype=wp.int32)


@wp.func
def look(hull: Hull, top: int, x: vec6):
    """Mark and list the facets that a point sees; their number."""
    count = wp.int32(0)
    for f in range(top):
        if hull.state[f] == LIVE:
            height = wp.dot(hull.normal[f], x) - hull.offset[f]
            hull.height[f] = height
            if height > wp.float64(0.0):
                hull.state[f] = SEEN
                hull.seen[count] = f
                count = count + 1
    return count


@wp.func
def span(hull: Hull, e: int, f: int, k: int, p: int, point: wp.array(dtype=vec6)):
    """Facet e from point p and the ridge that seen facet f shares with its unseen neighbour k."""
    g = hull.neighbour[f, k]
    apex = hull.vertex[f, k]
    beyond = wp.int32(0)
    for j in range(6):
        hull.vertex[e, j] = hull.vertex[f, j]
        if hull.neighbour[g, j] == f:
            hull.neighbour[g, j] = e
            beyond = hull.vertex[g, j]
    hull.vertex[e, k] = p
    hull.neighbour[e, k] = g
    up = hull.height[f]
    down = -hull.height[g]
    normal = up * hull.normal[g] + down * hull.normal[f]
    size = wp.length(normal)
    normal = normal / size
    offset = (up * hull.offset[g] + down * hull.offset[f]) / size
    hull.normal[e] = normal
    hull.offset[e] = offset
    # The simplex of p and an old facet has the new one as a face too, and area times height of either is the same. The
    # point stands well above at least one of the two old facets.
    if up > down:
        hull.area[e] = up * hull.area[f] / wp.abs(offset - wp.dot(normal, point[apex]))
    else:
        hull.area[e] = down * hull.area[g] / wp.abs(offset - wp.dot(normal, point[beyond]))
    hull.state[e] = FRESH


@wp.func
def link(hull: Hull, e: int, k: int, mark: wp.array(dtype=wp.int64), now: int, mask: wp.int64):
    """Join facet e to the fresh facets it shares ridges with; change in the number of ridges without a partner."""
    total = wp.int64(0)
    for j in range(6):
        total = total + mark[hull.vertex[e, j]]
    pending = wp.int32(0)
    for j in range(6):
        if j != k:
            # The sum of random marks names a set of corners, whatever their order.
            key = total - mark[hull.vertex[e, j]]
            at = int(key & mask)
            while hull.stamp[at] == now and hull.ridge[at] != key:
                at = int(wp.int64(at + 1) & mask)
            if hull.stamp[at] == now:
                other = hull.holder[at] / 6
                side = hull.holder[at] - 6 * other
                pending = pending - 1
                if hull.neighbour[other, side] != UNKNOWN:
                    # A third facet at one ridge: never made up for, so the hull counts as failed.
                    pending = pending + 1000000
                hull.neighbour[other, side] = e
                hull.neighbour[e, j] = other
            else:
                hull.stamp[at] = now
                hull.ridge[at] = key
                hull.holder[at] = 6 * e + j
                hull.neighbour[e, j] = UNKNOWN
                pending = pending + 1
    return pending


@wp.func
def insert(
    hull: Hull,
    p: int,
    point: wp.array(dtype=vec6),
    mark: wp.array(dtype=wp.int64),
    mask: wp.int64,
    stamp: int,
    top: int,
    spares: int,
):
    """Put point p into the hull; facets ever used, spare ones among them, and 1 if that failed."""
    capacity = hull.state.shape[0]
    failed = wp.int32(0)
    count = look(hull, top, point[p])
    born = wp.int32(0)
    pending = wp.int32(0)
    for i in range(count):
        f = hull.seen[i]
        for k in range(6):
            if failed == 0 and hull.state[hull.neighbour[f, k]] == LIVE:
                e = top
                if spares > 0:
                    spares = spares - 1
                    e = hull.spare[spares]
                elif top + 1 >= capacity:
                    failed = 1
                else:
                    top = top + 1
                span(hull, e, f, k, p, point)
                pending = pending + link(hull, e, k, mark, stamp, mask)
                hull.fresh[born] = e
                born = born + 1
    if pending != 0:
        failed = 1
    for i in range(count):
        hull.state[hull.seen[i]] = DEAD
        hull.spare[spares] = hull.seen[i]
        spares = spares + 1
    for i in range(born):
        hull.state[hull.fresh[i]] = LIVE
    return top, spares, failed


@wp.kernel
def grow_hull(
    # In:
    point_in: wp.array(dtype=vec6),
    order_in: wp.array(dtype=wp.int32),
    mark_in: wp.array(dtype=wp.int64),
    mask_in: wp.int64,
    stamp_in: int,
    # Out:
    hull_inout: Hull,
    result_out: wp.array(dtype=wp.float64),
):
    """Insert points in the given order into a hull that has 7 facets.

    `result_out`: least distance of a facet from the origin, negative where the origin is outside; volume; 1 if sound.
    """
    hull = hull_inout
    top = wp.int32(7)
    spares = wp.int32(0)
    failed = wp.int32(0)
    for turn in range(order_in.shape[0]):
        if failed == 0:
            top, spares, failed = insert(hull, order_in[turn], point_in, mark_in, mask_in, stamp_in + turn, top, spares)
    least = wp.float64(1.0e30)
    volume = wp.float64(0.0)
    for f in range(top):
        if hull.state[f] == LIVE:
            least = wp.min(least, hull.offset[f])
            volume = volume + hull.offset[f] * hull.area[f]
    result_out[0] = least
    result_out[1] = volume / wp.float64(6.0)
    result_out[2] = wp.float64(1 - failed)


@wp.kernel
def grow_to_nearest(
    # In:
    point_in: wp.array(dtype=vec6),
    rounding_in: wp.float64,
    mark_in: wp.array(dtype=wp.int64),
    mask_in: wp.int64,
    stamp_in: int,
    # Out:
    hull_inout: Hull,
    result_out: wp.array(dtype=wp.float64),
):
    """Grow a hull that has 7 facets where it is nearest to the origin, until its nearest facet is the whole hull's.

    A facet with no point above it is a facet of the hull of all points; no facet of the part that is built is nearer,
    and the whole contains the part. So its distance is that of the whole hull, of which little has to be built (Zheng,
    "An efficient algorithm for a grasp quality measure", IEEE T-RO 2013).

    `result_out`: least distance of a facet from the origin, at most 0 where the origin is outside; nan; 1 if sound.
    """
    hull = hull_inout
    top = wp.int32(7)
    spares = wp.int32(0)
    failed = wp.int32(0)
    done = wp.int32(0)
    least = wp.float64(0.0)
    for turn in range(point_in.shape[0]):
        if failed == 0 and done == 0:
            nearest = wp.int32(-1)
            least = wp.float64(1.0e30)
            for f in range(top):
                if hull.state[f] == LIVE and hull.offset[f] < least:
                    least = hull.offset[f]
                    nearest = f
            far = wp.int32(-1)
            height = rounding_in
            for i in range(point_in.shape[0]):
                above = wp.dot(hull.normal[nearest], point_in[i]) - least
                if above > height:
                    height = above
                    far = i
            if far < 0:
                done = 1
            else:
                top, spares, failed = insert(hull, far, point_in, mark_in, mask_in, stamp_in + turn, top, spares)
    if done == 0:
        failed = 1
    result_out[0] = least
    result_out[1] = wp.float64(wp.nan)
    result_out[2] = wp.float64(1 - failed)

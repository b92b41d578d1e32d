"""Convex hulls in six dimensions, grown point by point (beneath-beyond), for wrench spaces.

A facet is a simplex of 6 points. It has 6 neighbours: `neighbour[f, k]` shares all corners of f but `vertex[f, k]`.
Its plane n x = d has an outward n. The plane is scaled: n x - d is 6! times the volume of the simplex of the facet and
x, negative inside. A new point sees a facet if it lies above the facet's plane. Seen facets are removed. Every ridge
between a seen and an unseen facet spans a new facet with the point. The new plane is a positive combination of the two
old planes (Grassmann and Pluecker: determinants of six points out of eight). No system of equations is solved and no
root is computed."""

import warp as wp

wp.set_module_options({"enable_backward": False, "max_unroll": 0})

vec6 = wp.types.vector(length=6, dtype=wp.float64)

DEAD = wp.constant(0)
LIVE = wp.constant(1)
SEEN = wp.constant(2)
HORIZON = wp.constant(3)


@wp.struct
class Hull:
    """Working arrays of one hull: at most F facets, and a hash table of ridges."""

    vertex: wp.array2d(dtype=wp.int32)
    neighbour: wp.array2d(dtype=wp.int32)
    normal: wp.array(dtype=vec6)
    offset: wp.array(dtype=wp.float64)
    height: wp.array(dtype=wp.float64)
    distance: wp.array(dtype=wp.float64)
    state: wp.array(dtype=wp.int32)
    seen: wp.array(dtype=wp.int32)
    fresh: wp.array(dtype=wp.int32)
    side: wp.array(dtype=wp.int32)
    spare: wp.array(dtype=wp.int32)
    ridge: wp.array(dtype=wp.int64)
    holder: wp.array(dtype=wp.int32)
    stamp: wp.array(dtype=wp.int32)


@wp.func
def find_visible_facet(hull: Hull, start: int, x: vec6):
    """Return a facet that x is above, or -1 if x is inside; the hull contains the origin.
    An ascent of n x / d from neighbour to neighbour ends at the largest value, as in the simplex method on the polar
    polytope."""
    here = start
    best = wp.dot(hull.normal[here], x) / hull.offset[here]
    at = wp.int32(-1)
    while at != here and best <= wp.float64(1.0):
        at = here
        for k in range(6):
            g = hull.neighbour[at, k]
            share = wp.dot(hull.normal[g], x) / hull.offset[g]
            if share > best:
                best = share
                here = g
    found = wp.int32(-1)
    if best > wp.float64(1.0):
        found = here
    return found


@wp.func
def create_facet(hull: Hull, e: int, f: int, k: int, p: int, point: wp.array(dtype=vec6)):
    """Create facet e from point p and the ridge that seen facet f shares with its unseen neighbour k."""
    g = hull.neighbour[f, k]
    back = wp.int32(0)
    for j in range(6):
        hull.vertex[e, j] = hull.vertex[f, j]
        if hull.neighbour[g, j] == f:
            back = j
    hull.vertex[e, k] = p
    hull.neighbour[e, k] = g
    # Depth of either facet's far corner under the other's plane: the same determinant, and the larger one rounds less.
    under = hull.offset[f] - wp.dot(hull.normal[f], point[hull.vertex[g, back]])
    over = hull.offset[g] - wp.dot(hull.normal[g], point[hull.vertex[f, k]])
    scale = wp.float64(1.0) / wp.max(under, over)
    up = hull.height[f] * scale
    down = -hull.height[g] * scale
    hull.normal[e] = up * hull.normal[g] + down * hull.normal[f]
    hull.offset[e] = up * hull.offset[g] + down * hull.offset[f]
    hull.neighbour[g, back] = e


@wp.func
def connect_facet(hull: Hull, e: int, k: int, mark: wp.array(dtype=wp.int64), now: int, mask: wp.int64):
    """Join facet e to the fresh facets with common ridges; return the change in unpaired ridges."""
    total = wp.int64(0)
    for j in range(6):
        total = total + mark[hull.vertex[e, j]]
    pending = wp.int32(0)
    for j in range(6):
        if j != k:
            # The sum of random marks identifies a set of corners in any order.
            key = total - mark[hull.vertex[e, j]]
            at = int(key & mask)
            while hull.stamp[at] == now and hull.ridge[at] != key:
                at = int(wp.int64(at + 1) & mask)
            if hull.stamp[at] == now:
                held = hull.holder[at]
                other = held / 8
                if held < 0:
                    # A third facet at one ridge keeps `pending` above 0, so the hull counts as failed.
                    pending = pending + 1000000
                else:
                    pending = pending - 1
                    hull.neighbour[other, held - 8 * other] = e
                    hull.neighbour[e, j] = other
                    hull.holder[at] = -1
            else:
                hull.stamp[at] = now
                hull.ridge[at] = key
                hull.holder[at] = 8 * e + j
                pending = pending + 1
    return pending


@wp.func
def insert(
    hull: Hull,
    p: int,
    start: int,
    point: wp.array(dtype=vec6),
    mark: wp.array(dtype=wp.int64),
    stamp: int,
    top: int,
    spares: int,
):
    """Insert point p, above facet `start`; return numbers of used, spare, fresh facets, and 1 on failure."""
    capacity = hull.state.shape[0]
    failed = wp.int32(0)
    x = point[p]
    hull.state[start] = SEEN
    hull.height[start] = wp.dot(hull.normal[start], x) - hull.offset[start]
    hull.seen[0] = start
    count = wp.int32(1)
    born = wp.int32(0)
    i = wp.int32(0)
    while i < count:
        f = hull.seen[i]
        i = i + 1
        for k in range(6):
            g = hull.neighbour[f, k]
            state = hull.state[g]
            if state == LIVE:
                height = wp.dot(hull.normal[g], x) - hull.offset[g]
                hull.height[g] = height
                state = HORIZON
                if height > wp.float64(0.0):
                    state = SEEN
                    hull.seen[count] = g
                    count = count + 1
                hull.state[g] = state
            if state == HORIZON and failed == 0:
                e = top
                if spares > 0:
                    spares = spares - 1
                    e = hull.spare[spares]
                elif top + 1 >= capacity:
                    failed = 1
                else:
                    top = top + 1
                create_facet(hull, e, f, k, p, point)
                hull.fresh[born] = e
                hull.side[born] = k
                born = born + 1
    # A table that is not much larger than its content stays in the processor's cache.
    size = wp.int32(1024)
    while size < 6 * born and size < hull.stamp.shape[0]:
        size = 2 * size
    pending = wp.int32(0)
    if 5 * born > size:
        failed = 1
    else:
        for n in range(born):
            pending = pending + connect_facet(hull, hull.fresh[n], hull.side[n], mark, stamp, wp.int64(size - 1))
    if pending != 0:
        failed = 1
    for n in range(born):
        e = hull.fresh[n]
        hull.state[e] = LIVE
        hull.state[hull.neighbour[e, hull.side[n]]] = LIVE
    for n in range(count):
        hull.state[hull.seen[n]] = DEAD
        hull.spare[spares] = hull.seen[n]
        spares = spares + 1
    return top, spares, born, failed


@wp.func
def facet_distance(hull: Hull, f: int, origin: vec6):
    """Return the signed distance of facet f's plane from a point, positive inside."""
    normal = hull.normal[f]
    return (hull.offset[f] - wp.dot(normal, origin)) / wp.length(normal)


@wp.func
def is_corner(corner: wp.array(dtype=wp.int32), p: int):
    found = wp.int32(0)
    for i in range(7):
        if corner[i] == p:
            found = 1
    return found


@wp.func
def grow_whole(
    hull: Hull,
    point: wp.array(dtype=vec6),
    count: int,
    corner: wp.array(dtype=wp.int32),
    origin: vec6,
    mark: wp.array(dtype=wp.int64),
    stamp: int,
):
    """Insert all points except the corners of the first simplex.
    Return the least distance of a facet from `origin`, the volume, and 1 on failure."""
    top = wp.int32(7)
    spares = wp.int32(0)
    failed = wp.int32(0)
    start = wp.int32(0)
    half = (count + 1) / 2
    for turn in range(count):
        # Neighbours in a list are neighbours in space. If even places are inserted first, fewer facets are replaced.
        p = 2 * turn
        if turn >= half:
            p = 2 * (turn - half) + 1
        seen = wp.int32(-1)
        if failed == 0 and is_corner(corner, p) == 0:
            seen = find_visible_facet(hull, start, point[p])
        if seen >= 0:
            top, spares, _born, failed = insert(hull, p, seen, point, mark, stamp + p, top, spares)
            start = hull.fresh[0]
    least = wp.float64(1.0e30)
    volume = wp.float64(0.0)
    for f in range(top):
        if hull.state[f] == LIVE:
            least = wp.min(least, facet_distance(hull, f, origin))
            volume = volume + hull.offset[f]
    return least, volume / wp.float64(720.0), failed


@wp.func
def grow_to_nearest(
    hull: Hull,
    point: wp.array(dtype=vec6),
    count: int,
    origin: vec6,
    rounding: wp.float64,
    mark: wp.array(dtype=wp.int64),
    stamp: int,
):
    """Grow the hull at its facet nearest to the origin, until no point is above this facet.
    Return the facet's distance, at most 0 for an outside origin, and 1 on failure. A facet with no point above it is a
    facet of the hull of all points. No facet of the built part is nearer, and the whole hull contains the part. So this
    distance is the whole hull's (Zheng, "An efficient algorithm for a grasp quality measure", IEEE T-RO 2013)."""
    top = wp.int32(7)
    spares = wp.int32(0)
    born = wp.int32(0)
    failed = wp.int32(0)
    done = wp.int32(0)
    least = wp.float64(0.0)
    for f in range(7):
        hull.distance[f] = facet_distance(hull, f, origin)
    for turn in range(count):
        if failed == 0 and done == 0:
            nearest = wp.int32(-1)
            least = wp.float64(1.0e30)
            for f in range(top):
                if hull.state[f] == LIVE and hull.distance[f] < least:
                    least = hull.distance[f]
                    nearest = f
            far = wp.int32(-1)
            normal = hull.normal[nearest]
            highest = hull.offset[nearest] + rounding * wp.length(normal)
            for i in range(count):
                height = wp.dot(normal, point[i])
                if height > highest:
                    highest = height
                    far = i
            if far < 0:
                done = 1
            else:
                top, spares, born, failed = insert(hull, far, nearest, point, mark, stamp + turn, top, spares)
                for n in range(born):
                    hull.distance[hull.fresh[n]] = facet_distance(hull, hull.fresh[n], origin)
    if done == 0:
        failed = 1
    return least, failed


@wp.kernel
def measure_hulls(
    point_in: wp.array2d(dtype=vec6),
    count_in: wp.array(dtype=wp.int32),
    whole_in: wp.array(dtype=wp.int32),
    corner_in: wp.array2d(dtype=wp.int32),
    normal_in: wp.array2d(dtype=vec6),
    offset_in: wp.array2d(dtype=wp.float64),
    origin_in: wp.array(dtype=vec6),
    rounding_in: wp.array(dtype=wp.float64),
    mark_in: wp.array(dtype=wp.int64),
    stamp_in: int,
    hull_inout: Hull,
    result_out: wp.array2d(dtype=wp.float64),
):
    """Build one hull after the other from 7 facets: facet i omits corner i and is next to all others.
    Points are relative to a point inside the first simplex; distances are from `origin_in`. `result_out` has the least
    distance of a facet, at most 0 for an outside origin; the volume, nan where `whole_in` is 0; and 1 on success."""
    hull = hull_inout
    for h in range(count_in.shape[0]):
        for i in range(7):
            for j in range(6):
                other = j
                if j >= i:
                    other = j + 1
                hull.vertex[i, j] = corner_in[h, other]
                hull.neighbour[i, j] = other
            hull.normal[i] = normal_in[h, i]
            hull.offset[i] = offset_in[h, i]
            hull.state[i] = LIVE
        count = count_in[h]
        stamp = stamp_in + h * point_in.shape[1]
        volume = wp.float64(wp.nan)
        least = wp.float64(0.0)
        failed = wp.int32(0)
        if whole_in[h] != 0:
            least, volume, failed = grow_whole(hull, point_in[h], count, corner_in[h], origin_in[h], mark_in, stamp)
        else:
            least, failed = grow_to_nearest(hull, point_in[h], count, origin_in[h], rounding_in[h], mark_in, stamp)
        result_out[h, 0] = least
        result_out[h, 1] = volume
        result_out[h, 2] = wp.float64(1 - failed)

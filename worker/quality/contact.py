"""Contact between hand and object: area, contact points, links in contact, evenness over the fingers."""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from graspd.service.model.transforms import Floats, Mask
from graspd.worker.hands.digits import finger_of_body
from graspd.worker.hands.model import HandModel

Ints = NDArray[np.intp]

LINK_CONTACT_M: Final = 0.002  # a body closer than this is in contact [m] (DexGraspBench)
#: Cap of contact distances in the contact distance consistency [m] (DexGraspBench's contact margin).
CONSISTENCY_CAP_M: Final = 0.010
#: Largest number of contacts of a wrench space; more increase the cost of its hull, but hardly its radius.
MAX_CONTACTS: Final = 20


def contact_area_cm2(distance: Floats, area: Floats, thresholds_m: Floats) -> Floats:
    """Compute the hand area (B, T) within thresholds (T,) of the object's surface, on either side [cm^2].
    The distances (B, N) are signed [m]; each point represents an `area` (N,) [m^2]."""
    near = np.abs(distance)
    # Rows are summed, because the rounding of a matrix product would depend on its number of rows.
    return np.stack([np.where(near < t, area, 0.0).sum(axis=-1) for t in thresholds_m], axis=-1) * 1e4


def spread_contacts(near: Mask, place: Floats, normal: Floats, *, scale: float, limit: int) -> tuple[Ints, Ints]:
    """Choose at most `limit` points `near` (B, T, N) per grasp and threshold, as far apart as possible.
    Spread is measured by position (B, N, 3) divided by `scale`, the torque scale [m], and by normal (B, N, 3).
    Return indices (B, T, limit) and their number (B, T); further indices are undefined."""
    grasps, sets, _ = near.shape
    count = near.sum(axis=2)
    width = max(int(count.max(initial=0)), limit)
    # Move the points of each set to the front, in their order.
    order = np.argsort(~near, axis=2, kind="stable")[..., :width].reshape(grasps * sets, -1)
    inside = np.arange(order.shape[1]) < count.reshape(-1, 1)
    rows = np.repeat(np.arange(grasps), sets)[:, None]
    features = np.concatenate([place[rows, order] / scale, normal[rows, order]], axis=-1)
    chosen = np.where(
        count.reshape(-1, 1) > limit,
        _farthest(features, inside, limit),
        np.minimum(np.arange(limit), order.shape[1] - 1),
    )
    index = np.take_along_axis(order, chosen, axis=1)
    return index.reshape(grasps, sets, limit), np.minimum(count, limit)


def _farthest(points: Floats, inside: Mask, count: int) -> Ints:
    """Select (S, count) points of sets (S, W, K) as `farthest_points` does, only among `inside` (S, W)."""
    rows = np.arange(len(points))
    mean = np.einsum("sw,swk->sk", inside.astype(float), points) / np.maximum(inside.sum(axis=1), 1)[:, None]
    start = np.where(inside, ((points - mean[:, None]) ** 2).sum(axis=2), -1.0)
    chosen = np.empty((len(points), count), np.intp)
    chosen[:, 0] = np.argmax(start, axis=1)
    squares = np.einsum("swk,swk->sw", points, points)
    nearest = np.where(inside, np.inf, -1.0)
    for i in range(1, count):
        last = points[rows, chosen[:, i - 1]]
        apart = squares - 2 * np.matmul(points, last[..., None])[..., 0] + np.einsum("sk,sk->s", last, last)[:, None]
        np.minimum(nearest, apart, out=nearest)
        nearest[rows, chosen[:, i - 1]] = -1.0
        chosen[:, i] = np.argmax(nearest, axis=1)
    return chosen


def contact_links(body_distance: Floats) -> NDArray[np.int32]:
    """Count (B,) the bodies closer than `LINK_CONTACT_M`, from distances (B, L) [m]."""
    return (body_distance < LINK_CONTACT_M).sum(axis=1).astype(np.int32)


def contact_distance_consistency_mm(hand: HandModel, body_distance: Floats) -> Floats:
    """Compute CDC (B,): largest minus least finger distance, each capped to 0 .. 10 mm (DexGraspBench)."""
    finger = finger_of_body(hand)
    least = [body_distance[:, finger == f].min(axis=1) for f in np.unique(finger[finger >= 0])]
    if not least:
        return np.zeros(len(body_distance))
    capped = np.clip(np.stack(least, axis=1), 0.0, CONSISTENCY_CAP_M)
    return (capped.max(axis=1) - capped.min(axis=1)) * 1e3

"""Free paths through configuration space: RRT-Connect (Kuffner and LaValle 2000), shortened at random.

The seed alone determines a path; in OMPL, one random generator serves the whole process."""

import math
from collections.abc import Callable
from typing import Final

import numpy as np

from graspd.service.model.transforms import Floats

#: Length of a tree's steps and largest distance of tested points, by the joint that moves most [rad or m].
STEP: Final = 0.25
RESOLUTION: Final = 0.03
#: Numbers of samples until the search ends without a path, and of attempts to shorten a path.
SAMPLES: Final = 400
SHORTCUTS: Final = 60
_Test = Callable[[Floats], bool]


def is_free_line(start: Floats, end: Floats, is_free: _Test) -> bool:
    """Return whether points of a line (A,), at most `RESOLUTION` apart and without its start, are free."""
    count = max(1, math.ceil(float(np.abs(end - start).max()) / RESOLUTION))
    return all(is_free(start + (k / count) * (end - start)) for k in range(count, 0, -1))


def connect(
    start: Floats, goal: Floats, low: Floats, high: Floats, is_free: _Test, rng: np.random.Generator
) -> Floats | None:
    """Return the corners (C, A) of a free path between two configurations (A,), or None if none is found.
    Samples are between `low` and `high` (A,)."""
    if not (is_free(start) and is_free(goal)):
        return None
    # Each entry of a tree is the path from its root to a node.
    tree, other = [[start]], [[goal]]
    for k in range(SAMPLES):
        if _extend(tree, rng.uniform(low, high), is_free) is not None:
            while (joined := _extend(other, tree[-1][-1], is_free)) is False:
                pass
            if joined:
                path = [*tree[-1], *other[-1][-2::-1]]
                return _shortened(path if k % 2 == 0 else path[::-1], is_free, rng)
        tree, other = other, tree
    return None


def _extend(tree: list[list[Floats]], towards: Floats, is_free: _Test) -> bool | None:
    """Add a node at most `STEP` nearer to a point. Return whether it is there; None without a free step."""
    near = tree[int(np.argmin(np.linalg.norm([path[-1] for path in tree] - towards, axis=1)))]
    way = towards - near[-1]
    share = min(1.0, STEP / max(float(np.abs(way).max()), 1e-12))
    node = near[-1] + share * way
    if not is_free_line(near[-1], node, is_free):
        return None
    tree.append([*near, node])
    return share == 1.0


def _shortened(path: list[Floats], is_free: _Test, rng: np.random.Generator) -> Floats:
    for _ in range(SHORTCUTS):
        i, j = sorted(rng.choice(len(path), 2, replace=False))
        if j - i > 1 and is_free_line(path[i], path[j], is_free):
            path = [*path[: i + 1], *path[j:]]
    return np.array(path)

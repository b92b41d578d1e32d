"""Free paths through configuration space: RRT-Connect (Kuffner and LaValle 2000), shortened at random.

The seed alone determines a path; in OMPL, one random generator serves the whole process."""

import math
from collections.abc import Callable
from typing import Final

import numpy as np

from graspd.service.model.transforms import Floats

#: Length of a tree's steps and largest distance of tested points, by the joint that moves most [rad or m].
STEP: Final = 0.25
RESOLUTION: Final = 0.05
#: Numbers of samples until the search ends without a path, and of attempts to shorten a path.
SAMPLES: Final = 400
SHORTCUTS: Final = 60


class _Tree:
    def __init__(self, root: Floats) -> None:
        self.nodes, self.parents = [root], [-1]

    def extend(self, towards: Floats, is_free: Callable[[Floats], bool]) -> bool | None:
        """Add a node at most `STEP` nearer to a point. Return whether it is there; None without a free step."""
        near = int(np.argmin(np.linalg.norm(np.array(self.nodes) - towards, axis=1)))
        way = towards - self.nodes[near]
        share = min(1.0, STEP / max(float(np.abs(way).max()), 1e-12))
        node = towards if share == 1.0 else self.nodes[near] + share * way
        if not is_free_line(self.nodes[near], node, is_free):
            return None
        self.nodes.append(node)
        self.parents.append(near)
        return share == 1.0

    def path_to_root(self) -> list[Floats]:
        found, at = [], len(self.nodes) - 1
        while at >= 0:
            found.append(self.nodes[at])
            at = self.parents[at]
        return found


def is_free_line(start: Floats, end: Floats, is_free: Callable[[Floats], bool]) -> bool:
    """Return whether points of a line (A,), at most `RESOLUTION` apart and without its start, are free."""
    count = max(1, math.ceil(float(np.abs(end - start).max()) / RESOLUTION))
    return all(is_free(start + (k / count) * (end - start)) for k in range(count, 0, -1))


def connect(
    start: Floats, goal: Floats, low: Floats, high: Floats, is_free: Callable[[Floats], bool], rng: np.random.Generator
) -> Floats | None:
    """Return the corners (C, A) of a free path between two configurations (A,), or None if none is found.
    Samples are between `low` and `high` (A,)."""
    if not (is_free(start) and is_free(goal)):
        return None
    one, other = _Tree(start), _Tree(goal)
    for _ in range(SAMPLES):
        if one.extend(rng.uniform(low, high), is_free) is not None:
            while (joined := other.extend(one.nodes[-1], is_free)) is False:
                pass
            if joined:
                halves = one.path_to_root()[::-1], other.path_to_root()[1:]
                path = [*halves[0], *halves[1]]
                return _shortened(path if path[0] is start else path[::-1], is_free, rng)
        one, other = other, one
    return None


def _shortened(path: list[Floats], is_free: Callable[[Floats], bool], rng: np.random.Generator) -> Floats:
    for _ in range(SHORTCUTS):
        if len(path) < 3:
            break
        i, j = sorted(rng.choice(len(path), 2, replace=False))
        if j - i > 1 and is_free_line(path[i], path[j], is_free):
            path = [*path[: i + 1], *path[j:]]
    return np.array(path)

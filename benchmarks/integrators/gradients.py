"""Gradients of the float32 kernels, compared with central differences of the float64 reference."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from itertools import product
from typing import Any, Final

import numpy as np
import warp as wp

from benchmarks.integrators import reference
from benchmarks.integrators.flights import Solver, gauss_seidel_sweep
from benchmarks.integrators.grades import grade
from benchmarks.integrators.reference import Contacts, World
from graspd.service.model.studies import MapCell, StabilityMap, mark_reachable
from graspd.service.model.transforms import Floats
from graspd.worker.simulation.kernels import contact, kinematics, packing
from graspd.worker.simulation.model import initial_motions

PASSES: Final = 12
#: Radii of the held ball [m]; scale of its contacts' depths and gaps, as a multiple of the step.
SIZES_M: Final = (0.0005, 0.002, 0.01, 0.04, 0.15, 0.5)
GAPS: Final = (0.01, 0.03, 0.1, 0.3, 1.0, 3.0)
STEP_M: Final = 1e-3
ANGLE: Final = (0.25, 0.7)  # sine of the angle between the two gradients that counts as weak and as broken
#: Kernel of each solver, and its step in the reference.
SOLVERS: Final[dict[str, tuple[Any, Solver]]] = {
    "direct": (contact.direct, partial(reference.direct, passes=PASSES)),
    "gauss_seidel": (contact.gauss_seidel, gauss_seidel_sweep),
}


def run_kernel(
    name: str,
    contacts: Contacts,
    world: World,
    *,
    leak: float = 0.0,
    one_sided: bool = True,
    near_gap: float = 100.0,
    lane: int = 64,
) -> tuple[Floats, Floats, Floats]:
    """Run a kernel of `SOLVERS` on the CPU; return motions at the end (M, 6), losses (M,), dL/drho (N,)."""
    motions = initial_motions(7, world.step, world.gyration)
    n, m = len(contacts.points), len(motions)
    physics = _physics(world, leak, one_sided, near_gap, float(np.linalg.norm(contacts.points, axis=1).max()))
    listed = np.flatnonzero(contacts.distances - world.dilation <= near_gap)
    with wp.ScopedDevice("cpu"):
        hands, given = kinematics.Hands(), packing.Contacts()
        hands.active, hands.iteration = wp.ones(1, dtype=wp.int32), wp.zeros(1, dtype=wp.int32)
        hands.dilation_scale = wp.ones(1, dtype=wp.float32)
        given.count, given.near_count = (wp.array([k], dtype=wp.int32) for k in (n, len(listed)))
        given.point, given.normal = (wp.array(a[None], dtype=wp.vec3) for a in (contacts.points, contacts.normals))
        given.distance = wp.array(contacts.distances[None], dtype=wp.float32)
        given.weight = wp.array(contacts.weights[None], dtype=wp.float32)
        given.gradient = wp.zeros((1, n), dtype=wp.float32)
        given.near = wp.array(np.pad(listed, (0, n - len(listed)))[None], dtype=wp.int32)
        dilation = wp.array([world.dilation], dtype=wp.float32)
        loss, end = wp.zeros((1, m), dtype=wp.float32), wp.zeros((1, m), dtype=contact.vec6)
        inputs = [physics, wp.array(motions, dtype=contact.vec6), PASSES, dilation, hands, given]
        if name == "direct":
            adjoint = wp.zeros((1, m), dtype=contact.vec6)
            wp.launch(contact.direct, dim=(1, m), inputs=inputs, outputs=[loss, end, adjoint])
            inputs = [physics, lane, dilation, hands, end, adjoint]
            wp.launch(contact.direct_gradient, dim=(1, -(-n // lane)), inputs=inputs, outputs=[given])
        else:
            states = wp.zeros((1, m, n), dtype=contact.vec6)
            wp.launch(SOLVERS[name][0], dim=(1, m), inputs=inputs, outputs=[states, loss, end])
        found: Any = (end, loss, given.gradient)
        return tuple(array.numpy()[0].astype(float) for array in found)


def reference_gradient(name: str, contacts: Contacts, world: World) -> Floats:
    """Return dL/drho (N,) by central differences in float64."""
    motions = initial_motions(7, world.step, world.gyration)
    step = 1e-6 * world.step
    steps = step * np.eye(len(contacts.points))[:, None]

    def losses(distances: Floats) -> Floats:
        ends = SOLVERS[name][1](replace(contacts, distances=distances), motions, world)
        return np.asarray(np.mean(reference.loss(ends, world), axis=-1))

    return (losses(contacts.distances + steps) - losses(contacts.distances - steps)) / (2 * step)


def gradient_map(sizes: Sequence[float], gaps: Sequence[float], *, repeats: int) -> StabilityMap:
    cells = []
    for name, size, gap in product(SOLVERS, sizes, gaps):
        worst = float(np.median([_gradient_sine(name, size, gap, seed) for seed in range(repeats)]))
        cells.append(MapCell(name, size, gap, worst, grade(worst, *ANGLE)))
    return StabilityMap(
        "gradient",
        "Gradient of the float32 kernels against float64 differences",
        "radius of the object [m]",
        "spread of the gaps over the step",
        "sine of the angle between the gradients, median over contact sets",
        f"weak: {ANGLE[0]:g}; broken: {ANGLE[1]:g}",
        mark_reachable(cells, lambda cell: True),
        "the loss does not fall, even with more iterations",
        "a descent without progress stops after `patience` iterations; the balance of forces selects the best start",
        "tests/studies/test_stability.py::test_gradients_agree_at_the_sizes_of_hands_and_their_objects",
        reach="all: option `contact_solver` has each value, and objects have any size",
    )


def _physics(world: World, leak: float, one_sided: bool, near_gap: float, radius: float) -> Any:
    out = contact.Physics()
    out.mass = contact.mat66(*world.mass.ravel().tolist())
    out.inverse_mass = contact.mat66(*np.linalg.inv(world.mass).ravel().tolist())
    out.gyration, out.friction, out.stiffness = world.gyration, world.friction, world.stiffness
    out.leak, out.leak_length, out.one_sided, out.step = leak, 0.02, int(one_sided), world.step
    out.radius, out.near_gap = radius, near_gap
    return out


def _gradient_sine(name: str, size: float, gap: float, seed: int) -> float:
    count, rng = 8, np.random.default_rng(seed)
    normals = rng.normal(size=(count, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    distances = STEP_M * gap * (rng.uniform(-1.0, 0.5, count))
    contacts = Contacts(size * normals, normals, distances, np.ones(count))
    inertia = 0.4 * size**2 * np.eye(3)
    world = World(inertia=inertia, gyration=float(np.sqrt(0.4)) * size, step=STEP_M)
    ours, expected = run_kernel(name, contacts, world)[2], reference_gradient(name, contacts, world)
    lengths = float(np.linalg.norm(ours) * np.linalg.norm(expected))
    if lengths == 0.0:
        return 0.0 if np.linalg.norm(ours) == np.linalg.norm(expected) else 1.0
    cosine = float(ours @ expected) / lengths
    # Opposite gradients are worse than orthogonal ones.
    return float(np.sqrt(max(0.0, 1.0 - cosine**2))) if cosine > 0 else 1.0

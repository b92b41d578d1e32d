"""Integrators alone: a ball thrown into a cage of contact points, step by step, in float64.

A good integrator adds no energy, keeps the ball in the fixed cage and prevents penetration. Position-based integrators
are those of `reference.py`. The force-based one is Grasp'D's penalty force under semi-implicit Euler."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from itertools import product
from typing import Final

import numpy as np

from benchmarks.integrators import reference
from benchmarks.integrators.grades import grade
from benchmarks.integrators.reference import Contacts, World
from graspd.service.model.studies import MapCell, StabilityMap, format_short, mark_reachable
from graspd.service.model.transforms import Floats
from graspd.worker.simulation.model import LossOptions

#: Function from contacts (with present distances), free motion and world to the permitted motion.
Solver = Callable[[Contacts, Floats, World], Floats]

RADIUS_M: Final = 0.035
#: Gap between ball and cage at the start [m]; at most the ball's motion in `FLIGHT_STEPS` steps.
GAP_M: Final = 2e-3
FLIGHT_STEPS: Final = 10
STEPS: Final = 60
SINK_M: Final = (5e-4, 5e-3)  # penetration of a ball from which on a cell counts as weak and as broken [m]
#: Ratio of largest to initial energy from which on a cell counts as weak and as broken.
ENERGY: Final = (1.02, 2.0)
#: Sliding friction of the cage, and the viscous coefficient of the force-based contact [N s/m].
FRICTION: Final = 0.8
VISCOUS: Final = 10.0

#: A ball's cell shows the worse of the two values.
_BALL_MEASURE: Final = "with ×: largest kinetic energy over the initial one (∞: unstable); otherwise largest depth [mm]"

TIME_STEPS: Final = (1e-5, 1e-4, 3e-4, 1e-3, 3e-3, 1e-2, 3e-2)
SPEEDS: Final = (0.01, 0.1, 0.3, 1.0, 3.0, 10.0)
STIFFNESSES: Final = (1e2, 1e3, 1e4, 1e5, 1e6, 1e7)
MASSES: Final = (0.01, 0.1, 1.0, 10.0)
COUNTS: Final = (1, 2, 4, 8, 16, 64, 256)


def _cage_around(dt: float, speed: float) -> Floats:
    """Return 24 points of a cage, evenly spread (Fibonacci) [m]."""
    count = 24
    k = np.arange(count) + 0.5
    polar, turn = np.arccos(1 - 2 * k / count), np.pi * (1 + 5**0.5) * k
    directions = np.stack([np.cos(turn) * np.sin(polar), np.sin(turn) * np.sin(polar), np.cos(polar)], axis=1)
    return directions * (RADIUS_M + min(GAP_M, FLIGHT_STEPS * dt * speed))


def contacts_of(points: Floats, centre: Floats) -> Contacts:
    """Return contacts of the ball at `centre` with the cage's points (N, 3) [m]."""
    arms = points - centre
    length = np.linalg.norm(arms, axis=1)
    normals = arms / length[:, None]
    return Contacts(RADIUS_M * normals, normals, length - RADIUS_M, np.ones(len(points)))


def ball_world(dt: float, speed: float) -> World:
    inertia, gyration = 0.4 * RADIUS_M**2 * np.eye(3), math.sqrt(0.4) * RADIUS_M
    return World(inertia, gyration=gyration, friction=FRICTION, stiffness=1.0, step=max(dt * speed, 1e-9))


def simulate_position_based(solver: Solver, *, dt: float, speed: float) -> tuple[float, float]:
    """Return a ball's ratio of largest to initial energy, and deepest penetration [m], with a `solver`."""
    points = _cage_around(dt, speed)
    world = ball_world(dt, speed)

    def flight() -> Iterator[tuple[Floats, float]]:
        centre, velocity = np.zeros(3), np.array([0.8, 0.36, 0.48, 0, 0, 0]) * speed
        first = world.mass @ velocity @ velocity
        for _ in range(STEPS):
            motion = solver(contacts_of(points, centre), velocity * dt, world)
            centre, velocity = centre + motion[:3], motion / dt
            yield centre, float(world.mass @ velocity @ velocity / first)

    return _extremes(points, flight())


def simulate_force_based(*, dt: float, speed: float, stiffness: float, mass: float = 1.0) -> tuple[float, float]:
    """Return the values of `simulate_position_based` for penalty forces; `stiffness` [N/m], `mass` [kg]."""
    points = _cage_around(dt, speed)
    inertia = 0.4 * mass * RADIUS_M**2

    def flight() -> Iterator[tuple[Floats, float]]:
        centre, v, w = np.zeros(3), np.array([0.8, 0.36, 0.48]) * speed, np.zeros(3)
        first = mass * float(v @ v)
        for _ in range(STEPS):
            force, torque = _penalty(contacts_of(points, centre), v, w, stiffness)
            v, w = v + dt * force / mass, w + dt * torque / inertia
            centre = centre + dt * v
            yield centre, (mass * float(v @ v) + inertia * float(w @ w)) / first

    return _extremes(points, flight())


def _extremes(points: Floats, flight: Iterator[tuple[Floats, float]]) -> tuple[float, float]:
    """Return largest energy (inf if unstable) and deepest penetration of a flight's centres and energies."""
    most, deepest = 1.0, 0.0
    for centre, energy in flight:
        most, deepest = max(most, energy), max(deepest, _largest_depth(points, centre))
        if not np.isfinite(most) or most > 1e6:
            return math.inf, deepest
    return most, deepest


def _penalty(contacts: Contacts, v: Floats, w: Floats, stiffness: float) -> tuple[Floats, Floats]:
    c = np.maximum(-contacts.distances, 0.0)
    motion = v + np.cross(w, contacts.points)
    tangent = motion - np.einsum("ij,ij->i", motion, contacts.normals)[:, None] * contacts.normals
    slip = np.linalg.norm(tangent, axis=1)
    size = np.minimum(VISCOUS * slip * (c > 0), FRICTION * stiffness * c) / np.maximum(slip, 1e-12)
    forces = -stiffness * c[:, None] * contacts.normals - size[:, None] * tangent
    return forces.sum(axis=0), np.cross(contacts.points, forces).sum(axis=0)


def _largest_depth(points: Floats, centre: Floats) -> float:
    """Return the depth of the deepest cage point in the ball [m].
    It is the ball's diameter if the ball has left the cage."""
    if float(np.linalg.norm(centre)) > 2 * RADIUS_M:
        return 2 * RADIUS_M
    return max(0.0, RADIUS_M - float(np.linalg.norm(points - centre, axis=1).min()))


def gauss_seidel_sweep(contacts: Contacts, s0: Floats, world: World) -> Floats:
    return reference.gauss_seidel(contacts, s0, world)[0]


def summed_jacobi(contacts: Contacts, s0: Floats, world: World) -> Floats:
    """Return the motion after eight passes that sum the corrections of all contacts; graspd averages them."""
    inverse = np.linalg.inv(world.mass)
    s = s0.copy()
    for _ in range(8):
        total = np.zeros(6)
        for p, n, rho in zip(contacts.points, contacts.normals, contacts.distances, strict=True):
            j = reference.jacobian_row(n, p)
            c = world.dilation - rho + j @ s
            if c > 0:
                total -= c / (j @ inverse @ j) * (inverse @ j)
        s = s + total
    return s


SOLVERS: Final[dict[str, Solver]] = {
    "direct (default)": partial(reference.direct, passes=6),
    "Gauss-Seidel, one sweep": gauss_seidel_sweep,
    "Jacobi, averaged": partial(reference.jacobi, passes=8),
    "Jacobi, summed": summed_jacobi,
}
_OFFERED: Final = tuple(SOLVERS)[:2]  # solvers that the setting `contact_solver` offers


def time_step_map(time_steps: Sequence[float], speeds: Sequence[float]) -> StabilityMap:
    grid = list(product(time_steps, speeds))
    cells = [
        _ball_cell(name, dt, speed, simulate_position_based(solver, dt=dt, speed=speed))
        for name, solver in SOLVERS.items()
        for dt, speed in grid
    ]
    cells += [
        _ball_cell(f"penalty force, {name} N/m", dt, speed, simulate_force_based(dt=dt, speed=speed, stiffness=k))
        for name, k in (("1e4", 1e4), ("1e6", 1e6))
        for dt, speed in grid
    ]
    step = LossOptions().step
    # The grid approximates the planner's step within 10 %.
    cells = mark_reachable(cells, lambda c: c.panel in _OFFERED and abs(float(c.x) * float(c.y) / step - 1) < 0.15)
    return StabilityMap(
        "time_step",
        "A ball of 1 kg in a cage of 24 points, 60 steps",
        "time step [s]",
        "speed [m/s]",
        _BALL_MEASURE,
        f"weak: energy × {ENERGY[0]:g} or {SINK_M[0] * 1e3:g} mm deep; broken: energy × {ENERGY[1]:g} or "
        f"{SINK_M[1] * 1e3:g} mm deep",
        cells,
        "the object is thrown out of the hand, or hands penetrate it",
        "the planner's step is always 1 mm, where its integrators are good; the validator's integrator is implicit",
        "tests/studies/test_stability.py::test_planners_own_step_lies_where_its_integrators_are_good",
        reach=f"the offered solvers at a step of {1e3 * step:g} mm; the step is no option of a job",
    )


def _ball_cell(name: str, dt: float, speed: float, found: tuple[float, float]) -> MapCell:
    energy, deep = found
    worst = max(grade(energy, *ENERGY), grade(deep, *SINK_M), key=("good", "weak", "broken").index)
    said = f"energy × {energy:.3g}, {deep * 1e3:.2g} mm deep"
    # The label shows the cause of a bad cell.
    ratio = f"{energy:.2f}" if energy < 2 else format_short(energy)
    label = f"×{ratio}" if energy >= ENERGY[0] else format_short(round(deep * 1e3, 2))
    return MapCell(name, dt, speed, energy, worst, said, label)


def stiffness_map(stiffnesses: Sequence[float], masses: Sequence[float], time_steps: Sequence[float]) -> StabilityMap:
    cells, lines = [], {}
    for mass in masses:
        panel = f"penalty force, {mass:g} kg"
        for stiffness, dt in product(stiffnesses, time_steps):
            found = simulate_force_based(dt=dt, speed=0.3, stiffness=stiffness, mass=mass)
            cells.append(_ball_cell(panel, stiffness, dt, found))
        # Semi-implicit Euler on m x'' = -k x is stable for dt < 2 sqrt(m / k).
        lines[panel] = [(k, 2 * math.sqrt(mass / k)) for k in stiffnesses]
    cells += [
        _ball_cell(
            "direct (has no stiffness setting)",
            k,
            dt,
            simulate_position_based(SOLVERS["direct (default)"], dt=dt, speed=0.3),
        )
        for k in stiffnesses
        for dt in time_steps
    ]
    return StabilityMap(
        "stiffness",
        "Penalty stiffness against the position-based step, 0.3 m/s",
        "contact stiffness [N/m]",
        "time step [s]",
        _BALL_MEASURE,
        "bounds as in the first map; the line is dt = 2 sqrt(m / k), above which one contact alone is unstable",
        cells,
        "soft contacts allow penetration, stiff ones throw the object; the range between them narrows with dt",
        "only `graspd2022` uses penalty forces, and only for a static balance without time steps",
        "tests/studies/test_stability.py::test_a_penalty_force_blows_up_above_the_bound_of_theory",
        lines,
        reach="none: no planner integrates penalty forces over time, and the planner's own stiffness is fixed",
    )


def contact_count_map(counts: Sequence[int]) -> StabilityMap:
    cells = [
        _wall_cell(name, solver, count, depth)
        for name, solver in SOLVERS.items()
        for count in counts
        for depth in (0.0, 1e-4, 1e-3)
    ]
    cells = mark_reachable(cells, lambda cell: cell.panel in _OFFERED)
    return StabilityMap(
        "contact_count",
        "A step of 1 mm into a wall of contact points",
        "contact points",
        "initial depth [m]",
        "remaining motion into or out of the wall, as a share of the step",
        "weak: 0.25 of the step; broken: 1, more than the initial motion",
        cells,
        "more points on the same finger push harder; losses and gradients grow with the sampling",
        "summed Jacobi is not offered; the direct solver weights points by the area that they represent",
        "tests/studies/test_stability.py::test_summed_jacobi_overshoots_with_the_number_of_contacts",
        reach="the offered solvers, with any number of contacts (touching hand points)",
    )


def _wall_cell(name: str, solver: Solver, count: int, depth: float) -> MapCell:
    rng, step = np.random.default_rng(count), 1e-3
    points = np.concatenate([0.005 * rng.normal(size=(count, 2)), np.full((count, 1), RADIUS_M)], axis=1)
    normals = np.tile([0.0, 0, 1], (count, 1))
    # A constant sum of weights makes the finger's stiffness independent of its number of points.
    contacts = Contacts(points, normals, np.full(count, -depth), np.full(count, 24.0 / count))
    world = ball_world(1.0, step)
    end = solver(contacts, np.array([0, 0, step, 0, 0, 0]), world)
    left = abs(float(end[2]) + depth) / step
    return MapCell(name, count, depth, left, grade(left, 0.25, 1.0))

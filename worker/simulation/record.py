"""Operations on hands as recorded launches: one iteration is the gradient of the loss, then a step.

`record_*` records a whole list for the data's current schedule; `add_*` appends one part. No data leaves the device.
"""

from __future__ import annotations

from typing import Final

from graspd.service.model.errors import InputError
from graspd.worker.simulation.data import Data
from graspd.worker.simulation.kernels import (
    contact,
    kinematics,
    obstacles,
    optimizers,
    packing,
    penalties,
    pieces,
    solids,
    surface,
)
from graspd.worker.simulation.launches import Launches
from graspd.worker.simulation.model import NEAR_GAP, REFERENCE_SAMPLES, SOLVERS, Model

OPTIMIZERS: Final = ("adam", "gd")


def record_placement(m: Model, d: Data, *, room: float = 0.0, within: float | None = None) -> Launches:
    """Record contacts and penetration depths only; `room` is added to each feature's margin [m].
    `within`: only contacts within this distance are needed, exactly [m]; it does not change the depths."""
    out = Launches(m.device)
    add_poses(out, m, d)
    add_distances(out, m, d, within=within)
    add_penalties(out, m, d, room=room)
    return out


def record_evaluation(m: Model, d: Data) -> Launches:
    """Record loss and gradient of the state, without a step."""
    out = Launches(m.device)
    add_poses(out, m, d)
    add_distances(out, m, d)
    add_contact(out, m, d)
    add_penalties(out, m, d)
    add_gradient(out, m, d)
    return out


def record_iteration(m: Model, d: Data, optimizer: str, *, patience: int = 0) -> Launches:
    """Record one iteration: gradient and step.
    With a `patience`, a grasp without improvement for so many iterations is switched off and costs nothing more.
    Raises InputError: unknown optimizer."""
    out = record_evaluation(m, d)
    add_step(out, m, d, optimizer, patience=patience)
    return out


def add_poses(out: Launches, m: Model, d: Data) -> None:
    """Add poses of all bodies; accumulators of an iteration are set to zero."""
    counts = [d.contacts.count, d.contacts.near_count]
    outputs = [*d.bodies, d.axis, d.wrench, *counts, d.depths.points, d.depths.object, d.depths.links]
    out.add(kinematics.forward, d.capacity, inputs=[m.hand.tree, d.active, *d.root_and_joints], outputs=outputs)


def add_distances(out: Launches, m: Model, d: Data, *, within: float | None = None) -> None:
    """Add candidate contacts: hand points near the object, their distances and normals."""
    found, o = d.marked or d.contacts, m.options
    nearness = [o.band, o.exact_below, o.band] if within is None else [o.band, within, within]
    points = [m.point_body, m.point_position, m.point_weight]
    inputs = [m.obj.surface, *nearness, NEAR_GAP, m.lane, *points, *d.dilation, *d.bodies]
    out.add(surface.gather, (d.capacity, m.lanes), inputs=inputs, outputs=[*found.arrays, found.mark])
    if (marked := d.marked) is not None:
        counts = [marked.kept_in, marked.near_in]
        out.add(packing.count_marks, marked.kept_in.shape, inputs=[d.active, marked.mark], outputs=counts)
        measured = [marked.body, marked.point, marked.normal, marked.distance, marked.weight]
        inputs = [d.active, marked.mark, *counts, *measured]
        out.add(packing.pack, marked.mark.shape, inputs=inputs, outputs=d.contacts.arrays)


def add_contact(out: Launches, m: Model, d: Data) -> None:
    """Add the contact step and its gradient with respect to distances, or their substitute.
    The direct solver has two launches: over simulations, then over contacts."""
    o, c = m.options, d.contacts
    contacts = [c.count, c.point, c.normal, c.distance, c.weight]
    if not o.simulate:
        inputs = [o.leak, o.leak_length, d.active, c.count, c.distance, c.weight]
        out.add(penalties.attract, (d.capacity, m.count), inputs=inputs, outputs=[c.gradient])
        return
    step, inputs = SOLVERS[o.contact_solver], [m.physics, m.motions, o.passes, *d.dilation, *contacts]
    if o.contact_solver != "direct":
        out.add(step, (d.capacity, o.velocities), inputs=inputs, outputs=[d.states, d.loss, d.end, c.gradient])
        return
    inputs += [c.near_count, c.near]
    out.add(step, (d.capacity, o.velocities), inputs=inputs, outputs=[d.loss, d.end, d.adjoint])
    inputs = [m.physics, m.lane, *d.dilation, *contacts, d.end, d.adjoint]
    out.add(contact.direct_gradient, (d.capacity, m.lanes), inputs=inputs, outputs=[c.gradient])


def add_penalties(out: Launches, m: Model, d: Data, *, room: float = 0.0) -> None:
    """Add penetration terms, and the gradient's transfer from points to bodies."""
    add_object_penalty(out, m, d)
    add_self_penalty(out, m, d, m.options.self_margin)
    o, c = m.options, d.contacts
    weight = [d.active, d.iteration, d.schedule.penetration]
    contacts = [c.count, c.body, c.point, c.normal, c.distance, c.weight, c.gradient]
    inputs, outputs = [o.pull, o.pull_length, m.lane, *weight, *contacts], [d.wrench, d.depths.points]
    out.add(penalties.points_to_bodies, (d.capacity, m.lanes), inputs=inputs, outputs=outputs)
    if (around := m.obstacles) is None:
        return
    out.add(obstacles.clear, d.capacity, inputs=[d.active], outputs=[d.depths.obstacles])
    terms = [d.active, d.scene, d.iteration, d.schedule.penetration, *d.bodies, room]
    outputs = [d.wrench, d.depths.obstacles]
    inputs = [around.features, around.solids, *terms]
    out.add(obstacles.penalty, (d.capacity, m.pieces), inputs=inputs, outputs=outputs)
    if around.any_solid:
        inputs = [around.features, m.hand.pieces, around.solids, *terms]
        out.add(solids.penalty, (d.capacity, m.pieces), inputs=inputs, outputs=outputs)


def add_object_penalty(out: Launches, m: Model, d: Data) -> None:
    """Add the term of the object's samples inside links."""
    weight = [REFERENCE_SAMPLES / len(m.obj.samples), d.active, d.iteration, d.schedule.object_penetration]
    inputs, outputs = [m.hand.pieces, m.obj.sorted_samples, *weight, *d.bodies], [d.wrench, d.depths.object]
    out.add(pieces.object_in_pieces, (d.capacity, m.pieces), inputs=inputs, outputs=outputs)


def add_self_penalty(out: Launches, m: Model, d: Data, margin: float) -> None:
    """Add the term of links inside links, or closer than `margin` [m]."""
    weight = [m.self_scale, margin, d.active, d.iteration, d.schedule.self_penetration]
    inputs, outputs = [m.hand.pieces, m.body_points, *weight, *d.bodies], [d.wrench, d.depths.links]
    out.add(pieces.pieces_in_pieces, (d.capacity, m.pieces), inputs=inputs, outputs=outputs)


def add_root_gradient(out: Launches, m: Model, d: Data) -> None:
    """Add the gradient with respect to root and joints, from the bodies' wrenches."""
    inputs = [m.hand.tree, d.active, d.pivot, d.body_p, d.axis]
    out.add(kinematics.backward, d.capacity, inputs=inputs, outputs=[d.wrench, d.gradient])


def add_gradient(out: Launches, m: Model, d: Data) -> None:
    """Add the whole gradient: of the bodies' wrenches, and of the joints' penalties."""
    add_root_gradient(out, m, d)
    o = m.options
    inputs = [m.hand.lower, m.hand.upper, o.range_weight, o.limit_weight, d.active, d.q]
    out.add(penalties.joints, (d.capacity, m.dofs), inputs=inputs, outputs=[d.gradient])


def add_step(
    out: Launches, m: Model, d: Data, optimizer: str, *, betas: tuple[float, float] = (0.9, 0.99), patience: int = 0
) -> None:
    """Add a step of the optimizer and advance the iteration; see `record_iteration`."""
    if optimizer not in OPTIMIZERS:
        raise InputError(f"unknown optimizer {optimizer!r}; choose one of {', '.join(OPTIMIZERS)}")
    inputs = [m.hand.lower, m.hand.upper, d.active, d.iteration, d.schedule.rates, d.gradient]
    if optimizer == "adam":
        outputs = [d.first, d.second, *d.root_and_joints]
        out.add(optimizers.adam, d.capacity, inputs=[*inputs, *betas], outputs=outputs)
    else:
        clamp = int(m.options.limit_weight == 0.0)
        out.add(optimizers.gradient_descent, d.capacity, inputs=[*inputs, clamp], outputs=d.root_and_joints)
    if patience:
        inputs = [d.loss, d.depths.points, d.depths.object, d.depths.links, patience]
        out.add(optimizers.converge, d.capacity, inputs=inputs, outputs=[d.best, d.waited, d.active])
    out.add(optimizers.advance, 1, inputs=[], outputs=[d.iteration])

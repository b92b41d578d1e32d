"""Operations on hands as recorded launches: one iteration is the gradient of the loss, then a step.

`record_*` records a whole list for the data's current schedule; `add_*` appends one part. No data leaves the device."""

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
    Contacts are exact only up to the distance `within` [m], if given; depths do not depend on it."""
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
    """Record one iteration: gradient and step. Raises InputError: unknown optimizer.
    If `patience` is above 0, a grasp without improvement for this many iterations is switched off."""
    out = record_evaluation(m, d)
    add_step(out, m, d, optimizer, patience=patience)
    return out


def add_poses(out: Launches, m: Model, d: Data) -> None:
    """Add poses of all bodies; accumulators of an iteration are set to zero."""
    outputs = [d.hands, d.contacts.count, d.contacts.near_count, d.depths]
    out.add(kinematics.forward, d.capacity, inputs=[m.hand.tree], outputs=outputs)


def add_distances(out: Launches, m: Model, d: Data, *, within: float | None = None) -> None:
    """Add candidate contacts: hand points near the object, their distances and normals."""
    o = m.options
    nearness = [o.band, o.exact_below, o.band] if within is None else [o.band, within, within]
    points = [m.point_body, m.point_position, m.point_weight]
    inputs = [m.obj.surface, m.regions, *nearness, NEAR_GAP, m.lane, *points, d.schedule.dilation, d.hands]
    out.add(surface.gather, (d.capacity, m.lanes), inputs=inputs, outputs=[d.marked or d.contacts])
    if (marked := d.marked) is not None:
        counts = d.chunk_counts
        out.add(packing.count_marks, counts[0].shape, inputs=[d.active, marked.mark], outputs=counts)
        out.add(packing.pack, marked.mark.shape, inputs=[d.active, marked, *counts], outputs=[d.contacts])


def add_contact(out: Launches, m: Model, d: Data) -> None:
    """Add the contact step and its gradient by distances; without `simulate` only attract points.
    The direct solver has two launches: over simulations, then over contacts."""
    o, c = m.options, d.contacts
    if not o.simulate:
        out.add(penalties.attract, (d.capacity, m.count), inputs=[o.leak, o.leak_length, d.hands], outputs=[c])
        return
    inputs = [m.physics, m.motions, o.passes, d.schedule.dilation, d.hands, c]
    outputs = [d.loss, d.end, d.adjoint] if o.contact_solver == "direct" else [d.states, d.loss, d.end]
    out.add(SOLVERS[o.contact_solver], (d.capacity, o.velocities), inputs=inputs, outputs=outputs)
    if o.contact_solver == "direct":
        inputs = [m.physics, m.lane, d.schedule.dilation, d.hands, d.end, d.adjoint]
        out.add(contact.direct_gradient, (d.capacity, m.lanes), inputs=inputs, outputs=[c])


def add_penalties(out: Launches, m: Model, d: Data, *, room: float = 0.0) -> None:
    """Add penetration terms, and transfer the gradient from points to bodies."""
    o, over = m.options, (d.capacity, m.pieces)
    weight = [REFERENCE_SAMPLES / len(m.obj.samples), d.schedule.object_penetration]
    inputs = [m.hand.pieces, m.obj.sorted_samples, *weight]
    out.add(pieces.object_in_pieces, over, inputs=inputs, outputs=[d.hands, d.depths.object])
    add_self_penalty(out, m, d, o.self_margin)
    inputs = [o.pull, o.pull_length, m.lane, d.schedule.penetration, d.contacts]
    out.add(penalties.points_to_bodies, (d.capacity, m.lanes), inputs=inputs, outputs=[d.hands, d.depths.points])
    if (around := m.obstacles) is None:
        return
    terms, outputs = [d.schedule.penetration, room], [d.hands, d.depths.obstacles]
    out.add(obstacles.penalty, over, inputs=[around.features, around.solids, *terms], outputs=outputs)
    if around.any_solid:
        inputs = [around.features, m.hand.pieces, around.solids, *terms]
        out.add(solids.penalty, over, inputs=inputs, outputs=outputs)


def add_self_penalty(out: Launches, m: Model, d: Data, margin: float) -> None:
    """Add the penalty on links that penetrate each other or are closer than `margin` [m]."""
    inputs = [m.hand.pieces, m.body_points, m.self_scale, margin, d.schedule.self_penetration]
    out.add(pieces.pieces_in_pieces, (d.capacity, m.pieces), inputs=inputs, outputs=[d.hands, d.depths.links])


def add_root_gradient(out: Launches, m: Model, d: Data) -> None:
    """Add the gradient with respect to root and joints, from the bodies' wrenches."""
    out.add(kinematics.backward, d.capacity, inputs=[m.hand.tree], outputs=[d.hands, d.gradient])


def add_gradient(out: Launches, m: Model, d: Data) -> None:
    """Add the whole gradient: of the bodies' wrenches, and of the joints' penalties."""
    add_root_gradient(out, m, d)
    o = m.options
    inputs = [m.hand.lower, m.hand.upper, o.range_weight, o.limit_weight, d.hands]
    out.add(penalties.joint_penalties, (d.capacity, m.dofs), inputs=inputs, outputs=[d.gradient])


def add_step(
    out: Launches, m: Model, d: Data, optimizer: str, *, betas: tuple[float, float] = (0.9, 0.99), patience: int = 0
) -> None:
    """Add a step of the optimizer and advance the iteration; see `record_iteration`."""
    if optimizer not in OPTIMIZERS:
        raise InputError(f"unknown optimizer {optimizer!r}; choose one of {', '.join(OPTIMIZERS)}")
    adam = optimizer == "adam"
    kind = [int(adam), int(adam or m.options.limit_weight == 0.0), *betas]
    inputs = [m.hand.lower, m.hand.upper, d.schedule.rates, d.gradient, *kind]
    out.add(optimizers.descend, d.capacity, inputs=inputs, outputs=[d.first, d.second, d.hands])
    if patience:
        inputs, outputs = [d.loss, d.depths, patience], [d.best, d.waited, d.active]
        out.add(optimizers.stop_converged, d.capacity, inputs=inputs, outputs=outputs)
    out.add(optimizers.advance, 1, inputs=[], outputs=[d.iteration])

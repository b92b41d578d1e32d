"""Operations on hands as recorded launches: one iteration is the gradient of the loss, then a step.

`record_*` records a whole list for the data's current schedule; `add_*` appends one part. No data leaves the device.
"""

from __future__ import annotations

from typing import Final

from graspd.service.model.errors import InputError
from graspd.worker.simulation.data import Data, MarkedContacts
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

#: Optimisers of `record_iteration`.
OPTIMIZERS: Final = ("adam", "gd")


def record_placement(m: Model, d: Data, *, room: float = 0.0, within: float | None = None) -> Launches:
    """Record contacts and penetration depths only; `room` is added to each feature's margin [m].

    `within`: only contacts within this distance are needed, exactly [m]; it does not change the depths.
    """
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

    Raises:
        InputError: unknown optimizer.
    """
    out = record_evaluation(m, d)
    add_step(out, m, d, optimizer, patience=patience)
    return out


def add_poses(out: Launches, m: Model, d: Data) -> None:
    """Add poses of all bodies; accumulators of an iteration are set to zero."""
    out.add(
        kinematics.forward,
        d.capacity,
        inputs=[m.hand.tree, d.active, d.pivot, d.rotation, d.q],
        outputs=[
            d.body_p,
            d.body_q,
            d.axis,
            d.wrench,
            d.contacts.count,
            d.contacts.near_count,
            d.depths.points,
            d.depths.object,
            d.depths.links,
        ],
    )


def add_distances(out: Launches, m: Model, d: Data, *, within: float | None = None) -> None:
    """Add candidate contacts: hand points near the object, their distances and normals."""
    found, o = d.marked or d.contacts, m.options
    nearness = [o.band, o.exact_below, o.band] if within is None else [o.band, within, within]
    out.add(
        surface.gather,
        (d.capacity, m.lanes),
        inputs=[
            m.obj.surface,
            *nearness,
            NEAR_GAP,
            m.lane,
            m.point_body,
            m.point_position,
            m.point_weight,
            d.active,
            d.iteration,
            d.schedule.dilation,
            d.dilation_scale,
            d.body_p,
            d.body_q,
        ],
        outputs=[
            found.count,
            found.body,
            found.point,
            found.normal,
            found.distance,
            found.weight,
            found.gradient,
            found.near_count,
            found.near,
            found.mark,
        ],
    )
    if d.marked is not None:
        _add_packing(out, d, d.marked)


def _add_packing(out: Launches, d: Data, marked: MarkedContacts) -> None:
    """Add the packing of marked contacts."""
    c = d.contacts
    counts = [marked.kept_in, marked.near_in]
    out.add(packing.count_marks, marked.kept_in.shape, inputs=[d.active, marked.mark], outputs=counts)
    out.add(
        packing.pack,
        marked.mark.shape,
        inputs=[
            d.active,
            marked.mark,
            *counts,
            marked.body,
            marked.point,
            marked.normal,
            marked.distance,
            marked.weight,
        ],
        outputs=[c.count, c.body, c.point, c.normal, c.distance, c.weight, c.gradient, c.near_count, c.near],
    )


def add_contact(out: Launches, m: Model, d: Data) -> None:
    """Add the contact step and its gradient with respect to distances, or their substitute."""
    o, c = m.options, d.contacts
    if not o.simulate:
        out.add(
            penalties.attract,
            (d.capacity, m.count),
            inputs=[o.leak, o.leak_length, d.active, c.count, c.distance, c.weight],
            outputs=[c.gradient],
        )
        return
    if o.contact_solver == "direct":
        _add_direct(out, m, d)
        return
    out.add(
        SOLVERS[o.contact_solver],
        (d.capacity, o.velocities),
        inputs=[
            m.physics,
            m.motions,
            o.passes,
            d.active,
            d.iteration,
            d.schedule.dilation,
            d.dilation_scale,
            c.count,
            c.point,
            c.normal,
            c.distance,
            c.weight,
        ],
        outputs=[d.states, d.loss, d.end, c.gradient],
    )


def _add_direct(out: Launches, m: Model, d: Data) -> None:
    """Add the direct solver in two launches: over simulations, then over contacts."""
    c = d.contacts
    schedule = [d.active, d.iteration, d.schedule.dilation, d.dilation_scale]
    contacts = [c.count, c.point, c.normal, c.distance, c.weight]
    out.add(
        SOLVERS["direct"],
        (d.capacity, m.options.velocities),
        inputs=[m.physics, m.motions, m.options.passes, *schedule, *contacts, c.near_count, c.near],
        outputs=[d.loss, d.end, d.adjoint],
    )
    out.add(
        contact.direct_gradient,
        (d.capacity, m.lanes),
        inputs=[m.physics, m.lane, *schedule, *contacts, d.end, d.adjoint],
        outputs=[c.gradient],
    )


def add_penalties(out: Launches, m: Model, d: Data, *, room: float = 0.0) -> None:
    """Add penetration terms, and the gradient's transfer from points to bodies."""
    add_object_penalty(out, m, d)
    add_self_penalty(out, m, d, m.options.self_margin)
    c = d.contacts
    out.add(
        penalties.points_to_bodies,
        (d.capacity, m.lanes),
        inputs=[
            0.0,
            m.options.pull,
            m.options.pull_length,
            m.lane,
            d.active,
            d.iteration,
            d.schedule.penetration,
            c.count,
            c.body,
            c.point,
            c.normal,
            c.distance,
            c.weight,
            c.gradient,
        ],
        outputs=[d.wrench, d.depths.points],
    )
    if m.obstacles is not None:
        out.add(obstacles.clear, d.capacity, inputs=[d.active], outputs=[d.depths.obstacles])
        out.add(
            obstacles.penalty,
            (d.capacity, m.pieces),
            inputs=[
                m.obstacles.features,
                m.obstacles.solids,
                d.active,
                d.scene,
                d.iteration,
                d.schedule.penetration,
                d.body_p,
                d.body_q,
                room,
            ],
            outputs=[d.wrench, d.depths.obstacles],
        )
    if m.obstacles is not None and m.obstacles.any_solid:
        out.add(
            solids.penalty,
            (d.capacity, m.pieces),
            inputs=[
                m.obstacles.features,
                m.hand.pieces,
                m.obstacles.solids,
                d.active,
                d.scene,
                d.iteration,
                d.schedule.penetration,
                d.body_p,
                d.body_q,
                room,
            ],
            outputs=[d.wrench, d.depths.obstacles],
        )


def add_object_penalty(out: Launches, m: Model, d: Data) -> None:
    """Add the term of the object's samples inside links."""
    out.add(
        pieces.object_in_pieces,
        (d.capacity, m.pieces),
        inputs=[
            m.hand.pieces,
            m.obj.sorted_samples,
            REFERENCE_SAMPLES / len(m.obj.samples),
            d.active,
            d.iteration,
            d.schedule.object_penetration,
            d.body_p,
            d.body_q,
        ],
        outputs=[d.wrench, d.depths.object],
    )


def add_self_penalty(out: Launches, m: Model, d: Data, margin: float) -> None:
    """Add the term of links inside links, or closer than `margin` [m]."""
    out.add(
        pieces.pieces_in_pieces,
        (d.capacity, m.pieces),
        inputs=[
            m.hand.pieces,
            m.body_points,
            m.self_scale,
            margin,
            d.active,
            d.iteration,
            d.schedule.self_penetration,
            d.body_p,
            d.body_q,
        ],
        outputs=[d.wrench, d.depths.links],
    )


def add_root_gradient(out: Launches, m: Model, d: Data) -> None:
    """Add the gradient with respect to root and joints, from the bodies' wrenches."""
    out.add(
        kinematics.backward,
        d.capacity,
        inputs=[m.hand.tree, d.active, d.pivot, d.body_p, d.axis],
        outputs=[d.wrench, d.gradient],
    )


def add_gradient(out: Launches, m: Model, d: Data) -> None:
    """Add the whole gradient: of the bodies' wrenches, and of the joints' penalties."""
    add_root_gradient(out, m, d)
    o = m.options
    out.add(
        penalties.joints,
        (d.capacity, m.dofs),
        inputs=[m.hand.lower, m.hand.upper, o.range_weight, o.limit_weight, d.active, d.q],
        outputs=[d.gradient],
    )


def add_step(
    out: Launches, m: Model, d: Data, optimizer: str, *, betas: tuple[float, float] = (0.9, 0.99), patience: int = 0
) -> None:
    """Add a step of the optimizer and advance the iteration; see `record_iteration`."""
    if optimizer not in OPTIMIZERS:
        raise InputError(f"unknown optimizer {optimizer!r}; choose one of {', '.join(OPTIMIZERS)}")
    inputs = [m.hand.lower, m.hand.upper, d.active, d.iteration, d.schedule.rates, d.gradient]
    state = [d.pivot, d.rotation, d.q]
    if optimizer == "adam":
        out.add(optimizers.adam, d.capacity, inputs=[*inputs, *betas], outputs=[d.first, d.second, *state])
    else:
        clamp = int(m.options.limit_weight == 0.0)
        out.add(optimizers.gradient_descent, d.capacity, inputs=[*inputs, clamp], outputs=state)
    if patience:
        out.add(
            optimizers.converge,
            d.capacity,
            inputs=[d.loss, d.depths.points, d.depths.object, d.depths.links, patience],
            outputs=[d.best, d.waited, d.active],
        )
    out.add(optimizers.advance, 1, inputs=[], outputs=[d.iteration])

"""Hand, object and supports as meshes, for formats that show a grasp and simulate nothing."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from service.model.transforms import Floats
from worker.files.exchange.names import plain_name
from worker.hands.model import HandModel
from worker.hands.primitives import hull
from worker.hands.robot import Ints
from worker.objects.mesh_geometry import corner_normals
from worker.rendering.hands import drawn_bodies, hand_parts
from worker.robots.execution import Executions
from worker.simulation.surroundings import Obstacle

Colour = tuple[float, float, float]
OBJECT_COLOUR: Final[Colour] = (0.72, 0.2, 0.04)
SUPPORT_COLOUR: Final[Colour] = (0.5, 0.5, 0.47)
#: A half-space is shown as a slab of this width and thickness [m].
SLAB_M: Final = (1.0, 0.02)


@dataclass(frozen=True)
class Solid:
    """A mesh in the frame of what carries it."""

    name: str
    vertices: Floats
    faces: Ints
    normals: Floats
    """(F, 3, 3) unit normals of the corners of faces."""
    colour: Colour
    """Linear RGB, 0 .. 1."""
    body: int | None = None
    """The body of the hand that carries it; None: the object, or nothing."""


def hand_meshes(found: Executions) -> list[Solid]:
    """One for each body of the hand that is seen, in the body's frame."""
    hand = found.hand
    return [
        Solid(
            _name_of(hand, number),
            part.solid.vertices,
            part.solid.faces,
            part.solid.corner_normals,
            part.look.base,
            part.body,
        )
        for number, part in enumerate(hand_parts(hand))
    ]


def object_mesh(found: Executions) -> Solid:
    """The object in its own frame."""
    return Solid(
        plain_name(found.obj.name), found.obj.vertices, found.obj.faces, found.obj.corner_normals, OBJECT_COLOUR
    )


def support_meshes(found: Executions) -> list[Solid]:
    """The supports in the frame of the scene; half-spaces as slabs about the objects."""
    supports = () if found.placed is None else found.placed.supports
    middle = found.object_pose[:, :3].mean(axis=0)
    return [_support(f"support_{k}", _corners(one, middle)) for k, one in enumerate(supports)]


def _support(name: str, corners: Floats) -> Solid:
    vertices, faces = hull(corners)
    return Solid(name, vertices, faces, corner_normals(vertices, faces), SUPPORT_COLOUR)


def _corners(support: Obstacle, middle: Floats) -> Floats:
    if len(support.corners):
        return support.corners
    normal, offset = support.planes[0, :3], float(support.planes[0, 3])
    foot = middle - (middle @ normal - offset) * normal
    across = np.cross(normal, np.eye(3)[int(np.argmin(np.abs(normal)))])
    across /= np.linalg.norm(across)
    width, thickness = SLAB_M
    ends = [(a, b, c) for a in (-0.5, 0.5) for b in (-0.5, 0.5) for c in (-1, 0)]
    beside = np.cross(normal, across)
    return np.array([foot + width * (a * across + b * beside) + thickness * c * normal for a, b, c in ends])


def _name_of(hand: HandModel, number: int) -> str:
    """A body's name; its second solid and those after it are numbered."""
    bodies = drawn_bodies(hand)
    before = bodies[:number].count(bodies[number])
    return hand.body_names[bodies[number]] + (f"_{before + 1}" if before else "")

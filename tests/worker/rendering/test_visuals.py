"""A hand is drawn as it looks where it says so: visual meshes in their colours; collision shapes where it does not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from graspd.worker.hands.load import load_hand
from graspd.worker.hands.model import HandModel
from graspd.worker.rendering.hands import drawn_bodies, hand_parts, without_visuals
from graspd.worker.stages.models import hand_glb
from tests.worker.commands_run import refused
from tests.worker.hands.urdfs import joint, link, robot

BOX = '<collision><geometry><box size="0.02 0.02 0.04"/></geometry></collision>'
RED = '<material name="red"><color rgba="1 0 0 1"/></material>'
SEEN = (
    f'<visual><geometry><box size="0.06 0.06 0.01"/></geometry>{RED}</visual>'
    '<visual><geometry><mesh filename="part.stl"/></geometry><material name="blue"/></visual>'
    '<visual><geometry><mesh filename="missing.stl"/></geometry></visual>'
)


@pytest.fixture(scope="module")
def hand() -> HandModel:
    blue = '<material name="blue"><color rgba="0 0 1 1"/></material>'
    urdf = robot(blue, link("palm", BOX + SEEN), link("a", BOX), joint("j", "palm", "a"))
    part = bytes(trimesh.creation.icosphere(1, 0.01).export(file_type="stl"))
    return load_hand({"h.urdf": urdf, "part.stl": part}, name="h", digest="0" * 32)


def test_what_is_seen_has_its_colours_else_collision_shapes(hand: HandModel) -> None:
    palm = [part for part in hand_parts(hand) if part.body == 0]
    assert sorted((part.look.base, len(part.solid.faces)) for part in palm) == [((0, 0, 1), 80), ((1, 0, 0), 12)]
    (finger,) = [part for part in hand_parts(hand) if part.body == 1]
    assert np.ptp(finger.solid.vertices, axis=0) == pytest.approx([0.02, 0.02, 0.04])


def test_collision_shapes_are_drawn_on_a_toggle(hand: HandModel) -> None:
    bare = without_visuals(hand)
    assert bare.pieces is hand.pieces and bare.content != hand.content
    assert drawn_bodies(bare) == [0, 1] and drawn_bodies(hand) == [0, 0, 1]
    assert np.ptp(hand_parts(bare)[0].solid.vertices, axis=0) == pytest.approx([0.02, 0.02, 0.04])
    above = without_visuals(replace(hand, mounting=hand)).mounting
    assert above is not None and drawn_bodies(above) == [0, 1]


def test_a_model_for_viewers_has_the_colours(hand: HandModel) -> None:
    scene = trimesh.load(trimesh.util.wrap_as_stream(hand_glb(hand)), file_type="glb")
    colours = {
        tuple(colour)
        for mesh in scene.geometry.values()
        if len(getattr(mesh, "faces", ()))
        for colour in np.unique(mesh.visual.vertex_colors[:, :3], axis=0).tolist()
    }
    assert {(255, 0, 0), (0, 0, 255)} <= colours


@pytest.mark.parametrize("said", ["--closing ja=2", "--closing ja", "--xacro x"])
def test_an_option_that_cannot_be_read_is_the_callers_mistake(said: str) -> None:
    assert said.split()[0] in refused(f"hands check allegro --no-self-test {said}")

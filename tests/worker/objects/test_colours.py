"""Colours of mesh files: base colours and means of textures in GLB, of vertices in OBJ; bad ones are passed over."""

from __future__ import annotations

import io
import json
import struct

import numpy as np
import pytest
import trimesh
from PIL import Image

from graspd.worker.hands.load import load_hand
from graspd.worker.objects.formats import read_mesh
from graspd.worker.objects.formats.glb import material_colour
from graspd.worker.rendering.hands import hand_parts
from tests.worker.hands.urdfs import BOX, joint, link, robot

#: sRGB of a byte, rounded twice.
STEP = 1.5 / 255
PRIMARIES = np.array([[230, 20, 20], [230, 20, 20], [230, 20, 20], [230, 20, 20]], np.uint8).reshape(2, 2, 3)


def glb(material: trimesh.visual.material.PBRMaterial) -> bytes:
    box = trimesh.creation.box((0.02, 0.02, 0.04))
    box.visual = trimesh.visual.TextureVisuals(uv=np.zeros((len(box.vertices), 2)), material=material)
    return bytes(box.export(file_type="glb"))


def colour(data: bytes) -> np.ndarray:
    ((rgb, faces),) = read_mesh("m.glb", data).by_colour()
    assert len(faces) == 12
    return np.full(3, np.nan) if rgb is None else np.array(rgb)


def textured() -> bytes:
    return glb(trimesh.visual.material.PBRMaterial(baseColorTexture=Image.fromarray(PRIMARIES)))


def test_a_base_colour_is_linear_in_the_file_and_srgb_here() -> None:
    half = glb(trimesh.visual.material.PBRMaterial(baseColorFactor=[0.5, 0.0, 1.0, 1.0]))
    # trimesh stores colours as bytes.
    assert colour(half) == pytest.approx([0.735, 0.0, 1.0], abs=STEP)


def test_a_texture_gives_its_mean_colour() -> None:
    assert colour(textured()) == pytest.approx(np.array([230, 20, 20]) / 255, abs=STEP)


def test_a_hand_is_drawn_in_the_colours_of_its_textured_mesh() -> None:
    seen = '<visual><geometry><mesh filename="part.glb"/></geometry></visual>'
    urdf = robot(link("palm", BOX + seen), link("a"), joint("j", "palm", "a"))
    hand = load_hand({"h.urdf": urdf, "part.glb": textured()}, name="h", digest="")
    (palm,) = [part for part in hand_parts(hand) if part.body == 0]
    red, green, blue = palm.look.base
    assert red > 0.7 and green == pytest.approx(blue) and green < 0.02


def changed(data: bytes, change: object) -> bytes:
    """The file with another JSON chunk."""
    (length,) = struct.unpack("<I", data[12:16])
    document = json.loads(data[20 : 20 + length])
    change(document)  # type: ignore[operator]
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    rest = data[20 + length :]
    return struct.pack("<4sIII4s", b"glTF", 2, 20 + len(text) + len(rest), len(text), b"JSON") + text + rest


def large() -> bytes:
    """A small PNG of 65,536 times 65,536 pixels, as its header says."""
    buffer = io.BytesIO()
    Image.new("L", (1, 1)).save(buffer, "PNG")
    data = bytearray(buffer.getvalue())
    data[16:24] = struct.pack(">II", 65536, 65536)
    return bytes(data)


@pytest.mark.parametrize(
    "change",
    [
        lambda document: document["images"][0].update(bufferView=99),
        lambda document: document["images"][0].update(bufferView="x"),
        lambda document: document["images"].clear(),
        lambda document: document["bufferViews"][document["images"][0]["bufferView"]].update(byteOffset=-5),
        lambda document: document["bufferViews"][document["images"][0]["bufferView"]].update(byteLength=9),
        lambda document: document.update(materials=[{"pbrMetallicRoughness": {"baseColorFactor": [1e999, 0, 0, 1]}}]),
        lambda document: document.update(materials="none"),
    ],
)
def test_a_colour_that_cannot_be_read_leaves_the_shape(change: object) -> None:
    assert np.isnan(colour(changed(textured(), change))).all()


def test_a_texture_that_promises_too_much_is_not_unpacked() -> None:
    material = {"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}
    picture = large()
    document = {
        "materials": [material],
        "textures": [{"source": 0}],
        "images": [{"bufferView": 0}],
        "bufferViews": [{"byteLength": len(picture)}],
    }
    assert np.isnan(material_colour(document, picture, {"material": 0})).all()


def test_an_obj_has_the_colours_of_its_vertices() -> None:
    text = b"v 0 0 0 1 0 0\nv 1 0 0 1 0 0\nv 0 1 0 1 0 0\nv 0 0 1\nf 1 2 3\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
    known = {rgb: len(faces) for rgb, faces in read_mesh("m.obj", text).by_colour()}
    assert known == {(1.0, 0.0, 0.0): 1, None: 3}
    assert read_mesh("m.obj", b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n").colours is None

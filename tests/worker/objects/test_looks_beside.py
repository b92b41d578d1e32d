"""Colours that lie in files beside a mesh: MTL libraries and pictures, from the hand's own folder and nowhere else."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from graspd.service.store.hand_files import files_of_hand
from graspd.service.store.mesh_files import MAX_NAMES, beside, looks_of
from graspd.worker.hands.load import hand_from_path, load_hand
from graspd.worker.objects.formats import read_mesh
from tests.worker.hands.urdfs import BOX, joint, link, robot
from tests.worker.objects.test_colours import large
from tests.worker.objects.test_dae import dae

#: Two triangles without a material, a square that is cut into two, and a triangle of a material that nobody describes.
OBJ = b"""mtllib looks/part.mtl
v 0 0 0
v 1 0 0
v 1 1 0
v 0 1 0
v 0 0 1
f 1 2 5
usemtl green
f 1 2 3 4
usemtl photo
f 1 4 5
usemtl unknown
f 2 3 5
"""
MTL = b"newmtl green\nKd 0 1 0\nnewmtl photo\nKd 0.8 0.8 0.8\nmap_Kd -s 1 1 1 skin.png\n"
GREEN, RED = (0.0, 1.0, 0.0), (0.902, 0.078, 0.078)
IMAGE = '<library_images><image id="img"><init_from>{}</init_from></image></library_images>'
TEXTURED = (
    '<newparam sid="surf"><surface type="2D"><init_from>img</init_from></surface></newparam>'
    '<newparam sid="samp"><sampler2D><source>surf</source></sampler2D></newparam>'
    '<technique sid="c"><lambert><diffuse><texture texture="samp" texcoord="UV"/></diffuse></lambert></technique>'
)


def picture(format: str = "PNG") -> bytes:
    """Half of it (205, 15, 15), half (255, 25, 25)."""
    half = np.array([[[205, 15, 15], [255, 25, 25]]], np.uint8).repeat(8, axis=1)
    made = io.BytesIO()
    Image.fromarray(half.repeat(16, axis=0)).save(made, format)
    return made.getvalue()


def colours(files: dict[str, bytes], mesh: str = "m/part.obj") -> dict[object, int]:
    seen = f'<visual><geometry><mesh filename="{mesh}"/></geometry></visual>'
    urdf = robot(link("palm", BOX + seen), link("a"), joint("j", "palm", "a"))
    hand = load_hand({"h.urdf": urdf, **files}, name="h", digest="")
    return {mesh.colour: len(mesh.faces) for mesh in hand.visuals.meshes}


def test_an_obj_has_the_colours_of_its_library_and_the_mean_of_its_picture() -> None:
    files = {"m/part.obj": OBJ, "m/looks/part.mtl": MTL, "m/looks/skin.png": picture()}
    assert colours(files) == {GREEN: 2, RED: 1, None: 2}
    # Where the picture is missing or no picture, the number counts.
    grey = {GREEN: 2, (0.8, 0.8, 0.8): 1, None: 2}
    assert colours({**files, "m/looks/skin.png": b"no picture"}) == grey
    assert colours({**files, "m/looks/skin.png": large()}) == grey
    del files["m/looks/skin.png"]
    assert colours(files) == grey
    assert colours({"m/part.obj": OBJ}) == {None: 5}


def textured_dae(named: str) -> bytes:
    text = dae().decode()
    before, rest = text.split("<technique", 1)
    technique, after = rest.split("</technique>", 1)
    assert "<color>" in technique
    return (before + TEXTURED + after).replace("<library_nodes>", IMAGE.format(named) + "<library_nodes>").encode()


@pytest.mark.parametrize("named", ["skin.jpg", "file:///home/someone/skin.jpg", "C:\\\\work\\\\skin.jpg"])
def test_a_dae_has_the_mean_of_a_picture_beside_it(named: str) -> None:
    found = colours({"m/part.dae": textured_dae(named), "m/skin.jpg": picture("JPEG")}, "m/part.dae")
    (red,) = [colour for colour in found if colour]
    # JPEG rounds.
    assert red == pytest.approx(RED, abs=0.02) and found[red] == 4
    assert colours({"m/part.dae": textured_dae(named)}, "m/part.dae") == {None: 6}


def test_a_change_of_a_picture_is_another_look() -> None:
    files = {"m/part.obj": OBJ, "m/looks/part.mtl": MTL, "m/looks/skin.png": picture()}
    assert looks_of("m/part.obj", files) == ["m/looks/part.mtl", "m/looks/skin.png"]
    seen = '<visual><geometry><mesh filename="m/part.obj"/></geometry></visual>'
    urdf = robot(link("palm", BOX + seen), link("a"), joint("j", "palm", "a"))
    digests = {
        load_hand({"h.urdf": urdf, **files, "m/looks/skin.png": data}, name="h", digest="").visuals.content
        for data in (picture(), picture() + b" ")
    }
    assert len(digests) == 2


@pytest.mark.parametrize(
    "reference", ["../../secret.png", "/etc/secret.png", "secret.stl", "..", "", "a\0.png", "file://"]
)
def test_names_lead_nowhere_else(reference: str) -> None:
    there = {"secret.png", "/etc/secret.png", "../secret.png", "m/secret.stl", "etc/secret.png"}
    assert beside("m/part.obj", reference, there.__contains__) is None


def test_a_hand_brings_the_looks_that_its_meshes_name_and_nothing_from_outside(tmp_path: Path) -> None:
    folder = tmp_path / "hand"
    (folder / "m" / "looks").mkdir(parents=True)
    outside = b"newmtl other\nmap_Kd ../../secret.png\n"
    (folder / "m" / "part.obj").write_bytes(OBJ + b"mtllib other.mtl\n")
    (folder / "m" / "looks" / "part.mtl").write_bytes(MTL)
    (folder / "m" / "other.mtl").write_bytes(outside)
    (folder / "m" / "looks" / "skin.png").write_bytes(picture())
    (folder / "m" / "photo of the lab.png").write_bytes(picture())
    (tmp_path / "secret.png").write_bytes(picture())
    seen = '<visual><geometry><mesh filename="m/part.obj"/></geometry></visual>'
    (folder / "h.urdf").write_bytes(robot(link("palm", BOX + seen), link("a"), joint("j", "palm", "a")))
    for given in (folder / "h.urdf", folder):
        files, _ = files_of_hand(given)
        assert set(files) == {"h.urdf", "m/part.obj", "m/looks/part.mtl", "m/other.mtl", "m/looks/skin.png"}
    hand = hand_from_path(folder / "h.urdf")
    assert {mesh.colour for mesh in hand.visuals.meshes} == {None, GREEN, RED}


def test_a_library_that_names_itself_or_very_much_ends() -> None:
    many = b"".join(b"newmtl m%d\nmap_Kd p%d.png\n" % (k, k) for k in range(10_000))
    files = {"a.obj": b"mtllib a.mtl\n" * 10_000, "a.mtl": many, **{f"p{k}.png": b"" for k in range(10_000)}}
    assert len(looks_of("a.obj", files)) <= MAX_NAMES
    asked: list[str] = []
    text = OBJ.replace(b"looks/part.mtl", b"a.mtl")
    read_mesh("a.obj", text, lambda name: asked.append(name) or (many if name == "a.mtl" else None))
    assert len(asked) <= 1 + MAX_NAMES

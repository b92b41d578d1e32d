"""Colours of mesh files and of what lies beside them, and COLLADA, which has both; bad ones are passed over."""

import io
import json
import struct

import numpy as np
import pytest
import trimesh
from PIL import Image

from graspd.service.model.errors import LimitError, MeshError
from graspd.service.store.hand_files import find_hand_files
from graspd.service.store.mesh_files import MAX_NAMES, appearance_files, resolve_appearance_file
from graspd.worker.hands.load import hand_from_path, load_hand
from graspd.worker.hands.model import HandModel
from graspd.worker.objects.formats import read_mesh
from graspd.worker.objects.formats.glb import material_colour
from graspd.worker.rendering.hands import hand_parts
from tests.worker.hands.urdfs import BOX, joint, link, robot
from tests.worker.objects.test_formats import pack_glb

#: sRGB of a byte, rounded twice.
STEP = 1.5 / 255
PRIMARIES = np.array([[230, 20, 20], [230, 20, 20], [230, 20, 20], [230, 20, 20]], np.uint8).reshape(2, 2, 3)
OUTSIDE = ["../../secret.png", "/etc/secret.png", "secret.stl", "..", "", "a\0.png", "file://"]
BOMB = (
    "".join(f'<node id="n{k}">' + f'<instance_node url="#n{k + 1}"/>' * 10 + "</node>" for k in range(12))
    + '<node id="n12"><instance_geometry url="#g"/></node>'
)
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
HEAD = '<?xml version="1.0"?><COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1">'
#: A tetrahedron and a square of four corners, each in a colour of its own, in millimetres, moved and turned.
SCENE = """
<asset><unit meter="0.001" name="millimeter"/><up_axis>Y_UP</up_axis></asset>
<library_effects>
 <effect id="e1"><profile_COMMON><technique sid="c"><phong>
  <diffuse><color>1 0 0 1</color></diffuse></phong></technique>
 </profile_COMMON></effect>
 <effect id="e2"><profile_COMMON><technique sid="c"><phong>
  <diffuse><texture texture="x" texcoord="y"/></diffuse></phong>
 </technique></profile_COMMON></effect>
</library_effects>
<library_materials><material id="m1"><instance_effect url="#e1"/></material>
 <material id="m2"><instance_effect url="#e2"/></material></library_materials>
<library_geometries><geometry id="g"><mesh>
 <source id="p"><float_array id="f" count="15">0 0 0 10 0 0 0 10 0 0 0 10 10 10 0</float_array>
  <technique_common><accessor source="#f" count="5" stride="3"/></technique_common></source>
 <vertices id="v"><input semantic="POSITION" source="#p"/></vertices>
 <triangles material="red" count="4"><input semantic="VERTEX" source="#v" offset="0"/>
  <input semantic="NORMAL" source="#p" offset="1"/><p>0 0 2 0 1 0 0 0 1 0 3 0 1 0 2 0 3 0 0 0 3 0 2 0</p></triangles>
 <polylist material="plain" count="1"><input semantic="VERTEX" source="#v" offset="0"/>
  <vcount>4</vcount><p>0 1 4 2</p></polylist>
</mesh></geometry></library_geometries>
<library_nodes><node id="part"><translate>100 0 0</translate><rotate>0 0 1 90</rotate>
 <instance_geometry url="#g"><bind_material><technique_common><instance_material symbol="red" target="#m1"/>
 <instance_material symbol="plain" target="#m2"/></technique_common></bind_material></instance_geometry></node>
</library_nodes>
<library_visual_scenes><visual_scene id="s"><node><scale>2 2 2</scale><instance_node url="#part"/></node>
</visual_scene></library_visual_scenes><scene><instance_visual_scene url="#s"/></scene>"""


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


def test_base_colours_are_srgb_here_and_textures_give_their_mean() -> None:
    half = glb(trimesh.visual.material.PBRMaterial(baseColorFactor=[0.5, 0.0, 1.0, 1.0]))
    # trimesh stores colours as bytes.
    assert colour(half) == pytest.approx([0.735, 0.0, 1.0], abs=STEP)
    assert colour(textured()) == pytest.approx(np.array([230, 20, 20]) / 255, abs=STEP)


def urdf_seen_as(mesh: str) -> bytes:
    seen = f'<visual><geometry><mesh filename="{mesh}"/></geometry></visual>'
    return robot(link("palm", BOX + seen), link("a"), joint("j", "palm", "a"))


def hand_seen_as(mesh: str, files: dict[str, bytes]) -> HandModel:
    return load_hand({"h.urdf": urdf_seen_as(mesh), **files}, name="h", digest="")


def test_a_hand_is_drawn_in_the_colours_of_its_textured_mesh() -> None:
    hand = hand_seen_as("part.glb", {"part.glb": textured()})
    (palm,) = [part for part in hand_parts(hand) if part.body == 0]
    red, green, blue = palm.look.base
    assert red > 0.7 and green == pytest.approx(blue) and green < 0.02


def changed(data: bytes, change: object) -> bytes:
    (length,) = struct.unpack("<I", data[12:16])
    document = json.loads(data[20 : 20 + length])
    change(document)  # type: ignore[operator]
    return pack_glb(document, data[28 + length :])


def png(width: int, height: int) -> bytes:
    buffer = io.BytesIO()
    Image.new("1", (width, height)).save(buffer, "PNG")
    return buffer.getvalue()


#: A small PNG of 65,536 times 65,536 pixels, as its header says.
LARGE = png(1, 1)[:16] + struct.pack(">II", 65536, 65536) + png(1, 1)[24:]


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


def test_pictures_that_promise_too_much_and_endless_names_end() -> None:
    material = {"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}
    document = {"materials": [material], "textures": [{"source": 0}]}
    document |= {"images": [{"bufferView": 0}], "bufferViews": [{"byteLength": len(LARGE)}]}
    assert np.isnan(material_colour(document, LARGE, {"material": 0})).all()
    many = b"".join(b"newmtl m%d\nmap_Kd p%d.png\n" % (k, k) for k in range(10_000))
    files = {"a.obj": b"mtllib a.mtl\n" * 10_000, "a.mtl": many, **{f"p{k}.png": b"" for k in range(10_000)}}
    assert len(appearance_files("a.obj", files)) <= MAX_NAMES
    asked: list[str] = []
    text = OBJ.replace(b"looks/part.mtl", b"a.mtl")
    read_mesh("a.obj", text, lambda name: asked.append(name) or (many if name == "a.mtl" else None))
    assert len(asked) <= 1 + MAX_NAMES


def test_an_obj_has_the_colours_of_its_vertices() -> None:
    text = b"v 0 0 0 1 0 0\nv 1 0 0 1 0 0\nv 0 1 0 1 0 0\nv 0 0 1\nf 1 2 3\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
    known = {rgb: len(faces) for rgb, faces in read_mesh("m.obj", text).by_colour()}
    assert known == {(1.0, 0.0, 0.0): 1, None: 3}
    assert read_mesh("m.obj", b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n").colours is None


def picture(format: str = "PNG") -> bytes:
    """Half of it (205, 15, 15), half (255, 25, 25)."""
    half = np.array([[[205, 15, 15], [255, 25, 25]]], np.uint8).repeat(8, axis=1)
    made = io.BytesIO()
    Image.fromarray(half.repeat(16, axis=0)).save(made, format)
    return made.getvalue()


def colours(files: dict[str, bytes], mesh: str = "m/part.obj") -> dict[object, int]:
    return {mesh.colour: len(mesh.faces) for mesh in hand_seen_as(mesh, files).visuals.meshes}


def test_obj_has_colours_of_its_library_and_mean_of_its_picture() -> None:
    files = {"m/part.obj": OBJ, "m/looks/part.mtl": MTL, "m/looks/skin.png": picture()}
    assert colours(files) == {GREEN: 2, RED: 1, None: 2}
    # Where the picture is missing or no picture, the number counts.
    grey = {GREEN: 2, (0.8, 0.8, 0.8): 1, None: 2}
    for unused in (b"no picture", LARGE, png(4096, 4097)):
        assert colours({**files, "m/looks/skin.png": unused}) == grey
    del files["m/looks/skin.png"]
    assert colours(files) == grey and colours({"m/part.obj": OBJ}) == {None: 5}


def textured_dae(named: str) -> bytes:
    before, rest = dae().decode().split("<technique", 1)
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
    assert appearance_files("m/part.obj", files) == ["m/looks/part.mtl", "m/looks/skin.png"]
    other = {**files, "m/looks/skin.png": picture() + b" "}
    one, two = (hand_seen_as("m/part.obj", given).visuals.content for given in (files, other))
    assert one != two


@pytest.mark.parametrize("reference", OUTSIDE)
def test_names_lead_nowhere_else(reference: str) -> None:
    there = {"secret.png", "/etc/secret.png", "../secret.png", "m/secret.stl", "etc/secret.png"}
    assert resolve_appearance_file("m/part.obj", reference, there.__contains__) is None


def test_a_hand_brings_looks_its_meshes_name_none_from_outside(tmp_path) -> None:
    folder = tmp_path / "hand"
    (folder / "m" / "looks").mkdir(parents=True)
    outside = b"newmtl other\nmap_Kd ../../secret.png\n"
    (folder / "m" / "part.obj").write_bytes(OBJ + b"mtllib other.mtl\n")
    (folder / "m" / "looks" / "part.mtl").write_bytes(MTL)
    (folder / "m" / "other.mtl").write_bytes(outside)
    (folder / "m" / "looks" / "skin.png").write_bytes(picture())
    (folder / "m" / "photo of the lab.png").write_bytes(picture())
    (tmp_path / "secret.png").write_bytes(picture())
    (folder / "h.urdf").write_bytes(urdf_seen_as("m/part.obj"))
    for given in (folder / "h.urdf", folder):
        files, _ = find_hand_files(given)
        assert set(files) == {"h.urdf", "m/part.obj", "m/looks/part.mtl", "m/other.mtl", "m/looks/skin.png"}
    hand = hand_from_path(folder / "h.urdf")
    assert {mesh.colour for mesh in hand.visuals.meshes} == {None, GREEN, RED}


def dae(body: str = SCENE) -> bytes:
    return f"{HEAD}{body}</COLLADA>".encode()


def test_a_mesh_that_trimesh_wrote_comes_back_ours_is_placed() -> None:
    soup = read_mesh("a.dae", dae())
    assert len(soup.faces) == 6
    # 2 (R_z(90) p + 100 x) mm
    expected = 2e-3 * np.array([[100, 0, 0], [100, 10, 0], [90, 0, 0], [100, 0, 10], [90, 10, 0]])
    found = np.unique(soup.vertices.round(9), axis=0)
    np.testing.assert_allclose(found, np.unique(expected.round(9), axis=0), atol=1e-12)
    assert {colour: len(faces) for colour, faces in soup.by_colour()} == {(1.0, 0.0, 0.0): 4, None: 2}
    pytest.importorskip("collada")
    mesh = trimesh.creation.icosphere(2, 0.03)
    soup = read_mesh("a.dae", bytes(mesh.export(file_type="dae")))
    # Its vertices stand in the file in single precision.
    np.testing.assert_allclose(soup.vertices[soup.faces], mesh.vertices[mesh.faces], atol=1e-7)


@pytest.mark.parametrize(
    ("data", "named"),
    [
        (b'<!DOCTYPE C [<!ENTITY a SYSTEM "file:///etc/passwd">]><COLLADA>&a;</COLLADA>', "entities"),
        (b"PK\x03\x04not a zip either", "well-formed"),
        (b"<svg/>", "<COLLADA>"),
        (dae(SCENE.replace("<library_nodes>", f"<library_nodes>{BOMB}").replace("#part", "#n0")), "too deep"),
        (dae(SCENE.replace('<node id="part">', '<node id="part"><instance_node url="#part"/>')), "cyclic"),
        (dae(SCENE.replace('url="#g"', 'url="other.dae#g"')), "is missing"),
        (dae(SCENE.replace('meter="0.001"', 'meter="0"')), "unit"),
        (dae(SCENE.replace("<vcount>4</vcount>", "<vcount>400000000</vcount>")), "corners"),
        (dae(SCENE.replace("<p>0 1 4 2</p>", "<p>0 1 4 9</p>")), "outside the 10 vertices"),
        (dae(SCENE.replace("100 0 0</translate>", "nan 0 0</translate>")), "finite"),
        (dae(SCENE.replace('stride="3"', 'stride="0"')), "points of 0"),
        (dae("<asset/>"), "no faces"),
        (dae(SCENE.replace("VERTEX", "NORMAL")), "a primitive has no vertices"),
        (dae(SCENE.replace("polylist", "tristrips")), "strips are not read"),
        (dae(SCENE.replace("</polylist>", "</polylist><polygons><ph><p>0</p></ph></polygons>")), "polygons with holes"),
        (dae(SCENE.replace("<instance_geometry", '<instance_controller url="#c"/><instance_geometry')), "skinned"),
    ],
)
def test_a_bad_file_is_refused_and_told(data: bytes, named: str) -> None:
    with pytest.raises((MeshError, LimitError), match=named):
        read_mesh("a.dae", data)

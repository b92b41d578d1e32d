"""COLLADA: triangles in metres with their colours, as trimesh finds them; files made to break a reader are refused."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from graspd.service.model.errors import LimitError, MeshError
from graspd.worker.objects.formats import read_mesh

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


def dae(body: str = SCENE) -> bytes:
    return f"{HEAD}{body}</COLLADA>".encode()


def test_triangles_are_placed_scaled_and_coloured() -> None:
    soup = read_mesh("a.dae", dae())
    assert len(soup.faces) == 6
    # 2 (R_z(90) p + 100 x) mm
    expected = 2e-3 * np.array([[100, 0, 0], [100, 10, 0], [90, 0, 0], [100, 0, 10], [90, 10, 0]])
    found = np.unique(soup.vertices.round(9), axis=0)
    np.testing.assert_allclose(found, np.unique(expected.round(9), axis=0), atol=1e-12)
    assert {colour: len(faces) for colour, faces in soup.by_colour()} == {(1.0, 0.0, 0.0): 4, None: 2}


def test_a_mesh_that_trimesh_wrote_comes_back() -> None:
    pytest.importorskip("collada")
    mesh = trimesh.creation.icosphere(2, 0.03)
    soup = read_mesh("a.dae", bytes(mesh.export(file_type="dae")))
    # Its vertices stand in the file in single precision.
    np.testing.assert_allclose(soup.vertices[soup.faces], mesh.vertices[mesh.faces], atol=1e-7)


BOMB = (
    "".join(f'<node id="n{k}">' + f'<instance_node url="#n{k + 1}"/>' * 10 + "</node>" for k in range(12))
    + '<node id="n12"><instance_geometry url="#g"/></node>'
)


@pytest.mark.parametrize(
    ("data", "named"),
    [
        (b'<!DOCTYPE C [<!ENTITY a "aa"><!ENTITY b "&a;&a;">]><COLLADA>&b;</COLLADA>', "entities"),
        (b'<!DOCTYPE C [<!ENTITY a SYSTEM "file:///etc/passwd">]><COLLADA>&a;</COLLADA>', "entities"),
        (b"PK\x03\x04not a zip either", "well-formed"),
        (b"<svg/>", "<COLLADA>"),
        (dae(SCENE.replace("<library_nodes>", f"<library_nodes>{BOMB}").replace("#part", "#n0")), "too deep"),
        (dae(SCENE.replace('<node id="part">', '<node id="part"><instance_node url="#part"/>')), "cyclic"),
        (dae(SCENE.replace('url="#g"', 'url="other.dae#g"')), "not there"),
        (dae(SCENE.replace('meter="0.001"', 'meter="0"')), "unit"),
        (dae(SCENE.replace("<vcount>4</vcount>", "<vcount>400000000</vcount>")), "corners"),
        (dae(SCENE.replace("<p>0 1 4 2</p>", "<p>0 1 4 9</p>")), "outside the 10 vertices"),
        (dae(SCENE.replace("100 0 0</translate>", "nan 0 0</translate>")), "finite"),
        (dae(SCENE.replace('stride="3"', 'stride="0"')), "points of 0"),
        (dae("<asset/>"), "no faces"),
        (dae(SCENE.replace("polylist", "tristrips")), "strips are not read"),
        (dae(SCENE.replace("</polylist>", "</polylist><polygons><ph><p>0</p></ph></polygons>")), "polygons with holes"),
        (
            dae(
                SCENE.replace(
                    '<instance_geometry url="#g">', '<instance_controller url="#c"/><instance_geometry url="#g">'
                )
            ),
            "skinned",
        ),
    ],
)
def test_a_bad_file_is_refused_and_told(data: bytes, named: str) -> None:
    with pytest.raises((MeshError, LimitError), match=named):
        read_mesh("a.dae", data)

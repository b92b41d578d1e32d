"""What trimesh's readers would lose that the readers of meshes keep: docs/adr/0006 has the decision."""

from __future__ import annotations

import io

import numpy as np
import pytest
import trimesh

from graspd.service.model.errors import MeshError
from graspd.worker.objects.formats import read_mesh
from tests.worker.objects.test_formats import pack_glb
from tests.worker.objects.test_polygons import text

FACETS_OF_FOUR = (
    b"solid\n"
    + 3
    * (b"facet normal 0 0 0\nouter loop\nvertex 0 0 0\nvertex 1 0 0\nvertex 1 1 0\nvertex 0 1 0\nendloop\nendfacet\n")
    + b"endsolid\n"
)
SKINNED = pack_glb(
    {
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "skin": 0}],
        "skins": [{"joints": [0]}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}}]}],
        "buffers": [{"byteLength": 36}],
        "bufferViews": [{"buffer": 0, "byteLength": 36}],
        "accessors": [{"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3"}],
    },
    np.eye(3, dtype="<f4").tobytes(),
)


def as_trimesh_reads(name: str, data: bytes) -> trimesh.Trimesh:
    return trimesh.load(io.BytesIO(data), file_type=name[-3:], process=False, force="mesh")


@pytest.mark.parametrize("name", ["u.obj", "u.ply"])
def test_a_re_entrant_polygon_is_larger_than_it_is(name: str) -> None:
    soup = read_mesh(name, text(name))
    ours = trimesh.Trimesh(soup.vertices, soup.faces, process=False)
    assert as_trimesh_reads(name, text(name)).area > 1.05 * ours.area


def test_polygons_of_several_sizes_are_not_read_from_off() -> None:
    assert len(read_mesh("u.off", text("u.off")).faces)
    with pytest.raises(TypeError):
        as_trimesh_reads("u.off", text("u.off"))


@pytest.mark.parametrize(("name", "data"), [("m.stl", FACETS_OF_FOUR), ("m.glb", SKINNED)], ids=["stl", "glb"])
def test_what_would_be_read_wrongly_is_read(name: str, data: bytes) -> None:
    with pytest.raises(MeshError, match=r"more than three|skinned"):
        read_mesh(name, data)
    assert len(as_trimesh_reads(name, data).faces) > 0

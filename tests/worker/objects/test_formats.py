"""Every format gives the same mesh, and what a header promises is never believed."""

from __future__ import annotations

import json
import struct

import numpy as np
import pytest
import trimesh

from graspd.service.model.errors import LimitError, MeshError
from graspd.worker.objects.builtin import stl_bytes
from graspd.worker.objects.check import check_object
from graspd.worker.objects.formats import read_mesh
from graspd.worker.objects.formats.soup import MAX_FACES
from tests.worker.objects.shapes import Mesh, box

VOLUME = 0.06 * 0.05 * 0.04


def ascii_stl(mesh: Mesh) -> bytes:
    lines = ["solid test"]
    for triangle in mesh[0][mesh[1]]:
        lines += ["facet normal 0 0 0", "outer loop"]
        lines += [f"vertex {x:.9g} {y:.9g} {z:.9g}" for x, y, z in triangle]
        lines += ["endloop", "endfacet"]
    return "\n".join([*lines, "endsolid test"]).encode()


def obj(mesh: Mesh) -> bytes:
    lines = [f"v {x} {y} {z}" for x, y, z in mesh[0]] + ["vt 0 0", "vn 0 0 1"]
    return "\n".join([*lines, *(f"f {a + 1}/1/1 {b + 1}/1/1 {c + 1}//1" for a, b, c in mesh[1])]).encode()


def off(mesh: Mesh) -> bytes:
    lines = ["OFF # comment", f"{len(mesh[0])} {len(mesh[1])} 0"] + [f"{x} {y} {z}" for x, y, z in mesh[0]]
    return "\n".join([*lines, *(f"3 {a} {b} {c} 255 0 0" for a, b, c in mesh[1])]).encode()


def ply(mesh: Mesh, kind: str) -> bytes:
    header = f"ply\nformat {kind} 1.0\nelement vertex {len(mesh[0])}\nproperty double x\nproperty double y\n"
    header += f"property double z\nproperty uchar red\nelement face {len(mesh[1])}\n"
    header += "property list uchar int vertex_indices\nend_header\n"
    if kind == "ascii":
        rows = [f"{x} {y} {z} 7" for x, y, z in mesh[0]] + [f"3 {a} {b} {c}" for a, b, c in mesh[1]]
        return (header + "\n".join(rows) + "\n").encode()
    order = "<" if "little" in kind else ">"
    body = b"".join(struct.pack(order + "dddB", *v, 7) for v in mesh[0])
    return header.encode() + body + b"".join(struct.pack(order + "Biii", 3, *f) for f in mesh[1].tolist())


def glb(mesh: Mesh, node: dict[str, object] | None = None) -> bytes:
    points = mesh[0].astype("<f4").tobytes()
    index = mesh[1].astype("<u2").tobytes()
    document = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, **(node or {})}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}]}],
        "buffers": [{"byteLength": len(points) + len(index)}],
        "bufferViews": [
            {"buffer": 0, "byteOffset": 0, "byteLength": len(points)},
            {"buffer": 0, "byteOffset": len(points), "byteLength": len(index)},
        ],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "count": len(mesh[0]), "type": "VEC3"},
            {"bufferView": 1, "componentType": 5123, "count": 3 * len(mesh[1]), "type": "SCALAR"},
        ],
    }
    return pack_glb(document, points + index)


def pack_glb(document: dict[str, object], binary: bytes) -> bytes:
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    binary += b"\0" * (-len(binary) % 4)
    total = 12 + 8 + len(text) + 8 + len(binary)
    return (
        struct.pack("<4sII", b"glTF", 2, total)
        + struct.pack("<I4s", len(text), b"JSON")
        + text
        + struct.pack("<I4s", len(binary), b"BIN\0")
        + binary
    )


FILES = {
    "binary.stl": stl_bytes(*box()),
    "ascii.stl": ascii_stl(box()),
    "m.obj": obj(box()),
    "m.off": off(box()),
    "ascii.ply": ply(box(), "ascii"),
    "little.ply": ply(box(), "binary_little_endian"),
    "big.ply": ply(box(), "binary_big_endian"),
    "m.glb": glb(box()),
}


@pytest.mark.parametrize("name", sorted(FILES))
def test_every_format_gives_the_same_box(name: str) -> None:
    report = check_object({name: FILES[name]}, "m")
    assert report["verdict"] == "accept"
    # Binary STL and GLB hold float32.
    assert report["facts"]["volume_m3"] == pytest.approx(VOLUME, rel=1e-6)


@pytest.mark.parametrize("name", sorted(FILES))
def test_a_file_cut_anywhere_is_refused_or_still_a_mesh(name: str) -> None:
    data = FILES[name]
    for length in range(0, len(data), max(1, len(data) // 60)):
        report = check_object({name: data[:length]}, "m", allow_open=True)
        assert report["verdict"] in ("accept", "repair", "refuse")


def test_the_node_tree_of_a_glb_places_and_mirrors_its_mesh() -> None:
    node = {"scale": [-2, 1, 1], "translation": [1, 0, 0], "rotation": [0, 0, 2**-0.5, 2**-0.5]}
    soup = read_mesh("m.glb", glb(box(), node))
    np.testing.assert_allclose(np.ptp(soup.vertices, axis=0), [0.05, 0.12, 0.04], rtol=1e-6)
    np.testing.assert_allclose(soup.vertices.mean(axis=0), [1, 0, 0], atol=1e-6)
    a, b, c = np.moveaxis(soup.vertices[soup.faces] - [1, 0, 0], 1, 0)
    assert np.einsum("ij,ij->i", a, np.cross(b, c)).sum() > 0


def promise(name: str) -> bytes:
    """A small file whose header promises more than fits in memory."""
    match name:
        case "m.stl":
            return b"\0" * 80 + struct.pack("<I", 4_000_000_000) + b"\0" * 100
        case "m.off":
            return b"OFF\n4000000000 4000000000 0\n0 0 0\n"
        case _:
            head = b"ply\nformat binary_little_endian 1.0\nelement vertex 4000000000\nproperty float x\n"
            head += b"property float y\nproperty float z\nelement face 1\n"
            return head + b"property list uint int vertex_indices\nend_header\n" + b"\0" * 64


def test_a_header_that_promises_too_much_allocates_nothing() -> None:
    for name in ("m.stl", "m.off", "m.ply"):
        with pytest.raises((MeshError, LimitError)):
            read_mesh(name, promise(name))


def test_a_glb_accessor_beyond_its_buffer_is_refused() -> None:
    document = {
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}}]}],
        "bufferViews": [{"buffer": 0, "byteLength": 64}],
        "accessors": [{"bufferView": 0, "componentType": 5126, "count": 4_000_000_000, "type": "VEC3"}],
    }
    with pytest.raises(MeshError, match="beyond"):
        read_mesh("m.glb", pack_glb(document, b"\0" * 64))


def test_a_cyclic_node_tree_is_refused() -> None:
    document = {"nodes": [{"children": [1]}, {"children": [0]}], "scenes": [{"nodes": [0]}]}
    with pytest.raises(MeshError, match="cyclic"):
        read_mesh("m.glb", pack_glb(document, b""))


def test_a_polygon_that_would_make_too_many_triangles_is_refused() -> None:
    corners = " ".join(["1 2 3"] * ((MAX_FACES + 100) // 3))
    with pytest.raises(LimitError, match="decimate"):
        read_mesh("m.obj", f"v 0 0 0\nv 1 0 0\nv 0 1 0\nf {corners}\n".encode())


def test_more_faces_than_the_limit_are_refused_before_they_are_read() -> None:
    count = MAX_FACES + 1
    with pytest.raises(LimitError, match=str(count)):
        read_mesh("m.stl", b"\0" * 80 + struct.pack("<I", count) + bytes(50 * count))


def test_an_unknown_format_is_refused_with_those_that_are_read() -> None:
    with pytest.raises(MeshError, match="obj"):
        read_mesh("m.wrl", b"#VRML V2.0 utf8")


def test_continued_lines_and_negative_indices_of_obj() -> None:
    data = b"v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf -4 \\\n-2 -3\nf 1 2 4\nf 2 3 4\nf 3 1 4\n"
    assert read_mesh("m.obj", data).faces.tolist()[0] == [0, 2, 1]


def quantised(normalized: bool, extensions: dict[str, object] | None = None) -> bytes:
    """The box with positions of 16 bits: whole tenths of a millimetre, or shares of 10 cm; nodes scale them."""
    vertices, faces = box()
    scale = 0.1 if normalized else 1e-4
    numbers = np.rint(vertices / scale * (32767 if normalized else 1)).astype("<i2")
    padded = np.zeros((len(numbers), 4), "<i2")
    padded[:, :3] = numbers
    points, index = padded.tobytes(), faces.astype("<u2").tobytes()
    document: dict[str, object] = {
        "asset": {"version": "2.0"},
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "scale": [scale] * 3}],
        "extensionsRequired": ["KHR_mesh_quantization"],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}]}],
        "accessors": [
            {"bufferView": 0, "componentType": 5122, "count": len(vertices), "type": "VEC3", "normalized": normalized},
            {"bufferView": 1, "componentType": 5123, "count": faces.size, "type": "SCALAR"},
        ],
        "bufferViews": [
            {"buffer": 0, "byteLength": len(points), "byteStride": 8},
            {"buffer": 0, "byteOffset": len(points), "byteLength": len(index)},
        ],
        "buffers": [{"byteLength": len(points) + len(index)}],
        **(extensions or {}),
    }
    return pack_glb(document, points + index)


@pytest.mark.parametrize("normalized", [False, True])
def test_quantised_positions_of_a_glb_have_their_size(normalized: bool) -> None:
    soup = read_mesh("m.glb", quantised(normalized))
    # A step of the normalised ones is 3 micrometres.
    np.testing.assert_allclose(soup.vertices, box()[0], atol=2e-6)


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({"nodes": [{"mesh": 0, "skin": 0}]}, "skinned"),
        (
            {"extensionsRequired": ["EXT_meshopt_compression"]},
            "EXT_meshopt_compression is not read; export without compr",
        ),
        ({"extensionsRequired": ["KHR_draco_mesh_compression"]}, "export without compression"),
        ({"extensionsRequired": ["ACME_warp"]}, "ACME_warp is not read; export without it"),
        ({"nodes": [{"mesh": 0, "extensions": {"EXT_mesh_gpu_instancing": {}}}]}, "EXT_mesh_gpu_instancing"),
        ({"meshes": [{"weights": [0.5], "primitives": []}]}, "morph targets"),
        ({"nodes": [{"mesh": 0, "weights": [0.5]}]}, "morph targets"),
        ({"nodes": [{"mesh": -1}]}, "meshes has no item -1"),
        ({"buffers": [{"uri": "box.bin", "byteLength": 9}]}, "another file"),
    ],
)
def test_a_glb_that_would_be_read_wrongly_is_refused_for_what_it_is(change: dict[str, object], told: str) -> None:
    with pytest.raises(MeshError, match=told):
        read_mesh("m.glb", quantised(False, change))


def test_a_glb_with_variants_of_materials_is_read() -> None:
    variants = {"extensionsUsed": ["KHR_materials_variants"]}
    assert len(read_mesh("m.glb", quantised(False, variants)).faces) == 12


@pytest.mark.parametrize(
    "change",
    [
        {
            "extensions": {"ACME_notes": {}},
            "nodes": [{"mesh": 0, "extensions": {"ACME_notes": {}}, "scale": [1e-4] * 3}],
        },
        {
            "nodes": [{"mesh": 0, "scale": [1e-4] * 3}, {"mesh": 0}],
            "scenes": [{"nodes": [1]}, {"nodes": [0]}],
            "scene": 1,
        },
        {"nodes": [{"mesh": 0}, {"children": [0], "scale": [1e-4] * 3}], "scenes": []},
    ],
    ids=["an extension that is not required", "the scene that is shown", "no scenes: from the nodes above"],
)
def test_a_glb_is_read_as_its_scene_shows_it(change: dict[str, object]) -> None:
    soup = read_mesh("m.glb", quantised(False, change))
    np.testing.assert_allclose(soup.vertices, box()[0], atol=2e-6)


@pytest.mark.parametrize("mode", [5, 6])
def test_strips_and_fans_of_a_glb_are_wound_as_trimesh_winds_them(mode: int) -> None:
    order = np.array([0, 1, 2, 3, 5, 4], "<u2")
    points = np.random.default_rng(0).normal(size=(6, 3)).astype("<f4")
    document = {
        "asset": {"version": "2.0"},
        "nodes": [{"mesh": 0}],
        "scenes": [{"nodes": [0]}],
        "meshes": [
            {
                "primitives": [
                    {"attributes": {"POSITION": 0}, "mode": kind} | ({"indices": 1} if kind else {})
                    for kind in (0, mode)
                ]
            }
        ],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "count": 6, "type": "VEC3"},
            {"bufferView": 1, "componentType": 5123, "count": 6, "type": "SCALAR"},
        ],
        "bufferViews": [{"buffer": 0, "byteLength": 72}, {"buffer": 0, "byteOffset": 72, "byteLength": 12}],
        "buffers": [{"byteLength": 84}],
    }
    faces = read_mesh("m.glb", pack_glb(document, points.tobytes() + order.tobytes())).faces
    expected = (
        trimesh.util.triangle_strips_to_faces([order]) if mode == 5 else [[0, 1, 2], [0, 2, 3], [0, 3, 5], [0, 5, 4]]
    )
    # A triangle may begin at any of its corners.
    np.testing.assert_array_equal(*([np.roll(f, -np.argmin(f)).tolist() for f in given] for given in (faces, expected)))

"""Every format gives the same mesh however it is spelt, and what a header promises is never believed."""

import codecs
import gzip
import io
import json
import struct
from typing import Any

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from graspd.service.model.errors import LimitError, MeshError
from graspd.worker.objects.check import check_object
from graspd.worker.objects.formats import read_mesh
from graspd.worker.objects.formats.bare import stl_bytes
from graspd.worker.objects.formats.soup import MAX_FACES, triangulate
from tests.api.factories import zipped
from tests.worker.objects.shapes import Mesh, box, damaged

VOLUME = 0.06 * 0.05 * 0.04
SCALED = {"mesh": 0, "scale": [1e-4] * 3}
#: A channel, open above: its ends are polygons with two re-entrant corners.
U = np.array([(0, 0), (80, 0), (80, 50), (70, 50), (70, 10), (10, 10), (10, 50), (0, 50)], float) / 1000
LENGTH = 0.06
POINTER = b"version https://git-lfs.github.com/spec/v1\noid sha256:4d7a2146\nsize 12345\n"
FOUR = b"facet normal 0 0 0\nouter loop\nvertex 0 0 0\nvertex 1 0 0\nvertex 1 1 0\nvertex 0 1 0\nendloop\nendfacet\n"
FACETS_OF_FOUR = b"solid\n" + 3 * FOUR + b"endsolid\n"


def ascii_stl(mesh: Mesh) -> bytes:
    lines = ["solid test"]
    for triangle in mesh[0][mesh[1]]:
        lines += ["facet normal 0 0 0", "outer loop"]
        lines += [f"vertex {x:.9g} {y:.9g} {z:.9g}" for x, y, z in triangle]
        lines += ["endloop", "endfacet"]
    return "\n".join([*lines, "endsolid test"]).encode()


def obj(mesh: Mesh) -> bytes:
    lines = [f"v {x} {y} {z}" for x, y, z in mesh[0]] + ["vt 0 0", "vn 0 0 1"]
    lines += ["f " + "".join(f"{k + 1}/1/1 " for k in face[:-1]) + f"{face[-1] + 1}//1" for face in mesh[1]]
    return "\n".join(lines).encode()


def rows(mesh: Mesh, more: str = "") -> list[str]:
    return [f"{x} {y} {z}{more}" for x, y, z in mesh[0]] + [f"{len(f)} {' '.join(map(str, f))}" for f in mesh[1]]


def off(mesh: Mesh) -> bytes:
    return "\n".join(["OFF # comment", f"{len(mesh[0])} {len(mesh[1])} 0", *rows(mesh)]).encode()


def ply(mesh: Mesh, kind: str) -> bytes:
    header = f"ply\nformat {kind} 1.0\nelement vertex {len(mesh[0])}\nproperty double x\nproperty double y\n"
    header += f"property double z\nproperty uchar red\nelement face {len(mesh[1])}\n"
    header += "property list uchar int vertex_indices\nend_header\n"
    if kind == "ascii":
        return (header + "\n".join(rows(mesh, " 7")) + "\n").encode()
    order = "<" if "little" in kind else ">"
    body = b"".join(struct.pack(order + "dddB", *v, 7) for v in mesh[0])
    return header.encode() + body + b"".join(struct.pack(order + "Biii", 3, *f) for f in mesh[1].tolist())


def glb(mesh: Mesh, **changes: object) -> bytes:
    return glb_of(mesh[0].astype("<f4"), mesh[1].astype("<u2"), changes)


def glb_of(points: np.ndarray, index: np.ndarray, changes: dict[str, object], **accessor: object) -> bytes:
    """One mesh of float32 or int16 positions; `changes` replace keys of the document."""
    number = 5126 if points.dtype.kind == "f" else 5122
    document = {
        "asset": {"version": "2.0"},
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}]}],
        "accessors": [
            {"bufferView": 0, "componentType": number, "count": len(points), "type": "VEC3", **accessor},
            {"bufferView": 1, "componentType": 5123, "count": index.size, "type": "SCALAR"},
        ],
        "bufferViews": [
            {"buffer": 0, "byteLength": points.nbytes, "byteStride": points.strides[0]},
            {"buffer": 0, "byteOffset": points.nbytes, "byteLength": index.nbytes},
        ],
        "buffers": [{"byteLength": points.nbytes + index.nbytes}],
        **changes,
    }
    return pack_glb(document, points.tobytes() + index.tobytes())


def pack_glb(document: object, binary: bytes) -> bytes:
    text = json.dumps(document).encode()
    padded = (b"JSON", text + b" " * (-len(text) % 4)), (b"BIN\0", binary + b"\0" * (-len(binary) % 4))
    chunks = b"".join(struct.pack("<I4s", len(chunk), kind) + chunk for kind, chunk in padded)
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


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
    node = {"mesh": 0, "scale": [-2, 1, 1], "translation": [1, 0, 0], "rotation": [0, 0, 2**-0.5, 2**-0.5]}
    soup = read_mesh("m.glb", glb(box(), nodes=[node]))
    np.testing.assert_allclose(np.ptp(soup.vertices, axis=0), [0.05, 0.12, 0.04], rtol=1e-6)
    np.testing.assert_allclose(soup.vertices.mean(axis=0), [1, 0, 0], atol=1e-6)
    a, b, c = np.moveaxis(soup.vertices[soup.faces] - [1, 0, 0], 1, 0)
    assert np.einsum("ij,ij->i", a, np.cross(b, c)).sum() > 0


#: Small files whose headers promise more than fits in memory.
PLY_HEAD = b"ply\nformat binary_little_endian 1.0\nelement vertex 4000000000\nproperty float x\nproperty float y\n"
PLY_HEAD += b"property float z\nelement face 1\nproperty list uint int vertex_indices\nend_header\n"
PROMISES = {"m.stl": bytes(80) + struct.pack("<I", 4_000_000_000) + bytes(100), "m.ply": PLY_HEAD + bytes(64)}
PROMISES |= {"m.off": b"OFF\n4000000000 4000000000 0\n0 0 0\n"}


@pytest.mark.parametrize("name", PROMISES)
def test_a_header_that_promises_too_much_allocates_nothing(name: str) -> None:
    with pytest.raises((MeshError, LimitError)):
        read_mesh(name, PROMISES[name])


def test_accessors_beyond_their_buffer_and_cycles_are_refused() -> None:
    document = {
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}}]}],
        "bufferViews": [{"buffer": 0, "byteLength": 64}],
        "accessors": [{"bufferView": 0, "componentType": 5126, "count": 4_000_000_000, "type": "VEC3"}],
    }
    with pytest.raises(MeshError, match="beyond"):
        read_mesh("m.glb", pack_glb(document, b"\0" * 64))
    document = {"nodes": [{"children": [1]}, {"children": [0]}], "scenes": [{"nodes": [0]}]}
    with pytest.raises(MeshError, match="cyclic"):
        read_mesh("m.glb", pack_glb(document, b""))
    with pytest.raises(MeshError, match="holds no object"):
        read_mesh("m.glb", pack_glb([document], b""))


@pytest.mark.parametrize(
    ("name", "old", "new", "told"),
    [
        ("ascii.ply", b"format ascii 1.0\n", b"", "no format"),
        ("ascii.ply", b"vertex_indices", b"corners", "no list vertex_indices"),
        ("ascii.ply", b"element face 12", b"element face 13", "13 rows of face are stated, but 12 are there"),
        ("little.ply", b"element face 12", b"element face 13", "states more data"),
        ("binary.stl", stl_bytes(*box())[80:], b"", "too few for an STL"),
        ("binary.stl", struct.pack("<I", 12), struct.pack("<I", 13), "states 13 faces, but the file has 12"),
        ("binary.stl", stl_bytes(*box()), b"no vertices\n" * 9, "neither binary STL nor text with facets"),
        ("ascii.stl", b"endloop\nendfacet\nendsolid", b"vertex 0 0 0\nendsolid", "fewer than three vertices"),
        ("m.off", off(box()), b"", "the file is empty"),
        ("m.off", off(box())[3:], b"", "counts of vertices and faces are missing"),
        ("m.off", b"8 12 0", b"8 13 0", "not all of the stated 8 vertices and 13 faces"),
        ("m.off", b"\n3 ", b"\n4 ", "states 4 corners but has 3"),
        ("m.obj", b"\nvt 0 0", b"\nv 0 0", "vertex 9 has fewer than three"),
        ("m.obj", b"f 6/", b"f 0/", "count from 1"),
        ("m.obj", b"f 6/", b"f " + b"6/ " * 2**19 + b"\\\n6/", "continued line"),
        ("m.off", b"\n-0.03 ", b"\n-3e19 ", "coordinate exceeds"),
        ("m.glb", struct.pack("<4sI", b"glTF", 2), struct.pack("<4sI", b"glTF", 1), "glTF of version 2"),
        ("m.glb", b"JSON", b"JSOM", "the JSON chunk is not whole"),
        ("m.glb", b"BIN\0", b"BIM\0", "the binary chunk is not whole"),
        ("m.glb", b'"count": 36', b'"count": 35', "the last face is not whole"),
        ("m.glb", b'"SCALAR"', b'"VEC4"  ', "not SCALAR"),
        ("m.glb", b'"buffer": 0', b'"buffer": 1', "the data lie in another file"),
        ("m.glb", b'[{"mesh": 0}]', b' {"mesh": 0} ', "nodes is no list"),
    ],
)
def test_a_spoilt_file_is_refused_with_its_reason(name: str, old: bytes, new: bytes, told: str) -> None:
    assert old in FILES[name]
    with pytest.raises(MeshError, match=told):
        read_mesh(name, FILES[name].replace(old, new))


def test_more_faces_than_limit_are_refused_before_they_are_read() -> None:
    corners = " ".join(["1 2 3"] * ((MAX_FACES + 100) // 3))
    with pytest.raises(LimitError, match="decimate"):
        read_mesh("m.obj", f"v 0 0 0\nv 1 0 0\nv 0 1 0\nf {corners}\n".encode())
    count = MAX_FACES + 1
    with pytest.raises(LimitError, match=str(count)):
        read_mesh("m.stl", b"\0" * 80 + struct.pack("<I", count) + bytes(50 * count))
    with pytest.raises(MeshError, match="obj"):
        read_mesh("m.wrl", b"#VRML V2.0 utf8")


def test_comments_and_negative_indices_are_read() -> None:
    data = b"v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf -4 \\\n-2 -3\nf 1 2 4\nf 2 3 4\nf 3 1 4\n"
    assert read_mesh("m.obj", data).faces.tolist()[0] == [0, 2, 1]
    with pytest.raises(MeshError, match="4OFF is not read"):
        read_mesh("m.off", b"4OFF\n1 1 1\n")
    read_alike("m.ply", PLAIN["m.ply"].replace(b"element vertex", b"comment no end_header yet\nelement vertex", 1))


def quantised(normalized: bool, extensions: dict[str, object] | None = None) -> bytes:
    """The box with positions of 16 bits: whole tenths of a millimetre, or shares of 10 cm; nodes scale them."""
    vertices, faces = box()
    scale = 0.1 if normalized else 1e-4
    numbers = np.rint(vertices / scale * (32767 if normalized else 1)).astype("<i2")
    padded = np.zeros((len(numbers), 4), "<i2")
    padded[:, :3] = numbers
    changes = {"nodes": [{"mesh": 0, "scale": [scale] * 3}], "extensionsRequired": ["KHR_mesh_quantization"]}
    return glb_of(padded, faces.astype("<u2"), changes | (extensions or {}), normalized=normalized)


@pytest.mark.parametrize(
    ("normalized", "change"),
    [
        *[(False, {}), (True, {})],
        (False, {"extensions": {"ACME_notes": {}}, "nodes": [SCALED | {"extensions": {"ACME_notes": {}}}]}),
        (False, {"nodes": [SCALED, {"mesh": 0}], "scenes": [{"nodes": [1]}, {"nodes": [0]}], "scene": 1}),
        (False, {"nodes": [{"mesh": 0}, {"children": [0], "scale": [1e-4] * 3}], "scenes": []}),
        (False, {"extensionsUsed": ["KHR_materials_variants"]}),
    ],
    ids=[
        "whole",
        "shares",
        "an extension not required",
        "the scene that is shown",
        "no scenes: nodes above",
        "variants",
    ],
)
def test_quantised_positions_have_their_size_in_the_scene_that_is_shown(normalized: bool, change: Any) -> None:
    soup = read_mesh("m.glb", quantised(normalized, change))
    # A step of the normalised ones is 3 micrometres.
    np.testing.assert_allclose(soup.vertices, box()[0], atol=2e-6)


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({"nodes": [{"mesh": 0, "skin": 0}]}, "skinned"),
        ({"extensionsRequired": ["EXT_meshopt_compression"]}, "EXT_meshopt_compression is not read; export without c"),
        ({"extensionsRequired": ["KHR_draco_mesh_compression"]}, "export without compression"),
        ({"extensionsRequired": ["ACME_warp"]}, "ACME_warp is not read; export without it"),
        ({"nodes": [{"mesh": 0, "extensions": {"EXT_mesh_gpu_instancing": {}}}]}, "EXT_mesh_gpu_instancing"),
        ({"meshes": [{"weights": [0.5], "primitives": []}]}, "morph targets"),
        ({"nodes": [{"mesh": 0, "weights": [0.5]}]}, "morph targets"),
        ({"nodes": [{"mesh": -1}]}, "meshes has no item -1"),
        ({"buffers": [{"uri": "box.bin", "byteLength": 9}]}, "another file"),
    ],
)
def test_a_glb_that_would_be_read_wrongly_is_refused(change: dict[str, object], told: str) -> None:
    with pytest.raises(MeshError, match=told):
        read_mesh("m.glb", quantised(False, change))


@pytest.mark.parametrize("mode", [5, 6])
def test_strips_and_fans_of_glb_are_wound_as_trimesh_winds_them(mode: int) -> None:
    order = np.array([0, 1, 2, 3, 5, 4], "<u2")
    points = np.random.default_rng(0).normal(size=(6, 3)).astype("<f4")
    points_alone = {"attributes": {"POSITION": 0}, "mode": 0}
    primitives = [points_alone, points_alone | {"mode": mode, "indices": 1}]
    faces = read_mesh("m.glb", glb_of(points, order, {"meshes": [{"primitives": primitives}]})).faces
    fan = [[0, 1, 2], [0, 2, 3], [0, 3, 5], [0, 5, 4]]
    expected = trimesh.util.triangle_strips_to_faces([order]) if mode == 5 else fan
    # A triangle may begin at any of its corners.
    np.testing.assert_array_equal(*([np.roll(f, -np.argmin(f)).tolist() for f in given] for given in (faces, expected)))


def channel() -> tuple[np.ndarray, list[list[int]]]:
    n = len(U)
    points = np.vstack([np.column_stack([U[:, 0], np.full(n, y), U[:, 1]]) for y in (0.0, LENGTH)])
    sides = [[k + n, (k + 1) % n + n, (k + 1) % n, k] for k in range(n)]
    return points, [list(range(n)), list(range(2 * n - 1, n - 1, -1)), *sides]


def text(name: str) -> bytes:
    return {"u.obj": obj, "u.off": off, "u.ply": lambda mesh: ply(mesh, "ascii")}[name](channel())


@pytest.mark.parametrize("name", ["u.obj", "u.off", "u.ply"])
def test_a_channel_of_re_entrant_polygons_is_as_large_as_it_is(name: str) -> None:
    soup = read_mesh(name, text(name))
    mesh = trimesh.Trimesh(soup.vertices, soup.faces)
    ends = 2 * (0.08 * 0.05 - 0.06 * 0.04)
    around = 2 * (0.08 + 0.05 + 0.04) * LENGTH
    assert mesh.is_watertight and mesh.area == pytest.approx(ends + around)
    assert abs(mesh.volume) == pytest.approx(ends / 2 * LENGTH)


@given(st.integers(3, 40), st.integers(0, 10**6))
def test_a_star_is_cut_into_triangles_of_its_area(corners: int, seed: int) -> None:
    random = np.random.default_rng(seed)
    angle = np.sort(random.uniform(0, 2 * np.pi, corners))
    flat = (random.uniform(0.2, 1.0, corners) * np.exp(1j * angle)).view(float).reshape(-1, 2)
    # Stars around a point in which an angle gap of half a turn or more would leave them are no simple polygons.
    if np.diff(angle, append=angle[0] + 2 * np.pi).max() >= np.pi:
        return
    turn = np.linalg.qr(random.normal(size=(3, 3)))[0]
    points = np.column_stack([flat, np.zeros(corners)]) @ turn.T
    triangles = triangulate(points, np.array([corners]), np.arange(corners))
    a, b, c = np.moveaxis(points[triangles], 1, 0)
    vectors = np.cross(b - a, c - a) / 2
    x, y = flat.T
    area = 0.5 * abs(np.sum(x * np.roll(y, -1) - y * np.roll(x, -1)))
    # Triangles that overlap or lie outside would add up to more than their vector sum.
    assert len(triangles) == corners - 2
    assert np.linalg.norm(vectors, axis=1).sum() == pytest.approx(area, rel=1e-9)


def test_convex_polygons_are_fans_and_corners_on_a_line_stay() -> None:
    angle = np.linspace(0, 2 * np.pi, 7)[:-1]
    points = np.column_stack([np.cos(angle), np.sin(angle), 0 * angle])
    found = triangulate(points, np.array([6]), np.arange(6))
    assert found.tolist() == [[0, 1, 2], [0, 2, 3], [0, 3, 4], [0, 4, 5]]
    flat = [(0, 0), (4, 0), (4, 4), (3, 4), (3, 1), (2, 1), (1, 1), (1, 4), (0, 4)]
    points = np.column_stack([np.array(flat, float), np.zeros(9)])
    found = triangulate(points, np.array([9]), np.arange(9))
    assert set(found.ravel().tolist()) == set(range(9)) and len(found) == 7


def test_re_entrant_polygons_of_very_many_corners_are_refused() -> None:
    count = 40_000
    angle, radius = np.linspace(0, 2 * np.pi, count, endpoint=False), np.where(np.arange(count) % 2, 1, 0.5)
    points = np.column_stack([radius * np.cos(angle), radius * np.sin(angle), 0 * angle])
    with pytest.raises(LimitError, match="triangulate"):
        triangulate(points, np.array([count]), np.arange(count))


PLAIN = {"m.stl": ascii_stl(box()), "m.obj": obj(box()), "m.off": off(box()), "m.ply": ply(box(), "ascii")}


def read_alike(name: str, data: bytes) -> None:
    expected, found = read_mesh(name, PLAIN[name]), read_mesh(name, data)
    np.testing.assert_array_equal(found.faces, expected.faces)
    np.testing.assert_array_equal(found.vertices, expected.vertices)


@pytest.mark.parametrize("name", sorted(PLAIN))
@pytest.mark.parametrize(
    "mark",
    [
        lambda data: codecs.BOM_UTF8 + data,
        lambda data: data.decode().encode("utf-16"),
        lambda data: data.replace(b"\n", b"\r\n"),
        lambda data: data.replace(b"\n", b"\r"),
        lambda data: data.replace(b"\n", b" \t\n"),
    ],
    ids=["utf-8 mark", "utf-16", "crlf", "cr", "space at the end"],
)
def test_marks_and_line_ends_change_nothing(name: str, mark: object) -> None:
    read_alike(name, mark(PLAIN[name]))  # type: ignore[operator]


@pytest.mark.parametrize(
    ("name", "old", "new"),
    [
        ("m.off", "OFF # comment\n", "OFF"),
        ("m.off", "OFF # comment\n", "off\n\n# comment\n\n"),
        ("m.off", "OFF", "COFF"),
        ("m.off", "OFF # comment\n", "STCNOFF "),
        ("m.off", "\n3 ", " # comment\n\n3 "),
        ("m.obj", "//1\n", "//1 # a face\n"),
        ("m.obj", "v ", "# C:\\meshes\\\nv "),
        ("m.obj", "//1\n", "// \\\n\n"),
        ("m.stl", "solid test\n", ""),
        ("m.stl", "solid test\n", "# made by a script\n"),
    ],
)
def test_spellings_change_nothing(name: str, old: str, new: str) -> None:
    read_alike(name, PLAIN[name].decode().replace(old, new).encode())


@pytest.mark.parametrize("name", sorted(PLAIN))
def test_word_where_number_belongs_is_told_without_pythons_words(name: str) -> None:
    broken = PLAIN[name].replace(b"0.03", b"0,03x", 1)
    with pytest.raises(MeshError) as found:
        read_mesh(name, broken)
    assert f"not a readable {name[2:].upper()} file: '" in str(found.value) and "0,03x" in str(found.value)
    assert not any(word in str(found.value) for word in ("float", "int()", "literal", "b'"))


@pytest.mark.parametrize("suffix", ["stl", "obj", "ply", "off", "glb", "dae"])
@pytest.mark.parametrize(
    ("data", "told"),
    [
        (POINTER, "a Git LFS pointer, not the file itself: git lfs pull"),
        (codecs.BOM_UTF8 + POINTER.replace(b"\n", b"\r\n"), "a Git LFS pointer"),
        (b"../../.git/annex/objects/xk/Pq/SHA256E-s1--a.stl/SHA256E-s1--a.stl\n", "git annex get"),
        (b"\n<!DOCTYPE html>\n<html><body>Sign in</body></html>", "a web page"),
        (b'<?xml version="1.0"?>\n<Error><Code>AccessDenied</Code></Error>', "storage server"),
        (b'{"message": "Not Found", "status": "404"}', "an error message in JSON"),
        (zipped({"mug.stl": b"solid"}), "a ZIP archive"),
        (gzip.compress(b"solid", mtime=0), "a compressed archive"),
        (POINTER.decode().encode("utf-16"), "a Git LFS pointer"),
        (POINTER.replace(b"git-lfs", b"hawser"), "a Git LFS pointer"),
        (b"../shared/mug.stl", "the text of a symbolic link"),
        (b"404: Not Found", "an error message of a server"),
        (b"<?xml version='1.0'?><!-- saved --><!DOCTYPE html PUBLIC 'x'><html>", "a web page"),
        (b'<?xml version="1.0"?><Error xmlns="http://x"><Code>NoSuchKey</Code></Error>', "storage server"),
        (b'{"statusCode": 404, "error": "Not Found"}', "a JSON document"),
        (b'{"asset": {"version": "2.0"}}', "glTF in text"),
        (b"ISO-10303-21;\nHEADER;\n", "a STEP file"),
        (b"\x89PNG\r\n\x1a\n" + bytes(90), "a picture"),
        (b" \n\n", "nothing but spaces or zeros"),
        (bytes(5000), "nothing but spaces or zeros"),
    ],
)
def test_a_stand_in_is_told_for_what_it_is(suffix: str, data: bytes, told: str) -> None:
    report = check_object({f"mug.{suffix}": data}, "mug")
    assert report["verdict"] == "refuse" and report["message"].startswith(f"mug.{suffix} ")
    assert told in report["message"]


@pytest.mark.parametrize("header", [b"404 not found bracket", b'{"made": "by"}', b"OFF-road tyre", b"../parts/a.stl"])
def test_a_binary_stl_may_begin_with_any_words(header: bytes) -> None:
    data = header.ljust(80, b" ") + stl_bytes(*box())[80:]
    assert check_object({"mug.stl": data}, "mug")["verdict"] == "accept"


@pytest.mark.parametrize("name", sorted(PLAIN))
@pytest.mark.parametrize("suffix", ["stl", "obj", "ply", "off", "glb", "dae"])
def test_a_mesh_under_the_name_of_another_format_is_told(name: str, suffix: str) -> None:
    report = check_object({f"mug.{suffix}": PLAIN[name]}, "mug")
    told = f"it is a mesh of type {name[1:]}" in report["message"]
    assert told or (report["verdict"] == "accept" and name[2:] == suffix)


@pytest.mark.parametrize(
    ("length", "units", "likely"),
    [(12.0, "m", ["cm", "in"]), (4.6, "m", ["in", "cm"]), (117.0, "m", ["mm"]), (0.117, "mm", ["m"])],
)
def test_a_hint_of_units_fits_the_size(length: float, units: str, likely: list[str]) -> None:
    vertices, faces = box()
    mesh = obj((vertices * (length / np.ptp(vertices, axis=0).max()), faces))
    report = check_object({"mug.obj": mesh}, "mug", units=units)
    assert report["verdict"] == "refuse" and report["facts"]["units_suggested"] == likely
    assert f"--units {likely[0]}" in report["message"]
    assert "--" not in report["facts"]["problem"] and report["facts"]["options_suggested"] == [{"scale_to": None}]
    assert set(report["facts"]["lengths_m"]) == set(likely)
    assert all(check_object({"mug.obj": mesh}, "mug", units=unit)["verdict"] == "accept" for unit in likely)


WORDS = [b"nan", b"1e999", b"-1", b"0", b"999999999", b"\n", b"f 1 2 3\n", b"\xff\xff\xff\xff", b"\x7f\x7f\x80\0", b"{"]
#: A file of any format, damaged.
MUTATED = st.sampled_from(sorted(FILES)).flatmap(lambda name: st.tuples(st.just(name), damaged(FILES[name], WORDS)))


def answers(name: str, data: bytes, allow_open: bool) -> None:
    report = check_object({name: data}, "m", allow_open=allow_open)
    assert report["verdict"] in ("accept", "repair", "refuse")
    assert report["message"] and "\n" not in report["message"]
    if report["verdict"] != "refuse":
        assert report["facts"]["volume_m3"] > 0


@settings(max_examples=250)
@given(MUTATED, st.booleans())
def test_a_damaged_mesh_loads_or_is_refused(file: tuple[str, bytes], allow_open: bool) -> None:
    answers(*file, allow_open)


@settings(max_examples=100)
@given(st.sampled_from(["m.stl", "m.obj", "m.ply", "m.off", "m.glb"]), st.binary(max_size=400))
def test_noise_is_refused(name: str, data: bytes) -> None:
    assert check_object({name: data}, "m")["verdict"] == "refuse"


@pytest.mark.slow
@settings(derandomize=False, max_examples=10_000)
@given(MUTATED, st.booleans())
def test_ten_thousand_damaged_meshes_load_or_are_refused(file: tuple[str, bytes], allow_open: bool) -> None:
    answers(*file, allow_open)


def test_what_trimesh_loses_of_these_files_is_read_or_refused() -> None:
    """Why the readers are our own: docs/adr/0006-own-mesh-readers.md."""

    def trimesh_reads(name: str, data: bytes) -> trimesh.Trimesh:
        return trimesh.load(io.BytesIO(data), file_type=name[-3:], process=False, force="mesh")

    for name in ("u.obj", "u.ply"):
        soup = read_mesh(name, text(name))
        ours = trimesh.Trimesh(soup.vertices, soup.faces, process=False)
        assert trimesh_reads(name, text(name)).area > 1.05 * ours.area, "a re-entrant polygon"
    assert len(read_mesh("u.off", text("u.off")).faces)
    with pytest.raises(TypeError):
        trimesh_reads("u.off", text("u.off"))  # polygons of several sizes
    skinned = glb(box(), nodes=[{"mesh": 0, "skin": 0}])
    for name, data, told in (("m.stl", FACETS_OF_FOUR, "more than three"), ("m.glb", skinned, "skinned")):
        with pytest.raises(MeshError, match=told):
            read_mesh(name, data)
        assert len(trimesh_reads(name, data).faces)

"""Spellings of formats that others write, and files that are known to be something else."""

from __future__ import annotations

import codecs
import gzip
import io
import zipfile

import numpy as np
import pytest

from graspd.service.model.errors import MeshError
from graspd.worker.objects.builtin import stl_bytes
from graspd.worker.objects.check import check_object
from graspd.worker.objects.formats import read_mesh
from tests.worker.objects.shapes import box
from tests.worker.objects.test_formats import ascii_stl, obj, off, ply

PLAIN = {"m.stl": ascii_stl(box()), "m.obj": obj(box()), "m.off": off(box()), "m.ply": ply(box(), "ascii")}


def same(name: str, data: bytes) -> None:
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
    same(name, mark(PLAIN[name]))  # type: ignore[operator]


@pytest.mark.parametrize(
    "spelling",
    [
        lambda text: text.replace("OFF # comment\n", "OFF"),
        lambda text: text.replace("OFF # comment\n", "off\n\n# comment\n\n"),
        lambda text: text.replace("OFF", "COFF"),
        lambda text: text.replace("OFF # comment\n", "STCNOFF "),
        lambda text: text.replace("\n3 ", " # comment\n\n3 "),
    ],
    ids=["counts glued", "lower case and comments", "colours", "all letters", "comments behind rows"],
)
def test_spellings_of_off(spelling: object) -> None:
    same("m.off", spelling(PLAIN["m.off"].decode()).encode())  # type: ignore[operator]


def test_kinds_of_off_that_are_not_read_are_named() -> None:
    with pytest.raises(MeshError, match="4OFF is not read"):
        read_mesh("m.off", b"4OFF\n1 1 1\n")


@pytest.mark.parametrize(
    "spelling",
    [
        lambda text: text.replace("//1\n", "//1 # a face\n"),
        lambda text: "# C:\\meshes\\\n" + text,
        lambda text: text.replace("//1\n", "// \\\n\n"),
    ],
    ids=["comment behind a face", "comment that ends in a backslash", "empty normal, continued"],
)
def test_spellings_of_obj(spelling: object) -> None:
    same("m.obj", spelling(PLAIN["m.obj"].decode()).encode())  # type: ignore[operator]


@pytest.mark.parametrize("name", sorted(PLAIN))
def test_a_word_where_a_number_belongs_is_told_without_pythons_words(name: str) -> None:
    broken = PLAIN[name].replace(b"0.03", b"0,03x", 1)
    with pytest.raises(MeshError) as found:
        read_mesh(name, broken)
    assert f"not a readable {name[2:].upper()} file: '" in str(found.value) and "0,03x" in str(found.value)
    assert not any(word in str(found.value) for word in ("float", "int()", "literal", "b'"))


POINTER = b"version https://git-lfs.github.com/spec/v1\noid sha256:4d7a2146\nsize 12345\n"


def archive() -> bytes:
    data = io.BytesIO()
    with zipfile.ZipFile(data, "w") as file:
        file.writestr("mug.stl", b"solid")
    return data.getvalue()


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
        (archive(), "a ZIP archive"),
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
    ],
)
def test_a_stand_in_is_told_for_what_it_is(suffix: str, data: bytes, told: str) -> None:
    report = check_object({f"mug.{suffix}": data}, "mug")
    assert report["verdict"] == "refuse" and report["message"].startswith(f"mug.{suffix} is ")
    assert told in report["message"]


@pytest.mark.parametrize("data", [b" \n\n", bytes(5000)], ids=["spaces", "zeros"])
def test_a_file_of_nothing_is_told_as_such(data: bytes) -> None:
    assert "nothing but spaces or zeros" in check_object({"mug.stl": data}, "mug")["message"]


@pytest.mark.parametrize("header", [b"404 not found bracket", b'{"made": "by"}', b"OFF-road tyre", b"../parts/a.stl"])
def test_a_binary_stl_may_begin_with_any_words(header: bytes) -> None:
    data = header.ljust(80, b" ") + stl_bytes(*box())[80:]
    assert check_object({"mug.stl": data}, "mug")["verdict"] == "accept"


@pytest.mark.parametrize("name", sorted(PLAIN))
@pytest.mark.parametrize("suffix", ["stl", "obj", "ply", "off", "glb", "dae"])
def test_a_mesh_under_the_name_of_another_format_is_told(name: str, suffix: str) -> None:
    report = check_object({f"mug.{suffix}": PLAIN[name]}, "mug")
    assert (
        report["verdict"] == "accept" if name[2:] == suffix else f"it is a mesh of type {name[1:]}" in report["message"]
    )


@pytest.mark.parametrize("start", [b"", b"# made by a script\n"], ids=["no word solid", "a comment before it"])
def test_text_stl_is_known_by_its_facets(start: bytes) -> None:
    same("m.stl", start + PLAIN["m.stl"].removeprefix(b"solid test\n"))


def test_facets_of_four_corners_are_refused_for_what_they_are() -> None:
    four = b"facet normal 0 0 0\nouter loop\n" + 4 * b"vertex 0 0 0\n" + b"endloop\nendfacet\n"
    with pytest.raises(MeshError, match="more than three vertices"):
        read_mesh("m.stl", b"solid\n" + 3 * four + b"endsolid\n")


def test_a_comment_may_name_the_end_of_a_ply_header() -> None:
    same("m.ply", PLAIN["m.ply"].replace(b"element vertex", b"comment no end_header yet\nelement vertex", 1))


@pytest.mark.parametrize(
    ("length", "units", "likely"),
    [
        (12.0, "m", ["cm", "in"]),
        (4.6, "m", ["in", "cm"]),
        (117.0, "m", ["mm"]),
        (2000.0, "m", ["mm"]),
        (0.117, "mm", ["m"]),
    ],
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

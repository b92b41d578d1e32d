"""Files of assets: networks come back as written, all else is refused; folders of meshes become sets of objects."""

import io
import json
import zipfile
import zlib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest

from graspd.service.model.errors import InputError, LimitError, NotFoundError
from graspd.service.model.states import AssetKind
from graspd.service.store import network_file
from graspd.service.store.assets import builtin_files, pack, unpack
from graspd.service.store.network_file import ProposalNetwork, from_bytes, to_bytes
from graspd.service.store.object_sets import group_objects, read_set
from tests.networks import random_network

Arrays = dict[str, Any]


@pytest.fixture(scope="module")
def network() -> ProposalNetwork:
    return random_network(["a", "b"])


@pytest.fixture(scope="module")
def arrays(network: ProposalNetwork) -> Arrays:
    with np.load(io.BytesIO(to_bytes(network))) as stored:
        return {name: stored[name] for name in stored.files}


def packed(arrays: Arrays) -> bytes:
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)
    return buffer.getvalue()


def with_meta(arrays: Arrays, **change: Any) -> bytes:
    return packed(arrays | {"meta": np.array(json.dumps(json.loads(str(arrays["meta"])) | change))})


def test_a_network_comes_back_as_it_was(network: ProposalNetwork) -> None:
    data = to_bytes(network)
    back = from_bytes(data, "it")
    assert to_bytes(back) == data == to_bytes(network)
    assert (back.hand, back.joint_names, back.points, back.about) == ("some_hand", ("a", "b"), 64, "drawn by chance")
    assert all(np.array_equal(back.weights[name], network.weights[name]) for name in network.weights)
    assert np.array_equal(back.mean, network.mean) and np.array_equal(back.std, network.std)
    with np.load(io.BytesIO(data)) as arrays:
        meta = json.loads(str(arrays["meta"]))
    assert meta["schema"] == "graspd/proposals@1"
    assert meta["sizes"] == {"encoder": [7, 64, 128, 256, 256], "condition": [258], "flow": [284, 512, 512, 512, 18]}


class Bomb:
    def __reduce__(self) -> tuple[Any, ...]:
        return Path.touch, (Path("a pickle ran"),)


def _lying_header(arrays: Arrays) -> bytes:
    """A member whose header claims a petabyte."""
    buffer = io.BytesIO()
    np.lib.format.write_array_header_1_0(buffer, {"descr": "<f4", "fortran_order": False, "shape": (1 << 48,)})
    return _replaced(arrays, "mean.npy", buffer.getvalue())


def _replaced(arrays: Arrays, member: str, data: bytes, how: int = zipfile.ZIP_STORED) -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(packed(arrays))) as whole, zipfile.ZipFile(buffer, "w") as archive:
        for info in whole.infolist():
            archive.writestr(info.filename, data if info.filename == member else whole.read(info), how)
    return buffer.getvalue()


NAN = np.float32("nan")
HOSTILE: dict[str, tuple[Callable[[Arrays], bytes], str]] = {
    "no zip": (lambda arrays: b"PK\3\4 no archive", "no .npz"),
    "pickled text": (lambda arrays: packed(arrays | {"meta": np.array([Bomb()], object)}), "one text"),
    "pickled weights": (lambda arrays: packed(arrays | {"mean": np.array([Bomb()], object)}), "mean is object"),
    "double": (lambda arrays: packed(arrays | {"mean": arrays["mean"].astype(float)}), "mean is float64"),
    "transposed": (lambda arrays: packed(arrays | {"flow.out.weight": arrays["flow.out.weight"].T}), "flow.out.weight"),
    "an array less": (lambda arrays: packed({n: a for n, a in arrays.items() if n != "std"}), "without std"),
    "an array more": (lambda arrays: packed(arrays | {"extra": np.zeros(3)}), "besides extra"),
    "not finite": (lambda arrays: packed(arrays | {"mean": np.append(arrays["mean"][1:], NAN)}), "mean .* not finite"),
    "no spread": (lambda arrays: packed(arrays | {"std": 0 * arrays["std"]}), "std must be positive"),
    "lying header": (_lying_header, "mean is float32"),
    "a newer header": (lambda arrays: _replaced(arrays, "mean.npy", b"\x93NUMPY\3\0"), "of NumPy's format"),
    "zip bomb": (
        lambda arrays: _replaced(arrays, "mean.npy", bytes(1 << 23), zipfile.ZIP_DEFLATED),
        "unpacks to 8388608",
    ),
    "another schema": (lambda arrays: with_meta(arrays, schema="graspd/proposals@2"), "schema"),
    "another joint": (lambda arrays: with_meta(arrays, joint_names=["a", "b", "c"]), "sizes"),
    "a joint twice": (lambda arrays: with_meta(arrays, joint_names=["a", "a"]), "named twice"),
    "a long text": (lambda arrays: with_meta(arrays, about="x" * 5000), "about"),
    "a path for a name": (lambda arrays: with_meta(arrays, hand="../up"), "hand"),
    "deep JSON": (lambda arrays: packed(arrays | {"meta": np.array("[" * 9000)}), "JSON"),
}


@pytest.mark.parametrize("what", HOSTILE)
def test_a_file_that_is_no_network_is_refused_in_a_line(
    what: str, arrays: Arrays, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    make, message = HOSTILE[what]
    with pytest.raises(InputError, match=message) as refused:
        from_bytes(make(arrays), "net.npz")
    assert "\n" not in str(refused.value) and str(refused.value).startswith("net.npz")
    assert not list(tmp_path.iterdir())


def test_a_file_over_the_limit_is_not_even_opened(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(network_file, "MAX_BYTES", 10)
    with pytest.raises(LimitError, match="has more than"):
        from_bytes(b"x" * 11, "net.npz")


def test_what_no_reader_would_take_is_not_written(network: ProposalNetwork) -> None:
    for wrong in (
        replace(network, joint_names=("a",)),
        replace(network, hand_digest="x"),
        replace(network, mean=network.mean * np.float32(np.nan)),
        replace(network, weights={}),
    ):
        with pytest.raises(InputError, match="cannot be written"):
            to_bytes(wrong)


EGAD = ["egad/A0.obj", "egad/B3.obj", "egad/readme.txt"]
YCB = [f"ycb/a/google_16k/{name}" for name in ("nontextured.stl", "textured.obj")]
YCB += [f"ycb/b/google_16k/{name}" for name in ("textured.obj", "textured.mtl")]
DESCRIBED = ["a/clean.stl", "a/asset.json", "b/clean.stl"]


@pytest.mark.parametrize(
    ("paths", "objects"),
    [
        (EGAD, {"A0": ["A0.obj"], "B3": ["B3.obj"]}),
        (YCB, {"a": ["nontextured.stl"], "b": ["textured.obj"]}),
        (DESCRIBED, {"a": ["asset.json", "clean.stl"], "b": ["clean.stl"]}),
        (["a b.stl", "a!b.stl", "a?b.stl"], {"a_b": ["a b.stl"], "a_b-2": ["a!b.stl"], "a_b-3": ["a?b.stl"]}),
    ],
)
def test_a_folder_of_meshes_is_a_set_of_objects(paths: list[str], objects: dict[str, list[str]]) -> None:
    assert {name: sorted(files) for name, files in group_objects(dict.fromkeys(paths, b"x")).items()} == objects


def test_a_set_is_a_folder_of_meshes_as_the_reference_objects(shared_data: Path) -> None:
    with pytest.raises(InputError, match="no mesh"):
        group_objects({"a.txt": b""})
    found = group_objects(read_set(shared_data / "objects", limit_bytes=2**26))
    assert len(found) == 14 and list(found["025_mug"]) == ["clean.stl"]


def test_a_link_out_of_the_folder_is_left_alone_and_too_large_a_set_refused(tmp_path: Path) -> None:
    (tmp_path / "secret.stl").write_bytes(b"secret")
    (tmp_path / "set").mkdir()
    (tmp_path / "set" / "a.stl").write_bytes(b"x" * 100)
    (tmp_path / "set" / "b.stl").symlink_to(tmp_path / "secret.stl")
    assert list(read_set(tmp_path / "set", limit_bytes=100)) == ["a.stl"]
    with pytest.raises(LimitError):
        read_set(tmp_path / "set", limit_bytes=99)


def test_a_builtin_that_is_not_there_lists_those_that_are() -> None:
    with pytest.raises(NotFoundError, match="allegro"):
        builtin_files(AssetKind.HAND, "nothing")


def test_a_machine_without_memory_damages_no_archive(monkeypatch: pytest.MonkeyPatch) -> None:
    data = pack({"asset.json": b"{}"})
    monkeypatch.setattr(zipfile.ZipExtFile, "read", Mock(side_effect=zlib.error("Error -4 while decompressing data")))
    with pytest.raises(MemoryError):
        unpack(data, limit_bytes=100)

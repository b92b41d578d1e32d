"""What an export writes: names that its libraries take, and files that they open before it says it is done."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from graspd.exchange.opening import READERS, check_written_files
from graspd.exchange.plan import prim_name, prim_names
from graspd.service.model.errors import GraspdError


@pytest.mark.parametrize(
    ("suffix", "content"),
    [*((suffix, b"\x00<broken\n1,2\xff") for suffix in READERS), (".csv", b"1,2\n3\n"), (".usd", b"#usda 1.0\n")],
)
def test_a_file_that_its_library_cannot_read_is_named(suffix: str, content: bytes, tmp_path) -> None:
    with (
        pytest.raises(GraspdError, match=rf"broken\{suffix} was written but .* cannot read it"),
        check_written_files(tmp_path),
    ):
        (tmp_path / f"broken{suffix}").write_bytes(content)


def test_only_files_that_are_written_anew_are_looked_at(tmp_path) -> None:
    (tmp_path / "old.xml").write_bytes(b"broken")
    with check_written_files(tmp_path):
        (tmp_path / "new.json").write_text("{}")
    (tmp_path / "scene.xml").write_text("<mujoco/>")
    with pytest.raises(GraspdError, match="scene"), check_written_files(tmp_path):
        (tmp_path / "scene.xml").write_text("<mujoco><tendon><fixed/></tendon></mujoco>")


Sdf = pytest.importorskip("pxr.Sdf")


@given(st.text(max_size=30))
def test_any_name_becomes_one_that_usd_takes_for_a_prim(name: str) -> None:
    assert Sdf.Path.IsValidIdentifier(prim_name(name))


@pytest.mark.parametrize(
    ("name", "prim"),
    [("003_cracker_box", "_003_cracker_box"), ("mug.v2.final", "mug_v2_final"), ("tasse-caf-1", "tasse_caf_1")],
)
def test_a_prim_keeps_what_it_can_of_the_name(name: str, prim: str) -> None:
    assert prim_name(name) == prim


def test_siblings_whose_names_become_the_same_are_told_apart() -> None:
    assert prim_names(["a-b", "a_b", "a.b", "a_b_2"]) == ["a_b", "a_b_2", "a_b_3", "a_b_2_2"]

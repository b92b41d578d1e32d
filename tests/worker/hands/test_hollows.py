"""A mesh whose hull would hide what touches becomes several pieces; all others stay one hull, bit for bit."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh

from graspd.worker.hands.load import load_hand
from graspd.worker.hands.shapes import MAX_ERROR_M, hull_error, parts_of
from tests.worker.hands.urdfs import joint, link, robot


@pytest.fixture(autouse=True)
def own_cache(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.getbasetemp() / "hollows"))


def fork(gap: float) -> trimesh.Trimesh:
    """A U of three boxes: two prongs 40 mm high, `gap` [m] apart, on a bar."""
    prong = trimesh.creation.box((0.008, 0.02, 0.04))
    parts = [prong.copy().apply_translation((side * (gap / 2 + 0.004), 0, 0.024)) for side in (-1, 1)]
    bar = trimesh.creation.box((gap + 0.016, 0.02, 0.008))
    return trimesh.boolean.union([*parts, bar], engine="manifold")


def measured(mesh: trimesh.Trimesh) -> tuple[int, float]:
    vertices, faces = np.asarray(mesh.vertices, float), np.asarray(mesh.faces, np.int32)
    parts = parts_of(vertices, faces)
    return len(parts), hull_error(vertices, faces, parts)


def test_a_fork_is_taken_apart_within_the_error() -> None:
    mesh = fork(0.04)
    whole = (np.asarray(mesh.vertices, float),)
    assert hull_error(whole[0], np.asarray(mesh.faces, np.int32), whole) > MAX_ERROR_M
    count, error = measured(mesh)
    assert count > 1 and error <= MAX_ERROR_M


@pytest.mark.parametrize(
    "mesh",
    [
        trimesh.creation.box((0.02, 0.03, 0.04)),
        trimesh.creation.icosphere(2, 0.02),
        # A housing with a cavity inside: nothing gets there.
        trimesh.creation.box((0.06, 0.06, 0.06)) + trimesh.creation.box((0.04, 0.04, 0.04)),
    ],
)
def test_what_its_hull_shows_well_enough_stays_one_hull(mesh: trimesh.Trimesh) -> None:
    vertices = np.asarray(mesh.vertices, float)
    (part,) = parts_of(vertices, np.asarray(mesh.faces, np.int32))
    assert part is vertices


def test_an_object_fits_between_the_prongs_of_a_loaded_hand() -> None:
    mesh = '<collision><geometry><mesh filename="fork.stl"/></geometry></collision>'
    files = {
        "h.urdf": robot(link("palm", mesh), link("a", mesh), joint("j", "palm", "a")),
        "fork.stl": bytes(fork(0.04).export(file_type="stl")),
    }
    hand = load_hand(files, name="h", digest="0" * 32)
    middle = np.array([[0, 0, 0.03]])
    inside = [trimesh.Trimesh(p.vertices, p.faces).contains(middle)[0] for p in hand.pieces if p.link == "palm"]
    assert len(inside) > 1 and not any(inside)


def test_a_failed_decomposition_leaves_the_hull_and_is_not_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("graspd.worker.hands.shapes.coacd_parts", lambda *_: ())
    mesh = fork(0.05)
    assert measured(mesh)[0] == 1
    monkeypatch.undo()
    assert measured(mesh)[0] > 1


def test_real_hands_keep_their_hulls_but_for_barretts_palm(shared_data: Path) -> None:
    from graspd.worker.hands.load import hand_from_path

    counts = {"allegro/allegro_hand_right.urdf": 23, "barrett_bh280/bh280.urdf": 14, "barrett/bhand_model.urdf": 33}
    for file, count in counts.items():
        assert len(hand_from_path(shared_data / "hands" / file).pieces) == count, file

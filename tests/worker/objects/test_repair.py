"""From triangles to a solid: what is repaired, what is refused, and that both are said."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from graspd.commands.objects import report_object
from graspd.service.model.errors import MeshError
from graspd.worker.objects.check import check_object
from graspd.worker.objects.prepare import load_object
from graspd.worker.objects.topology import is_closed
from tests.worker.objects.shapes import Mesh, box, join, sphere, stl

#: Uploads are float32: seven digits of 0.1 m.
ROUNDING = 1e-6


def check(mesh: Mesh, **options: Any) -> dict[str, Any]:
    return check_object(stl(mesh), "m", face_error_m=0.0, **options)


def test_every_bad_mesh_gets_its_verdict_and_a_message_that_names_the_defect(shared_data: Path) -> None:
    entries = json.loads((shared_data / "bad" / "INDEX.json").read_text())["inputs"]
    meshes = [entry for entry in entries if entry["kind"].startswith("mesh")]
    assert len(meshes) >= 20
    wrong = []
    for entry in meshes:
        report = report_object(str(shared_data / "bad" / entry["file"]))
        if report["verdict"] != entry["expect"] or entry["message_names"].lower() not in report["message"].lower():
            wrong.append((entry["file"], entry["expect"], report["verdict"], report["message"]))
    assert not wrong


@pytest.mark.parametrize(
    ("file", "options", "volume"),
    [
        ("banana_in_millimetres.stl", {"units": "mm"}, 171.3e-6),
        ("two_components.stl", {"keep_largest": True}, 4 / 3 * np.pi * 0.04**3),
        ("open_shell.stl", {"allow_open": True}, None),
    ],
)
def test_the_mend_that_a_refusal_names_works(
    shared_data: Path, file: str, options: dict[str, Any], volume: float | None
) -> None:
    report = report_object(str(shared_data / "bad" / file), options)
    assert report["verdict"] != "refuse"
    if volume is not None:
        # A sphere of 1280 faces has 1.2 % less volume than the ball.
        assert report["facts"]["volume_m3"] == pytest.approx(volume, rel=0.015)


def test_an_open_mesh_is_marked_as_such(shared_data: Path) -> None:
    files = {"m.stl": (shared_data / "bad" / "open_shell.stl").read_bytes()}
    model = load_object(files, name="m", digest="", face_error_m=0.0, options={"allow_open": True})
    assert not model.watertight and model.volume > 0


def test_a_sound_mesh_is_taken_as_it_is() -> None:
    report = check(box())
    assert report["verdict"] == "accept" and report["repairs"] == []
    assert report["facts"]["volume_m3"] == pytest.approx(0.06 * 0.05 * 0.04, rel=ROUNDING)


def test_a_mesh_wound_inwards_is_turned() -> None:
    vertices, faces = sphere()
    report = check((vertices, faces[:, ::-1]))
    assert report["verdict"] == "repair" and "winding" in report["message"]
    assert report["facts"]["volume_m3"] > 0


def test_faces_wound_at_random_are_made_to_agree() -> None:
    vertices, faces = sphere()
    turn = np.random.default_rng(0).random(len(faces)) < 0.4
    report = check((vertices, np.where(turn[:, None], faces[:, ::-1], faces)))
    assert report["facts"]["volume_m3"] == pytest.approx(check((vertices, faces))["facts"]["volume_m3"], rel=ROUNDING)


def test_a_cavity_stays_a_cavity() -> None:
    outer, inner = sphere(0.04), sphere(0.03)
    report = check(join(outer, (inner[0], inner[1][:, ::-1])))
    hollow = check(outer)["facts"]["volume_m3"] - check(inner)["facts"]["volume_m3"]
    assert report["facts"]["volume_m3"] == pytest.approx(hollow, rel=1e-4)


def test_a_hollow_mesh_wound_inwards_keeps_its_cavity() -> None:
    outer, inner = sphere(0.04), sphere(0.03)
    report = check(join((outer[0], outer[1][:, ::-1]), inner))
    hollow = check(outer)["facts"]["volume_m3"] - check(inner)["facts"]["volume_m3"]
    assert report["facts"]["volume_m3"] == pytest.approx(hollow, rel=1e-4)


def test_overlapping_solids_become_one() -> None:
    report = check(join(box(), box(at=(0.03, 0.0, 0.0))))
    assert report["verdict"] == "repair" and "intersect" in report["message"]
    assert report["facts"]["volume_m3"] == pytest.approx(0.09 * 0.05 * 0.04, rel=1e-4)


def test_a_small_hole_is_filled_and_a_large_one_refused() -> None:
    vertices, faces = sphere(segments=128)
    low = np.argsort(vertices[faces].mean(axis=1)[:, 2])
    small = check((vertices, faces[low[1:]]))
    assert small["verdict"] == "repair" and "hole" in small["message"]
    large = check((vertices, faces[low[len(low) // 4 :]]))
    assert large["verdict"] == "refuse" and "--allow-open" in large["message"]


def test_a_wall_inside_a_mesh_is_no_hole_and_no_traceback() -> None:
    (one, faces), (other, more) = box(), box(at=(0.06, 0.0, 0.0))
    # Their common face is there once: its four edges have three faces each.
    kept = ~np.isclose(other[more][:, :, 0], 0.03).all(axis=1)
    report = check(join((one, faces), (other, more[kept])))
    assert report["verdict"] == "refuse" and "not watertight (4 open edges)" in report["message"]


def test_a_seam_that_does_not_quite_close_is_welded() -> None:
    vertices, faces = sphere()
    corners = vertices[faces].reshape(-1, 3) + np.random.default_rng(0).normal(scale=1e-8, size=(3 * len(faces), 3))
    report = check((corners, np.arange(len(corners)).reshape(-1, 3)))
    assert report["verdict"] == "repair" and "weld" in report["message"]


def test_scan_debris_without_volume_is_dropped() -> None:
    vertices, faces = join(box(), sphere(1e-5, 8, at=(0.05, 0.0, 0.0)))
    report = check((vertices, faces))
    assert report["verdict"] == "repair" and "components" in report["message"]
    assert report["facts"]["volume_m3"] == pytest.approx(0.06 * 0.05 * 0.04, rel=1e-4)


def test_scale_to_sets_the_longest_extent() -> None:
    report = check(box(), scale_to=0.12)
    np.testing.assert_allclose(report["facts"]["extents_m"], [0.12, 0.10, 0.08], rtol=ROUNDING)


def test_mass_is_density_times_volume() -> None:
    assert check(box(), density=1000.0)["facts"]["mass_kg"] == pytest.approx(0.12, rel=ROUNDING)


#: One of each format and source; a handle, and what is thin.
SOME = ("011_banana", "025_mug", "048_hammer", "koala")


@pytest.mark.parametrize("chosen", [SOME, pytest.param((), marks=pytest.mark.slow)], ids=["some", "all"])
def test_published_scans_become_closed_solids(shared_data: Path, chosen: tuple[str, ...]) -> None:
    known = sorted((shared_data / "objects").glob("*/raw.*"))
    scans = [path for path in known if path.parent.name in chosen] if chosen else known
    assert len(scans) == (len(chosen) or 14)
    for path in scans:
        options = {"scale_to": 0.14} if path.parent.name in ("koala", "spot") else {}
        files = {path.name: path.read_bytes()}
        model = load_object(files, name="o", digest="", face_error_m=0.0, options=options)
        assert is_closed(model.faces.astype(np.int64)) and model.volume > 0, path.parent.name


def test_an_unknown_key_in_asset_json_is_named() -> None:
    with pytest.raises(MeshError, match="unit"):
        load_object(
            {**stl(box()), "asset.json": b'{"file": "m.stl", "unit": "mm"}'}, name="m", digest="", face_error_m=0
        )


def test_two_meshes_without_a_word_on_which_are_refused() -> None:
    with pytest.raises(MeshError, match="name one"):
        load_object({**stl(box()), "n.stl": b"x"}, name="m", digest="", face_error_m=0)

"""Objects of several parts: what touches is one rigid body, what lies apart is one on request."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import trimesh

from graspd.worker.objects.check import check_object


def boxes(gap: float, upper: tuple[float, float, float] = (0.04, 0.05, 0.03)) -> trimesh.Trimesh:
    lower, other = trimesh.creation.box((0.04, 0.05, 0.06)), trimesh.creation.box(upper)
    other.apply_translation((0, 0, 0.03 + upper[2] / 2 + gap))
    return trimesh.util.concatenate([lower, other])


def check(mesh: trimesh.Trimesh, suffix: str = "obj", **options: Any) -> dict[str, Any]:
    data = mesh.export(file_type=suffix)
    return check_object({f"m.{suffix}": data if isinstance(data, bytes) else data.encode()}, "m", **options)


@pytest.mark.parametrize("suffix", ["obj", "stl"])
@pytest.mark.parametrize("upper", [(0.04, 0.05, 0.03), (0.02, 0.05, 0.03), (0.02, 0.02, 0.03)])
def test_parts_that_share_a_face_are_united(upper: tuple[float, float, float], suffix: str) -> None:
    mesh = boxes(0.0, upper)
    report = check(mesh, suffix)
    assert report["verdict"] == "repair" and "united 2 touching" in report["message"]
    assert report["facts"]["volume_m3"] == pytest.approx(abs(mesh.volume), rel=1e-5)


def test_eight_cubes_of_a_block_are_one_cube() -> None:
    cubes = []
    for corner in np.indices((2, 2, 2)).reshape(3, -1).T:
        cubes.append(trimesh.creation.box((0.03, 0.03, 0.03)))
        cubes[-1].apply_translation(0.03 * corner)
    report = check(trimesh.util.concatenate(cubes))
    assert report["verdict"] == "repair" and report["facts"]["volume_m3"] == pytest.approx(0.06**3)


def test_parts_within_a_millimetre_are_one_rigid_body() -> None:
    report = check(boxes(0.0009))
    assert (
        report["verdict"] == "accept"
        and "2 parts that touch or lie within 1 mm are one rigid body" in report["message"]
    )


def test_parts_that_lie_apart_are_a_choice() -> None:
    apart = boxes(0.0012)
    refused = check(apart)
    assert (
        refused["verdict"] == "refuse" and "--compound" in refused["message"] and "--keep-largest" in refused["message"]
    )
    compound = check(apart, compound=True)
    assert compound["verdict"] == "accept" and "2 parts that lie apart are one rigid body" in compound["message"]
    assert compound["facts"]["volume_m3"] == pytest.approx(abs(apart.volume))
    assert check(apart, keep_largest=True)["facts"]["volume_m3"] == pytest.approx(0.04 * 0.05 * 0.06)


def test_the_largest_group_is_kept_with_all_its_parts() -> None:
    third = trimesh.creation.box((0.04, 0.05, 0.07))
    third.apply_translation((0, 0, 0.3))
    report = check(trimesh.util.concatenate([boxes(0.0005), third]), keep_largest=True)
    assert report["facts"]["volume_m3"] == pytest.approx(0.04 * 0.05 * 0.09)


def test_a_gap_of_a_millimetre_joins_whatever_its_rounding() -> None:
    assert check(boxes(0.001))["verdict"] == "accept"


def rattle() -> trimesh.Trimesh:
    """A hollow box with a loose ball in it."""
    hollow, ball = trimesh.creation.box((0.04, 0.04, 0.04)), trimesh.creation.icosphere(1, 0.01)
    cavity = trimesh.creation.box((0.036, 0.036, 0.036))
    cavity.invert()
    return trimesh.util.concatenate([hollow, cavity, ball])


def test_a_loose_part_in_a_cavity_is_a_part_of_its_own() -> None:
    assert "2 separate components" in check(rattle())["message"]
    assert check(rattle(), compound=True)["facts"]["volume_m3"] == pytest.approx(rattle().volume)
    kept = check(rattle(), keep_largest=True)["facts"]["volume_m3"]
    assert kept == pytest.approx(0.04**3 - 0.036**3)

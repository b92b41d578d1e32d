"""Regions of an object: half-spaces, and points of its surface inside them."""

import numpy as np
import pytest
import trimesh

from graspd.service.model.contact_region import parse_region
from graspd.service.model.errors import InputError
from graspd.worker.objects.region import WHOLE, ContactRegion
from graspd.worker.planners.fitting import FEWEST, SAMPLES, even_points, region_points
from tests.worker.models import object_from_mesh

SIZE = np.array([0.06, 0.04, 0.1])
BOX = object_from_mesh(trimesh.creation.box(SIZE))


def region(touch: str = "", avoid: str = "") -> ContactRegion:
    return ContactRegion(*(np.array(parse_region(text)) if text else None for text in (touch, avoid)))


def test_a_region_is_where_all_bounds_hold_except_where_all_to_avoid_do() -> None:
    points = np.random.default_rng(0).uniform(-0.05, 0.05, (7, 60, 3))
    x, _, z = np.moveaxis(points, -1, 0)
    for touch, avoid, expected in (
        ("z > 0.01, x < 0.02", "", (z > 0.01) & (x < 0.02)),
        ("", "z > 0.01, x < 0.02", ~((z > 0.01) & (x < 0.02))),
        ("z > 0", "x > 0", (z > 0) & (x <= 0)),
    ):
        np.testing.assert_array_equal(region(touch, avoid).contains(points), expected)
    assert WHOLE.is_whole and region().is_whole and not region(avoid="z > 9").is_whole


@pytest.mark.parametrize(("touch", "avoid", "inside"), [("z < 0.05", "", True), ("", "z < 0.05", False)])
def test_a_point_on_the_bound_of_a_face_is_inside_its_half_space(touch: str, avoid: str, inside: bool) -> None:
    top = np.array([[0.0, 0, 0.05], [0.03, 0.02, 0.05], [0, 0, np.nextafter(0.05, 1)]])
    assert region(touch, avoid).contains(top).tolist() == [inside, inside, not inside]


@pytest.mark.parametrize("touch", ["z > 0", "x > 0.0299", "z > 0.045, x > 0.02", "z > 0.0475, x > 0.0275, y > 0.0175"])
def test_points_cover_a_region_evenly_however_small(touch: str) -> None:
    place, face = region_points(BOX, region(touch))
    assert len(place) > (SAMPLES if "y" not in touch else FEWEST) and region(touch).contains(place).all()
    on_face = np.abs(np.abs(place) - SIZE / 2).min(axis=1)
    assert on_face.max() < 1e-9 and len(face) == len(place)
    # Each octant of the region's bounds that other points of the surface are in has some.
    other = even_points(BOX, 200_000, np.random.default_rng(1))[0]
    other = other[region(touch).contains(other)]
    for axis in range(3):
        share = [(some[:, axis] > np.median(other[:, axis])).mean() for some in (place, other)]
        assert share[0] == pytest.approx(share[1], abs=0.16)


@pytest.mark.parametrize("bounds", [("z > 0.0499, x > 0.0299, y > 0.0199", ""), ("z > 5", ""), ("z > 0", "z > -1")])
def test_a_region_without_surface_is_refused(bounds: tuple[str, str]) -> None:
    with pytest.raises(InputError, match=r"no surface in the region.*in metres"):
        region_points(BOX, region(*bounds))

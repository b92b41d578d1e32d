"""Regions of an object: half-spaces, and points of its surface inside them."""

import numpy as np
import pytest
import trimesh

from graspd.service.model.contact_region import parse_region
from graspd.service.model.errors import InputError
from graspd.worker.objects.region import WHOLE, ContactRegion
from graspd.worker.planners.fitting import FEWEST, SAMPLES, region_points
from tests.worker.models import object_from_mesh

SIZE = np.array([0.06, 0.04, 0.1])
BOX = object_from_mesh(trimesh.creation.box(SIZE))
AREA = 2 * (SIZE[0] * SIZE[1] + SIZE[1] * SIZE[2] + SIZE[0] * SIZE[2])


def region(touch: str = "", avoid: str = "") -> ContactRegion:
    return ContactRegion(*(np.array(parse_region(text)) if text else None for text in (touch, avoid)))


def test_a_region_is_where_all_bounds_hold_except_where_all_to_avoid_do() -> None:
    points = np.random.default_rng(0).uniform(-0.05, 0.05, (7, 60, 3))
    x, _, z = np.moveaxis(points, -1, 0)
    for touch, avoid, expected in (
        ("z > 0.01, x < 0.02", "", (z > 0.01) & (x < 0.02)),
        ("", "z > 0.01, x < 0.02", ~((z > 0.01) & (x < 0.02))),
        ("z > 0", "x > 0", (z > 0) & (x <= 0)),
        ("z > 0.1", "", np.zeros(x.shape, bool)),
        ("", "", np.ones(x.shape, bool)),
    ):
        np.testing.assert_array_equal(region(touch, avoid).contains(points), expected)
    assert WHOLE.is_whole and region().is_whole and not region(avoid="z > 9").is_whole


@pytest.mark.parametrize(("touch", "avoid", "inside"), [("z < 0.05", "", True), ("", "z < 0.05", False)])
def test_a_point_on_the_bound_of_a_face_is_inside_its_half_space(touch: str, avoid: str, inside: bool) -> None:
    top = np.array([[0.0, 0, 0.05], [0.03, 0.02, 0.05], [0, 0, np.nextafter(0.05, 1)]])
    assert region(touch, avoid).contains(top).tolist() == [inside, inside, not inside]


@pytest.mark.parametrize(
    ("touch", "share"),
    [
        ("z > 0", 0.5),
        ("z > 0.045, x > 0.02", (0.01 * 0.04 + 0.005 * (0.04 + 2 * 0.01)) / AREA),
        ("x > 0.0299", (0.04 * 0.1 + 1e-4 * 2 * (0.04 + 0.1)) / AREA),
    ],
)
def test_points_cover_a_region_evenly_however_small(touch: str, share: float) -> None:
    place, face = region_points(BOX, region(touch))
    assert len(place) >= SAMPLES and region(touch).contains(place).all()
    corners = BOX.vertices[BOX.faces[face]]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert np.abs(np.einsum("ni,ni->n", place - corners[:, 0], normal)).max() < 1e-9
    every = region_points(BOX, WHOLE)[0]
    assert len(every) == SAMPLES
    if share > 0.1:
        assert region(touch).contains(every).mean() == pytest.approx(share, abs=0.05)
    # The nearest point to a random place of the region is within a few mean spacings.
    spacing = np.sqrt(share * AREA / len(place))
    low, high = place.min(axis=0), place.max(axis=0)
    assert np.linalg.norm(high - low) > 0.5 * np.sqrt(share * AREA) > spacing


def test_a_tiny_patch_has_few_points_and_an_empty_one_is_refused() -> None:
    corner = region("z > 0.0475, x > 0.0275, y > 0.0175")
    place, _ = region_points(BOX, corner)
    assert FEWEST < len(place) < SAMPLES and corner.contains(place).all()
    for empty in (region("z > 0.0499, x > 0.0299, y > 0.0199"), region("z > 5"), region("z > 0", "z > -1")):
        with pytest.raises(InputError, match=r"no surface in the region.*in metres") as error:
            region_points(BOX, empty)
        assert "\n" not in str(error.value)

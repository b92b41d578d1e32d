"""Regions and cones as text: what is parsed, and what is refused in one line."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from graspd.service.model.contact_region import MOST_PLANES, parse_cone, parse_region
from graspd.service.model.domain import JobOptions

NUMBERS = st.sampled_from(["0.05", "-1e-3", "1e9", "9" * 150, "nan", "inf", "1e999", "-1e999", "٣", "0x1", "", "1\0"])
BOUNDS = st.lists(st.builds("{} {} {}".format, st.sampled_from("xyzw"), st.sampled_from("<>="), NUMBERS), max_size=14)


@pytest.mark.parametrize(
    ("text", "planes"),
    [
        ("z>0.05,x<.02", [(0, 0, -1, -0.05), (1, 0, 0, 0.02)]),
        (" y < -1e-3 ", [(0, 1, 0, -0.001)]),
        (", ".join(["x > +2."] * MOST_PLANES), [(-1, 0, 0, -2.0)] * MOST_PLANES),
    ],
)
def test_bounds_are_half_spaces(text: str, planes: list[tuple[float, ...]]) -> None:
    assert parse_region(text).planes == tuple(planes)


def test_cones_have_an_axis_and_an_angle() -> None:
    assert parse_cone("0, 0, -1, 30") == ((0, 0, -1), 30) and parse_cone("1,2,3,180") == ((1, 2, 3), 180)


REGIONS = ["", "z", "w > 1", "z >= 1", "z > 1 mm", "1 < z", "z > 1,", "z > 1; x < 2", "z > nan", "z > inf", "z > 1_0"]
REGIONS += ["z > ٣", "Z > 1", "z > 1\n# comment", "z > 1e999", ", ".join(["z > 0"] * (MOST_PLANES + 1))]
CONES = ["", "0, 0, -1", "0, 0, 0, 30", "0, 0, -1, 0.5", "0, 0, -1, 181", "0, 0, -1, -30", "0, 0, -1, 30, 4"]
CONES += ["a, b, c, d", "0, 0, nan, 30", "0, 0, 1e999, 30", "0, 0, 1e300, 30", "0 0 -1 30", "0, 0, -1, 30 deg"]


@pytest.mark.parametrize(
    ("option", "text"), [*(("touch_region", t) for t in REGIONS), *(("approach_cone", t) for t in CONES)]
)
def test_other_text_is_refused_in_one_line(option: str, text: str) -> None:
    parse, message = (
        (parse_region, "in metres, such as z > 0") if option == "touch_region" else (parse_cone, "1 to 180")
    )
    with pytest.raises(ValueError, match=message) as error:
        parse(text)
    assert "\n" not in str(error.value)
    if text:
        with pytest.raises(ValidationError):
            JobOptions(**{option: text})


@given(BOUNDS.map(", ".join) | st.lists(NUMBERS, min_size=4, max_size=4).map(", ".join) | st.text(max_size=40))
def test_hostile_text_is_parsed_to_moderate_numbers_or_refused_in_one_line(text: str) -> None:
    for parse in (lambda text: parse_region(text).planes, parse_cone):
        try:
            found = np.concatenate([np.ravel(part) for part in parse(text)] or [np.zeros(0)])
        except ValueError as error:
            assert "got" in str(error) and "\n" not in str(error)
        else:
            assert (text.isascii() or not len(found)) and (np.abs(found) <= 1e6).all()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"digits": ("pinky",)}, "thumb"),
        ({"digits": ("thumb",) * 7}, "at most 6"),
        ({"type": "grip"}, "any"),
        ({"avoid_region": "z > 1, " * 40}, "at most 200"),
        ({"method": "dfc", "type": "pinch"}, "method dfc plans any grasps: type requires method fast_graspd"),
        ({"method": "dfc", "touch_region": "z > 0"}, "any grasps: touch-region requires method fast_graspd"),
    ],
)
def test_options_refuse_requirements_before_any_work(options: dict[str, object], message: str) -> None:
    with pytest.raises(ValidationError, match=message):
        JobOptions(**options)


def test_options_without_requirements_state_none_and_keep_the_ids_of_old_jobs() -> None:
    plain, all_set = JobOptions(), JobOptions(type="pinch", digits=("thumb", "index"), approach_cone="0, 0, -1, 30")
    assert plain.requirements == {} and not {"type", "digits", "touch_region"} & set(plain.model_dump())
    assert set(all_set.requirements) == {"type", "digits", "approach_cone"}
    assert JobOptions(type="any", digits=(), touch_region="") == plain

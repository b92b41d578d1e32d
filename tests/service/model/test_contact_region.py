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
        ("z > 0.05", [(0, 0, -1, -0.05)]),
        ("z>0.05,x<.02", [(0, 0, -1, -0.05), (1, 0, 0, 0.02)]),
        (" y < -1e-3 ", [(0, 1, 0, -0.001)]),
        ("x > +2.", [(-1, 0, 0, -2.0)]),
        (", ".join(["z > 0"] * MOST_PLANES), [(0, 0, -1, 0.0)] * MOST_PLANES),
    ],
)
def test_bounds_are_half_spaces(text: str, planes: list[tuple[float, ...]]) -> None:
    assert parse_region(text) == planes


@pytest.mark.parametrize(
    "text",
    [
        *("", "z", "z > ", "w > 1", "z >= 1", "z > 1 mm", "1 < z", "z > 1,", "z > 1; x < 2", "z > 1 x < 2"),
        *("z > nan", "z > inf", "z > 0x10", "z > 1_000", "z > ٣", "Z > 1", "z > 1\n# comment", "z > 1e999"),
        ", ".join(["z > 0"] * (MOST_PLANES + 1)),
    ],
)
def test_other_text_is_refused_as_a_region(text: str) -> None:
    with pytest.raises(ValueError, match=r"bounds in metres, such as z > 0\.05") as error:
        parse_region(text)
    assert "\n" not in str(error.value)


def test_cones_have_an_axis_and_an_angle() -> None:
    assert parse_cone("0, 0, -1, 30") == ((0, 0, -1), 30) and parse_cone("1,2,3,180") == ((1, 2, 3), 180)


@pytest.mark.parametrize(
    "text",
    [
        *("", "0, 0, -1", "0, 0, 0, 30", "0, 0, -1, 0.5", "0, 0, -1, 181", "0, 0, -1, -30", "0, 0, -1, 30, 4"),
        *("a, b, c, d", "0, 0, nan, 30", "0, 0, inf, 30", "0, 0, 1e999, 30", "0 0 -1 30", "0, 0, -1, 30 deg"),
    ],
)
def test_other_text_is_refused_as_a_cone(text: str) -> None:
    with pytest.raises(ValueError, match="an axis and an angle of 1 to 180 degrees") as error:
        parse_cone(text)
    assert "\n" not in str(error.value)


@given(BOUNDS.map(", ".join) | st.lists(NUMBERS, min_size=4, max_size=4).map(", ".join) | st.text(max_size=40))
def test_hostile_text_is_parsed_to_moderate_numbers_or_refused_in_one_line(text: str) -> None:
    for parse in (parse_region, parse_cone):
        try:
            found = np.concatenate([np.ravel(part) for part in parse(text)])
        except ValueError as error:
            assert "got" in str(error) and "\n" not in str(error)
        else:
            assert text.isascii() and (np.abs(found) <= 1e6).all()


@pytest.mark.parametrize(
    "options",
    [
        *({name: text} for name in ("touch_region", "avoid_region") for text in ("up", "z > 1, " * 40)),
        *({"approach_cone": text} for text in ("up", "0, 0, 0, 30", "0, " * 40)),
        *({"digits": names} for names in (("pinky",), ("thumb",) * 7)),
        {"type": "grip"},
        *({"method": "dfc", **one} for one in ({"type": "pinch"}, {"digits": ("thumb", "index")})),
        {"method": "dfc", "touch_region": "z > 0"},
    ],
)
def test_options_refuse_requirements_before_any_work(options: dict[str, object]) -> None:
    with pytest.raises(ValidationError):
        JobOptions(**options)


def test_options_without_requirements_state_none_and_keep_the_ids_of_old_jobs() -> None:
    plain, all_set = JobOptions(), JobOptions(type="pinch", digits=("thumb", "index"), approach_cone="0, 0, -1, 30")
    assert plain.requirements == {} and not {"type", "digits", "touch_region"} & set(plain.model_dump())
    assert set(all_set.requirements) == {"type", "digits", "approach_cone"}
    assert JobOptions(type="any", digits=(), touch_region="") == plain
    with pytest.raises(ValidationError, match="method dfc plans any grasps: touch-region requires method fast_graspd"):
        JobOptions(method="dfc", touch_region="z > 0")

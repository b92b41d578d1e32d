"""Options are declared once; messages name them as the caller spells them."""

from __future__ import annotations

import inspect
from typing import Any

import pytest

import graspd
from service.command_options import validated
from service.model.domain import JobOptions, JobRequest
from service.model.errors import InputError
from service.model.local_options import LocalOptions
from service.model.options import rows, type_text


@pytest.mark.parametrize("join", ["0", 0, -1, "many", 1.5, ""])
def test_join_is_named_as_the_caller_spells_it(join: Any) -> None:
    line = f"join: must be a number of batches from 1 to 9999, or auto; got {join!r}"
    with pytest.raises(InputError) as typed:
        validated(LocalOptions, {"join": join})
    assert str(typed.value) == f"--{line}"
    with pytest.raises(InputError) as called:
        graspd.synthesize("barrett", "block", join=join)
    assert str(called.value) == line


@pytest.mark.parametrize(
    ("wrong", "typed", "called"),
    [
        ({"grasps": 0}, "--grasps: ", "count: "),
        ({"neighbours": ["mug"] * 9}, "--with: ", "beside: "),
        ({"options": {"a": None}}, "--option: ", "options.a"),
        ({"min_payload": -1}, "--min-payload: ", "min_payload: "),
        ({"payload": "perhaps"}, "--payload: ", "payload: "),
    ],
)
def test_every_message_is_in_the_words_of_the_caller(wrong: dict[str, Any], typed: str, called: str) -> None:
    with pytest.raises(InputError) as refused:
        validated(LocalOptions, wrong)
    assert str(refused.value).startswith(typed)
    names = {row.name: row.keyword for row in rows(LocalOptions, "python")}
    with pytest.raises(InputError) as refused:
        graspd.synthesize("barrett", "block", **{names[name]: value for name, value in wrong.items()})  # type: ignore[arg-type]
    assert str(refused.value).startswith(called)


def test_a_keyword_that_is_none_is_a_type_error() -> None:
    with pytest.raises(TypeError, match=r"^synthesize\(\) got an unexpected keyword argument 'views'$"):
        graspd.synthesize("barrett", "block", views=3)  # type: ignore[call-arg]


def test_a_field_without_an_option_is_no_option_of_anybody() -> None:
    assert {row.name for row in rows(JobRequest, "job")} == set(JobOptions.model_fields)


@pytest.mark.parametrize("most", [1_000_000])
def test_the_command_and_python_take_as_many_grasps(most: int) -> None:
    assert LocalOptions(grasps=most).grasps == most
    assert {row.name: row.bounds for row in rows(LocalOptions, "synth")}["grasps"] == {"ge": 1, "le": most}


def test_the_signature_has_defaults_and_plain_types() -> None:
    shown = inspect.signature(graspd.synthesize).parameters
    assert (shown["count"].default, shown["count"].annotation) == (32, "int")
    assert (shown["scene"].default, shown["scene"].annotation) == ("free", "str | Path")
    assert (shown["touch"].default, shown["touch"].annotation) == (None, "float | None")
    assert all(one.kind is one.KEYWORD_ONLY for name, one in shown.items() if name not in ("hand", "object"))
    assert "views" in inspect.signature(graspd.Client.submit).parameters


def test_types_lose_their_bounds_and_keep_their_choices() -> None:
    types = {name: type_text(field.annotation) for name, field in JobOptions.model_fields.items()}
    assert types["mass"] == "float | None"
    assert types["want"] == 'Literal["valid", "raw"]'
    assert types["neighbours"] == "Sequence[str | Mapping[str, Any]]"
    assert types["options"] == "Mapping[str, int | float | str]"

"""Options are declared once; messages name them as the caller spells them."""

from pathlib import Path
from typing import Any

import pytest
import trimesh

import graspd
from graspd.service.command_options import validate_options
from graspd.service.docs import STUB, keywords_stub
from graspd.service.model.domain import JobOptions, JobRequest
from graspd.service.model.errors import InputError
from graspd.service.model.local_options import LocalOptions
from graspd.service.model.options import option_rows
from tests.conftest import REPOSITORY


@pytest.mark.parametrize(
    ("wrong", "typed", "called"),
    [
        ({"grasps": 0}, "--grasps: ", "grasps: "),
        ({"neighbours": ["mug"] * 9}, "--with: ", "neighbours: "),
        ({"options": "steps"}, "--option: ", "options: "),
        ({"min_payload": -1}, "--min-payload: ", "min_payload: "),
        ({"payload": "perhaps"}, "--payload: ", "payload: "),
        ({"join": "many"}, "--join: must be a number of batches from 1 to 9999, or auto; got 'many'", "join: must be"),
        ({"friction": 9}, "--friction: ", "friction: must be more than 0 and at most 3; got 9"),
        ({"fidelity": "paint"}, "--fidelity: unknown fidelity 'paint'; choose one of", "fidelity: unknown"),
        ({"threads": -1}, "--threads: ", "threads: must be at least 0; got -1"),
    ],
)
def test_every_message_is_in_the_words_of_the_caller(wrong: dict[str, Any], typed: str, called: str) -> None:
    with pytest.raises(InputError) as refused:
        validate_options(LocalOptions, wrong)
    assert str(refused.value).startswith(typed)
    with pytest.raises(InputError) as refused:
        graspd.synthesize("barrett", "block", **wrong)
    assert str(refused.value).startswith(called)


def test_a_fix_is_in_the_words_of_the_caller(tmp_path: Path) -> None:
    trimesh.creation.box((60, 60, 60)).export(tmp_path / "box.stl")
    with pytest.raises(graspd.MeshError, match=r"; units mm makes it .*scale_to 0\.1") as refused:
        graspd.synthesize("barrett", tmp_path / "box.stl")
    assert "--" not in str(refused.value) and refused.value.facts["options_suggested"]  # type: ignore[attr-defined]


def test_a_keyword_that_is_none_is_a_type_error() -> None:
    with pytest.raises(TypeError, match=r"^synthesize\(\) got an unexpected keyword argument 'views'$"):
        graspd.synthesize("barrett", "block", views=3)  # type: ignore[call-arg]


def test_a_field_without_an_option_is_no_option_of_anybody() -> None:
    assert {row.name for row in option_rows(JobRequest, "job")} == set(JobOptions.model_fields)


@pytest.mark.parametrize("kind", [str, Path])
def test_an_option_of_the_planner_may_be_a_file_with_a_long_path(kind: type, tmp_path: Path) -> None:
    file = kind(tmp_path / f"{'x' * 100}.npz")
    with pytest.raises(InputError, match=r"xxx\.npz"):
        graspd.synthesize("barrett", "mug", scene="table", method="learned", options={"network": file})
    with pytest.raises(InputError, match=r"^options\.steps: must"):
        graspd.synthesize("barrett", "mug", method="graspit", options={"steps": "x" * 100})


def test_the_types_of_keywords_are_up_to_date() -> None:
    assert (REPOSITORY / STUB).read_text() == keywords_stub(), "run: make docs"

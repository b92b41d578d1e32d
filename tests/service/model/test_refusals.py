"""What a model refuses is said in this project's words."""

from __future__ import annotations

from typing import Any, Literal

import pytest
from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator

from graspd.service.model.base import Name, refusal


class Kind(BaseModel):
    model_config = ConfigDict(extra="forbid")

    n: int = Field(1, ge=1, le=9)
    share: float = Field(0.5, gt=0, lt=1)
    on: bool = True
    name: Name = "mug"
    fidelity: Literal["draft", "standard", "fine"] = "draft"
    text: str = Field("", max_length=3)
    names: tuple[str, ...] = Field((), max_length=1)

    @field_validator("text")
    @classmethod
    def _no_x(cls, text: str) -> str:
        if text == "x":
            raise ValueError("x is taken")
        return text


@pytest.mark.parametrize(
    ("given", "line"),
    [
        ({"n": 0}, "n: must be at least 1"),
        ({"n": 10}, "n: must be at most 9"),
        ({"n": "many"}, "n: must be a whole number"),
        ({"n": 1.5}, "n: must be a whole number"),
        ({"share": 0}, "share: must be more than 0"),
        ({"share": 1}, "share: must be less than 1"),
        ({"share": "half"}, "share: must be a number"),
        ({"on": "perhaps"}, "on: must be true or false"),
        (
            {"name": "a/b"},
            "name: must begin with a letter or digit and hold at most 64 letters, digits, dots, dashes and underscores",
        ),
        ({"fidelity": "strandard"}, "fidelity: must be one of draft, standard, fine; did you mean standard?"),
        ({"fidelity": 3}, "fidelity: must be one of draft, standard, fine"),
        ({"text": "long"}, "text: must have at most 3 characters"),
        ({"text": "x"}, "text: x is taken"),
        ({"names": ["a", "b"]}, "names: must have at most 1 item"),
        ({"knob": 1}, "knob: is not known"),
    ],
)
def test_the_first_mistake_is_one_line(given: dict[str, Any], line: str) -> None:
    with pytest.raises(ValidationError) as refused:
        Kind.model_validate(given)
    assert refusal(refused.value).startswith(line)
    assert "nput should" not in refusal(refused.value)
